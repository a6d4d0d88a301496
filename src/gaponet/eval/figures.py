"""The figures of a report: one function each, matplotlib in, Figure out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.plot.charts import Once, against, bars, lines
from gaponet.plot.methods import COLOURS, colour, title
from gaponet.plot.style import figure, joint_label, legend, styled

Array = np.ndarray


def by_joint(methods: dict[str, Any]) -> Figure:
    """MPJAE per joint, one bar per method."""
    return _bars(methods, "by_joint", "MPJAE by joint", joint_label)


def by_payload(methods: dict[str, Any]) -> Figure:
    """MPJAE per payload, one bar per method."""
    return _bars(methods, "by_payload", "MPJAE by payload", "{} kg".format)


def _bars(methods: dict[str, Any], group: str, heading: str, label: Callable[[str], str]) -> Figure:
    keys = list(methods["nominal"][group])
    values = {title(n): (colour(n), [Once(1e3 * m[group][k]["mpjae"]) for k in keys]) for n, m in methods.items()}
    return bars([label(k) for k in keys], values, "mrad", heading)


def by_horizon(methods: dict[str, Any]) -> Figure:
    """MPJAE against the time since the common start: does the error grow?"""
    keys = [k for k in methods["nominal"]["by_horizon"] if k != "whole"]
    x = [float(k) for k in keys]
    ticks = [*((v, f"{v:g} s") for v in x), (4 * x[-1], "whole\nmotion")]
    drawn = {
        title(n): (
            colour(n),
            [at for at, _ in ticks],
            [Once(1e3 * m["by_horizon"][k]["mpjae"]) for k in (*keys, "whole")],
        )
        for n, m in methods.items()
    }
    return lines([("MPJAE by horizon of the free run", drawn)], ("", "mrad"), ticks, log=True)


@styled
def training_curve(progress: list[dict[str, Any]]) -> Figure:
    """Held-out error after each validation; stages shaded, the kept model marked."""
    fig = figure(5.0, 3.0)
    ax = fig.subplots()
    steps = np.array([p["steps"] for p in progress]) / 1e6
    value = np.array([p["val_mpjae"] for p in progress]) * 1e3
    ax.plot(steps, value, "-", color="#555555", lw=0.8)
    for stage, tint, label in (("warm start", COLOURS["mlp"], "warm start"), ("ppo", COLOURS["gaponet"], "PPO")):
        at = [i for i, p in enumerate(progress) if p["stage"] == stage]
        if at:
            ax.plot(steps[at], value[at], "o", ms=3.5, color=tint, label=label)
    best = int(value.argmin())
    ax.plot(steps[best], value[best], "o", ms=9, mfc="none", mec="#111111", label="kept")
    ax.axhline(progress[0]["nominal_mpjae"] * 1e3, color=COLOURS["nominal"], ls="--", lw=1)
    ax.annotate("nominal", (1, progress[0]["nominal_mpjae"] * 1e3), xycoords=("axes fraction", "data"), ha="right",
                va="bottom", color=COLOURS["nominal"])  # fmt: skip
    ax.set_ylim(bottom=0)
    ax.set_xlabel("control steps, million")
    ax.set_ylabel("validation MPJAE, mrad")
    ax.set_title("Training")
    legend(fig)
    return fig


def trajectories(
    arrays: dict[str, Array], row: int, joints: list[str], columns: list[int], methods: list[str], dt: float
) -> Figure:
    """Recorded against simulated position of a few joints, and the error below, over one motion."""
    recorded = arrays[f"{row}/recorded"]
    window = _window(recorded[:, columns], dt)
    names = {j: joint_label(joints[j], wrapped=False) for j in columns}
    shown = {names[j]: ({n: arrays[f"{row}/{n}"][window, j] for n in methods}, recorded[window, j]) for j in columns}
    learned = [n for n in methods if f"{row}/delta/{n}" in arrays]
    delta = {names[j]: {n: arrays[f"{row}/delta/{n}"][window, j] for n in learned} for j in columns}
    looks = {n: (title(n), colour(n)) for n in (*methods, "recorded")}
    return against(np.arange(len(recorded))[window] * dt, shown, looks, "recorded", corrections=delta)


def _window(recorded: Array, dt: float, seconds: float = 20.0) -> slice:
    """The stretch with the most motion; a two-minute plot shows nothing."""
    n = round(seconds / dt)
    if len(recorded) <= n:
        return slice(0, len(recorded))
    moved = np.concatenate([[0], np.abs(np.diff(recorded, axis=0)).sum(axis=1).cumsum()])
    gain = moved[n:] - moved[:-n]
    start = int(gain.argmax())
    return slice(start, start + n)
