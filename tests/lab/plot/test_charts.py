"""Figures of experiments: what is drawn is what was measured."""

import math

import pytest

from gaponet.methods import colour
from gaponet.spread import Spread
from gaponet_lab.plot.charts import bars, dots, lines


def test_the_default_is_hollow_and_a_line_through_all_groups():
    rows = [
        ("H", "2", Spread(0.3, 0.1, 3), False),
        ("H", "4", Spread(0.2, math.nan, 1), True),
        ("p", "4", Spread(0.4, 0, 3), False),
    ]
    ax = dots(rows, "of nominal", "title").axes[0]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["2", "4", "4"]
    points = [line for line in ax.lines if line.get_marker() == "o"]
    assert [p.get_xdata()[0] for p in points] == [0.3, 0.2, 0.4]
    assert [p.get_markerfacecolor() for p in points] == [colour("gaponet"), "white", colour("gaponet")]
    assert ax.lines[-1].get_xdata()[0] == 0.2
    places = ax.get_yticks()
    assert places[2] - places[1] > places[1] - places[0]  # groups stand apart


def test_a_line_has_error_bars_where_there_are_seeds_and_the_place_left_out_is_shaded():
    one = {"m": ("#000000", [0, 1], [Spread(1, 0.5, 3), Spread(2, math.nan, 1)])}
    fig = lines([("left", one), ("right", one)], ("kg", "mrad"), marked=[None, 1.0])
    left, right = fig.axes
    (bar,) = left.containers
    assert bar.lines[2][0].get_segments()[0][:, 1] == pytest.approx([0.5, 1.5])
    assert len(left.patches) == 0
    assert right.patches[0].get_x() == pytest.approx(0.7)
    assert len(fig.legends[0].get_texts()) == 1


def test_bars_stand_side_by_side():
    ax = bars(["a", "b"], {"m": ("#000000", [Spread(1, 0.1, 2), Spread(2, 0.1, 2)]),
                           "n": ("#111111", [Spread(3, 0.1, 2), Spread(4, 0.1, 2)])}, "mrad", "t").axes[0]  # fmt: skip
    heights = sorted(p.get_height() for p in ax.patches)
    assert heights == [1, 2, 3, 4]
    assert len({round(p.get_x(), 6) for p in ax.patches}) == 4
