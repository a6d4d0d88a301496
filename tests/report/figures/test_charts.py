"""Figures of experiments: what is drawn is what was measured."""

import math

import pytest

from gaponet.base.result_table import MeanStd
from gaponet.report.figures.charts import bars, lines


def test_a_line_has_error_bars_where_there_are_seeds():
    one = {"m": ("#000000", [0, 1], [MeanStd(1, 0.5, 3), MeanStd(2, math.nan, 1)])}
    fig = lines([("left", one), ("right", one)], ("kg", "mrad"))
    left, _ = fig.axes
    (bar,) = left.containers
    assert bar.lines[2][0].get_segments()[0][:, 1] == pytest.approx([0.5, 1.5])
    assert len(fig.legends[0].get_texts()) == 1


def test_bars_stand_side_by_side():
    m, n = [MeanStd(1, 0.1, 2), MeanStd(2, 0.1, 2)], [MeanStd(3, 0.1, 2), MeanStd(4, 0.1, 2)]
    ax = bars(["a", "b"], {"m": ("#000000", m), "n": ("#111111", n)}, "mrad", "t").axes[0]
    heights = sorted(p.get_height() for p in ax.patches)
    assert heights == [1, 2, 3, 4]
    assert len({round(p.get_x(), 6) for p in ax.patches}) == 4
