"""gaponet report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Json, Known, Robot
from gaponet.cli.out import Out
from gaponet.evaluation.methods import method, title
from gaponet.evaluation.run_files import read_config, read_metrics, read_progress
from gaponet.evaluation.verdict import next_step, verdict
from gaponet.nn.artifact import CARD, GapModel
from gaponet.report.view.gl import prepare
from gaponet.robot.folder import load_stored_robot


def report(
    run: Known = Path("."), dataset: Path | None = None, robot: Robot = None,
    list_runs: Annotated[Flag, tyro.conf.arg(name="list")] = False, json: Json = False,
) -> None:  # fmt: skip
    """Write one offline HTML page about an identified robot or a run.

    Args:
        list_runs: Instead, list the training runs in this folder and below, best first.
        dataset: Dataset folder to evaluate on. Default: the dataset of the last evaluation.
    """
    if list_runs:
        _show_runs(Out(json), run)
        return
    prepare()
    from gaponet.report.report import write_report
    from gaponet.report.view.picture import portrait

    out = Out(json)
    with progress_bar("report") as update:
        path = write_report(run, dataset, robot, update, portrait)
    metrics = read_metrics(run)
    out.say(" ".join(verdict(metrics["methods"])), "result: ", "bold green")
    out.say(f"report: {path}")
    out.next(next_step(metrics["methods"], str(dataset or metrics["dataset"]), run, reported=True))
    out.result({"report": str(path)})


def _show_runs(screen: Out, folder: Path) -> None:
    """List the training runs in a folder and below it, best first."""
    runs = [
        _facts(p.parent, folder)
        for p in sorted(folder.rglob("config.json"))
        if (p.parent / "split.json").is_file()
    ]
    if not runs:
        raise UsageError(
            f"{folder}: no run here or below (a run has config.json and split.json); train one first"
        )
    runs.sort(key=lambda r: r["val_ratio"] if r["val_ratio"] is not None else float("inf"))
    screen.table(
        f"Runs in {folder}: mean |error| of validation and test motions, mrad (of nominal)",
        ["run", "model", "seed", "minutes", "validation", "evaluated"],
        [
            [r["run"], title(r["model"]), str(r["seed"]), "" if r["seconds"] is None else f"{r['seconds'] / 60:.1f}",
             _error(r["val_mpjae"], r["val_ratio"]), _error(r["test_mpjae"], r["test_ratio"])]
            for r in runs
        ],
    )  # fmt: skip
    if any(r["virtual"] for r in runs):
        screen.say("Runs marked V were trained on VIRTUAL robots.")
    screen.result({"runs": runs})


def _facts(run: Path, folder: Path) -> dict[str, Any]:
    """Return facts from the files of a run; None for those that are not written yet."""
    config, last = read_config(run), _last(run)
    kind, file = config["model"]["kind"], run / "model" / CARD
    card = GapModel.read_card(file)[0] if file.is_file() else {}
    metrics = read_metrics(run) if (run / "metrics.json").is_file() else {}
    val = card.get("val_mpjae", {"model": last.get("best"), "nominal": last.get("nominal_mpjae")})
    own = method(kind, load_stored_robot(run, config["robot"]))
    measured = metrics.get("methods", {}).get(own, {})
    virtual = bool(card.get("virtual", False))
    return {
        "run": str(run.relative_to(folder)) + (" V" if virtual else ""),
        "model": own,
        "seed": config["seed"],
        "robot": config["robot"],
        "virtual": virtual,
        "dataset_hash": config["dataset_hash"],
        "simulator": card.get("simulator"),
        "hours": card.get("hours"),
        "steps": card.get("steps", last.get("steps")),
        "seconds": card.get("seconds", last.get("seconds")),
        "finished": bool(card) and not card.get("interrupted", False),
        "val_mpjae": val["model"],
        "val_ratio": val["model"] / val["nominal"] if val["model"] and val["nominal"] else None,
        "evaluated_on": metrics.get("dataset"),
        "test_mpjae": measured.get("mpjae"),
        "test_ratio": metrics.get("ratio_to_nominal", {}).get(own),
    }


def _last(run: Path) -> dict[str, Any]:
    """The newest line of a training curve, and the best validation so far."""
    lines = read_progress(run)
    return (lines[-1] | {"best": min(line["val_mpjae"] for line in lines)}) if lines else {}


def _error(mpjae: float | None, ratio: float | None) -> str:
    return "" if mpjae is None or ratio is None else f"{mpjae * 1e3:.2f} ({ratio:.2f})"
