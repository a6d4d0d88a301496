"""The benchmark's table, figure and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.files import write_text
from gaponet.experiments.real.rivals import LEFT_OUT
from gaponet.report.figures.colours import colour, shade
from gaponet.report.figures.style import figure, legend, save, styled

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
WIDEST = 1.6  # of nominal: what lies beyond stands at the edge
COLUMNS = (
    "set",
    "question",
    "method",
    "mrad",
    "of nominal",
    "less than nominal, mrad",
    "floor",
    "motions",
    "recordings",
)
NAME = "real"
TITLE = """# Real robots

`gaponet bench real` ([benchmark](../benchmark.md)): recordings that no method was fitted to, in free run from the
recorded start. ± is the standard error over independent motions, of differences to the nominal simulator paired;
"floor" is what two recordings of one command differ by."""


def table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Cells; ± is the standard error over independent motions, of differences paired."""
    return [
        [r["set"], r["question"], r["method"] + _left_out(r.get("notes", ())),
         _pm(r["mrad"], r["standard_error"]), f"{r['of_nominal']:.2f}",
         "" if i == 0 or not r["less_than_nominal"] else _pm(r["less_than_nominal"], r["less_standard_error"]),
         "–" if r["floor_mrad"] is None else f"{r['floor_mrad']:.1f}", str(r["motions"]), str(r["recordings"])]
        for i, r in enumerate(rows)
    ]  # fmt: skip


def by_joint(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of Markdown: what each method leaves by joint and payload, of sets that were recorded joint by joint."""
    lines = []
    for name in dict.fromkeys(r["set"] for r in rows if r.get("by_joint_mrad")):
        mine = [r for r in rows if r["set"] == name]
        methods = list(dict.fromkeys(r["method"] for r in mine))
        heads = [m.partition(" by ")[0].removesuffix(" simulator") for m in methods]
        lines += ["", f"{name} by joint and payload, mrad (means over motions, few in a cell, so no ±):", ""]
        lines += ["| question | joint | kg | recordings | " + " | ".join(heads) + " |"]
        lines += ["| --- | --- | ---: | ---: |" + " ---: |" * len(heads)]
        for question in dict.fromkeys(r["question"] for r in mine):
            found = {r["method"]: r["by_joint_mrad"] for r in mine if r["question"] == question}
            first = next(iter(found.values()))
            for joint, kg, count in ((j, kg, n) for j, each in first.items() for kg, (_, n) in each.items()):
                cells = [f"{found[m][joint][kg][0]:.1f}" if m in found else "–" for m in methods]
                lines += ["| " + " | ".join([question, joint, kg, str(count), *cells]) + " |"]
    return lines


def _left_out(notes: tuple[str, ...]) -> str:
    """That validation left a network out, of so many that were trained."""
    count = sum(note.startswith(LEFT_OUT) for note in notes)
    return f" ({LEFT_OUT} in {count} of {len(notes)})" if count else ""


def _pm(value: float, error: float | None) -> str:
    return f"{value:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def write_page(found: dict[str, Any], out: Path) -> list[Path]:
    """JSON, Markdown and figure in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    rows, name = found["rows"], f"{NAME}-{found['adversary']}".rstrip("-")
    write_text(out / f"{name}.json", json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    lines = [TITLE, "", f"![What methods leave of the nominal error]({name}.png)", ""]
    if found["adversary"]:
        lines += [f"ADVERSARY: {found['adversary']}.", ""]
    lines += ["| " + " | ".join(COLUMNS) + " |", "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"]
    lines += ["| " + " | ".join(cells) + " |" for cells in table(rows)]
    lines += by_joint(rows)
    spent = ", ".join(f"{what} {seconds:,} s" for what, seconds in found["seconds"].items())
    lines += ["", f"From file to table, on this machine: {spent}."]
    for what, remarks in found["labels"].items():
        lines += ["", f"Labels of {what} (`gaponet data labels`):", "", *(f"- {remark}" for remark in remarks)]
    write_text(out / f"{name}.md", "\n".join(lines) + "\n")
    figures = save(draw(rows, found["cards"]), out / name) if rows else []
    return [out / f"{name}.md", out / f"{name}.json", *figures]


@styled
def draw(rows: list[dict[str, Any]], titles: dict[str, str]) -> Figure:
    """What each method leaves of the nominal error, a line for each question, what the robot itself leaves shaded."""
    asked = list(dict.fromkeys((r["set"], r["question"]) for r in rows))
    fig = figure(7.2, 0.5 * len(asked) + 1.5)
    ax = fig.subplots()
    names = [titles.get(name, name).partition(",")[0] + f": {question}" for name, question in asked]
    shown = {y: [r for r in rows if (r["set"], r["question"]) == key] for y, key in enumerate(asked)}
    for y, (first, *_) in shown.items():
        if first["floor_mrad"] is not None:
            ax.barh(y, first["floor_mrad"] / first["mrad"], 0.86, color="#111111", alpha=0.1, lw=0,
                    label="repetitions differ by")  # fmt: skip
    for method, (own, marker) in LOOKS.items():  # the nominal simulator is the line
        for y, (first, *others) in shown.items():
            lanes = [r for r in others if r["method"] in LOOKS]
            for i, r in enumerate(lanes):
                if r["method"] == method:
                    x, error = r["of_nominal"], (r["standard_error"] or 0.0) / first["mrad"]
                    ax.errorbar(min(x, WIDEST), y + 0.76 * ((i + 0.5) / len(lanes) - 0.5), xerr=error or None,
                                fmt=marker if x <= WIDEST else ">", ms=4, color=own, elinewidth=0.8,
                                label=method.partition(" by ")[0])  # fmt: skip
    for y in range(1, len(asked)):
        ax.axhline(y - 0.5, color="#111111", alpha=0.08, lw=0.6, zorder=0)
    ax.axvline(1.0, color=colour("nominal"), lw=1.2, zorder=0, label="nominal simulator")
    ax.set_yticks(np.arange(len(asked)), names)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(asked) - 0.5, -0.5)
    ax.set_xlim(0.0, max(1.05, min(1.05 * max(r["of_nominal"] for r in rows), WIDEST)))
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("mean |error|, of the nominal simulator's")
    legend(fig)
    return fig
