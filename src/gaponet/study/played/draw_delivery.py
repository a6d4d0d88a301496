"""The figures of delivery: offsets by axis and payload, and one hand on its way to two goals."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np
from matplotlib.figure import Figure

from gaponet.plot.methods import COLOURS
from gaponet.plot.style import figure, styled
from gaponet.study.played.delivery import NEAR, Delivery, Example
from gaponet.study.played.draw_tracking import LEFT_OUT, _legend
from gaponet.study.played.methods import colour, methods, title

AXES = ("X, forward", "Y, left", "Z, up")


@styled
def offsets(found: ListOf[Delivery]) -> Figure:
    """Mean |hand − goal| by axis, a group of bars per payload; standard error over goals."""
    payloads, names = sorted({d.payload for d in found}), [m for m in methods(found) if m not in LEFT_OUT]
    fig = figure(10.2, 3.5)
    width = 0.84 / len(names)
    for a, ax in enumerate(fig.subplots(1, 3)):
        for i, m in enumerate(names):
            values = [np.array([d.offset[a] for d in found if d.method == m and d.payload == p]) for p in payloads]
            seeds = len({d.seed for d in found if d.method == m})
            error = [v.std() / np.sqrt(max(len(v) / seeds, 1)) * 1e2 for v in values]
            x = np.arange(len(payloads)) + (i - (len(names) - 1) / 2) * width
            ax.bar(x, [v.mean() * 1e2 for v in values], width * 0.92, yerr=error, color=colour(m), label=title(m),
                   error_kw={"lw": 0.7, "capsize": 1.5, "capthick": 0.7})  # fmt: skip
        ax.axhline(NEAR * 1e2, color="#111111", lw=0.7, ls=(0, (4, 3)))
        ax.set_xticks(np.arange(len(payloads)), [f"{p:g} kg" for p in payloads])
        ax.grid(axis="x", visible=False)
        ax.tick_params(axis="x", length=0)
        ax.set_title(AXES[a])
    fig.axes[0].set_ylabel("|hand − goal|, cm")
    fig.suptitle("Offset at the goal, VIRTUAL robot; mean and standard error over goals; dashed: 1 cm", fontsize=9,
                 x=0.005, ha="left")  # fmt: skip
    _legend(fig, fig.axes[:1])
    return fig


@styled
def example(shown: Example) -> Figure:
    """The hand's true place over time, axis by axis, goals with 1 cm on both sides."""
    fig = figure(10.2, 3.2)
    time = np.arange(len(shown.target)) * shown.dt
    for a, ax in enumerate(fig.subplots(1, 3, sharex=True)):
        for m, place in shown.places.items():
            if m not in LEFT_OUT:
                ax.plot(time, place[:, a] * 1e2, color=colour(m), label=title(m))
        ax.plot(time, shown.target[:, a] * 1e2, color=COLOURS["target"], ls=(0, (4, 1.5)), lw=1.0, label="target")
        for k, goal in enumerate(shown.goals):
            low, high = (goal[a] - NEAR) * 1e2, (goal[a] + NEAR) * 1e2
            span = [shown.arrive[k] * shown.dt, shown.leave[k] * shown.dt]
            ax.fill_between(span, low, high, color=COLOURS["target"], alpha=0.18, lw=0)
        ax.set_title(AXES[a])
        ax.set_xlabel("time, s")
    fig.axes[0].set_ylabel("hand, cm")
    fig.suptitle(f"One hand, two goals, {shown.payload:g} kg in each hand, VIRTUAL robot; shaded: goal ± 1 cm",
                 fontsize=9, x=0.005, ha="left")  # fmt: skip
    _legend(fig, fig.axes[:1])
    return fig
