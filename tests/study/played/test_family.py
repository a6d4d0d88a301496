"""Models of a family beside rivals, from errors that are known."""

import numpy as np

from gaponet.study.played.family import told, words
from gaponet.study.played.simulators import CHANGES


def test_a_family_that_is_better_than_transfer_nowhere_is_said_to_be_so():
    uncorrected = [10.0, 20.0, 30.0]
    rivals = {at: {"uncorrected": uncorrected, "transferred": [2.0, 4.0, 6.0]} for at in (*CHANGES, "100 Hz")}
    shares = dict(zip(words("wide"), (0.6, 0.5, 0.55, 0.4, 0.3), strict=True))
    seeds = {w: [[s * x * f for x in uncorrected] for f in (0.9, 1.1)] for w, s in shares.items()}
    table, said = told(dict.fromkeys(rivals, seeds), rivals, "wide")
    mean, over = (next(r for r in table.rows if r[0].startswith(name)) for name in ("mean", "the same"))
    np.testing.assert_allclose([x.mean for x in mean[1:]], [0.2, *shares.values()])
    np.testing.assert_allclose([x.std / x.mean for x in over[2:]], [np.sqrt(2) / 10] * 5)
    assert "told its parameters: 0.30" in said[0]
    assert "transferred: 0.20" in said[0]
    assert "ahead in 0 of 12" in said[0]
