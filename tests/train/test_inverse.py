"""Inverse labels lead the simulator along the recording."""

import numpy as np
from arm import recordings, write_arm

from gaponet.sim.replay import replay
from gaponet.train.inverse import inverse_targets


class Lead:
    """Applies the labels instead of the commands."""

    def __init__(self, labels):
        self.labels = labels

    def reset(self, start):
        self.order = [self.labels[s.meta.motion] for s in start]

    def correct(self, t, target, qpos, qvel):
        return np.stack([labels[min(t, len(labels) - 1)] for labels in self.order])


def test_labels_remove_nearly_all_of_the_gap(tmp_path):
    robot = write_arm(tmp_path)
    sequences = recordings(robot, 4, rows=200, kp=0.5, delay=3)
    labels = {s.meta.motion: inverse_targets(s, robot) for s in sequences}
    error = [
        np.mean([np.abs(t.qpos - s.qpos).mean() for s, t in zip(sequences, replay(sequences, robot, c), strict=True)])
        for c in (None, Lead(labels))
    ]
    assert error[1] < 0.1 * error[0]


def test_without_a_gap_the_labels_are_the_commands(tmp_path):
    robot = write_arm(tmp_path)
    sequence = recordings(robot, 1, rows=200)[0]
    assert np.abs(inverse_targets(sequence, robot) - sequence.ctrl)[20:-20].max() < 0.01
