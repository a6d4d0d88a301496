"""Figures of an identified robot: error by step, parameter uncertainty, response to a policy's targets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.base.files import lock_folder, write_text
from gaponet.report.figures.style import figure, joint_label, save, styled
from gaponet.report.methods import colour, shade, title
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.sysid.uncertainty import ParameterUncertainty, summarize

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_COLUMNS = 4
FLOOR_COLOUR = "#1f7a56"
QUANTILE_90 = 1.645  # standard deviations on each side of a 90 % interval
MAX_INTERVAL = 3.0  # of the joints' range; a wider interval is drawn as unknown


def write_gap(gap: dict[str, Any], folder: Path, kind: str) -> None:
    """Write the result of report.gap.gap_by_step as gap.json, gap.svg and gap.png into a robot folder or a run."""
    with lock_folder(folder, kind):
        write_text(folder / "gap.json", json.dumps(gap, indent=1) + "\n")
        save(waterfall(gap), folder / "gap")


@styled
def waterfall(gap: dict[str, Any]) -> Figure:
    """Draw the reduction of the mean |error| by each step (hollow: increase), all joints first, and the error floor."""
    panels = {"all joints": {"left": gap["left"], "floor": gap["floor"]}} | gap["by_joint"]
    steps = list(gap["left"])
    rows = -(-len(panels) // MAX_COLUMNS)
    columns = -(-len(panels) // rows)
    fig = figure(1.2 + 2.3 * columns, (0.55 + 0.16 * len(steps)) * rows + 0.6)
    axes = fig.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for i, (ax, (name, panel)) in enumerate(zip(axes.flat, panels.items(), strict=False)):
        _waterfall_panel(ax, steps, {k: 1e3 * v for k, v in panel["left"].items()}, panel["floor"]["both"])
        ax.set_title(joint_label(name, wrapped=False))
        ax.xaxis.set_tick_params(labelbottom=i + columns >= len(panels))
        if i + columns >= len(panels):
            ax.set_xlabel("MPJAE, mrad")
    axes[0, 0].set_yticks(range(len(steps) + 1), [*map(title, steps), "remaining"])
    for ax in axes[:, 0]:
        ax.tick_params(axis="y", labelsize=7)
    axes[0, 0].invert_yaxis()
    robot, end = f"{'VIRTUAL' if gap['virtual'] else 'real'} {gap['robot']}", "s" * (gap["sequences"] != 1)
    fig.suptitle(
        f"{robot}, {gap['sequences']} {'test ' if gap['unseen'] else ''}recording{end}: reduction "
        "of the error by each step (hollow: increase)\ndashed: floor, by encoder and repeatability (– unknown)",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    return fig


def _waterfall_panel(ax: Axes, steps: list[str], errors: dict[str, float], floor: float | None) -> None:
    """Draw one panel; errors after each step in mrad, floor in rad."""
    start = before = errors[steps[0]]
    ax.barh(0, before, color=colour("nominal"))
    for k, step in enumerate(steps[1:], 1):
        after = errors[step]
        ax.barh(k, abs(before - after), left=min(before, after), color="white" if after > before else colour(step),
                edgecolor=colour(step), lw=1.0)  # fmt: skip
        ax.plot([before, before], [k - 0.6, k + 0.4], color="#555555", lw=0.6)
        ax.annotate(f"{after - before:+.1f}".replace("-", "−"), (max(before, after), k), (2, 0), ha="left", va="center",
                    textcoords="offset points", fontsize=6.5, color=shade(colour(step), -0.25))  # fmt: skip
        before = after
    ax.plot([before, before], [len(steps) - 0.6, len(steps) + 0.4], color="#555555", lw=0.6)
    ax.barh(len(steps), before, color="#333333")
    for k, error in ((len(steps), before), (0, start)):
        ax.annotate(f"{error:.1f}", (error, k), (2, 0), ha="left", va="center", textcoords="offset points", fontsize=7)
    label = "floor –"
    if floor is not None and not np.isnan(floor):  # an absent number is read as NaN
        ax.barh(len(steps), min(1e3 * floor, before), color=FLOOR_COLOUR)
        ax.axvline(1e3 * floor, ls=(0, (4, 2)), lw=0.8, color=FLOOR_COLOUR)
        label = f"floor {1e3 * floor:.1f}"
    ax.set_title(label, loc="right", fontsize=7, fontweight="normal", color=FLOOR_COLOUR)
    ax.grid(axis="y", visible=False)
    ax.margins(x=0.16)


@styled
def draw_uncertainty(uncertainty: ParameterUncertainty, heading: str) -> Figure:
    """Draw a panel for each parameter: the value of every joint with its 90 % interval."""
    joints = list(uncertainty.joints)
    summaries = [summarize(uncertainty, j) for j in joints]
    fields = [f for f in uncertainty.fields if any(s.values[f] for s in summaries)]
    columns = min(MAX_COLUMNS, len(fields))
    rows = -(-len(fields) // columns)
    fig = figure(2.4 * columns + 1.0, (0.24 * len(joints) + 0.8) * rows + 0.4)
    axes = fig.subplots(rows, columns, squeeze=False)
    for ax in axes.flat[len(fields) :]:
        ax.set_visible(False)
    y = np.arange(len(joints))[::-1]
    for place, (ax, field) in enumerate(zip(axes.flat, fields, strict=False)):
        name, factor = SERVO_FIELDS[field].heading, SERVO_FIELDS[field].factor
        values = np.array([s.values[field] * factor for s in summaries])
        half = np.array([QUANTILE_90 * s.errors[field] * factor for s in summaries])
        span = max(float(np.ptp(values)), float(np.abs(values).max()) * 0.1, 1e-9)
        shown = half < MAX_INTERVAL * span
        ax.errorbar(values[shown], y[shown], xerr=half[shown], fmt="o", ms=3.5, capsize=2, lw=1.2, color="#1f5fa8")
        ax.plot(values[~shown], y[~shown], "o", ms=4, mfc="none", color="#999999")
        labels = [joint_label(j, wrapped=False) for j in joints] if place % columns == 0 else [""] * len(joints)
        ax.set_yticks(y, labels)
        ax.set_title(name)
        ax.set_ylim(-0.6, len(joints) - 0.4)
    fig.suptitle(heading, x=0.01, ha="left", fontsize=9, fontweight="bold")
    return fig
