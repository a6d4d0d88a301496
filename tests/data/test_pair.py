"""Pairs and splits."""

from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, wave

from gaponet.base.errors import DatasetError
from gaponet.data.pair import Pair, Twin, require_disjoint


def test_the_gap_is_real_minus_simulated(arm):
    ctrl = wave(20, 2)
    real = arm_sequence(arm, ctrl, ctrl + 0.25)
    assert np.allclose(Pair(real, Twin("abc", ctrl, ctrl, ctrl)).gap, 0.25, atol=1e-6)


def test_a_twin_of_another_length_is_refused(arm):
    ctrl = wave(20, 2)
    with pytest.raises(DatasetError, match=r"twin of 'm' has shape \(19, 2\), recording \(20, 2\)"):
        Pair(arm_sequence(arm, ctrl, ctrl), Twin("abc", ctrl[1:], ctrl[1:], ctrl[1:]))


def test_one_recording_under_two_names_in_two_parts_is_found(arm):
    ctrl = wave(20, 2)
    one = arm_sequence(arm, ctrl, ctrl)
    other = replace(one, meta=replace(one.meta, motion="renamed"))
    require_disjoint([one], [arm_sequence(arm, ctrl, ctrl + 0.1)])
    with pytest.raises(DatasetError, match="'renamed' is in two parts of the split under different names"):
        require_disjoint([one], [other])
