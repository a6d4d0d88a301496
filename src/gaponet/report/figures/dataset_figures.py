"""The figures of a dataset, drawn from arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from gaponet.base.arrays import Array
from gaponet.data.sequence import LEVELS, Sequence
from gaponet.data.store import Entry
from gaponet.report.figures.style import figure, joint_label, legend, styled
from gaponet.report.methods import colour

SIDES = {"left": "#3b7dd8", "right": "#d9662b", "": "#4d8f5b"}
LEVEL_COLOURS = dict(zip(LEVELS, ("#9ecae1", "#4292c6", "#084594"), strict=True))
SINGLE_POINTS = 250  # single rows drawn for each joint


def payload_colours(payloads: list[float]) -> dict[float, Any]:
    """Return colours of the payloads from light to heavy, dark enough for print."""
    steps = np.linspace(0.85, 0.05, len(payloads)) if len(payloads) > 1 else [0.4]
    return dict(zip(payloads, mpl.colormaps["plasma"](steps), strict=True))


@styled
def joint_ranges(positions: dict[str, Array], limits: dict[str, tuple[float, float]], title: str) -> Figure:
    """Draw a raincloud of each joint: density, quartiles with 1 % and 99 %, single rows; grey: the joint's range.

    Args:
        positions: {joint: (k,) rad}.
        limits: {joint: (low, high) rad}, infinite where there is none.
    """
    fig = figure(7.0, 1.2 + 0.62 * len(positions))
    ax = fig.subplots()
    rng = np.random.default_rng(0)
    for row, (joint, values) in enumerate(positions.items()):
        y, tint = -row, SIDES[next((s for s in ("left", "right") if joint.startswith(s)), "")]
        if np.isfinite(limits[joint]).all():
            ax.barh(y, np.ptp(limits[joint]), 0.86, limits[joint][0], color="#000000", alpha=0.05, lw=0)
        x, density = _density(values)
        ax.fill_between(x, y + 0.06, y + 0.06 + 0.36 * density, color=tint, alpha=0.75, lw=0)
        low, q1, middle, q3, high = np.percentile(values, [1, 25, 50, 75, 99])
        ax.plot([low, high], [y, y], color=tint, lw=1)
        ax.plot([q1, q3], [y, y], color=tint, lw=4, solid_capstyle="butt")
        ax.plot(middle, y, "o", ms=3.2, mfc="white", mec=tint, mew=1)
        rain = rng.choice(values, min(SINGLE_POINTS, len(values)), replace=False)
        ax.plot(rain, y - 0.23 + rng.uniform(-0.12, 0.12, len(rain)), ".", ms=1.6, mew=0, color=tint, alpha=0.5)
    ax.set_yticks(-np.arange(len(positions)), [joint_label(j, wrapped=False) for j in positions])
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_ylim(-len(positions) + 0.45, 0.55)
    ax.spines["left"].set_visible(False)
    low, high = ax.dataLim.intervalx
    ax.set_xlim(low - 0.1, high + 0.1)
    ax.set_xlabel(
        "position, rad\nthick: quartiles, thin: 1–99 %, circle: median, points: single rows, grey: range of the joint"
    )
    degrees = ax.secondary_xaxis("top", functions=(np.degrees, np.radians))
    degrees.xaxis.set_major_locator(MultipleLocator(45))
    degrees.set_xlabel("position, degrees")
    degrees.spines["top"].set_visible(True)
    fig.suptitle(title, x=0.01, ha="left", fontsize=9, fontweight="bold")
    return fig


def _density(values: Array) -> tuple[Array, Array]:
    """Return positions and kernel density over the values' range, scaled to a peak of 1."""
    low, high = values.min(), values.max()
    width = np.clip(0.015 * (high - low), 1e-3, 0.04)  # rad, of the kernel
    x = np.linspace(low - 3 * width, high + 3 * width, 400)
    counts, edges = np.histogram(values, 400, (x[0], x[-1]))
    kernel = np.exp(-0.5 * ((x - x.mean()) / width) ** 2)
    density = np.convolve(counts, kernel, "same")
    return (edges[1:] + edges[:-1]) / 2, density / density.max()


@styled
def composition(entries: list[Entry], title: str) -> Figure:
    """Draw hours by payload, unit and rate, stacked by level, with the number of sequences over each bar."""
    keys = {
        "payload, kg per hand": lambda e: e.meta.payload_mass,
        "unit": lambda e: e.meta.unit_id,
        "rate, Hz": lambda e: round(1 / e.dt, 2),
    }
    names = [sorted({key(e) for e in entries}) for key in keys.values()]
    fig = figure(7.0, 2.9)
    axes = fig.subplots(1, 3, sharey=True, width_ratios=[max(2, len(n)) for n in names])
    present = [level for level in LEVELS if any(e.meta.level == level for e in entries)]
    for ax, (label, key), values in zip(axes, keys.items(), names, strict=True):
        base = np.zeros(len(values))
        for level in present:
            hours = np.array([_hours(e for e in entries if key(e) == v and e.meta.level == level) for v in values])
            ax.bar(range(len(values)), hours, 0.72, base, color=LEVEL_COLOURS[level], label=level.replace("_", " "))
            base = base + hours
        for x, v in enumerate(values):
            ax.annotate(f"{sum(key(e) == v for e in entries):,}", (x, base[x]), (0, 2), textcoords="offset points",
                        ha="center", fontsize=7.5)  # fmt: skip
        ticks = [v if isinstance(v, str) else f"{v:g}" for v in values]
        long = max(map(len, ticks)) > 5
        ax.set_xticks(range(len(values)), ticks, rotation=30 if long else 0, ha="right" if long else "center")
        ax.set_xlim(-0.6, len(values) - 0.4)
        ax.set_xlabel(label)
        ax.grid(axis="x", visible=False)
    axes[0].set_ylabel("recorded, h")
    axes[0].margins(y=0.09)
    fig.align_xlabels(axes)
    legend(fig, f"{title}; numbers are sequences")
    return fig


def _hours(entries: Iterable[Entry]) -> float:
    return sum(e.rows * e.dt for e in entries) / 3600


@styled
def torque_temperature(takes: dict[float, Sequence], joints: list[str], title: str) -> Figure:
    """Draw position, torque and warming over time of one motion with several payloads.

    Args:
        takes: {payload kg: recording}, with torque or temperature or both.
    """
    first = next(iter(takes.values()))
    rows = [("qpos", "position, rad"), ("tau", "torque, N·m"), ("temperature", "warming, K")]
    rows = [(c, label) for c, label in rows if getattr(first, c) is not None]
    fig = figure(7.0, 0.9 + 1.45 * len(rows))
    axes = fig.subplots(len(rows), len(joints), sharex=True, squeeze=False)
    _same_scale(axes[1:])
    colours = payload_colours(sorted(takes))
    for payload in sorted(takes):
        take = takes[payload]
        time = np.arange(len(take)) * take.dt
        for column, joint in enumerate(joints):
            j = take.joint_names.index(joint)
            for row, (channel, _) in enumerate(rows):
                values = getattr(take, channel)[:, j]
                values = values - values[0] if channel == "temperature" else values
                axes[row, column].plot(time, values, color=colours[payload], lw=0.9, label=f"{payload:g} kg")
    for column, joint in enumerate(joints):
        axes[0, column].set_title(joint_label(joint, wrapped=False))
        axes[-1, column].set_xlabel("time, s")
        axes[0, column].margins(x=0.01)
    for row, (_, label) in enumerate(rows):
        axes[row, 0].set_ylabel(label)
    fig.align_ylabels(axes[:, 0])
    legend(fig, title)
    return fig


@styled
def overlay(real: Sequence, sim_qpos: Array, joints: list[str], title: str) -> Figure:
    """Draw command, recording and nominal simulation of some joints, and their difference below.

    Args:
        sim_qpos: Positions of the nominal simulator, (T, n) rad.
    """
    fig = figure(7.0, 3.7)
    axes = fig.subplots(2, len(joints), sharex=True, squeeze=False, height_ratios=[1.5, 1])
    _same_scale(axes[1:])
    time = np.arange(len(real)) * real.dt
    for column, joint in enumerate(joints):
        j = real.joint_names.index(joint)
        top, low = axes[:, column]
        top.plot(time, real.ctrl[:, j], color="#d99000", lw=0.8, ls=(0, (3, 1.5)), label="command")
        top.plot(time, sim_qpos[:, j], color=colour("nominal"), lw=1.4, label="simulated")
        top.plot(time, real.qpos[:, j], color=colour("recorded"), lw=1.0, label="recorded")
        gap = (real.qpos[:, j] - sim_qpos[:, j]) * 1e3
        low.axhline(0, color="#111111", lw=0.6)
        low.fill_between(time, gap, 0, color=colour("gaponet"), alpha=0.25, lw=0)
        low.plot(time, gap, color=colour("gaponet"), lw=0.9)
        top.set_title(joint_label(joint, wrapped=False))
        low.set_xlabel("time, s")
        top.margins(x=0.01)
    axes[0, 0].set_ylabel("position, rad")
    axes[1, 0].set_ylabel("gap, mrad")
    fig.align_ylabels(axes[:, 0])
    legend(fig, title)
    return fig


@styled
def gap_by_payload(errors: dict[float, Array], joints: list[str], title: str) -> Figure:
    """Draw the mean |gap| of each joint and of all joints by payload: median, quartiles, 5–95 % over sequences.

    Args:
        errors: {payload kg: (sequences, n) rad, mean |gap| of a sequence}.
        joints: (n).
    """
    fig = figure(7.0, 3.4)
    ax = fig.subplots()
    payloads, names = sorted(errors), ["all joints", *joints]
    colours, width = payload_colours(payloads), 0.8 / len(payloads)
    for i, payload in enumerate(payloads):
        values = np.column_stack([errors[payload].mean(axis=1), errors[payload]]) * 1e3  # (sequences, 1 + n)
        x = np.arange(len(names)) + (i - (len(payloads) - 1) / 2) * width
        low, q1, middle, q3, high = np.percentile(values, [5, 25, 50, 75, 95], axis=0)
        ax.vlines(x, low, high, color=colours[payload], lw=0.8)
        ax.bar(x, q3 - q1, width * 0.8, q1, color=colours[payload], label=f"{payload:g} kg")
        ax.hlines(middle, x - 0.4 * width, x + 0.4 * width, color="white", lw=1.2)
    ax.axvline(0.5, color="#999999", lw=0.6)
    ax.set_xticks(np.arange(len(names)), [joint_label(j) for j in names], fontsize=7.5)
    ax.set_xlim(-0.55, len(names) - 0.45)
    ax.set_ylim(bottom=0)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel("mean |recorded − simulated|, mrad")
    ax.set_xlabel("white: median over takes, box: quartiles, line: 5–95 %", fontsize=7.5)
    legend(fig, title)
    return fig


def _same_scale(rows: Any) -> None:
    """Give each row of axes one scale, so that joints can be compared."""
    for row in rows:
        for ax in row[1:]:
            ax.sharey(row[0])
            ax.tick_params(labelleft=False)
