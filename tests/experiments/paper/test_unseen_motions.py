"""Motions of the experiment: made for it, and in no recording."""

import numpy as np
import pytest
from arm import commands, record, write_dataset

from gaponet.base.errors import UsageError
from gaponet.experiments.paper.unseen_motions import (
    UnseenMotion,
    make_unseen_motions,
    require_unseen,
    rms_difference,
)


@pytest.fixture
def dataset(robot, tmp_path):
    return write_dataset(tmp_path / "data", robot, [record(robot, commands(100, 0), "recorded")])


def test_as_many_different_motions_are_made_as_are_asked_for(robot):
    motions = make_unseen_motions(robot, 3, 0.4, 0.02)
    assert len({motion.name for motion in motions}) == 3


def test_more_motions_than_the_robot_has_are_refused(robot):
    with pytest.raises(UsageError, match="--motions"):
        make_unseen_motions(robot, 10_000, 0.4, 0.02)


def test_a_recorded_motion_under_another_name_is_refused(robot, dataset):
    motion = UnseenMotion("other", commands(100, 0))
    with pytest.raises(UsageError, match="recorded"):
        require_unseen([motion], dataset, robot, 0.02)


def test_a_motion_that_only_begins_like_a_recorded_one_is_another(robot, dataset):
    ctrl = commands(100, 0)
    ctrl[50:] += 0.2
    require_unseen([UnseenMotion("other", ctrl)], dataset, robot, 0.02)


def test_a_shorter_motion_is_compared_as_if_it_stood_at_its_end():
    first = np.zeros((4, 1))
    second = np.ones((2, 1))
    assert rms_difference(first, second) == 1.0
    assert rms_difference(first, np.zeros((2, 1))) == 0.0
