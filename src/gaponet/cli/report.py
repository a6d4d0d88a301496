"""gaponet report."""

from __future__ import annotations

from pathlib import Path

from gaponet.base.progress import progress_bar
from gaponet.cli.gap import show_verdict
from gaponet.cli.options import Json, Known, Robot
from gaponet.cli.out import Out
from gaponet.report.run_files import read_metrics
from gaponet.report.view.portrait import portrait, prepare


def report(
    run: Known, dataset: Path | None = None, also: tuple[Path, ...] = (), robot: Robot = None, json: Json = False
) -> None:
    """Write one offline HTML page about an identified robot or a run.

    Args:
        dataset: Dataset folder to evaluate on; default the one of the last evaluation, where it still is.
        also: Further runs to compare, e.g. the MLP's.
    """
    prepare()
    from gaponet.report.report import write_report

    out = Out(json)
    with progress_bar("report") as update:
        path = write_report(run, dataset, also, robot, update, portrait)
    out.say(f"report: {path}")
    metrics = read_metrics(run)
    show_verdict(out, metrics["methods"], str(dataset or metrics["dataset"]), run, reported=True)
    out.result({"report": str(path)})
