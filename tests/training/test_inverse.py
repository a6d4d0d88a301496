"""Inverse labels lead the simulator along the recording."""

from dataclasses import replace

import numpy as np
from arm import recordings, write_arm

from gaponet.sim.replay import replay
from gaponet.training.inverse import inverse_labels


class Lead:
    """Adds the labels to the commands."""

    def __init__(self, labels):
        self.labels = labels

    def reset(self, start):
        self.order = [self.labels[s.meta.motion] for s in start]

    def correct(self, t, target, qpos, qvel):
        return target + np.stack([labels[min(t, len(labels) - 1)] for labels in self.order])


def test_labels_remove_nearly_all_of_the_gap(tmp_path):
    robot = write_arm(tmp_path)
    sequences = recordings(robot, 4, rows=200, kp=0.5, delay=3)
    labels = {s.meta.motion: inverse_labels([s], robot, 0.5) for s in sequences}
    error = [
        np.mean([np.abs(t.qpos - s.qpos).mean() for s, t in zip(sequences, replay(sequences, robot, c), strict=True)])
        for c in (None, Lead(labels))
    ]
    assert error[1] < 0.1 * error[0]


def test_without_a_gap_the_labels_are_zero(tmp_path):
    robot = write_arm(tmp_path)
    sequence = recordings(robot, 1, rows=200)[0]
    assert np.abs(inverse_labels([sequence], robot, 0.5))[20:-20].max() < 0.01


def test_a_joint_that_friction_holds_needs_no_label(tmp_path):
    robot = write_arm(tmp_path)
    sticky = robot.with_servos({j: {"frictionloss": 1.5} for j in robot.operated})
    rest = np.tile(np.array([0.3, -0.2], np.float32), (100, 1))
    sequence = replace(recordings(robot, 1, rows=100)[0], qpos=rest, qvel=0 * rest, ctrl=rest + 0.01)
    assert not inverse_labels([sequence], sticky, 0.5).any()
    assert np.abs(inverse_labels([sequence], robot, 0.5)).max() > 0.005
