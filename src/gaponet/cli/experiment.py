"""gaponet experiment: one question each, from trainings to tables, figures and a report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet.cli.experiment_unit import delivery, tracking
from gaponet.cli.inputs import open_dataset
from gaponet.cli.out import Out, show_result, writes
from gaponet.cli.progress import bars
from gaponet.study.options import Options

if TYPE_CHECKING:
    from gaponet.study.pool import Cell
    from gaponet.study.result import Result
    from gaponet.study.study import Show, Study

Shared = Annotated[Options, tyro.conf.arg(name="")]
MODELS = ("gaponet", "mlp:mlp_match=on")


@writes("experiments")
def ablation(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    holdout_units: tuple[str, ...] = (),
    bound_seeds: int = 1,
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Table 2 of the paper and our own switches: what each choice of the operator is worth, one changed at a time.

    The same command again goes on where it was. About an hour and a half on two cores; --quick in under five minutes.

    Args:
        dataset: Dataset folder.
        out: Folder of the results; its report.html shows all experiments in it.
        holdout_units: Units never trained on; shown in a column of their own.
        bound_seeds: Seeds of oracle and learned sensors, for which the simulator itself is asked: ten times as long.
            0, or --quick, leaves them out.
        options: Shared.
    """
    import gaponet.study.ablation as table2

    study = _study(dataset, out, options, holdout_units)
    bound_seeds = 0 if options.quick else bound_seeds
    cells = table2.cells(study, table2.rows(study)[0], bound_seeds)
    _carry_out(study, cells, lambda show: table2.run(study, bound_seeds, show), options)


@writes("experiments")
def payload(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    between: float | None = None,
    beyond: float | None = None,
    holdout_units: tuple[str, ...] = (),
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Payloads never trained on, one between those trained on and one beyond them, told the mass and not told.

    Args:
        dataset: Dataset folder with three payloads or more.
        out: Folder of the results.
        between: kg left out on the inside; default the heaviest but one.
        beyond: kg left out on the outside; default the heaviest.
        holdout_units: Units never trained on.
        options: Shared.
    """
    import gaponet.study.payload as experiment

    study = _study(dataset, out, options, holdout_units)
    asked = experiment.questions(study.data, between, beyond)
    _carry_out(study, experiment.cells(study, asked), lambda show: experiment.run(study, asked, show), options)


@writes("experiments")
def unit(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    models: tuple[str, ...] = MODELS,
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Leave one unit out, each in turn: how well is a unit served that training never saw?

    Args:
        dataset: Dataset folder with two units or more.
        out: Folder of the results.
        models: As of gaponet compare.
        options: Shared.
    """
    import gaponet.study.unit as experiment

    study = _study(dataset, out, options)
    cells = [c for fold in experiment.cells(study, models).values() for c in fold]
    _carry_out(study, cells, lambda show: experiment.run(study, models, show), options)


@writes("experiments")
def data(
    dataset: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    models: tuple[str, ...] = MODELS,
    shares: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0),
    holdout_units: tuple[str, ...] = (),
    options: Shared = Options(),  # noqa: B008
) -> None:
    """Error against hours of training data: how much must be recorded?

    Args:
        dataset: Dataset folder.
        out: Folder of the results.
        models: As of gaponet compare.
        shares: Parts of the training motions.
        holdout_units: Units never trained on.
        options: Shared.
    """
    import gaponet.study.data as experiment

    study = _study(dataset, out, options, holdout_units)
    cells = experiment.cells(study, models, shares)
    _carry_out(study, cells, lambda show: experiment.run(study, models, shares, show), options)


# Each is run while the command line is parsed; what is left to call is nothing.
Action = (
    Annotated[None, tyro.conf.subcommand("ablation", constructor=ablation)]
    | Annotated[None, tyro.conf.subcommand("payload", constructor=payload)]
    | Annotated[None, tyro.conf.subcommand("unit", constructor=unit)]
    | Annotated[None, tyro.conf.subcommand("data", constructor=data)]
    | Annotated[None, tyro.conf.subcommand("tracking", constructor=tracking)]
    | Annotated[None, tyro.conf.subcommand("delivery", constructor=delivery)]
)


def experiment(action: Annotated[tyro.conf.OmitSubcommandPrefixes[Action], tyro.conf.arg(name="")]) -> None:
    """Experiments with a question each: tables, figures and sentences in OUT, one report.html over all."""


def _study(dataset: Path, out: Path, options: Options, holdout_units: tuple[str, ...] = ()) -> Study:
    from gaponet.study.study import Study

    opened, robot = open_dataset(dataset, options.robot)
    return Study.of(opened, robot, out, options, holdout_units)


def _carry_out(study: Study, cells: list[Cell], run: Callable[[Show], Result], options: Options) -> None:
    """Say how long it will take, train, and show what came out."""
    from gaponet.study.study import expected_s

    screen, todo = Out(options.json), sum(not c.done for c in cells)
    words = len({c.variant.name for c in cells})
    minutes = expected_s(cells, study) / 60
    rest = f"about {minutes:.0f} minutes" if minutes > 1.5 else "about a minute"
    screen.say(
        f"{len(cells)} trainings ({words} settings), {len(cells) - todo} there already"
        + (f"; the others take {rest}, {study.processes} at a time" if todo else "")
    )
    with bars("trainings", todo) as show:
        result = run(show)
    show_result(result, study.out, screen)
