"""Charts that several figures use: bars by group, trajectories against a reference."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import MeanStd
from gaponet.report.figures.style import DASHED, DOTTED, LETTER, figure, legend, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Bars = Mapping[str, tuple[str, ListOf[MeanStd]]]  # label → colour, value of each group
MIN_POSITION_SPAN = 0.06  # rad of a position axis, so that encoder steps of a joint at rest are not magnified


@styled
def bars(groups: ListOf[str], methods: Bars, axis: str, title: str) -> Figure:
    """Draw bars with error bars, the methods of each group side by side."""
    word = max((len(word) for group in groups for word in group.split()), default=0)
    fig = figure(max(5.2, 0.17 * len(groups) * len(methods) + 1.7, (LETTER * word + 0.05) * len(groups) + 1.3), 3.3)
    ax = fig.subplots()
    draw_bars(ax, groups, methods)
    ax.set_ylabel(axis)
    ax.set_title(title)
    legend(fig)
    return fig


def draw_bars(ax: Axes, groups: ListOf[str], methods: Bars, size: float | None = None) -> None:
    """Draw the bars into existing axes; size is the font size of the group labels."""
    width = 0.84 / len(methods)
    for i, (label, (colour, values)) in enumerate(methods.items()):
        x = np.arange(len(groups)) + (i - (len(methods) - 1) / 2) * width
        ax.bar(x, [v.mean for v in values], width * 0.92, yerr=error_bars(values), color=colour, label=label,
               error_kw={"lw": 0.7, "capsize": 1.2, "capthick": 0.6})  # fmt: skip
    ax.set_xticks(np.arange(len(groups)), groups, fontsize=size)
    ax.tick_params(axis="x", length=0)
    ax.grid(axis="x", visible=False)


def error_bars(values: ListOf[MeanStd]) -> Array | None:
    """Return the lengths of error bars; None if no value has a standard deviation."""
    std = np.array([v.std if v.std == v.std else 0.0 for v in values])
    return std if std.any() else None


@dataclass(frozen=True)
class JointTrajectory:
    """Positions of one joint, (T,) rad.

    Attributes:
        by_method: Positions of each method.
        reference: Positions of the reference.
        corrections: Δa of each method, (up to T,) rad.
        zoom: Rows that are drawn again, magnified; given for all joints or for none.
    """

    by_method: Mapping[str, Array]
    reference: Array
    command: Array | None = None
    corrections: Mapping[str, Array] = field(default_factory=dict)
    zoom: slice | None = None


@styled
def against(
    time: Array,
    joints: Mapping[str, JointTrajectory],
    looks: Mapping[str, tuple[str, str]],
    reference: str,
    title: str = "",
) -> Figure:
    """Draw positions by method over time, a column per joint, and their errors below on one scale.

    Args:
        time: (T,) s.
        joints: Title of a column → its trajectories.
        looks: Label and colour of each method, of the reference, and of "command".
    """
    first = next(iter(joints.values()))
    rows = {"position, rad": 1.8, "zoom, rad": 1.6 * (first.zoom is not None), "error, mrad": 1.1,
            "Δa, mrad": 0.9 * bool(first.corrections)}  # fmt: skip
    rows = {label: height for label, height in rows.items() if height}
    fig = figure(3.6 * len(joints), 1.0 + 1.1 * sum(rows.values()))
    axes = fig.subplots(len(rows), len(joints), squeeze=False, height_ratios=list(rows.values()))
    for column, (joint, trajectory) in zip(axes.T, joints.items(), strict=True):
        ax = dict(zip(rows, column, strict=True))
        _positions(ax["position, rad"], time, trajectory, looks, reference)
        if trajectory.zoom is not None:
            _positions(ax["zoom, rad"], time, trajectory, looks, reference, trajectory.zoom)
            ax["position, rad"].axvspan(*time[trajectory.zoom][[0, -1]], color="#000000", alpha=0.06, lw=0)
        for method, values in trajectory.by_method.items():
            ax["error, mrad"].plot(time, (values - trajectory.reference) * 1e3, color=looks[method][1], lw=1.0)
        ax["error, mrad"].axhline(0, color="#111111", lw=0.6)
        for method, values in trajectory.corrections.items():
            ax["Δa, mrad"].plot(time[: len(values)], values * 1e3, color=looks[method][1], lw=0.9)
        column[0].set_title(joint)
        column[-1].set_xlabel("time, s")
        for other in column:
            other.set_xlim(time[0], time[-1]) if other is not ax.get("zoom, rad") else None
    for row, label in zip(axes, rows, strict=True):
        row[0].set_ylabel(label)
        if label in ("error, mrad", "Δa, mrad"):
            largest = max(abs(v) for ax in row for v in ax.dataLim.intervaly)
            end = 1.08 * largest or 1.0
            for ax in row:
                ax.set_ylim(-end, end)
    fig.align_ylabels(axes[:, 0])
    legend(fig, title)
    return fig


def _positions(
    ax: Axes,
    time: Array,
    trajectory: JointTrajectory,
    looks: Mapping[str, tuple[str, str]],
    reference: str,
    rows: slice = slice(None),
) -> None:
    """Draw command, methods and reference."""
    if trajectory.command is not None:
        label, colour = looks["command"]
        ax.step(time[rows], trajectory.command[rows], where="post", color=colour, ls=DOTTED, lw=1.1, label=label)
    for method, values in trajectory.by_method.items():
        label, colour = looks[method]
        ax.plot(time[rows], values[rows], color=colour, label=label)
    label, colour = looks[reference]
    ax.plot(time[rows], trajectory.reference[rows], color=colour, ls=DASHED, lw=1.0, label=label)
    low, high = ax.get_ylim()
    if high - low < MIN_POSITION_SPAN:
        ax.set_ylim((low + high - MIN_POSITION_SPAN) / 2, (low + high + MIN_POSITION_SPAN) / 2)
