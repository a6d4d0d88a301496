"""Where the gap comes from, as a waterfall."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gaponet.base.files import lock_folder, write_text
from gaponet.report.figures.style import figure, joint_label, save, styled
from gaponet.report.methods import colour, shade, title

COLUMNS = 4  # at most
FLOOR = "#1f7a56"


def write_gap(found: dict[str, Any], folder: Path, kind: str) -> None:
    """What eval.gap.gap_by_step found, as gap.json, gap.svg and gap.png of a folder: a robot or a run."""
    with lock_folder(folder, kind):
        write_text(folder / "gap.json", json.dumps(found, indent=1) + "\n")
        save(waterfall(found), folder / "gap")


@styled
def waterfall(found: dict[str, Any]) -> Figure:
    """What each step removes of the mean |error| (hollow: adds), the mean over joints first, and the floor."""
    panels = {"all joints": {"left": found["left"], "floor": found["floor"]}} | found["by_joint"]
    steps = list(found["left"])
    rows = -(-len(panels) // COLUMNS)
    columns = -(-len(panels) // rows)
    fig = figure(1.2 + 2.3 * columns, (0.55 + 0.16 * len(steps)) * rows + 0.6)
    axes = fig.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for i, (ax, (name, panel)) in enumerate(zip(axes.flat, panels.items(), strict=False)):
        _panel(ax, steps, {k: 1e3 * v for k, v in panel["left"].items()}, panel["floor"]["both"])
        ax.set_title(joint_label(name, wrapped=False))
        ax.xaxis.set_tick_params(labelbottom=i + columns >= len(panels))
        if i + columns >= len(panels):
            ax.set_xlabel("MPJAE, mrad")
    axes[0, 0].set_yticks(range(len(steps) + 1), [*map(title, steps), "left"])
    for ax in axes[:, 0]:
        ax.tick_params(axis="y", labelsize=7)
    axes[0, 0].invert_yaxis()
    who = "VIRTUAL " if found["virtual"] else "real "
    fig.suptitle(
        f"{who}{found['robot']}, {found['sequences']} {'held-out ' if found['unseen'] else ''}recordings: "
        "what each step removes (hollow: adds)\n"
        "dashed: floor, what encoder and repeatability hide (– unknown)",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    return fig


def _panel(ax: Any, steps: list[str], left: dict[str, float], floor: float | None) -> None:
    start = before = left[steps[0]]
    ax.barh(0, before, color=colour("nominal"))
    for k, step in enumerate(steps[1:], 1):
        after = left[step]
        adds = after > before
        ax.barh(k, abs(before - after), left=min(before, after), color="white" if adds else colour(step),
                edgecolor=colour(step), lw=1.0)  # fmt: skip
        ax.plot([before, before], [k - 0.6, k + 0.4], color="#555555", lw=0.6)
        ax.annotate(f"{after - before:+.1f}".replace("-", "−"), (max(before, after), k), (2, 0), ha="left", va="center",
                    textcoords="offset points", fontsize=6.5, color=shade(colour(step), -0.25))  # fmt: skip
        before = after
    ax.plot([before, before], [len(steps) - 0.6, len(steps) + 0.4], color="#555555", lw=0.6)
    ax.barh(len(steps), before, color="#333333")
    for k, whole in ((len(steps), before), (0, start)):
        ax.annotate(f"{whole:.1f}", (whole, k), (2, 0), ha="left", va="center", textcoords="offset points", fontsize=7)
    known = floor is not None and floor == floor  # absent numbers are read as NaN
    if floor is not None and known:
        ax.barh(len(steps), min(1e3 * floor, before), color=FLOOR)
        ax.axvline(1e3 * floor, ls=(0, (4, 2)), lw=0.8, color=FLOOR)
    ax.set_title(f"floor {1e3 * floor:.1f}" if floor is not None and known else "floor –", loc="right", fontsize=7,
                 fontweight="normal", color=FLOOR)  # fmt: skip
    ax.grid(axis="y", visible=False)
    ax.margins(x=0.16)
