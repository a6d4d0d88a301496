"""gaponet experiment: from trainings to tables, figures and a report."""

from __future__ import annotations

import inspect
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.progress import progress_bar, progress_bars
from gaponet.cli.options import Json, actions
from gaponet.cli.out import Out, writes
from gaponet.experiments.cells import Cell
from gaponet.experiments.compare import Compare, with_identified
from gaponet.experiments.outcomes import train_all
from gaponet.experiments.result import Result
from gaponet.experiments.study import Options, Study
from gaponet.experiments.variant import parse_variant
from gaponet.experiments.virtual.delivery import Delivery
from gaponet.experiments.virtual.paper import Paper
from gaponet.experiments.virtual.play import load_trained
from gaponet.experiments.virtual.session import Session, UnitExperiment
from gaponet.experiments.virtual.tracking import Tracking
from gaponet.nn.training.config import TrainConfig
from gaponet.share.reading import open_dataset

if TYPE_CHECKING:
    from gaponet.data.store import Dataset
    from gaponet.robot.spec import RobotSpec

FLAT = tyro.conf.arg(name="")
Shared = Annotated[Options, FLAT]
EXPERIMENTS = (Compare, Paper, Tracking, Delivery)
DEFAULTS = {Compare: Options(budget="10m", config=TrainConfig())}


def _compare(
    experiment: Compare, data: Dataset, robot: RobotSpec, out: Path, options: Options
) -> None:
    """Train, and show the result."""
    study = Study.from_options(
        data, robot, out, options, holdout_units=experiment.holdout_units, one_rate=False
    )
    if experiment.identify:
        study = _identified(experiment, study)
    screen, cells = Out(options.json), experiment.cells(study)
    with _trainings(cells, screen) as show:
        result = experiment.run(study, show)
    _show_result(result, study.out, screen)
    if failed := sum(not c.done for c in cells):
        raise ModelError(
            f"{failed} trainings failed; the tables are of the others. Run it again to retry"
        )


def _identified(experiment: Compare, study: Study) -> Study:
    """Check the models, then identify the simulator."""
    if study.robot.nominal is not None:
        raise UsageError(
            f"--identify: robot {study.robot.folder} is an identified one; all models start from it"
        )
    for word in experiment.models:
        parse_variant(word, study.config)
    with progress_bar("identifying") as update:
        return with_identified(study, update)


def _on_unit(
    experiment: UnitExperiment, data: Dataset, robot: RobotSpec, out: Path, options: Options
) -> None:
    """Train GAPONet and an MLP if no runs are given, run the experiment, and show the result."""
    data.require_robot(robot)
    experiment.require(data)
    experiment = experiment.quick() if options.quick else experiment
    screen, runs = Out(options.json), experiment.runs
    study, cells = None, list[Cell]()
    if not runs:
        study = experiment.study(data, robot, out, options)
        cells = experiment.cells(study)
        with _trainings(cells, screen) as show:
            failed = train_all(cells, study, show)
        if failed:
            raise UsageError(f"{failed[0]}; run it again to retry")
        runs = experiment.evaluated(cells)
    trained_on, nominal = data if study is None else study.data, robot.nominal or robot
    session = Session(
        experiment, trained_on, nominal, load_trained(runs, nominal), study, tuple(cells)
    )
    with progress_bar("playing") as update:
        result = experiment.run(session, lambda step, share: update(share, 1.0, step))
    _show_result(result, out if study is None else study.out, screen)


def _trainings(cells: list[Cell], screen: Out) -> Any:
    """Say how many trainings there are, and open their progress bars."""
    todo = sum(not c.done for c in cells)
    settings = len({c.variant.name for c in cells})
    screen.say(f"{len(cells)} trainings ({settings} settings), {len(cells) - todo} there already")
    return progress_bars("trainings", todo)


def _command(kind: type[Any]) -> Any:
    """Return the command of an experiment: its fields are options."""
    usual = DEFAULTS.get(kind, Options())

    def run(dataset: Any, out: Any, experiment: Any, options: Any = usual) -> None:
        import gaponet.experiments.result_files  # noqa: F401  # needs an extra; without it nothing is trained

        if threading.current_thread() is threading.main_thread():
            signal.signal(
                signal.SIGINT, signal.default_int_handler
            )  # options are understood (__main__.py)
        data, robot = open_dataset(dataset, options.robot)
        (_compare if kind is Compare else _on_unit)(experiment, data, robot, out, options)

    place = tyro.conf.Positional[str]
    run.__annotations__ = {
        "dataset": place,
        "out": Path,
        "experiment": Annotated[kind, FLAT],
        "options": Shared,
    }
    trained_on = "" if kind is Compare else " that the models were trained on"
    run.__doc__ = "\n    ".join((
        f"{inspect.getdoc(kind)}\n\nArgs:",
        f"dataset: Dataset folder{trained_on}, or the address (s3://, gs://) of one that was pushed.",
        "out: Folder of the results; its report.html shows all experiments in it.", "experiment: Its options.",
        "options: Shared.",
    ))  # fmt: skip
    return writes("experiments")(run)


def _show_result(result: Result, out: Path, screen: Out) -> None:
    """Write the result's files and print its tables and sentences."""
    from gaponet.experiments.result_files import write

    files = write(result, out)
    screen.say("", result.title)
    screen.say(result.virtual)
    for table in (t for t in result.tables if t.shown):
        screen.show("", table)
        if table.caption:
            screen.say(table.caption)
    for sentence in result.sentences:
        screen.say(f"- {sentence}")
    screen.say(f"written: {', '.join(str(f) for f in files)}")
    screen.result({"name": result.name, "virtual": result.virtual, "facts": dict(result.facts),
                   "sentences": list(result.sentences), "files": [str(f) for f in files],
                   "tables": {t.name: t.record() for t in result.tables if t.shown}})  # fmt: skip


def real(
    data: Path | None = None, out: Path = Path("bench_real"), sets: tuple[str, ...] = (),
    questions: tuple[str, ...] = (), method: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    networks: int = 0, json: Json = False,
) -> None:  # fmt: skip
    """Compare methods on public recordings of real robots.

    Args:
        data: Folder of the public recordings; default GAPONET_DATA, else ../shared/data.
        out: Folder for datasets, table and figure.
        sets: Only these data sets.
        questions: Only these questions, such as "3 kg left out".
        method: A method of your own, FILE.py:FUNCTION; may be repeated.
        networks: Train networks too, for so many control steps each; 0 for none.
    """
    from gaponet.experiments.real.bench import Bench, load_method
    from gaponet.experiments.real.cards import data_folder, read_cards
    from gaponet.experiments.real.methods import METHODS, network_methods
    from gaponet.experiments.real.page import result_table, write_page

    screen = Out(json)
    methods = METHODS | {name: (name, function) for name, function in map(load_method, method)}
    methods |= network_methods(networks) if networks else {}
    result = Bench(read_cards(), data_folder(data), out, methods, screen.say).run(sets, questions)
    screen.show(
        "Real robots, recordings that no method was fitted to", result_table(result["rows"])
    )
    for name, remarks in result["labels"].items():
        screen.say(f" of {name}: {'; '.join(remarks)}", "labels")
    for path in write_page(result, out):
        screen.say(f"written: {path!s}")
    screen.result(result)


@actions(**{kind.__name__.lower(): _command(kind) for kind in EXPERIMENTS}, real=real)
def experiment(action: None) -> None:
    """Run an experiment: the paper, comparisons, real recordings."""
