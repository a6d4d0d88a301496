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
    from matplotlib.axes import Axes
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
COLUMNS = (
    "set",
    "question",
    "method",
    "mrad",
    "of nominal",
    "less than nominal, mrad",
    "more than identification, mrad",
    "floor",
    "motions",
)
STEM = "real"
HEADING = """# Real robots

`benchmarks/compare_methods.py` writes this table. It has errors in mrad (1 mrad is 0.057°) on
public recordings of real robots, of recordings that no method was fitted to. Each simulation starts
at the recorded state and then receives only commands. Where a payload or a unit is left out, the
same commands were fitted with other payloads or units; payload and unit are estimated from the
recorded torque, also those of the test. [Compare your
method](../benchmark.md#the-benchmark-of-real-robots) explains the questions and the methods.

± is the standard error over independent motions; differences are paired, motion by motion. "Of
nominal" is the error divided by that of the nominal simulator, which is the robot as its maker's
file describes it. "Floor" is the difference between two recordings of one command; where errors are
as small, differences between methods may be chance. "Identified elsewhere" means on another session
or unit."""


def result_table(rows: list[dict[str, Any]]) -> ResultTable:
    """Return a row for each data set, question and method, from Bench.evaluate."""
    identification = METHODS["identified"][0]
    identified = {}
    for row in rows:
        if row["method"] == identification:
            identified[row["set"], row["question"]] = row
    lines = []
    for i, row in enumerate(rows):
        less = ""
        if i > 0 and row["less_than_nominal"]:
            less = _plus_minus(row["less_than_nominal"], row["less_standard_error"])
        floor = row["floor_mrad"]
        line = (
            row["set"],
            row["question"],
            row["method"] + _left_out(row.get("notes", ())),
            _plus_minus(row["mrad"], row["standard_error"]),
            f"{row['of_nominal']:.2f}",
            less,
            _more_than(identified.get((row["set"], row["question"])), row),
            "–" if floor is None else f"{floor:.1f}",
            row["motions"],
        )
        lines.append(line)
    return ResultTable(STEM, COLUMNS, tuple(lines))


def _more_than(identified: dict[str, Any] | None, row: dict[str, Any]) -> str:
    """Return how much larger a row's error is than that of identification, ± over motions.

    "" if there is none to compare with.
    """
    if identified is None or identified is row:
        return ""
    mrad = row.get("by_motion_mrad")
    mrad_of_identified = identified.get("by_motion_mrad")
    if mrad is None or mrad_of_identified is None:
        return ""
    more = np.array([mrad[motion] - value for motion, value in mrad_of_identified.items()])
    return _plus_minus(more.mean(), standard_error(more) if len(more) > 1 else None)


def _left_out(notes: tuple[str, ...]) -> str:
    """Say in how many folds validation rejected the network."""
    count = sum(note.startswith(LEFT_OUT) for note in notes)
    return f" ({LEFT_OUT} in {count} of {len(notes)})" if count else ""


def _plus_minus(value: float, error: float | None) -> str:
    if error is None:
        return f"{value:.2f}"
    return f"{value:.2f} ± {error:.2f}"


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
    """Draw each method's share of the nominal error, a line for each question.

    The nominal simulator is the vertical line. The repeatability of the robot is shaded.
    """
    questions: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        questions.setdefault((row["set"], row["question"]), []).append(row)
    fig = figure(7.2, 0.5 * len(questions) + 1.5)
    ax = fig.subplots()
    lines = list(questions.values())
    for y, (nominal, *_) in enumerate(lines):
        _draw_floor(ax, y, nominal)
    for method in LOOKS:  # so is the order of the legend
        for y, line in enumerate(lines):
            _draw_method(ax, y, line, method)
    for y in range(1, len(lines)):
        ax.axhline(y - 0.5, color="#111111", alpha=0.08, lw=0.6, zorder=0)
    ax.axvline(1.0, color=colour("nominal"), lw=1.2, zorder=0, label="nominal simulator")
    names = []
    for data_set, question in questions:
        title, _, _ = titles.get(data_set, data_set).partition(",")
        names.append(f"{title}: {question}")
    ax.set_yticks(np.arange(len(lines)), names)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(lines) - 0.5, -0.5)
    largest = 1.05 * max(row["of_nominal"] for row in rows)
    ax.set_xlim(0.0, max(1.05, min(largest, MAX_OF_NOMINAL)))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("mean |error|, of the nominal simulator's")
    legend(fig)
    return fig


def _draw_floor(ax: Axes, y: int, nominal: dict[str, Any]) -> None:
    if nominal["floor_mrad"] is None:
        return
    width = nominal["floor_mrad"] / nominal["mrad"]
    ax.barh(y, width, 0.86, color="#111111", alpha=0.1, lw=0, label="repetitions differ by")


def _draw_method(ax: Axes, y: int, line: list[dict[str, Any]], method: str) -> None:
    """Draw the error of one method into the line of a question, beside the other methods."""
    nominal, *others = line
    drawn = [row for row in others if row["method"] in LOOKS]
    own_colour, marker = LOOKS[method]
    for i, row in enumerate(drawn):
        if row["method"] != method:
            continue
        x = row["of_nominal"]
        error = (row["standard_error"] or 0.0) / nominal["mrad"]
        ax.errorbar(
            min(x, MAX_OF_NOMINAL),
            y + 0.76 * ((i + 0.5) / len(drawn) - 0.5),
            xerr=error or None,
            fmt=marker if x <= MAX_OF_NOMINAL else ">",
            ms=4,
            color=own_colour,
            elinewidth=0.8,
            label=method.partition(" by ")[0],
        )
