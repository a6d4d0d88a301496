"""Where the gap comes from, as a waterfall."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import wrap
from typing import Any

from matplotlib.figure import Figure

from gaponet.files import write_text, writing
from gaponet.plot.methods import colour, shade, title
from gaponet.plot.style import figure, joint_label, save, styled

COLUMNS = 4  # at most
FLOOR = "#1f7a56"


def write_gap(found: dict[str, Any], run: Path) -> None:
    """What eval.gap.gap_by_step found, as gap.json, gap.svg and gap.png of the run."""
    with writing(run, "run"):
        write_text(run / "gap.json", json.dumps(found, indent=1) + "\n")
        save(waterfall(found), run / "gap")


@styled
def waterfall(found: dict[str, Any]) -> Figure:
    """What each step removes of the mean |error| (hollow: adds), the mean over joints first, and the floor."""
    panels = {"all joints": {"left": found["left"], "floor": found["floor"]}} | found["by_joint"]
    steps = list(found["left"])
    rows = -(-len(panels) // COLUMNS)
    columns = -(-len(panels) // rows)
    fig = figure(2.55 * columns, 2.0 * rows + 0.55)
    axes = fig.subplots(rows, columns, squeeze=False, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for i, (ax, (name, panel)) in enumerate(zip(axes.flat, panels.items(), strict=False)):
        _panel(ax, steps, {k: 1e3 * v for k, v in panel["left"].items()}, panel["floor"]["both"])
        ax.set_title(joint_label(name, wrapped=False))
        if i % columns == 0:
            ax.set_ylabel("MPJAE, mrad")
        bottom = i + columns >= len(panels)
        ax.set_xticks(range(len(steps) + 1), [*(_tick(s) for s in steps), "left"] if bottom else [], fontsize=5.8)
    who = "VIRTUAL " if found["virtual"] else "real "
    fig.suptitle(
        f"{who}{found['robot']}, {found['sequences']} {'held-out ' if found['unseen'] else ''}recordings: "
        "what each step removes (hollow: adds)\n"
        "dashed: floor, what encoder and repeatability hide (– unknown)",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    return fig


def _panel(ax: Any, steps: list[str], left: dict[str, float], floor: float | None) -> None:
    before = left[steps[0]]
    ax.bar(0, before, color=colour("nominal"))
    for k, step in enumerate(steps[1:], 1):
        after = left[step]
        adds = after > before
        ax.bar(k, abs(before - after), bottom=min(before, after), color="white" if adds else colour(step),
               edgecolor=colour(step), lw=1.0)  # fmt: skip
        ax.plot([k - 0.6, k + 0.4], [before, before], color="#555555", lw=0.6)
        ax.annotate(f"{after - before:+.1f}".replace("-", "−"), (k, max(before, after)), ha="center", va="bottom",
                    fontsize=6.5, color=shade(colour(step), -0.25))  # fmt: skip
        before = after
    ax.plot([len(steps) - 0.6, len(steps) + 0.4], [before, before], color="#555555", lw=0.6)
    ax.bar(len(steps), before, color="#333333")
    ax.annotate(f"{before:.1f}", (len(steps), before), ha="center", va="bottom", fontsize=7)
    ax.annotate(f"{left[steps[0]]:.1f}", (0, left[steps[0]]), ha="center", va="bottom", fontsize=7)
    known = floor is not None and floor == floor  # absent numbers are read as NaN
    if floor is not None and known:
        ax.bar(len(steps), min(1e3 * floor, before), color=FLOOR)
        ax.axhline(1e3 * floor, ls=(0, (4, 2)), lw=0.8, color=FLOOR)
    ax.set_title(f"floor {1e3 * floor:.1f}" if floor is not None and known else "floor –", loc="right", fontsize=7,
                 fontweight="normal", color=FLOOR)  # fmt: skip
    ax.grid(axis="x", visible=False)
    ax.margins(y=0.12)


def _tick(step: str) -> str:
    """The step's name in the width of a bar: a word a line, long ones broken."""
    return "\n".join("-\n".join(wrap(word, 8)) for word in title(step).removesuffix(" simulator").split())
