"""Repetitions: what counts as one command played again, and what cannot be compared."""

from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, late, wave

from gaponet.data.repeatability import Repetitions, repetition_difference

JOINTS = ("shoulder", "elbow")


def played(arm, ctrl, shift=0.0, **labels):
    """A recording of a command, with its state shifted by so many rad."""
    return arm_sequence(arm, ctrl, late(ctrl, 2) + shift, **labels)


def test_periods_of_a_motion_are_its_repetitions_without_the_first(arm):
    ctrl = np.tile(wave(50, 2), (4, 1))
    periods = Repetitions.periods(played(arm, ctrl))
    assert [len(period) for period in periods] == [50, 50, 50]
    for period in periods:
        assert np.array_equal(period.ctrl, ctrl[:50].astype(np.float32))


@pytest.mark.parametrize(
    "ctrl",
    [wave(200, 2), np.zeros((200, 2)), np.concatenate([np.zeros((60, 2)), wave(60, 2)])],
    ids=["never again", "at rest", "at rest first"],
)
def test_a_motion_that_does_not_come_again_has_no_periods(arm, ctrl):
    assert Repetitions.periods(played(arm, ctrl)) == []


def test_states_of_one_command_that_lie_apart_differ_by_that(arm):
    ctrl = wave(200, 2)
    found = repetition_difference([played(arm, ctrl), played(arm, ctrl, 0.01)], JOINTS)
    assert found == pytest.approx([0.01, 0.01], rel=1e-3)


def test_recordings_of_two_units_are_no_repetitions(arm):
    ctrl = wave(200, 2)
    two = [played(arm, ctrl), played(arm, ctrl, 0.01, unit="b")]
    assert repetition_difference(two, JOINTS).tolist() == [0, 0]


def test_joints_that_no_log_held_are_not_compared(arm):
    ctrl = wave(200, 2)
    two = []
    for shift in (0.0, 0.01):
        one = played(arm, ctrl, shift)
        two.append(replace(one, meta=replace(one.meta, notes={"held_at_home": ["elbow"]})))
    assert repetition_difference(two, JOINTS) == pytest.approx([0.01, 0], rel=1e-3)
    assert repetition_difference(two, ("elbow",)).tolist() == [0]


def test_one_command_that_begins_later_cannot_be_compared_row_by_row(arm):
    ctrl = wave(200, 2)
    waited = np.concatenate([np.repeat(ctrl[:1], 40, axis=0), ctrl])
    two = [played(arm, ctrl), played(arm, waited, 0.01)]
    assert repetition_difference(two, JOINTS).tolist() == [0, 0]


def test_a_torque_that_was_recorded_once_has_no_repeatability(arm):
    ctrl = wave(200, 2)
    repetitions = Repetitions()
    repetitions.add(arm_sequence(arm, ctrl, late(ctrl, 2), tau=ctrl))
    repetitions.add(played(arm, ctrl, 0.01))
    assert sorted(repetitions.result().variance) == ["qpos", "qvel"]


def test_the_variance_of_two_states_is_half_their_distance_squared(arm):
    ctrl = wave(200, 2)
    repetitions = Repetitions()
    repetitions.add(played(arm, ctrl))
    repetitions.add(played(arm, ctrl, 0.02))
    assert repetitions.result().variance["qpos"] == pytest.approx([2e-4, 2e-4], rel=1e-3)
