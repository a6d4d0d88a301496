"""Figures of a dataset and of the doctor's findings. Recordings are selected by fixed rules."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from gaponet.base.arrays import Array
from gaponet.base.files import lock_folder
from gaponet.base.progress import Progress, no_progress
from gaponet.data.repeatability import MIN_MOTION_RAD
from gaponet.data.sequence import LEVELS, Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.evaluation.candidate import robot_label
from gaponet.evaluation.evaluate import evenly_spaced
from gaponet.report.figures.style import figure, joint_label, legend, save, styled
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec

MAX_RANGE_SEQUENCES = 400  # of joint_ranges
MAX_RANGE_ROWS = 40_000  # of joint_ranges
MAX_TORQUE_MOTIONS = 60  # compared to find the motion with the largest change of torque
MAX_PAYLOADS = 4  # of torque_temperature
MAX_JOINTS = 3  # of a figure
SHOWN_S = 12.0  # of a long motion
SIDES = {"left": "#3b7dd8", "right": "#d9662b", "": "#4d8f5b"}
LEVEL_COLOURS = dict(zip(LEVELS, ("#9ecae1", "#4292c6", "#084594"), strict=True))
SINGLE_POINTS = 250  # single rows drawn for each joint
FINDING_S = 8.0  # of the recording with a finding
TORQUE_CHECKS = ("torque", "saturation", "gravity")
COMMAND_COLOUR = "#222222"
STATE_COLOUR = "#d9662b"
TORQUE_COLOUR = "#3b7dd8"


class _NoDataError(Exception):
    """The dataset has no data for a figure; the message gives the reason."""


def write_figures(
    dataset: Dataset, robot: RobotSpec, out: Path, progress: Progress = no_progress
) -> tuple[list[Path], dict[str, str]]:
    """Write every figure for which the dataset has data.

    Return the files, and {figure: reason for its absence}.
    """
    dataset.require_robot(robot)
    dataset.require_sequences()
    with lock_folder(out, "figures"):
        figures, left_out = draw_figures(dataset, robot, progress)
        written = []
        for name, fig in figures.items():
            written += save(fig, out / name)
    return written, left_out


def draw_figures(
    dataset: Dataset, robot: RobotSpec, progress: Progress = no_progress
) -> tuple[dict[str, Figure], dict[str, str]]:
    """Draw all figures. Return them, and {figure: reason for its absence}."""
    figures = dict[str, Figure]()
    left_out = dict[str, str]()
    for i, (name, draw) in enumerate(FIGURES.items()):
        progress(i, len(FIGURES), name)
        try:
            figures[name] = draw(dataset, robot)
        except _NoDataError as reason:
            left_out[name] = str(reason)
    progress(len(FIGURES), len(FIGURES), "")
    return figures, left_out


def joint_ranges(dataset: Dataset, robot: RobotSpec) -> Figure:
    """Draw positions of each operated joint, of sequences that command it to move."""
    rows: dict[str, list[Array]] = defaultdict(list)
    entries = evenly_spaced(dataset.entries, MAX_RANGE_SEQUENCES)
    stride = max(1, sum(e.rows for e in entries) // MAX_RANGE_ROWS)
    for entry in entries:
        arrays = dataset.channels(entry, ("ctrl", "qpos"))
        for joint, j in zip(robot.operated, robot.operated_index, strict=True):
            if np.ptp(arrays["ctrl"][:, j]) > MIN_MOTION_RAD:
                rows[joint].append(arrays["qpos"][::stride, j])
    if not rows:
        raise _NoDataError("no operated joint is commanded to move")
    positions = {joint: np.concatenate(rows[joint]) for joint in robot.operated if joint in rows}
    limits = {j: tuple(robot.qpos_range[robot.joint_names.index(j)]) for j in positions}
    part = f"{len(entries)} of " if len(entries) < len(dataset) else ""
    title = (
        f"{robot_label(entries)}: where joints were while commanded to move, "
        f"{part}{len(dataset):,} sequences"
    )
    return draw_joint_ranges(positions, limits, title)


@styled
def draw_joint_ranges(
    positions: dict[str, Array], limits: dict[str, tuple[float, float]], title: str
) -> Figure:
    """Draw a raincloud of each joint: density, quartiles with 1 % and 99 %, single rows.

    grey: the joint's range.

    Args:
        positions: {joint: (k,) rad}.
        limits: {joint: (low, high) rad}, infinite where there is none.
    """
    fig = figure(7.0, 1.2 + 0.62 * len(positions))
    ax = fig.subplots()
    rng = np.random.default_rng(0)
    for row, (joint, values) in enumerate(positions.items()):
        lowest, highest = limits[joint]
        if np.isfinite([lowest, highest]).all():
            ax.barh(-row, highest - lowest, 0.86, lowest, color="#000000", alpha=0.05, lw=0)
        _draw_raincloud(ax, -row, values, _side_colour(joint), rng)
    ax.set_yticks(-np.arange(len(positions)), [joint_label(j, wrapped=False) for j in positions])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_ylim(-len(positions) + 0.45, 0.55)
    ax.spines["left"].set_visible(False)
    low, high = ax.dataLim.intervalx
    ax.set_xlim(low - 0.1, high + 0.1)
    ax.set_xlabel(
        "position, rad\nthick: quartiles, thin: 1–99 %, circle: median, points: single rows, "
        "grey: range of the joint"
    )
    degrees = ax.secondary_xaxis("top", functions=(np.degrees, np.radians))
    degrees.xaxis.set_major_locator(MultipleLocator(45))
    degrees.set_xlabel("position, degrees")
    degrees.spines["top"].set_visible(True)
    fig.suptitle(title, x=0.01, ha="left", fontsize=9, fontweight="bold")
    return fig


def _draw_raincloud(
    ax: Axes, y: float, values: Array, colour: str, rng: np.random.Generator
) -> None:
    """Draw values (k,) at height y: density, quartiles with 1 % and 99 %, single values."""
    x, density = _density(values)
    ax.fill_between(x, y + 0.06, y + 0.06 + 0.36 * density, color=colour, alpha=0.75, lw=0)
    low, q1, middle, q3, high = np.percentile(values, [1, 25, 50, 75, 99])
    ax.plot([low, high], [y, y], color=colour, lw=1)
    ax.plot([q1, q3], [y, y], color=colour, lw=4, solid_capstyle="butt")
    ax.plot(middle, y, "o", ms=3.2, mfc="white", mec=colour, mew=1)
    rain = rng.choice(values, min(SINGLE_POINTS, len(values)), replace=False)
    heights = y - 0.23 + rng.uniform(-0.12, 0.12, len(rain))
    ax.plot(rain, heights, ".", ms=1.6, mew=0, color=colour, alpha=0.5)


def _side_colour(joint: str) -> str:
    """Return the colour of the robot's side at which a joint is."""
    for side in ("left", "right"):
        if joint.startswith(side):
            return SIDES[side]
    return SIDES[""]


def _density(values: Array) -> tuple[Array, Array]:
    """Return positions and kernel density over the values' range, scaled to a peak of 1."""
    low = values.min()
    high = values.max()
    width = np.clip(0.015 * (high - low), 1e-3, 0.04)  # rad, of the kernel
    x = np.linspace(low - 3 * width, high + 3 * width, 400)
    counts, edges = np.histogram(values, 400, (x[0], x[-1]))
    kernel = np.exp(-0.5 * ((x - x.mean()) / width) ** 2)
    density = np.convolve(counts, kernel, "same")
    return (edges[1:] + edges[:-1]) / 2, density / density.max()


@styled
def composition(dataset: Dataset, robot: RobotSpec) -> Figure:
    """Draw hours by payload, unit and rate, stacked by level.

    The numbers over the bars are sequences.
    """
    entries = dataset.entries
    motions = len({e.meta.motion for e in entries})
    title = f"{robot_label(entries)}: {dataset.hours():.2f} h, {motions} motions"
    groups = {
        "payload, kg per hand": _grouped(entries, lambda e: e.meta.payload_mass),
        "unit": _grouped(entries, lambda e: e.meta.unit_id),
        "rate, Hz": _grouped(entries, lambda e: round(1 / e.dt, 2)),
    }
    fig = figure(7.0, 2.9)
    widths = [max(2, len(group)) for group in groups.values()]
    axes = fig.subplots(1, 3, sharey=True, width_ratios=widths)
    for ax, (label, group) in zip(axes, groups.items(), strict=True):
        _stack_hours(ax, group, {e.meta.level for e in entries})
        ax.set_xlabel(label)
    axes[0].set_ylabel("recorded, h")
    axes[0].margins(y=0.09)
    fig.align_xlabels(axes)
    legend(fig, f"{title}; numbers are sequences")
    return fig


def _grouped(entries: list[Entry], key: Callable[[Entry], Any]) -> dict[Any, list[Entry]]:
    """Return the entries by a value, in its order."""
    groups: dict[Any, list[Entry]] = defaultdict(list)
    for entry in entries:
        groups[key(entry)].append(entry)
    return dict(sorted(groups.items()))


def _stack_hours(ax: Axes, groups: dict[Any, list[Entry]], levels: set[str]) -> None:
    """Draw a bar of recorded hours for each group, stacked by level."""
    base = np.zeros(len(groups))
    x = range(len(groups))
    for level in LEVELS:
        if level not in levels:
            continue
        hours = np.array([_hours(group, level) for group in groups.values()])
        name = level.replace("_", " ")
        ax.bar(x, hours, 0.72, base, color=LEVEL_COLOURS[level], label=name)
        base = base + hours
    for i, group in enumerate(groups.values()):
        ax.annotate(
            f"{len(group):,}",
            (i, base[i]),
            (0, 2),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
        )
    ticks = [value if isinstance(value, str) else f"{value:g}" for value in groups]
    if max(map(len, ticks)) > 5:
        ax.set_xticks(x, ticks, rotation=30, ha="right")
    else:
        ax.set_xticks(x, ticks, rotation=0, ha="center")
    ax.set_xlim(-0.6, len(groups) - 0.4)
    ax.grid(axis="x", visible=False)


def _hours(entries: list[Entry], level: str) -> float:
    """Return the recorded time of the entries of a level, h."""
    return sum(e.rows * e.dt for e in entries if e.meta.level == level) / 3600


def torque_temperature(dataset: Dataset, robot: RobotSpec) -> Figure:
    """Draw the motion with the largest change of torque at several payloads, and the joints that
    bear it.
    """
    group = largest_torque_change(dataset, robot)
    payloads = evenly_spaced(sorted({e.meta.payload_mass for e in group}), MAX_PAYLOADS)
    takes = {}
    for payload in payloads:
        take = dataset.read(next(e for e in group if e.meta.payload_mass == payload))
        takes[payload] = take.rows(slice(0, max(2, round(SHOWN_S / take.dt))))
    heaviest = takes[max(takes)]
    assert heaviest.tau is not None
    size = swing(heaviest.tau[:, robot.operated_index])
    joints = [robot.operated[i] for i in sorted(np.argsort(-size)[:MAX_JOINTS])]
    meta = heaviest.meta
    title = f"{robot_label(group)}: {meta.motion}, {meta.unit_id}"
    return draw_torque_temperature(takes, joints, title)


FIGURES = {
    "joint_ranges": joint_ranges,
    "composition": composition,
    "torque_temperature": torque_temperature,
}


@styled
def draw_torque_temperature(takes: dict[float, Sequence], joints: list[str], title: str) -> Figure:
    """Draw position, torque and warming over time of one motion with several payloads.

    Args:
        takes: {payload kg: recording} in ascending order, with torque or temperature or both.
    """
    first = next(iter(takes.values()))
    labels = {"qpos": "position, rad", "tau": "torque, N·m", "temperature": "warming, K"}
    rows = [channel for channel in labels if getattr(first, channel) is not None]
    fig = figure(7.0, 0.9 + 1.45 * len(rows))
    axes = fig.subplots(len(rows), len(joints), sharex=True, squeeze=False)
    for ax in axes[1:, 1:].flat:  # one scale for a row, so that joints can be compared
        ax.sharey(axes[ax.get_subplotspec().rowspan.start, 0])
        ax.tick_params(labelleft=False)
    shades = np.linspace(0.85, 0.05, len(takes)) if len(takes) > 1 else [0.4]
    colours = mpl.colormaps["plasma"](shades)
    for colour, (payload, take) in zip(colours, takes.items(), strict=True):
        time = np.arange(len(take)) * take.dt
        for column, joint in enumerate(joints):
            j = take.joint_names.index(joint)
            for row, channel in enumerate(rows):
                values = getattr(take, channel)[:, j]
                if channel == "temperature":
                    values = values - values[0]
                axes[row, column].plot(time, values, color=colour, lw=0.9, label=f"{payload:g} kg")
    for column, joint in enumerate(joints):
        axes[0, column].set_title(joint_label(joint, wrapped=False))
        axes[-1, column].set_xlabel("time, s")
        axes[0, column].margins(x=0.01)
    for row, channel in enumerate(rows):
        axes[row, 0].set_ylabel(labels[channel])
    fig.align_ylabels(axes[:, 0])
    legend(fig, title)
    return fig


def largest_torque_change(dataset: Dataset, robot: RobotSpec) -> list[Entry]:
    """Return the entries of the motion with the largest change of torque.

    Only motions with the most payloads count.
    """
    # Entries of a group differ only in payload and repetition.
    takes: dict[tuple[Any, ...], list[Entry]] = defaultdict(list)
    for e in dataset.entries:
        takes[e.meta.motion, e.meta.unit_id, e.meta.payload_side, round(e.dt, 7)].append(e)
    groups = [group for group in takes.values() if all("tau" in e.channels for e in group)]
    if not groups:
        raise _NoDataError("no torque was recorded")
    most = max(map(_count_payloads, groups))
    by_motion: dict[str, list[Entry]] = {}  # the first group of each motion; the last motion first
    for group in reversed(groups):
        if _count_payloads(group) == most:
            by_motion[group[0].meta.motion] = group

    def torque(group: list[Entry]) -> float:
        entry = max(group, key=lambda e: e.meta.payload_mass)
        rows = dataset.channels(entry, ("tau",))["tau"][: round(SHOWN_S / entry.dt)]
        return float(swing(rows[:, robot.operated_index]).mean())

    return max(evenly_spaced(list(by_motion.values()), MAX_TORQUE_MOTIONS), key=torque)


def _count_payloads(entries: list[Entry]) -> int:
    return len({e.meta.payload_mass for e in entries})


def swing(values: Array) -> Array:
    """Return the range of a signal from its 5th to its 95th percentile, (T, n) → (n,)."""
    low, high = np.percentile(values, [5, 95], axis=0)
    result: Array = high - low
    return result


def draw_findings(
    dataset: Dataset, robot: RobotSpec, findings: list[Finding], out: Path
) -> list[Path]:
    """Write a figure (SVG, PNG) for each warning, error, and note about a joint.

    Return the files.
    """
    shown = [finding for finding in findings if _deserves_figure(finding)]
    written = []
    for number, finding in enumerate(shown, 1):
        sequence = dataset.read(_entry(dataset.entries, finding))
        joints = [j for j in finding.joints or robot.operated if j in robot.joint_names]
        fig = _draw_finding(finding, sequence, robot.index(joints[:MAX_JOINTS]))
        written += save(fig, out / f"{number:02d}-{finding.check}")
    return written


def _deserves_figure(finding: Finding) -> bool:
    if finding.level == "note":
        return bool(finding.joints)
    return finding.level in ("warning", "error")


def _entry(entries: list[Entry], finding: Finding) -> Entry:
    """Return the recording that the message names first, else the first recording."""
    words = re.split(r"[\s,;:()]+", finding.message)
    named = {e.meta.motion: e for e in reversed(entries)}
    return next((named[word] for word in words if word in named), entries[0])


@styled
def _draw_finding(finding: Finding, sequence: Sequence, joints: Array) -> Figure:
    torque = sequence.tau if finding.check in TORQUE_CHECKS else None
    rows = _window(finding, sequence, joints, torque)
    time = np.arange(len(sequence))[rows] * sequence.dt
    fig = figure(7.0, 1.3 + 1.5 * len(joints))
    axes = np.atleast_1d(fig.subplots(len(joints), sharex=True))
    for ax, j in zip(axes, joints, strict=True):
        if torque is not None:
            ax.plot(time, torque[rows, j], color=TORQUE_COLOUR, label="torque")
        else:
            ax.plot(time, sequence.ctrl[rows, j], color=COMMAND_COLOUR, label="command")
            ax.plot(time, sequence.qpos[rows, j], color=STATE_COLOUR, label="state")
        unit = "rad" if torque is None else "N·m"
        ax.set_ylabel(f"{joint_label(sequence.joint_names[j])}, {unit}")
    axes[-1].set_xlabel(f"time in {sequence.meta.motion}, s")
    legend(fig)
    axes[0].set_title(
        fill(f"{finding.level}, {finding.check}: {finding.message}", 105),
        fontsize=8,
        weight="normal",
    )
    return fig


def _window(finding: Finding, sequence: Sequence, joints: Array, torque: Array | None) -> slice:
    """Return the rows around the largest error, jump or torque."""
    ctrl = sequence.ctrl[:, joints]
    qpos = sequence.qpos[:, joints]
    worst = np.abs(torque[:, joints]) if torque is not None else np.abs(ctrl - qpos)
    if finding.check == "jumps":
        worst = np.abs(np.diff(qpos, n=2, axis=0, prepend=qpos[:1], append=qpos[-1:]))
    middle = int(worst.max(axis=1).argmax())
    half = round(FINDING_S / 2 / sequence.dt)
    start = min(max(0, middle - half), max(0, len(qpos) - 2 * half))
    return slice(start, start + 2 * half)
