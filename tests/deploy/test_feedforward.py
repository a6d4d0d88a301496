"""Feed-forward of motion: the torque that inverse dynamics asks for, less what holding takes."""

import mujoco
import numpy as np
import pytest
from arm import commands, write_arm

from gaponet.deploy.feedforward import MAX_ACCELERATION, MAX_SPEED, MotionTorque
from gaponet.sim.batch import BatchSim


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


def make(robot, num=1, acceleration_time=0.0):
    sim = BatchSim(robot, [(0.4, "both", 0.02)] * num, 1)
    return sim, MotionTorque(sim, np.arange(2), robot, 0.02, acceleration_time)


def test_feed_forward_equals_inverse_dynamics(robot):
    sim, moving = make(robot)
    targets = commands(30, 0)
    moving.reset(targets[:1])
    for target in targets:
        moving.update(target[None])
    sim.reset(slice(None), targets[-1:], np.zeros((1, 2)))
    sim.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
    data = sim.batch.get_data(0)
    model = next(iter(sim.models.values()))
    data.qacc[:] = moving.qacc[0]
    mujoco.mj_inverse(model, data)
    expected = (
        data.qfrc_inverse
        - data.qfrc_bias
        + 0.5 * moving.qvel[0]
        + 0.05 * np.tanh(moving.qvel[0] / 0.05)
    )
    friction = data.qfrc_constraint  # of standing still, which mj_inverse counts
    np.testing.assert_allclose(moving.torque()[0], expected + friction, atol=1e-9)


def test_what_the_servo_brakes_itself_does_not_rub_in_the_gear(tmp_path):
    """At an even speed without gravity and damping the motor gives no torque that could rub."""
    arm = write_arm(tmp_path).with_servo(
        kd=np.full(2, 1.5), damping=0.0, frictionloss=0.0, friction_motor=0.3
    )
    _, moving = make(arm)
    moving.qvel = np.full((1, 2), 0.8)
    moving.qacc = np.zeros((1, 2))
    np.testing.assert_allclose(moving.torque(), 1.5 * 0.8)


def test_a_target_that_stands_asks_for_nothing_and_a_jump_for_a_bounded_torque(robot):
    _, moving = make(robot)
    moving.reset(np.zeros((1, 2)))
    moving.update(np.zeros((1, 2)))
    np.testing.assert_array_equal(moving.torque(), 0.0)
    moving.update(np.full((1, 2), 1.0))
    np.testing.assert_array_equal(moving.qvel, MAX_SPEED)
    np.testing.assert_array_equal(moving.qacc, MAX_ACCELERATION)


def test_the_low_pass_lessens_the_noise_of_targets(robot):
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1e-3, (200, 1, 2))
    size = {}
    for time in (0.0, 0.08):
        _, moving = make(robot, acceleration_time=time)
        moving.reset(noise[0])
        size[time] = 0.0
        for target in noise:
            moving.update(target)
            size[time] += np.abs(moving.qacc).mean()
    assert size[0.08] < 0.4 * size[0.0]
