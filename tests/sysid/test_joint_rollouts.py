"""Joints on their own move as in the simulator of the whole robot."""

from dataclasses import replace

import numpy as np
import pytest
from arm import SERVO, TOML, XML, commands, recordings, write_arm

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


def same(servo, candidates=1):
    """Values of both joints from those of one servo: field → (candidates, 2)."""
    return {field: np.full((candidates, 2), float(value)) for field, value in servo.items()}


MAX_DIFFERENCE = 0.1  # of two rollouts, over the distance of the robot's from the recording


@pytest.mark.parametrize(
    "changed",  # values with which each term moves a joint by more than MAX_DIFFERENCE
    [
        {},
        {"delay": 0.033, "offset": 0.01},
        {"stribeck": 0.1, "stribeck_speed": 0.3, "friction_motor": 0.2},
        {"encoder_step": 0.01, "min_torque": 0.4},
        {"kd": 1.0},
        {"kd": 1.0, "effort_limit": 1.2, "no_load_speed": 1.0},
        {"effort_limit": 2.0, "no_load_speed": 1.5, "friction_motor": 0.2},
    ],
)
def test_a_single_joint_rollout_is_the_robots_rollout(tmp_path, changed):
    """Of backlash, which the constant load of this arm hides, tests/sim/test_backlash.py has it."""
    changed = dict(changed)
    kd = f"effort_limit = 5.0\nkd = {changed.pop('kd', 0.0)}"
    robot = write_arm(tmp_path / "arm", TOML.replace("effort_limit = 5.0", kd))
    servos = SERVO | changed
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, servos))
    real = recordings(robot, 1, rows=200, kp=0.7)
    whole = [t.qpos for t in replay(real, acting)]
    runs = JointRollouts(real, robot)
    company = np.where(runs.counted[0][:, None], whole[0] - real[0].qpos, 0.0)

    def difference(servo):
        """Mean difference of the joints' rollouts from the robot's, over its own error."""
        alone = runs.errors(same(servo))[0, :, 0].T
        return np.abs(alone - company).mean() / np.abs(company).mean()

    assert np.abs(company).mean() > 0.005  # it is not the robot that was recorded
    assert difference(servos) < MAX_DIFFERENCE
    for term in changed:
        others = {field: value for field, value in changed.items() if field != term}
        assert difference(SERVO | others) > MAX_DIFFERENCE, f"the same without {term}"
    assert set(changed) <= {*SERVO, *SERVO_TERMS, "effort_limit"}


@pytest.mark.parametrize(
    ("part", "new"),
    [
        ('range="-1.5 1.5"/>', 'range="-1.5 1.5" stiffness="3" springref="0.3"/>'),
        ('<body name="fore"', '<body name="fore" gravcomp="1"'),
    ],
    ids=["springs", "compensated gravity"],
)
def test_springs_and_compensated_gravity_act_on_a_joint_alone(tmp_path, part, new):
    xml = XML.replace(part, new)
    assert xml != XML
    robot = write_arm(tmp_path / "arm", xml=xml)
    real = recordings(robot, 2, rows=200)
    errors = JointRollouts(real, robot).errors(same(SERVO | {"kp": 20.0}))
    assert np.abs(errors).mean() < 1e-3


def test_damping_taken_from_kd_is_a_share_of_it_at_all_gains(tmp_path):
    robot = write_arm(tmp_path, TOML.replace("kp = 20.0", "kp = 20.0\nkd = 2.0"))
    less = dict.fromkeys(robot.joint_names, SERVO | {"damping": -0.5})
    told = []
    for kd in (2.0, 1.0):
        acting = robot.with_identified(less).with_gains(None, (kd, kd))
        made = recordings(acting, 1, rows=200)[0]
        told.append(replace(made, meta=replace(made.meta, kp=(20.0, 20.0), kd=(kd, kd))))
    errors = JointRollouts(told, robot).errors(same(SERVO | {"damping": -0.5}))
    assert np.abs(errors).mean() < 1e-3


def test_numba_compiles_once_for_all_numbers_of_windows_joints_and_candidates(tmp_path):
    robot = write_arm(tmp_path)
    real = recordings(robot, 2, rows=60)
    ramped = robot.with_servo(target_speed=np.full(2, 0.8))
    before = len(compiled(simulate_joints).signatures)
    for parts, one, count in ((real, robot, 3), (real[:1], robot, 1), (real, ramped, 2)):
        runs = JointRollouts(parts, one)
        values = same(SERVO, count)
        runs.errors(values)
        single = {field: value.astype(np.float32) for field, value in values.items()}
        runs.shortened(0.5).errors(single)
    assert len(compiled(simulate_joints).signatures) <= max(before, 1)


def test_candidates_do_not_affect_each_other(tmp_path):
    robot = write_arm(tmp_path)
    runs = JointRollouts(recordings(robot, 2, rows=60, kp=0.7), robot)
    law = {"stribeck": 0.1, "stribeck_speed": 0.05, "friction_motor": 0.2, "min_torque": 0.1}
    factors = np.linspace(0.5, 1.5, 6).reshape(3, 2)
    servo = SERVO | {"delay": 0.013} | law
    values = {field: value * factors for field, value in servo.items()}
    together = runs.errors(values)
    for i in range(3):
        candidate = {field: value[i : i + 1] for field, value in values.items()}
        np.testing.assert_array_equal(together[i], runs.errors(candidate)[0])


def test_recordings_at_several_gains_have_one_servo(tmp_path):
    robot = write_arm(tmp_path)
    told = []
    for kp in (8.0, 40.0):  # of a motor that makes 0.8 of what its gains say
        set_to = robot.with_gains((kp, kp), None)
        motor = {joint: {"kp": 0.8 * kp} for joint in robot.joint_names}
        made = recordings(set_to.with_identified(motor), 1, rows=200)[0]
        told.append(replace(made, meta=replace(made.meta, kp=(kp, kp), kd=(0.0, 0.0))))
    values = same(SERVO | {"kp": 0.8 * 20.0})
    assert np.abs(JointRollouts(told, robot).errors(values)).mean() < 1e-3
    untold = [replace(s, meta=replace(s.meta, kp=None)) for s in told]
    assert np.abs(JointRollouts(untold, robot).errors(values)).mean() > 5e-3


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("one_joint") / "arm")


@pytest.fixture(scope="module")
def elbow_recordings(arm):
    """Five seconds each in which the elbow, softer than its file, moves alone; the shoulder is at
    an angle that was told.
    """
    soft = arm.with_identified({"elbow": {"kp": 0.7 * arm.servo.kp[1]}})
    made = []
    for real in recordings(arm, 3, rows=250, kp=0.7):
        qpos = np.array(real.qpos)
        ctrl = np.array(real.ctrl)
        qvel = np.array(real.qvel)
        qpos[:, 0] = 0.4
        ctrl[:, 0] = 0.4
        qvel[:, 0] = 0.0
        meta = replace(real.meta, notes=real.meta.notes | {"posture": {"shoulder": 0.4}})
        whole = replace(real, meta=meta, qpos=qpos, ctrl=ctrl, qvel=qvel)
        (moved,) = replay([whole], soft)
        made.append(replace(whole, qpos=moved.qpos, qvel=moved.qvel))
    return made


@pytest.fixture(scope="module")
def elbow_windows(elbow_recordings):
    """Their windows of a second."""
    windows = []
    for recorded in elbow_recordings:
        for start in range(0, 250, 50):
            windows.append(recorded.rows(slice(start, start + 50)))
    return windows


def test_an_unrecorded_joint_stands_still(elbow_recordings):
    for recorded in elbow_recordings:
        assert np.array_equal(recorded.qpos[:, 0], np.full(250, np.float32(0.4)))


def test_nothing_is_asked_of_an_unrecorded_joint(arm, elbow_windows):
    found = identify(elbow_windows, arm, options=IdentifyOptions(terms=()))
    assert found.robot.servo.kp[1] == pytest.approx(0.7 * arm.servo.kp[1], rel=0.02)
    assert found.robot.servo.kp[0] == pytest.approx(arm.servo.kp[0], rel=1e-3)
    assert found.after < 0.2 * found.before


def test_an_unrecorded_joint_is_not_counted(arm, elbow_windows):
    simulated = [trajectory.qpos for trajectory in replay(elbow_windows, arm)]
    total = summary(runs(elbow_windows, simulated, arm), arm)
    assert total["mpjae"] == total["by_joint"]["elbow"]["mpjae"]
    assert list(total["by_joint"]) == ["elbow"]
    worst = f"most at elbow ({1e3 * total['mpjae']:.2f})."
    assert verdict({"nominal": total})[0].endswith(worst)


def test_a_single_joint_rollout_stays_within_the_joints_range():
    """The G1's waist bent, its servos softer and softer: at most from stop to stop."""
    robot = load_robot("g1_29")
    qpos = np.tile(np.float32(robot.qpos_home), (200, 1))
    qpos[:, robot.index(["waist_roll_joint", "waist_pitch_joint"])] = 0.3
    meta = SequenceMeta("g1_29", "unit", "bent", 0.0)
    runs = JointRollouts([Sequence(meta, robot.joint_names, 0.02, qpos, qpos, 0 * qpos)], robot)
    candidates = (3, len(robot.operated))
    values = {field: np.zeros(candidates) for field in SERVO}
    values["kp"] = np.repeat([[40.0], [10.0], [0.1]], candidates[1], axis=1)
    way = np.ptp(robot.qpos_range[robot.operated_index], axis=1)
    errors = runs.errors(values)
    assert (np.abs(errors).max(axis=(2, 3)) <= way).all()
    assert np.abs(errors[2]).max() > 0.3  # the softest falls


def test_windows_of_several_control_rates_are_fitted_together(tmp_path):
    """Two seconds of one servo, recorded at 50, at 100 and at 400 Hz: its numbers explain all of
    them.
    """
    robot = write_arm(tmp_path)
    true = SERVO | {"kp": 14.0, "delay": 0.03, "damping": 0.8}
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, true))
    template = recordings(robot, 1)[0]
    parts = []
    for motion, dt in enumerate([0.02, 0.01, 0.01, 0.0025]):
        rows = round(2 / dt)
        ctrl = commands(rows, motion, dt)
        start = np.tile(ctrl[0], (rows, 1))
        asked = Sequence(template.meta, robot.joint_names, dt, ctrl, start, 0 * ctrl)
        (simulated,) = replay([asked], acting)
        parts.append(replace(asked, qpos=simulated.qpos, qvel=simulated.qvel))
    runs = JointRollouts(parts, robot)
    values = {field: np.array([acting.servo[field]]) for field in SERVO}
    before = np.abs(runs.errors(same(SERVO))).mean(axis=(0, 1, 3))
    after = np.abs(runs.errors(values)).mean(axis=(0, 1, 3))
    assert (after < 0.1 * before).all()
    # No row in less than 10 ms.
    np.testing.assert_allclose(runs.counted.sum(axis=1), [95, 190, 190, 190], atol=5)
    # Where a search starts.
    np.testing.assert_allclose(balanced_values(runs.windows)["kp"], 14.0, rtol=0.35)
