"""Pairs and splits."""

from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, wave

from gaponet.data.pair import Pair, Twin, require_disjoint, split_by_motion
from gaponet.errors import DatasetError, UsageError


def test_the_gap_is_real_minus_simulated(arm):
    ctrl = wave(20, 2)
    real = arm_sequence(arm, ctrl, ctrl + 0.25)
    assert np.allclose(Pair(real, Twin("abc", ctrl, ctrl, ctrl)).gap, 0.25, atol=1e-6)


def test_a_twin_of_another_length_is_refused(arm):
    ctrl = wave(20, 2)
    with pytest.raises(DatasetError, match=r"twin of 'm' has shape \(19, 2\), recording \(20, 2\)"):
        Pair(arm_sequence(arm, ctrl, ctrl), Twin("abc", ctrl[1:], ctrl[1:], ctrl[1:]))


def test_a_split_holds_every_motion_once():
    motions = [f"m{i}" for i in range(40)]
    split = split_by_motion(motions)
    assert (len(split.test), len(split.val), len(split.train)) == (10, 5, 25)
    assert sorted(split.train + split.val + split.test) == sorted(motions)


def test_a_split_depends_on_names_alone_and_not_on_their_order_or_number():
    motions = [f"m{i}" for i in range(40)]
    assert split_by_motion(motions) == split_by_motion([*reversed(motions), *motions])


def test_two_motions_cannot_be_split_in_three():
    with pytest.raises(UsageError, match=r"2 motion\(s\) \(.*\): a split by motion needs 3 or more"):
        split_by_motion(["a", "b"])


def test_one_recording_under_two_names_in_two_parts_is_found(arm):
    ctrl = wave(20, 2)
    one = arm_sequence(arm, ctrl, ctrl)
    other = replace(one, meta=replace(one.meta, motion="renamed"))
    require_disjoint([one], [arm_sequence(arm, ctrl, ctrl + 0.1)])
    with pytest.raises(DatasetError, match="'renamed' is in two parts of the split under different names"):
        require_disjoint([one], [other])
