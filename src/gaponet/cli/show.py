"""Tables and sentences about errors, for several commands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaponet.base.result_table import ResultTable
from gaponet.cli.out import Out
from gaponet.evaluation.tables import by_group, mrad, totals
from gaponet.evaluation.verdict import next_step, verdict

UNITS = {"payload": ", kg", "horizon": " (time since the start, s)"}
GROUPS = ("joint", "payload", "unit", "horizon", "motion")
SHOWN = 4  # columns of the totals that a screen has room for


def show_verdict(
    out: Out,
    methods: dict[str, Any],
    dataset: str,
    folder: Path | None,
    baselines: Mapping[str, float] | None = None,
) -> None:
    """Print the verdict and the next command. The folder is that of a robot or a run, or None."""
    for sentence in verdict(methods, baselines):
        out.say(sentence)
    out.next(next_step(methods, dataset, folder))


def baseline_rows(baselines: Mapping[str, float]) -> list[list[str]]:
    """Return rows of title and error, mrad, of predictions that need no identified simulator."""
    return [
        ["delay + offset of the nominal simulator", mrad(baselines["delay_offset"])],
        ["the command itself, delayed and offset", mrad(baselines["command"])],
    ]


def show_baselines(out: Out, baselines: Mapping[str, float], motions: int) -> None:
    """Print the errors of predictions that need no identified simulator, measured on so many
    motions.
    """
    fitted_to = "other motions" if motions > 1 else "the same motion"
    title = f"Without an identified simulator; delay and offset of each joint fitted to {fitted_to}"
    out.table(title, ["prediction", "error, mrad"], baseline_rows(baselines))


def show_methods(out: Out, result: dict[str, Any], groups: tuple[str, ...] = GROUPS) -> None:
    """The tables of gap and eval: totals by method, then by each group."""
    methods = result["methods"]
    kind = "VIRTUAL robot" if result["virtual"] else "real robot"
    out.say(
        f", {kind}, {result['sequences']} recordings, open-loop rollouts of whole motions",
        result["robot"],
    )
    whole = totals(methods)
    out.show(
        "Error of each method",
        ResultTable("", whole.columns[:SHOWN], tuple(row[:SHOWN] for row in whole.rows)),
    )
    for group in groups:
        if group not in ("payload", "unit") or len(methods["nominal"][f"by_{group}"]) > 1:
            out.show(f"Mean |error| by {group}{UNITS.get(group, '')}", by_group(methods, group))
