"""The figures of a report: one function each, matplotlib in, Figure out."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.plot.methods import COLOURS, NAMES
from gaponet.plot.style import figure, styled

Array = np.ndarray


@styled
def by_joint(methods: dict[str, Any]) -> Figure:
    """MPJAE per joint, one bar per method."""
    return _bars(methods, "by_joint", "MPJAE by joint")


@styled
def by_payload(methods: dict[str, Any]) -> Figure:
    """MPJAE per payload, one bar per method."""
    return _bars(methods, "by_payload", "MPJAE by payload", suffix=" kg")


def _bars(methods: dict[str, Any], group: str, title: str, suffix: str = "") -> Figure:
    keys = list(methods["nominal"][group])
    fig = figure(max(5.2, 0.72 * len(keys) + 1.6), 3.0)
    ax = fig.subplots()
    width = 0.8 / len(methods)
    for i, (name, m) in enumerate(methods.items()):
        x = np.arange(len(keys)) + (i - (len(methods) - 1) / 2) * width
        values = [m[group][k]["mpjae"] * 1e3 for k in keys]
        ax.bar(x, values, width * 0.92, color=COLOURS[name], label=NAMES[name])
    labels = [k.removesuffix("_joint").replace("_", "\n") + suffix for k in keys]
    ax.set_xticks(np.arange(len(keys)), labels)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel("mrad")
    ax.set_title(title)
    _legend(fig, ax)
    return fig


def _legend(fig: Figure, ax: Any) -> None:
    """Above the plot, never over the data."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper left", ncols=len(labels), columnspacing=1.1, handlelength=1.4)


@styled
def by_horizon(methods: dict[str, Any]) -> Figure:
    """MPJAE against the time since the common start: does the error grow?"""
    fig = figure(5.0, 3.0)
    ax = fig.subplots()
    for name, m in methods.items():
        points = [(float(k), v["mpjae"] * 1e3) for k, v in m["by_horizon"].items() if k != "whole"]
        x, y = zip(*points, strict=True)
        end = x[-1] * 4
        ax.plot([*x, end], [*y, m["by_horizon"]["whole"]["mpjae"] * 1e3], "o-", ms=3.5, color=COLOURS[name],
                label=NAMES[name])  # fmt: skip
    ax.set_xscale("log")
    ax.set_xticks([*x, end], [*(f"{v:g} s" for v in x), "whole\nmotion"])
    ax.minorticks_off()
    ax.set_ylim(bottom=0)
    ax.set_ylabel("mrad")
    ax.set_title("MPJAE by horizon of the free run")
    _legend(fig, ax)
    return fig


@styled
def training_curve(progress: list[dict[str, Any]]) -> Figure:
    """Held-out error after each validation; stages shaded, the kept model marked."""
    fig = figure(5.0, 3.0)
    ax = fig.subplots()
    steps = np.array([p["steps"] for p in progress]) / 1e6
    value = np.array([p["val_mpjae"] for p in progress]) * 1e3
    ax.plot(steps, value, "-", color="#555555", lw=0.8)
    for stage, colour, label in (("warm start", "#3b7dd8", "warm start"), ("ppo", "#c8102e", "PPO")):
        at = [i for i, p in enumerate(progress) if p["stage"] == stage]
        if at:
            ax.plot(steps[at], value[at], "o", ms=3.5, color=colour, label=label)
    best = int(value.argmin())
    ax.plot(steps[best], value[best], "o", ms=9, mfc="none", mec="#111111", label="kept")
    ax.axhline(progress[0]["nominal_mpjae"] * 1e3, color=COLOURS["nominal"], ls="--", lw=1)
    ax.annotate("nominal", (1, progress[0]["nominal_mpjae"] * 1e3), xycoords=("axes fraction", "data"), ha="right",
                va="bottom", color=COLOURS["nominal"])  # fmt: skip
    ax.set_ylim(bottom=0)
    ax.set_xlabel("control steps, million")
    ax.set_ylabel("validation MPJAE, mrad")
    ax.set_title("Training")
    _legend(fig, ax)
    return fig


@styled
def trajectories(
    arrays: dict[str, Array], row: int, joints: list[str], columns: list[int], methods: list[str], dt: float
) -> Figure:
    """Recorded against simulated position of a few joints, and the error below, over one motion."""
    fig = figure(3.6 * len(columns), 4.4)
    axes = fig.subplots(3, len(columns), sharex=True, squeeze=False, height_ratios=[2, 1.2, 1])
    window = _window(arrays[f"{row}/recorded"][:, columns], dt)
    recorded = arrays[f"{row}/recorded"]
    time = np.arange(len(recorded)) * dt
    for c, j in enumerate(columns):
        top, mid, low = axes[:, c]
        for name in methods:
            x = arrays[f"{row}/{name}"][:, j]
            top.plot(time[window], x[window], color=COLOURS[name], label=NAMES[name])
            mid.plot(time[window], (x - recorded[:, j])[window] * 1e3, color=COLOURS[name])
            if f"{row}/delta/{name}" in arrays:
                delta = arrays[f"{row}/delta/{name}"][:, j]
                part = slice(window.start, min(window.stop, len(delta)))
                low.plot(time[part], delta[part] * 1e3, color=COLOURS[name], lw=0.9)
        top.plot(
            time[window], recorded[window, j], color=COLOURS["recorded"], lw=1.0, ls=(0, (4, 1.5)), label="recorded"
        )
        mid.axhline(0, color="#111111", lw=0.6)
        top.set_title(joints[j].removesuffix("_joint"))
        low.set_xlabel("time, s")
    for ax, label in zip(axes[:, 0], ("position, rad", "error, mrad", "Δa, mrad"), strict=True):
        ax.set_ylabel(label)
    fig.align_ylabels(axes[:, 0])
    _legend(fig, axes[0, 0])
    return fig


def _window(recorded: Array, dt: float, seconds: float = 20.0) -> slice:
    """The stretch with the most motion; a two-minute plot shows nothing."""
    n = round(seconds / dt)
    if len(recorded) <= n:
        return slice(0, len(recorded))
    moved = np.concatenate([[0], np.abs(np.diff(recorded, axis=0)).sum(axis=1).cumsum()])
    gain = moved[n:] - moved[:-n]
    start = int(gain.argmax())
    return slice(start, start + n)
