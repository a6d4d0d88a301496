"""The figures of tracking: bars joint by joint and payload by payload, and one motion as it was followed."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.plot.methods import COLOURS
from gaponet.plot.style import figure, styled
from gaponet.robot import RobotSpec
from gaponet.study.played.methods import colour, methods, title
from gaponet.study.played.tracking import Example, Score

HEADS = {"alignment": "Alignment: simulator to robot", "compensation": "Compensation: robot to target"}
LEFT_OUT = ("identified feedforward",)  # of the bars; it stands in the tables


@styled
def joints(scores: ListOf[Score], robot: RobotSpec, label: str) -> Figure:
    """Q_dis per joint, a row per payload, alignment beside compensation; standard error over motions."""
    parts, payloads = list(dict.fromkeys(s.part for s in scores)), sorted({s.payload for s in scores})
    wide = 0.52 * len(robot.operated) + 0.8
    fig = figure(max(6.0, wide * len(parts)), 1.55 * len(payloads) + 1.5)
    axes = fig.subplots(len(payloads), len(parts), sharex=True, sharey="col", squeeze=False)
    for c, part in enumerate(parts):
        for r, payload in enumerate(payloads):
            some = [s for s in scores if s.part == part and s.payload == payload]
            _bars(axes[r, c], some, robot)
            axes[r, c].annotate(f"{payload:g} kg", (0.995, 0.97), xycoords="axes fraction", ha="right", va="top",
                                fontweight="bold")  # fmt: skip
            axes[r, 0].set_ylabel("Q_dis, rad·s")
        axes[0, c].set_title(HEADS[part])
    names = [n.removesuffix("_joint").replace("_", "\n", 1).replace("_", "\n") for n in robot.operated]
    for ax in axes[-1]:
        ax.set_xticks(np.arange(len(names)), names, fontsize=7)
    fig.suptitle(f"{robot.name}, {label}; mean and standard error over motions", fontsize=9, x=0.005, ha="left")
    _legend(fig, axes[0])
    return fig


def _bars(ax: Any, scores: ListOf[Score], robot: RobotSpec) -> None:
    names = [m for m in methods(scores) if m not in LEFT_OUT]
    width = 0.84 / len(names)
    for i, m in enumerate(names):
        by_motion: dict[str, list[Any]] = {}
        for s in scores:
            if s.method == m:
                by_motion.setdefault(s.motion, []).append(s.q_dis)
        values = np.array([np.mean(v, axis=0) for v in by_motion.values()])  # seeds averaged: (motions, n)
        error = values.std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else None
        x = np.arange(len(robot.operated)) + (i - (len(names) - 1) / 2) * width
        ax.bar(x, values.mean(axis=0), width * 0.92, yerr=error, color=colour(m), label=title(m),
               error_kw={"lw": 0.6, "capsize": 1.2, "capthick": 0.6})  # fmt: skip
    ax.grid(axis="x", visible=False)
    ax.tick_params(axis="x", length=0)


def _legend(fig: Figure, axes: Any) -> None:
    """Each method once, whichever part it is of."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    columns = max(2, int(fig.get_figwidth() / 1.9))
    fig.legend(found.values(), found.keys(), loc="outside lower left", ncols=columns, columnspacing=1.1,
               handlelength=1.2)  # fmt: skip


@styled
def example(shown: Example, robot: RobotSpec, tag: str) -> Figure:
    """Targets and joints by method, and the error below: of joints that move the three with the largest raw error."""
    moves = np.ptp(shown.target, axis=0) > 0.1
    raw = np.abs(shown.qpos["raw"] - shown.target).mean(axis=0) * (moves if moves.sum() > 2 else 1)
    columns = sorted(np.argsort(-raw)[:3].tolist())
    fig = figure(3.5 * len(columns), 4.2)
    axes = fig.subplots(2, len(columns), sharex=True, squeeze=False, height_ratios=[1.6, 1])
    time = np.arange(len(shown.target)) * shown.dt
    for c, j in enumerate(columns):
        top, low = axes[:, c]
        for m, qpos in shown.qpos.items():
            if m not in LEFT_OUT:
                top.plot(time, qpos[:, j], color=colour(m), label=title(m))
                low.plot(time, (qpos[:, j] - shown.target[:, j]) * 1e3, color=colour(m), lw=1.0)
        top.plot(time, shown.target[:, j], color=COLOURS["target"], ls=(0, (4, 1.5)), lw=1.0, label="target")
        low.axhline(0, color="#111111", lw=0.6)
        top.set_title(robot.operated[j].removesuffix("_joint"))
        low.set_xlabel("time, s")
    axes[0, 0].set_ylabel("position, rad")
    axes[1, 0].set_ylabel("error, mrad")
    fig.align_ylabels(axes[:, 0])
    fig.suptitle(f"{shown.motion}, {shown.payload:g} kg in each hand, {tag}", fontsize=9, x=0.005, ha="left")
    _legend(fig, axes[0])
    return fig
