"""Servos whose own trajectory generator limits the speed of their targets."""

from dataclasses import replace

import numpy as np
import pytest
from arm import commands, write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import DEFAULT_TERMS
from gaponet.sim.replay import replay
from gaponet.sysid.identify import identify
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.motion_limits import default_terms, target_speeds
from gaponet.sysid.options import IdentifyOptions


def recorded(robot, count=6, rows=400):
    """What a robot does with jumps and waves, with the noise of an encoder."""
    asked = []
    rng = np.random.default_rng(5)
    for i in range(count):
        ctrl = 1.5 * commands(rows, i)
        ctrl[: rows // 2] = np.repeat(rng.uniform(-1, 1, (4, 2)), rows // 8, axis=0)
        start = np.tile(ctrl[0], (rows, 1))
        meta = SequenceMeta("arm", "a", f"m{i}", 0.0)
        asked.append(Sequence(meta, robot.joint_names, 0.02, ctrl, start, 0 * start))
    made = []
    for s, t in zip(asked, replay(asked, robot), strict=True):
        noise = rng.normal(0, 1e-4, t.qpos.shape).astype(np.float32)
        made.append(replace(s, qpos=t.qpos + noise, qvel=t.qvel))
    return made


@pytest.fixture
def servos():
    servo = {"kp": 14.0, "delay": 0.02, "damping": 0.8, "armature": 0.02}
    return {"shoulder": servo.copy(), "elbow": servo.copy()}


def test_the_speed_of_a_ramp_is_estimated_from_recordings(tmp_path, servos):
    robot = write_arm(tmp_path)
    servos["elbow"]["target_speed"] = 0.7
    found = target_speeds(recorded(robot.with_identified(servos)), robot)
    assert found == pytest.approx([0.0, 0.7], rel=0.04)


@pytest.mark.parametrize("wrong", [{"damping": 4.0}, {"frictionloss": 0.6}])
def test_slow_and_stiff_servos_are_not_taken_for_ramps(tmp_path, servos, wrong):
    robot = write_arm(tmp_path)
    servos["elbow"] |= wrong
    assert not target_speeds(recorded(robot.with_identified(servos)), robot).any()


def test_identification_finds_a_ramp_and_warns(tmp_path, servos):
    robot = write_arm(tmp_path)
    servos["shoulder"]["target_speed"] = 0.6
    logs = recorded(robot.with_identified(servos), 5, rows=240)
    options = IdentifyOptions(
        windows=3, terms=(), table=False, joints_alone=True, nthread=1, folds=1
    )
    found = identify(logs[:3], robot, logs[3:], options=options)
    assert found.robot.servo.target_speed == pytest.approx([0.6, 0.0], rel=0.04)
    assert found.after < 0.1 * found.before
    assert found.comparisons[-1].name == "ramp"
    assert "profile velocity" in found.warnings[0]
    assert found.robot.before_identification.servo.target_speed.max() == 0


@pytest.mark.parametrize(
    ("limit", "terms"), [(3.0, ("limit", "speed", *DEFAULT_TERMS)), (50.0, DEFAULT_TERMS)]
)
def test_a_torque_limit_is_fitted_where_recordings_reach_it(tmp_path, servos, limit, terms):
    logs = recorded(write_arm(tmp_path).with_identified(servos), 3, rows=240)
    limits = {joint: {"effort_limit": limit} for joint in servos}
    assert default_terms(logs, write_arm(tmp_path).with_identified(limits)) == terms


def test_single_joint_rollouts_follow_ramps(tmp_path, servos):
    servos["shoulder"]["target_speed"] = 0.6
    robot = write_arm(tmp_path).with_identified(servos)
    runs = JointRollouts(recorded(robot), robot, nthread=1)
    values = {"offset": np.zeros((1, 2)), "frictionloss": np.full((1, 2), 0.05)}
    for field in ("kp", "delay", "damping", "armature"):
        values[field] = np.full((1, 2), servos["elbow"][field])
    errors = runs.errors(values)
    assert np.abs(errors).mean() < 1e-3
