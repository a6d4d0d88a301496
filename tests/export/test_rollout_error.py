"""Errors that an export states."""

from dataclasses import replace

import numpy as np
from arm import recordings, write_arm

from gaponet.export.plain_servos import check_error, rollout_error


def test_a_joint_that_was_not_recorded_does_not_lower_the_error(tmp_path):
    robot = write_arm(tmp_path / "arm")
    (whole,) = recordings(robot, 1, rows=100, kp=10.0)
    at_home = whole.ctrl.copy()
    at_home[:, 1] = 0.0
    resting = np.where([True, False], whole.qpos, at_home)
    meta = replace(whole.meta, notes={"held_at_home": ["elbow"]})
    partial = replace(whole, meta=meta, ctrl=at_home, qpos=resting)

    stated = rollout_error([partial], robot)

    assert stated > 1.5 * check_error([partial], robot)
