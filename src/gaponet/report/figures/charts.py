"""Bars by group, which several figures use."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.result_table import MeanStd
from gaponet.report.figures.style import LETTER, figure, legend, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Bars = Mapping[str, tuple[str, ListOf[MeanStd]]]  # label → colour, value of each group


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
        std = np.array([v.std if v.std == v.std else 0.0 for v in values])
        ax.bar(x, [v.mean for v in values], width * 0.92, yerr=std if std.any() else None, color=colour, label=label,
               error_kw={"lw": 0.7, "capsize": 1.2, "capthick": 0.6})  # fmt: skip
    ax.set_xticks(np.arange(len(groups)), groups, fontsize=size)
    ax.tick_params(axis="x", length=0)
    ax.grid(axis="x", visible=False)
