"""Joints on their own move as in the simulator of the whole robot."""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, recordings, write_arm

from gaponet.robot import LAW
from gaponet.sim.joint_runs import JointRuns
from gaponet.sim.replay import replay

FIRST = {"kp": 20.0, "damping": 0.5, "frictionloss": 0.05, "armature": 0.02, "offset": 0.0, "delay": 0.0}


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"delay": 0.033, "offset": 0.01},
        {"stribeck": 0.1, "stribeck_speed": 0.05, "friction_motor": 0.2},
        {"encoder_step": 0.005, "min_torque": 0.2},
        {"kd": 1.0},
    ],
)
def test_a_joint_on_its_own_moves_as_the_whole_robot(tmp_path, changed):
    changed = dict(changed)
    kd = f"effort_limit = 5.0\nkd = {changed.pop('kd', 0.0)}"
    robot = write_arm(tmp_path / "arm", TOML.replace("effort_limit = 5.0", kd))
    servos = FIRST | changed
    acting = robot.with_servos(dict.fromkeys(robot.joint_names, servos))
    real = recordings(robot, 1, rows=200, kp=0.7)
    whole = [t.qpos for t in replay(real, acting)]
    runs = JointRuns(real, robot)
    values = {f: np.full((1, 2), float(v)) for f, v in servos.items()}
    alone = runs.errors(values)[:, 0, 0]
    company = np.where(runs.counted, whole[0] - real[0].qpos, 0.0)
    assert np.abs(company).mean() > 0.005  # it is not the robot that was recorded
    assert np.abs(alone - company).mean() < 0.1 * np.abs(company).mean()
    assert set(changed) <= {*FIRST, *LAW}


def test_recordings_at_several_gains_have_one_servo(tmp_path):
    robot = write_arm(tmp_path)
    told = []
    for kp in (8.0, 40.0):  # of a motor that makes 0.8 of what its gains say
        set_to = robot.with_gains((kp, kp), None)
        motor = {joint: {"kp": v} for joint, v in zip(robot.joint_names, (0.8 * kp, 0.8 * kp), strict=True)}
        made = recordings(set_to.with_servos(motor), 1, rows=200)[0]
        told.append(replace(made, meta=replace(made.meta, kp=(kp, kp), kd=(0.0, 0.0))))
    values = {f: np.full((1, 2), v) for f, v in (FIRST | {"kp": 0.8 * 20.0}).items()}
    assert np.abs(JointRuns(told, robot).errors(values)).mean() < 1e-3
    untold = [replace(s, meta=replace(s.meta, kp=None)) for s in told]
    assert np.abs(JointRuns(untold, robot).errors(values)).mean() > 5e-3
