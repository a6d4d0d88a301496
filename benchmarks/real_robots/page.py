"""The benchmark's table, figure and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.files import write_text
from gaponet.base.result_table import ResultTable
from gaponet.evaluation.methods import colour, shade
from gaponet.report.figures.style import figure, legend, save, styled
from gaponet.sim.metrics import standard_error
from real_robots.methods import LEFT_OUT, METHODS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOKS = {  # method's title → colour, marker
    "constant offset by joint, payload, unit": (colour("offset"), "x"),
    "delay + offset": (colour("delay_offset"), "s"),
    "identified elsewhere": (shade(colour("identified"), 0.5), "o"),
    "identification": (colour("identified"), "o"),
    "identified elsewhere, adapted": (colour("adapted"), "D"),
    "shared MLP": (colour("shared_mlp"), "^"),
    "GAPONet": (colour("gaponet"), "^"),
    "identification + GAPONet": (colour("identified+gaponet"), "v"),
}
MAX_OF_NOMINAL = 1.6  # end of the figure's axis; larger values are drawn at it
COLUMNS = ("set", "question", "method", "mrad", "of nominal", "less than nominal, mrad",
           "more than identification, mrad", "floor", "motions")  # fmt: skip
STEM = "real"
HEADING = """# Real robots

This table is what `benchmarks/compare_methods.py` writes ([compare your method](../benchmark.md)): errors in mrad on
public recordings of real robots, of motions that no method was fitted to. Each simulation starts at the recorded state
and then receives only commands.

± is the standard error over independent motions; differences are paired, motion by motion. "Floor" is the difference
between two recordings of one command. "Identified elsewhere" means on another session or unit."""


def result_table(rows: list[dict[str, Any]]) -> ResultTable:
    """One row per data set, question and method, from Bench.evaluate."""
    fitted = {(r["set"], r["question"]): r for r in rows if r["method"] == METHODS["identified"][0]}
    return ResultTable(STEM, COLUMNS, tuple(
        (r["set"], r["question"], r["method"] + _left_out(r.get("notes", ())),
         _plus_minus(r["mrad"], r["standard_error"]), f"{r['of_nominal']:.2f}",
         "" if i == 0 or not r["less_than_nominal"] else _plus_minus(r["less_than_nominal"], r["less_standard_error"]),
         _more_than(fitted.get((r["set"], r["question"])), r),
         "–" if r["floor_mrad"] is None else f"{r['floor_mrad']:.1f}", r["motions"])
        for i, r in enumerate(rows)
    ))  # fmt: skip


def _more_than(fitted: dict[str, Any] | None, row: dict[str, Any]) -> str:
    """Return how much larger a row's error is than that of identification, ± over motions; "" if it
    is no rival.
    """
    if fitted in (None, row) or not (fitted.keys() & row.keys() >= {"by_motion_mrad"}):
        return ""
    more = np.array(
        [row["by_motion_mrad"][motion] - mrad for motion, mrad in fitted["by_motion_mrad"].items()]
    )
    return _plus_minus(more.mean(), standard_error(more) if len(more) > 1 else None)


def _left_out(notes: tuple[str, ...]) -> str:
    """Say in how many folds validation rejected the network."""
    count = sum(note.startswith(LEFT_OUT) for note in notes)
    return f" ({LEFT_OUT} in {count} of {len(notes)})" if count else ""


def _plus_minus(value: float, error: float | None) -> str:
    return f"{value:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def write_page(result: dict[str, Any], out: Path) -> list[Path]:
    """Write JSON, Markdown and figure of Bench.run into a folder. Return the files."""
    out.mkdir(parents=True, exist_ok=True)
    rows = result["rows"]
    write_text(out / f"{STEM}.json", json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    parts = [HEADING, f"![Error of each method as a share of the nominal error]({STEM}.png)"]
    parts.append(result_table(rows).markdown())
    write_text(out / f"{STEM}.md", "\n\n".join(parts) + "\n")
    figures = save(draw(rows, result["cards"]), out / STEM) if rows else []
    return [out / f"{STEM}.md", out / f"{STEM}.json", *figures]


@styled
def draw(rows: list[dict[str, Any]], titles: dict[str, str]) -> Figure:
    """Draw each method's share of the nominal error, a line for each question; shaded:
    repeatability of the robot.
    """
    keys = list(dict.fromkeys((r["set"], r["question"]) for r in rows))
    fig = figure(7.2, 0.5 * len(keys) + 1.5)
    ax = fig.subplots()
    names = [titles.get(name, name).partition(",")[0] + f": {question}" for name, question in keys]
    lines = {y: [r for r in rows if (r["set"], r["question"]) == key] for y, key in enumerate(keys)}
    for y, (first, *_) in lines.items():
        if first["floor_mrad"] is not None:
            ax.barh(y, first["floor_mrad"] / first["mrad"], 0.86, color="#111111", alpha=0.1, lw=0,
                    label="repetitions differ by")  # fmt: skip
    for method, (own, marker) in LOOKS.items():  # the nominal simulator is the vertical line
        for y, (first, *others) in lines.items():
            drawn = [r for r in others if r["method"] in LOOKS]
            for i, r in enumerate(drawn):
                if r["method"] == method:
                    x, error = r["of_nominal"], (r["standard_error"] or 0.0) / first["mrad"]
                    ax.errorbar(min(x, MAX_OF_NOMINAL), y + 0.76 * ((i + 0.5) / len(drawn) - 0.5), xerr=error or None,
                                fmt=marker if x <= MAX_OF_NOMINAL else ">", ms=4, color=own, elinewidth=0.8,
                                label=method.partition(" by ")[0])  # fmt: skip
    for y in range(1, len(keys)):
        ax.axhline(y - 0.5, color="#111111", alpha=0.08, lw=0.6, zorder=0)
    ax.axvline(1.0, color=colour("nominal"), lw=1.2, zorder=0, label="nominal simulator")
    ax.set_yticks(np.arange(len(keys)), names)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(keys) - 0.5, -0.5)
    ax.set_xlim(0.0, max(1.05, min(1.05 * max(r["of_nominal"] for r in rows), MAX_OF_NOMINAL)))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("mean |error|, of the nominal simulator's")
    legend(fig)
    return fig
