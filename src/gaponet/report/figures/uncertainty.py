"""What is known of a robot, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gaponet.report.figures.style import figure, joint_label, styled
from gaponet.sysid.uncertainty import ParameterUncertainty
from gaponet.sysid.uncertainty_table import FIELD_UNITS, summarize

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def picture(known: ParameterUncertainty, title: str) -> Figure:
    """A panel for each field: every joint's value with the range that holds 9 of 10 times."""
    fields = [f for f in known.fields if any(summarize(known, j).values[f] for j in known.joints)]
    joints, columns = list(known.joints), min(4, len(fields))
    lines = -(-len(fields) // columns)
    fig = figure(2.4 * columns + 1.0, (0.24 * len(joints) + 0.8) * lines + 0.4)
    axes = np.atleast_2d(fig.subplots(lines, columns, squeeze=False))
    y = np.arange(len(joints))[::-1]
    for place, ax in enumerate(axes.flat):
        if place >= len(fields):
            ax.set_visible(False)
            continue
        heading, factor = FIELD_UNITS[fields[place]]
        known_of = [summarize(known, j) for j in joints]
        at = np.array([c.values[fields[place]] * factor for c in known_of])
        wide = np.array([1.645 * c.errors[fields[place]] * factor for c in known_of])
        span = max(float(np.ptp(at)), float(np.abs(at).max()) * 0.1, 1e-9)
        sure = wide < 3 * span
        ax.errorbar(at[sure], y[sure], xerr=wide[sure], fmt="o", ms=3.5, capsize=2, lw=1.2, color="#1f5fa8")
        ax.plot(at[~sure], y[~sure], "o", ms=4, mfc="none", color="#999999")
        ax.set_yticks(
            y, [joint_label(j, wrapped=False) for j in joints] if place % columns == 0 else [""] * len(joints)
        )
        ax.set_title(heading)
        ax.set_ylim(-0.6, len(joints) - 0.4)
    fig.suptitle(title, x=0.01, ha="left", fontsize=9, fontweight="bold")
    return fig
