"""gaponet report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet.api.pages import TrainedRun, trained_runs, write_report
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Json, Known, Robot
from gaponet.cli.out import Out
from gaponet.evaluation.methods import title
from gaponet.evaluation.verdict import next_step, verdict

RUN_COLUMNS = ["run", "model", "seed", "minutes", "validation", "evaluated"]


def report(
    run: Known = Path("."),
    dataset: Path | None = None,
    robot: Robot = None,
    list_runs: Annotated[Flag, tyro.conf.arg(name="list")] = False,
    json: Json = False,
) -> None:
    """Write one offline HTML page about an identified robot or a run.

    Args:
        list_runs: Instead, list the training runs in this folder and below, best first.
        dataset: Dataset folder to evaluate on. Default: the dataset of the last evaluation.
    """
    screen = Out(json)
    if list_runs:
        _show_runs(screen, run, trained_runs(run))
        return
    with progress_bar("report") as update:
        made = write_report(run, dataset=dataset, robot=robot, progress=update)
    screen.say(" ".join(verdict(made.methods)), "result: ", "bold green")
    screen.say(f"report: {made.path}")
    screen.next(next_step(made.methods, made.dataset, run, reported=True))
    screen.result(made.to_dict())


def _show_runs(screen: Out, folder: Path, runs: list[TrainedRun]) -> None:
    """Print training runs, best first."""
    heading = f"Runs in {folder}: mean |error| of validation and test motions, mrad (of nominal)"
    screen.table(heading, RUN_COLUMNS, [_row(run) for run in runs])
    if any(run.virtual for run in runs):
        screen.say("Runs marked V were trained on VIRTUAL robots.")
    screen.result({"runs": [run.to_dict() for run in runs]})


def _row(run: TrainedRun) -> list[str]:
    return [
        run.run,
        title(run.model),
        str(run.seed),
        "" if run.seconds is None else f"{run.seconds / 60:.1f}",
        _error(run.val_mpjae, run.val_ratio),
        _error(run.test_mpjae, run.test_ratio),
    ]


def _error(mpjae: float | None, ratio: float | None) -> str:
    if mpjae is None or ratio is None:
        return ""
    return f"{mpjae * 1e3:.2f} ({ratio:.2f})"
