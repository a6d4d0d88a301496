"""The figures of a report, and of an identified robot: error by step, uncertainty of parameters."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gaponet.base.arrays import Array
from gaponet.base.files import lock_folder, write_text
from gaponet.base.result_table import MeanStd
from gaponet.data.repeatability import MIN_MOTION_RAD
from gaponet.data.signals import busiest_window
from gaponet.evaluation.candidate import is_robot
from gaponet.evaluation.methods import colour, shade, title
from gaponet.report.figures.style import (
    DASHED,
    DOTTED,
    bars,
    figure,
    joint_label,
    legend,
    save,
    styled,
)
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.sysid.uncertainty import JointSummary, ParameterUncertainty, summarize

SHOWN_S = 20.0  # of each motion, so that details are visible
# rad of a position axis, so that encoder steps of a joint at rest are not magnified
MIN_POSITION_SPAN = 0.06
MIN_CORRECTION = 1e-5  # rad; smaller corrections are noise
MAX_JOINTS = 3  # of a motion
MAX_COLUMNS = 4
FLOOR_COLOUR = "#1f7a56"
QUANTILE_90 = 1.645  # standard deviations on each side of a 90 % interval
MAX_INTERVAL = 3.0  # of the joints' range; a wider interval is drawn as unknown


def by_group(methods: dict[str, Any], group: str, label: Callable[[str], str]) -> Figure:
    """Draw the MPJAE of each method by joint or payload; label names a bar's group."""
    field = f"by_{group}"
    keys = list(methods["nominal"][field])
    values = {}
    for name, metrics in methods.items():
        errors = [MeanStd.from_values([metrics[field][key]["mpjae"]], 1e3) for key in keys]
        values[title(name)] = (colour(name), errors)
    return _degrees(bars([label(key) for key in keys], values, "mrad", f"MPJAE by {group}"))


@styled
def by_horizon(methods: dict[str, Any]) -> Figure:
    """Draw the MPJAE of each method against the time since the common start."""
    horizons = [k for k in methods["nominal"]["by_horizon"] if k != "whole"]
    ticks = {float(k): f"{float(k):g} s" for k in horizons}
    ticks[4 * float(horizons[-1])] = "whole\nmotion"
    fig = figure(4.2, 3.2)
    ax = fig.subplots()
    for name, metrics in methods.items():
        errors = [1e3 * metrics["by_horizon"][k]["mpjae"] for k in (*horizons, "whole")]
        ax.plot(list(ticks), errors, "o-", ms=3.5, color=colour(name), label=title(name))
    ax.set_xscale("log")
    ax.minorticks_off()
    ax.set_xticks(list(ticks), list(ticks.values()))
    ax.set_title("MPJAE by time since the start of the rollout")
    ax.set_ylim(bottom=0)
    ax.set_ylabel("mrad")
    legend(fig)
    return _degrees(fig)


@styled
def _degrees(fig: Figure) -> Figure:
    """Add an axis in degrees on the right."""
    mrad = 1e3 * np.pi / 180
    ways: Any = (lambda y: y / mrad, lambda y: y * mrad)
    fig.axes[0].secondary_yaxis("right", functions=ways).set_ylabel("degrees")
    return fig


@styled
def training_curve(progress: list[dict[str, Any]]) -> Figure:
    """Draw the validation error during training; the selected model is circled."""
    fig = figure(5.0, 3.0)
    ax = fig.subplots()
    steps = np.array([p["steps"] for p in progress]) / 1e6
    value = np.array([p["val_mpjae"] for p in progress]) * 1e3
    ax.plot(steps, value, "-", color="#555555", lw=0.8)
    for stage, tint, label in (
        ("pretraining", colour("mlp"), "pre-training"),
        ("ppo", colour("gaponet"), "PPO"),
    ):
        at = [i for i, p in enumerate(progress) if p["stage"] == stage]
        if at:
            ax.plot(steps[at], value[at], "o", ms=3.5, color=tint, label=label)
    best = int(value.argmin())
    ax.plot(steps[best], value[best], "o", ms=9, mfc="none", mec="#111111", label="selected")
    ax.axhline(progress[0]["nominal_mpjae"] * 1e3, color=colour("nominal"), ls="--", lw=1)
    ax.annotate(
        "nominal",
        (1, progress[0]["nominal_mpjae"] * 1e3),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        color=colour("nominal"),
    )
    ax.set_ylim(bottom=0)
    ax.set_xlabel("control steps, million")
    ax.set_ylabel("validation MPJAE, mrad")
    ax.set_title("Training")
    legend(fig)
    return fig


def trajectories(
    arrays: dict[str, Array],
    shown: list[dict[str, Any]],
    joints: tuple[str, ...],
    methods: list[str],
) -> dict[int, Figure]:
    """Draw commanded, recorded and simulated positions of three joints for each stored motion.

    Args:
        arrays: For each row ROW/METHOD, recorded, command, delta/METHOD, (T, n) rad.

    Returns:
        Figures by row, the motion with the longest travel first.
    """
    travel = []
    for row in range(len(shown)):
        steps = np.diff(arrays[f"{row}/recorded"], axis=0)
        travel.append(np.abs(steps).sum())
    order = sorted(range(len(shown)), key=lambda row: -travel[row])
    return {row: _trajectory(arrays, row, joints, methods, shown[row]["dt"]) for row in order}


@styled
def _trajectory(
    arrays: dict[str, Array], row: int, joints: tuple[str, ...], methods: list[str], dt: float
) -> Figure:
    """Draw three joints of the stored motion `row`, a column each.

    Joints that move in the drawn part are picked before those at rest, and of either those with the
    largest nominal error in the whole motion. From top to bottom: positions, positions around the
    largest turn of the command, errors, and corrections if there are any.
    """
    recorded = arrays[f"{row}/recorded"]  # (T, n) rad
    command = arrays[f"{row}/command"]
    count = round(SHOWN_S / dt)
    start = busiest_window(recorded, count)
    window = slice(start, min(start + count, len(recorded)))
    is_still = np.ptp(command[window], axis=0) <= MIN_MOTION_RAD  # (n,)
    nominal_error = np.abs(arrays[f"{row}/nominal"] - recorded).mean(axis=0)  # (n,) rad
    order = np.lexsort((-nominal_error, is_still))  # the last key counts most
    picked = sorted(order[:MAX_JOINTS].tolist())
    deltas = {}
    for name in methods:
        delta = arrays.get(f"{row}/delta/{name}")
        if delta is not None and np.abs(delta).max() > MIN_CORRECTION:
            deltas[name] = delta[window]
    heights = {"position, rad": 1.8, "zoom, rad": 1.6, "error, mrad": 1.1}  # of panels, top first
    if deltas:
        heights["Δa, mrad"] = 0.9
    fig = figure(3.6 * len(picked), 1.0 + 1.1 * sum(heights.values()))
    axes = fig.subplots(
        len(heights), len(picked), squeeze=False, height_ratios=list(heights.values())
    )
    time = np.arange(len(recorded))[window] * dt
    for column, j in zip(axes.T, picked, strict=True):
        shown = _JointPaths(
            time,
            dt,
            command=command[window, j],
            recorded=recorded[window, j],
            simulated={name: arrays[f"{row}/{name}"][window, j] for name in methods},
            deltas={name: delta[:, j] for name, delta in deltas.items()},
        )
        heading = joint_label(joints[j], wrapped=False)
        column[0].set_title(f"{heading} (stands still)" if is_still[j] else heading)
        _draw_joint(column, shown)
    for panels, label in zip(axes, heights, strict=True):
        panels[0].set_ylabel(label)
    for panels in axes[2:]:  # errors and corrections
        _centre_on_zero(panels)
    fig.align_ylabels(axes[:, 0])
    legend(fig)
    return fig


@dataclass(frozen=True)
class _JointPaths:
    """Paths of one joint in the part of a motion that is drawn, (T,) each."""

    time: Array  # s
    dt: float  # s
    command: Array  # rad
    recorded: Array  # rad
    simulated: dict[str, Array]  # method → rad
    deltas: dict[str, Array]  # method → correction, rad; of methods with a network


def _draw_joint(column: Array, paths: _JointPaths) -> None:
    """Draw a joint into a column of axes, from top to bottom as `_trajectory` says."""
    whole, zoomed, error = column[:3]
    time = paths.time
    zoom = _turn(paths.command, paths.dt)
    _draw_positions(whole, paths, slice(None))
    _draw_positions(zoomed, paths, zoom)
    whole.axvspan(*time[zoom][[0, -1]], color="#000000", alpha=0.06, lw=0)
    for name, qpos in paths.simulated.items():
        error.plot(time, (qpos - paths.recorded) * 1e3, color=colour(name), lw=1.0)
    error.axhline(0, color="#111111", lw=0.6)
    for name, delta in paths.deltas.items():
        column[3].plot(time[: len(delta)], delta * 1e3, color=colour(name), lw=0.9)
    column[-1].set_xlabel("time, s")
    for ax in (whole, *column[2:]):
        ax.set_xlim(time[0], time[-1])


def _draw_positions(ax: Axes, paths: _JointPaths, part: slice) -> None:
    """Draw some rows of a joint's command, of its positions by each method, and as recorded."""
    time = paths.time[part]
    ax.step(
        time,
        paths.command[part],
        where="post",
        color=colour("command"),
        ls=DOTTED,
        lw=1.1,
        label=title("command"),
    )
    for name, qpos in paths.simulated.items():
        ax.plot(time, qpos[part], color=colour(name), label=title(name))
    ax.plot(
        time,
        paths.recorded[part],
        color=colour("recorded"),
        ls=DASHED,
        lw=1.0,
        label=title("recorded"),
    )
    low, high = ax.get_ylim()
    if high - low < MIN_POSITION_SPAN:
        middle_twice = low + high
        ax.set_ylim((middle_twice - MIN_POSITION_SPAN) / 2, (middle_twice + MIN_POSITION_SPAN) / 2)


def _centre_on_zero(panels: Array) -> None:
    """Give panels that stand side by side one vertical range, with zero in the middle."""
    ends = [np.abs(ax.dataLim.intervaly).max() for ax in panels]
    end = 1.08 * max(ends) or 1.0
    for ax in panels:
        ax.set_ylim(-end, end)


def _turn(command: Array, dt: float) -> slice:
    """Return the rows of 2 s around the largest change of the command's speed."""
    half = round(1 / dt)
    if len(command) <= 2 * half:
        return slice(0, len(command))
    change = 2 * command[half:-half] - command[: -2 * half] - command[2 * half :]
    start = int(np.abs(change).argmax())
    return slice(start, start + 2 * half)


def write_gap(gap: dict[str, Any], folder: Path) -> None:
    """Write the result of evaluation.gap.gap_by_step as gap.json, gap.svg and gap.png into a robot
    folder or a run.
    """
    with lock_folder(folder, "robot" if is_robot(folder) else "run"):
        write_text(folder / "gap.json", json.dumps(gap, indent=1) + "\n")
        save(waterfall(gap), folder / "gap")


@styled
def waterfall(gap: dict[str, Any]) -> Figure:
    """Draw the reduction of the mean |error| by each step (hollow: increase), all joints first,
    and the error floor.
    """
    panels = {"all joints": {"left": gap["left"], "floor": gap["floor"]}} | gap["by_joint"]
    steps = list(gap["left"])
    rows = math.ceil(len(panels) / MAX_COLUMNS)
    columns = math.ceil(len(panels) / rows)
    fig = figure(1.2 + 2.3 * columns, (0.55 + 0.16 * len(steps)) * rows + 0.6)
    axes = fig.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for i, (name, panel) in enumerate(panels.items()):
        ax = axes.flat[i]
        errors = {step: 1e3 * error for step, error in panel["left"].items()}  # mrad
        _waterfall_panel(ax, steps, errors, panel["floor"]["both"])
        ax.set_title(joint_label(name, wrapped=False))
        is_lowest = i + columns >= len(panels)
        ax.xaxis.set_tick_params(labelbottom=is_lowest)
        if is_lowest:
            ax.set_xlabel("MPJAE, mrad")
    axes[0, 0].set_yticks(range(len(steps) + 1), [*map(title, steps), "remaining"])
    for ax in axes[:, 0]:
        ax.tick_params(axis="y", labelsize=7)
    axes[0, 0].invert_yaxis()
    robot = f"{'VIRTUAL' if gap['virtual'] else 'real'} {gap['robot']}"
    recordings = "test recording" if gap["unseen"] else "recording"
    if gap["sequences"] != 1:
        recordings += "s"
    fig.suptitle(
        f"{robot}, {gap['sequences']} {recordings}: reduction "
        "of the error by each step (hollow: increase)\ndashed: floor, by encoder and "
        "repeatability (– unknown)",
        fontsize=9,
        x=0.01,
        ha="left",
    )
    return fig


def _waterfall_panel(
    ax: Axes, steps: list[str], errors: dict[str, float], floor: float | None
) -> None:
    """Draw one panel; errors after each step in mrad, floor in rad."""
    start = errors[steps[0]]
    before = start
    ax.barh(0, before, color=colour("nominal"))
    for k, step in enumerate(steps[1:], 1):
        after = errors[step]
        ax.barh(
            k,
            abs(before - after),
            left=min(before, after),
            color="white" if after > before else colour(step),
            edgecolor=colour(step),
            lw=1.0,
        )
        ax.plot([before, before], [k - 0.6, k + 0.4], color="#555555", lw=0.6)
        ax.annotate(
            f"{after - before:+.1f}".replace("-", "−"),
            (max(before, after), k),
            (2, 0),
            ha="left",
            va="center",
            textcoords="offset points",
            fontsize=6.5,
            color=shade(colour(step), -0.25),
        )
        before = after
    ax.plot([before, before], [len(steps) - 0.6, len(steps) + 0.4], color="#555555", lw=0.6)
    ax.barh(len(steps), before, color="#333333")
    for k, error in ((len(steps), before), (0, start)):
        ax.annotate(
            f"{error:.1f}",
            (error, k),
            (2, 0),
            ha="left",
            va="center",
            textcoords="offset points",
            fontsize=7,
        )
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
    fields = []
    for field in uncertainty.fields:
        if any(summary.values[field] for summary in summaries):
            fields.append(field)
    columns = min(MAX_COLUMNS, len(fields))
    rows = math.ceil(len(fields) / columns)
    fig = figure(2.4 * columns + 1.0, (0.24 * len(joints) + 0.8) * rows + 0.4)
    axes = fig.subplots(rows, columns, squeeze=False)
    for ax in axes.flat[len(fields) :]:
        ax.set_visible(False)
    labels = [joint_label(joint, wrapped=False) for joint in joints]
    for place, (ax, field) in enumerate(zip(axes.flat, fields, strict=False)):
        is_leftmost = place % columns == 0
        _draw_parameter(ax, field, summaries)
        y = np.arange(len(joints))[::-1]  # the first joint on top
        ax.set_yticks(y, labels if is_leftmost else [""] * len(joints))
        ax.set_ylim(-0.6, len(joints) - 0.4)
    fig.suptitle(heading, x=0.01, ha="left", fontsize=9, fontweight="bold")
    return fig


def _draw_parameter(ax: Axes, field: str, summaries: list[JointSummary]) -> None:
    """Draw the values of a field, the first joint on top, with their 90 % intervals; hollow and
    without interval where that is too wide.
    """
    factor = SERVO_FIELDS[field].factor
    values = np.array([s.values[field] * factor for s in summaries])
    half = np.array([QUANTILE_90 * s.errors[field] * factor for s in summaries])
    span = max(float(np.ptp(values)), float(np.abs(values).max()) * 0.1, 1e-9)
    is_known = half < MAX_INTERVAL * span
    y = np.arange(len(summaries))[::-1]
    ax.errorbar(
        values[is_known],
        y[is_known],
        xerr=half[is_known],
        fmt="o",
        ms=3.5,
        capsize=2,
        lw=1.2,
        color="#1f5fa8",
    )
    ax.plot(values[~is_known], y[~is_known], "o", ms=4, mfc="none", color="#999999")
    ax.set_title(SERVO_FIELDS[field].heading)
