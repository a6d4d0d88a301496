"""Charts: what is drawn is what was measured."""

from gaponet.base.result_table import MeanStd
from gaponet.report.figures.style import bars


def test_bars_are_side_by_side():
    m, n = ([MeanStd(a, 0.1, 2), MeanStd(b, 0.1, 2)] for a, b in ((1, 2), (3, 4)))
    ax = bars(["a", "b"], {"m": ("#000000", m), "n": ("#111111", n)}, "mrad", "t").axes[0]
    heights = sorted(p.get_height() for p in ax.patches)
    assert heights == [1, 2, 3, 4]
    assert len({round(p.get_x(), 6) for p in ax.patches}) == 4
