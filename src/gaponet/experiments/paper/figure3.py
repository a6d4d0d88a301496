"""Figure 3: Q_dis of eight joints at four payloads, on motions that are in no training."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.paper.options import Block
from gaponet.experiments.paper.results import Results
from gaponet.report.figures.style import figure, joint_label, legend, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Curve → grey-proof style: line, marker, colour.
CURVES = {
    "raw": ((0, (1, 1)), "s", "#555555"),
    "MLP": ((0, (4, 1.5)), "^", "#3b7dd8"),
    "GAPONet": ("-", "o", "#c8102e"),
}
COLUMNS = 4  # panels side by side


@styled
def draw_figure_3(results: Results, block: Block) -> Figure:
    """Draw a panel for each joint without wrists: Q_dis over the payload, raw, MLP and GAPONet.

    Bars are the standard error over motions. A robot with one payload has its joints on the x-axis
    instead.
    """
    curves = _curves(results, block)
    if len(results.masses) == 1:
        return _draw_joints(results, curves)
    joints = results.eight_joints
    rows = -(-len(joints) // COLUMNS)
    fig = figure(7.2, 1.7 * rows + 0.6)
    axes = fig.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    for panel, joint in enumerate(joints):
        ax = axes.flat[panel]
        for name, q_dis in curves.items():
            values = [_over_motions(results, q_dis, joint, mass) for mass in results.masses]
            _draw_curve(ax, results.masses, values, name, markersize=3.5)
        ax.set_title(joint_label(results.study.robot.operated[joint], wrapped=False))
    axes.flat[0].set_ylim(bottom=0)  # of all panels, after the last curve
    for ax in axes.flat[len(joints) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("payload, kg")
    for ax in axes[:, 0]:
        ax.set_ylabel("Q_dis, rad·s")
    legend(fig)
    return fig


def _draw_joints(results: Results, curves: dict[str, Array]) -> Figure:
    """Draw one panel with the joints side by side."""
    joints = results.eight_joints
    fig = figure(max(4.5, 0.8 * len(joints) + 1.5), 2.8)
    ax = fig.subplots()
    for name, q_dis in curves.items():
        values = [_over_motions(results, q_dis, joint, results.masses[0]) for joint in joints]
        _draw_curve(ax, range(len(joints)), values, name)
    names = [joint_label(results.study.robot.operated[joint]) for joint in joints]
    ax.set_xticks(np.arange(len(joints)), names)
    ax.set_ylabel("Q_dis, rad·s")
    ax.set_ylim(bottom=0)
    legend(fig)
    return fig


def _draw_curve(
    ax: Axes, x: ListOf[float], values: list[MeanStd], name: str, markersize: float | None = None
) -> None:
    """Draw the means of a curve of CURVES with their standard errors."""
    line, marker, colour = CURVES[name]
    means = []
    errors = []
    for value in values:
        means.append(value.mean)
        errors.append(value.standard_error)
    ax.errorbar(
        x,
        means,
        yerr=errors,
        linestyle=line,
        marker=marker,
        color=colour,
        capsize=1.5,
        label=name,
        markersize=markersize,
    )


def _curves(results: Results, block: Block) -> dict[str, Array]:
    """Return curve → Q_dis, mean over seeds, (recordings, n) rad·s."""
    curves = {"raw": results.baseline_q_dis("nominal")}
    for name in ("MLP", "GAPONet"):
        seeds = results.q_dis(block, name)
        if seeds:
            curves[name] = np.mean(seeds, axis=0)
    return curves


def _over_motions(results: Results, q_dis: Array, joint: int, mass: float) -> MeanStd:
    """Return mean and deviation over motions of one joint at one payload, rad·s."""
    return MeanStd.from_values(q_dis[results.payloads == mass, joint])


def figure_3_table(results: Results, block: Block) -> ResultTable:
    """Return Q_dis by payload for all methods, mean over the eight joints."""
    methods = results.networks(block)
    rows = []
    for mass in results.masses:
        kept = results.payloads == mass
        cells: list[object] = []
        for name in results.simulators:
            q_dis = results.over_joints(results.baseline_q_dis(name))  # (recordings,)
            cells.append(float(q_dis[kept].mean()))
        for name in methods:
            seeds = []
            for q_dis in results.q_dis(block, name):
                seeds.append(float(results.over_joints(q_dis)[kept].mean()))
            cells.append(MeanStd.from_values(seeds))
        rows.append((f"{mass:g} kg", *cells))
    caption = (
        "Q_dis between simulator and robot, mean over joints without wrists and over motions; ± "
        "is the standard deviation over training seeds."
    )
    columns = ("Q_dis, rad·s", *results.simulators.values(), *methods)
    return ResultTable(f"figure3_{block}", columns, tuple(rows), caption, digits=4)
