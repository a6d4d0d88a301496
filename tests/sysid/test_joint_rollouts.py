"""Joints on their own move as in the simulator of the whole robot."""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, commands, recordings, write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.evaluation.verdict import verdict
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import load_robot
from gaponet.sim.metrics import runs, summary
from gaponet.sim.replay import replay
from gaponet.sim.servo import compiled, simulate_joints
from gaponet.sysid.identify import identify
from gaponet.sysid.joint_rollouts import JointRollouts, balanced_values
from gaponet.sysid.options import IdentifyOptions

FIRST = {
    "kp": 20.0,
    "damping": 0.5,
    "frictionloss": 0.05,
    "armature": 0.02,
    "offset": 0.0,
    "delay": 0.0,
}


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"delay": 0.033, "offset": 0.01},
        {"stribeck": 0.1, "stribeck_speed": 0.05, "friction_motor": 0.2},
        {"encoder_step": 0.005, "min_torque": 0.2},
        {"kd": 1.0},
        {"kd": 1.0, "effort_limit": 2.0, "no_load_speed": 1.5},
        {"effort_limit": 2.0, "no_load_speed": 1.5, "friction_motor": 0.2},
        {"backlash": 0.02},
    ],
)
def test_a_single_joint_rollout_is_the_robots_rollout(tmp_path, changed):
    changed = dict(changed)
    kd = f"effort_limit = 5.0\nkd = {changed.pop('kd', 0.0)}"
    robot = write_arm(tmp_path / "arm", TOML.replace("effort_limit = 5.0", kd))
    servos = FIRST | changed
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, servos))
    real = recordings(robot, 1, rows=200, kp=0.7)
    whole = [t.qpos for t in replay(real, acting)]
    runs = JointRollouts(real, robot)
    values = {f: np.full((1, 2), float(v)) for f, v in servos.items()}
    alone = runs.errors(values)[0, :, 0].T
    company = np.where(runs.counted[0][:, None], whole[0] - real[0].qpos, 0.0)
    assert np.abs(company).mean() > 0.005  # it is not the robot that was recorded
    assert np.abs(alone - company).mean() < 0.1 * np.abs(company).mean()
    assert set(changed) <= {*FIRST, *SERVO_TERMS, "effort_limit"}


def test_numba_compiles_once_for_all_numbers_of_windows_joints_and_candidates(tmp_path):
    robot = write_arm(tmp_path)
    real = recordings(robot, 2, rows=60)
    ramped = robot.with_servo(target_speed=np.full(2, 0.8))
    before = len(compiled(simulate_joints).signatures)
    for parts, one, count in ((real, robot, 3), (real[:1], robot, 1), (real, ramped, 2)):
        runs = JointRollouts(parts, one)
        values = {f: np.full((count, 2), v) for f, v in FIRST.items()}
        runs.errors(values)
        runs.shortened(0.5).errors({f: v.astype(np.float32) for f, v in values.items()})
    assert len(compiled(simulate_joints).signatures) <= max(before, 1)


def test_candidates_do_not_affect_each_other(tmp_path):
    robot = write_arm(tmp_path)
    runs = JointRollouts(recordings(robot, 2, rows=60, kp=0.7), robot)
    law = {"stribeck": 0.1, "stribeck_speed": 0.05, "friction_motor": 0.2, "min_torque": 0.1}
    values = {
        f: v * np.linspace(0.5, 1.5, 6).reshape(3, 2)
        for f, v in (FIRST | {"delay": 0.013} | law).items()
    }
    alone = [runs.errors({f: v[i : i + 1] for f, v in values.items()})[0] for i in range(3)]
    np.testing.assert_array_equal(runs.errors(values), alone)


def test_recordings_at_several_gains_have_one_servo(tmp_path):
    robot = write_arm(tmp_path)
    told = []
    for kp in (8.0, 40.0):  # of a motor that makes 0.8 of what its gains say
        set_to = robot.with_gains((kp, kp), None)
        motor = {
            joint: {"kp": v}
            for joint, v in zip(robot.joint_names, (0.8 * kp, 0.8 * kp), strict=True)
        }
        made = recordings(set_to.with_identified(motor), 1, rows=200)[0]
        told.append(replace(made, meta=replace(made.meta, kp=(kp, kp), kd=(0.0, 0.0))))
    values = {f: np.full((1, 2), v) for f, v in (FIRST | {"kp": 0.8 * 20.0}).items()}
    assert np.abs(JointRollouts(told, robot).errors(values)).mean() < 1e-3
    untold = [replace(s, meta=replace(s.meta, kp=None)) for s in told]
    assert np.abs(JointRollouts(untold, robot).errors(values)).mean() > 5e-3


def test_unrecorded_joints_stand_still_and_are_not_counted(tmp_path):
    """Windows of a second in which one joint moves, the other at an angle that was told: nothing is
    asked of it.
    """
    robot = write_arm(tmp_path / "arm")
    windows = []
    for real in recordings(robot, 3, rows=250, kp=0.7):
        qpos, ctrl, qvel = (np.array(getattr(real, f)) for f in ("qpos", "ctrl", "qvel"))
        qpos[:, 0], ctrl[:, 0], qvel[:, 0] = 0.4, 0.4, 0.0
        meta = replace(real.meta, notes=real.meta.notes | {"posture": {robot.joint_names[0]: 0.4}})
        whole = replace(real, meta=meta, qpos=qpos, ctrl=ctrl, qvel=qvel)
        (moved,) = replay(
            [whole], robot.with_identified({robot.joint_names[1]: {"kp": 0.7 * robot.servo.kp[1]}})
        )
        assert np.array_equal(moved.qpos[:, 0], np.full(250, np.float32(0.4)))
        seen = replace(whole, qpos=moved.qpos, qvel=moved.qvel)
        windows += [seen.rows(slice(a, a + 50)) for a in range(0, 250, 50)]
    found = identify(windows, robot, options=IdentifyOptions(terms=()))
    assert found.robot.servo.kp[1] == pytest.approx(0.7 * robot.servo.kp[1], rel=0.02)
    assert found.robot.servo.kp[0] == pytest.approx(robot.servo.kp[0], rel=1e-3)
    assert found.after < 0.2 * found.before
    total = summary(runs(windows, [t.qpos for t in replay(windows, robot)], robot), robot)
    assert total["mpjae"] == total["by_joint"][robot.joint_names[1]]["mpjae"]
    assert list(total["by_joint"]) == [robot.joint_names[1]]
    assert verdict({"nominal": total})[0].endswith(
        f"most at {robot.joint_names[1]} ({1e3 * total['mpjae']:.2f})."
    )


def test_a_single_joint_rollout_stays_within_the_joints_range():
    """The G1's waist bent, its servos softer and softer: at most from stop to stop."""
    robot = load_robot("g1_29")
    qpos = np.tile(np.float32(robot.qpos_home), (200, 1))
    qpos[:, robot.index(["waist_roll_joint", "waist_pitch_joint"])] = 0.3
    meta = SequenceMeta("g1_29", "unit", "bent", 0.0)
    runs = JointRollouts([Sequence(meta, robot.joint_names, 0.02, qpos, qpos, 0 * qpos)], robot)
    candidates = (3, len(robot.operated))
    values = {f: np.zeros(candidates) for f in FIRST} | {
        "kp": np.repeat([[40.0], [10.0], [0.1]], candidates[1], axis=1)
    }
    way = np.ptp(robot.qpos_range[robot.operated_index], axis=1)
    errors = runs.errors(values)
    assert (np.abs(errors).max(axis=(2, 3)) <= way).all()
    assert np.abs(errors[2]).max() > 0.3  # the softest falls


def test_windows_of_several_control_rates_are_fitted_together(tmp_path):
    """Two seconds of one servo, recorded at 50, at 100 and at 400 Hz: its numbers explain all of
    them.
    """
    robot = write_arm(tmp_path)
    acting = robot.with_identified(
        {j: FIRST | {"kp": 14.0, "delay": 0.03, "damping": 0.8} for j in robot.joint_names}
    )
    template, parts = recordings(robot, 1)[0], []
    for motion, dt in enumerate([0.02, 0.01, 0.01, 0.0025]):
        rows = round(2 / dt)
        ctrl = commands(rows, motion, dt)
        asked = Sequence(
            template.meta, robot.joint_names, dt, ctrl, np.tile(ctrl[0], (rows, 1)), 0 * ctrl
        )
        (simulated,) = replay([asked], acting)
        parts.append(replace(asked, qpos=simulated.qpos, qvel=simulated.qvel))
    runs = JointRollouts(parts, robot)
    values = {f: np.array([acting.servo[f]]) for f in FIRST}
    first = np.abs(runs.errors({f: np.full((1, 2), v) for f, v in FIRST.items()})).mean(
        axis=(0, 1, 3)
    )
    assert (np.abs(runs.errors(values)).mean(axis=(0, 1, 3)) < 0.1 * first).all()
    np.testing.assert_allclose(
        runs.counted.sum(axis=1), [95, 190, 190, 190], atol=5
    )  # no row in less than 10 ms
    np.testing.assert_allclose(
        balanced_values(runs.windows)["kp"], 14.0, rtol=0.35
    )  # where a search starts
