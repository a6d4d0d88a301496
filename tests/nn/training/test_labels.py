"""Labels lead the simulator along the recording, in free run and not row by row."""

from dataclasses import replace

import numpy as np
from arm import TOML, recordings, write_arm

from gaponet.nn.training.pretraining import trajectory_labels
from gaponet.robot.spec import Table
from gaponet.sim.replay import replay


def errors(sequences, labels, robot):
    """Mean |error| of each recording under its labels, rad."""
    parts = np.split(labels, np.cumsum([len(s) for s in sequences])[:-1])
    told = [replace(s, ctrl=s.ctrl + part) for s, part in zip(sequences, parts, strict=True)]
    return np.array([np.abs(t.qpos - s.qpos).mean() for s, t in zip(sequences, replay(told, robot), strict=True)])


def test_labels_remove_most_of_the_gap(tmp_path):
    robot = write_arm(tmp_path)
    sequences = recordings(robot, 4, rows=200, kp=0.5, delay=3)
    labels = trajectory_labels(sequences, robot, 0.5)
    none = errors(sequences, np.zeros_like(labels), robot)
    assert (errors(sequences, labels, robot) < 0.3 * none).all()


def test_without_a_gap_the_labels_are_zero(tmp_path):
    robot = write_arm(tmp_path)
    labels = trajectory_labels(recordings(robot, 1, rows=200, kp=1.0, delay=0), robot, 0.5)
    assert np.abs(labels).max() < 1e-6


def test_a_joint_that_nobody_recorded_has_no_label(tmp_path):
    robot = write_arm(tmp_path)
    (sequence,) = recordings(robot, 1, rows=60)
    meta = replace(sequence.meta, notes={"held_at_home": [robot.operated[1]]})
    labels = trajectory_labels([replace(sequence, meta=meta)], robot, 0.5)
    assert np.isnan(labels[:, 1]).all()
    assert np.isfinite(labels[:, 0]).all()


def test_where_a_tip_is_at_the_table_there_is_no_label(tmp_path):
    robot = write_arm(tmp_path, toml=TOML + '[[tip]]\nbody = "fore"\npos = [0.2, 0.0, 0.0]\n')
    sequences = recordings(robot, 2, rows=100)
    q = np.concatenate([s.qpos for s in sequences])
    tip = -0.2 * (np.sin(q[:, 0]) + np.sin(q.sum(1)))
    table = replace(robot, table=Table(float(np.median(tip)) - 0.01))
    labels = trajectory_labels(sequences, table, 0.5)
    assert (np.isnan(labels).all(1) == (tip < np.median(tip))).mean() > 0.98
    assert np.isfinite(trajectory_labels(sequences, robot, 0.5)).all()
