"""Recordings and their simulated replays."""

import numpy as np
import pytest
from logs import arm_sequence, wave

from gaponet.base.errors import DatasetError
from gaponet.data.pair import Pair, SimulatedReplay


def test_the_gap_is_real_minus_simulated(arm):
    ctrl = wave(20, 2)
    real = arm_sequence(arm, ctrl, ctrl + 0.25)
    assert np.allclose(Pair(real, SimulatedReplay("abc", ctrl, ctrl, ctrl)).gap, 0.25, atol=1e-6)


def test_a_replay_of_another_length_is_refused(arm):
    ctrl = wave(20, 2)
    with pytest.raises(DatasetError, match=r"\(19, 2\)"):
        Pair(arm_sequence(arm, ctrl, ctrl), SimulatedReplay("abc", ctrl[1:], ctrl[1:], ctrl[1:]))
