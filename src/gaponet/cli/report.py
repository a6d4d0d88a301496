"""gaponet report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet.base.progress import progress_bar
from gaponet.cli.gap import show_verdict
from gaponet.cli.options import Flag, Json, Known, Robot
from gaponet.cli.out import Out
from gaponet.cli.runs import show_runs
from gaponet.report.run_files import read_metrics
from gaponet.report.view.portrait import portrait, prepare


def report(
    run: Known = Path("."), dataset: Path | None = None, also: tuple[Path, ...] = (), robot: Robot = None,
    list_runs: Annotated[Flag, tyro.conf.arg(name="list")] = False, json: Json = False,
) -> None:  # fmt: skip
    """Write one offline HTML page about an identified robot or a run.

    Args:
        list_runs: List the training runs in this folder and below it, best first, instead.
        dataset: Dataset folder to evaluate on; default the one of the last evaluation, where it still is.
        also: Further runs to compare, e.g. the MLP's.
    """
    if list_runs:
        show_runs(Out(json), run)
        return
    prepare()
    from gaponet.report.report import write_report

    out = Out(json)
    with progress_bar("report") as update:
        path = write_report(run, dataset, also, robot, update, portrait)
    out.say(f"report: {path}")
    metrics = read_metrics(run)
    show_verdict(out, metrics["methods"], str(dataset or metrics["dataset"]), run, reported=True)
    out.result({"report": str(path)})
