"""Candidates for the servos of a whole robot beside recordings."""

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.sim.replay import replay
from gaponet.sysid.axes import CLASSIC, Bounds
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.problem import JointFit
from gaponet.sysid.robot_rollouts import RobotRollouts, cut


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def parts(robot):
    return cut(recordings(robot, 2, rows=60, kp=0.6), 2)


def own(robot, parts):
    return {f: x[None] for f, x in Bounds(robot, parts).first.items() if f in CLASSIC}


def test_robot_rollouts_agree_with_replays(robot, parts):
    runs = RobotRollouts(parts, robot)
    values = own(robot, parts)
    both = {field: np.concatenate([value, value]) for field, value in values.items()}
    both["kp"][1] *= 1.3
    errors = runs.flat_errors(both)
    assert np.abs(errors[1] - errors[0]).max() > 1e-3
    for window, (part, simulated) in enumerate(zip(parts, replay(parts, robot), strict=True)):
        expected = (simulated.qpos - part.qpos)[1:][runs.counted[: len(part) - 1, window]].T
        np.testing.assert_allclose(errors[0][:, runs.window == window], expected, atol=1e-6)


def test_a_joints_error_depends_mostly_on_its_own_parameters(robot, parts):
    runs = RobotRollouts(parts, robot)
    values = own(robot, parts)
    candidates = {field: np.repeat(value, 4, axis=0) for field, value in values.items()}
    candidates["kp"] *= [[1.0, 1.0], [1.02, 1.02], [1.02, 1.0], [1.0, 1.02]]
    errors = runs.flat_errors(candidates)
    together = errors[1] - errors[0]
    for joint in range(2):
        alone = errors[2 + joint, joint] - errors[0, joint]
        assert np.abs(together[joint] - alone).mean() < 0.2 * np.abs(alone).mean()


def test_a_rollout_restarts_from_the_recording_after_a_possible_contact(robot, parts):
    touch = np.zeros((2, 60), bool)
    touch[0, 30] = True
    free = RobotRollouts(parts, robot)
    held = RobotRollouts(parts, robot, touch=touch)
    values = own(robot, parts)
    assert free.counted[29, 0]
    assert not held.counted[29, 0]
    assert held.counted[29, 1]
    untouched = free.flat_errors(values)[0]
    touched = held.flat_errors(values)[0]
    np.testing.assert_array_equal(untouched[:, free.window == 1], touched[:, held.window == 1])
    late = RobotRollouts([parts[0].rows(slice(30, 60))], robot)
    afresh = late.flat_errors(values)[0][:, 1:]  # the first rows after it do not count
    restarted = touched[:, held.window == 0][:, -afresh.shape[1] :]
    np.testing.assert_allclose(restarted, afresh, atol=1e-6)


def test_damping_below_zero_is_taken_from_the_servo(robot, parts):
    less = robot.with_servo(kd=np.full(2, 0.4))
    softer = robot.with_servo(kd=np.full(2, 0.1))
    values = own(less, parts)
    np.testing.assert_allclose(
        RobotRollouts(parts, less).flat_errors(values | {"damping": np.full((1, 2), -0.3)}),
        RobotRollouts(parts, softer).flat_errors(values | {"damping": np.zeros((1, 2))}),
        atol=1e-6,
    )
    written = less.with_identified({"elbow": {"damping": -0.3}})
    assert written.servo.kd.tolist() == pytest.approx([0.4, 0.1])
    assert (written.servo.damping[1], written.nominal.servo.kd[1]) == (0.0, 0.4)


def test_a_search_goes_on_with_the_better_of_its_starts(robot, parts):
    fit = JointFit(JointRollouts(parts, robot), robot, Bounds(robot, parts)).robot_fit(1)
    file = fit.bounds.start
    real = file | {"kp": 0.6 * file["kp"]}
    search = fit.search(CLASSIC, file, (file, real))
    errors = []
    for _ in range(2):
        search.iterate(1)
        search.keep_better_starts()
        errors.append(np.abs(fit.rollouts.flat_errors(alone(search.values))).mean())
    assert errors[1] <= errors[0]
    np.testing.assert_allclose(search.values["kp"], real["kp"], rtol=0.1)


def alone(values):
    return {f: x[None] for f, x in values.items()}
