"""gaponet experiment: one question each, from trainings to tables, figures and a report."""

from __future__ import annotations

import inspect
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.progress import progress_bar, progress_bars
from gaponet.cli.out import Out, writes
from gaponet.experiments.compare import Compare, identified
from gaponet.experiments.data import Data
from gaponet.experiments.found import Question, answer, train_all
from gaponet.experiments.options import Options
from gaponet.experiments.played.delivery import Delivery
from gaponet.experiments.played.paper import Paper
from gaponet.experiments.played.session import Playing, Session, study_to_play
from gaponet.experiments.played.tracking import Tracking
from gaponet.experiments.pool import Cell
from gaponet.experiments.study import Study, expected_s
from gaponet.experiments.unit import Unit
from gaponet.experiments.variant import parse_variant
from gaponet.nn.training.config import TrainConfig
from gaponet.share.reading import open_dataset

if TYPE_CHECKING:
    from gaponet.data.store import Dataset
    from gaponet.robot.spec import RobotSpec

FLAT = tyro.conf.arg(name="")
Shared = Annotated[Options, FLAT]
PLAYED = (Paper, Tracking, Delivery)
DEFAULTS = {Compare: Options(budget="10m", config=TrainConfig())}


def _carry_out(question: Question, study: Study, json: bool) -> None:
    """Say how long it will take, train, and show what came out."""
    from gaponet.cli.show import show_result  # needs an extra, whose lack is told before anything is trained

    screen, cells = Out(json), question.cells(study)
    with _trainings(cells, study, screen) as show:
        result = answer(question, study, show)
    show_result(result, study.out, screen)
    if failed := sum(not c.done for c in cells):
        raise ModelError(f"{failed} trainings failed; the tables are of the others. Run it again to retry")


def _trainings(cells: list[Cell], study: Study, screen: Out) -> Any:
    todo = sum(not c.done for c in cells)
    minutes = expected_s(cells, study) / 60
    rest = f"about {minutes:.0f} minutes" if minutes > 1.5 else "about a minute"
    screen.say(
        f"{len(cells)} trainings ({len({c.variant.name for c in cells})} settings), {len(cells) - todo} there already"
        + (f"; the others take {rest}, {study.at_once} at a time" if todo else "")
    )
    return progress_bars("trainings", todo)


def _ask(kind: type[Any], dataset: str, out: Path, question: Any, options: Options) -> None:
    data, robot = open_dataset(dataset, options.robot)
    if kind in PLAYED:
        _play(question, data, robot, out, options)
        return
    study = Study.of(data, robot, out, options, question.holdout_units, one_rate=kind is not Compare)
    if kind is Compare:
        study = _prepared(question, study)
    _carry_out(question, study, options.json)


def _prepared(question: Compare, study: Study) -> Study:
    """The study with what is asked to be identified first; models that cannot be are refused before that."""
    if not question.identify:
        return study
    if study.robot.nominal is not None:
        raise UsageError(f"--identify: robot {study.robot.folder} is an identified one; all models start from it")
    for word in question.models:
        parse_variant(word, study.config)
    with progress_bar("identifying") as update:
        return identified(study, update)


def _play(question: Playing, data: Dataset, robot: RobotSpec, out: Path, options: Options) -> None:
    """Train GAPONet and an MLP where no runs are given, play, and show what came out."""
    from gaponet.cli.show import show_result

    data.require_robot(robot)
    question.require(data)
    screen, runs, part = Out(options.json), question.runs, data
    study, cells = None, list[Cell]()
    if not runs:
        study = study_to_play(question, data, robot, out, options)
        cells = question.cells(study)
        with _trainings(cells, study, screen) as show:
            failed = train_all(cells, study, show)
        if failed:
            raise UsageError(f"{failed[0]}; run it again to retry")
        runs, part, out = question.played(cells), study.data, study.out
    how = out, options.quick, study, tuple(cells)
    session = Session.of(question, part, data, robot.nominal or robot, runs, *how)
    with progress_bar("playing") as update:
        result = question.play(session, lambda what, share: update(share, 1.0, what))
    show_result(result, out, screen)


def _command(kind: type[Any]) -> Any:
    """A question's command: its fields are options."""
    usual = DEFAULTS.get(kind, Options())

    def ask(dataset: Any, out: Any, question: Any, options: Any = usual) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.default_int_handler)  # options are understood (__main__.py)
        _ask(kind, dataset, out, question, options)

    place = tyro.conf.Positional[str]
    ask.__annotations__ = {"dataset": place, "out": Path, "question": Annotated[kind, FLAT], "options": Shared}
    trained_on = " that the models were trained on" if kind in PLAYED else ""
    ask.__doc__ = "\n    ".join((
        f"{inspect.getdoc(kind)}\n\nArgs:",
        f"dataset: Dataset folder{trained_on}, or the address (s3://, gs://) of one that was pushed.",
        "out: Folder of the results; its report.html shows all experiments in it.", "question: What is asked.",
        "options: Shared.",
    ))  # fmt: skip
    return Annotated[None, tyro.conf.subcommand(kind.__name__.lower(), constructor=writes("experiments")(ask))]


def experiment(action: None) -> None:
    """Run a study: the paper's tables, comparisons, units left out."""


# Each is run while the command line is parsed; what is left to call is nothing.
ACTION: Any = Union[tuple(_command(kind) for kind in (Compare, Unit, Data, *PLAYED))]  # noqa: UP007
experiment.__annotations__["action"] = Annotated[ACTION, tyro.conf.OmitSubcommandPrefixes, FLAT]
