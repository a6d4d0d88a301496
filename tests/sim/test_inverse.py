"""The inverse of a simulator is the target that was given to it, and the label of pre-training."""

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, commands, record, write_arm

from gaponet.robot.mjcf import compile_spec
from gaponet.sim.batch import Batch, BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse, Inertia, Period, weights_within_period
from gaponet.sim.model import build_model, build_spec
from gaponet.sim.replay import replay

CONDITION = Condition(0.2, "both", 0.02)
EMPTY = Condition(0.0, "both", 0.02)
LOADED = {"frictionloss": 0.05, "friction_motor": 0.4, "friction_external": 0.1}


def smooth(robot):
    """A recording of slow motion, so that filters and steps take nothing away."""
    return record(robot, 0.3 * commands(200, 2), "slow", payload=0.2)


def periods(sequence, friction):
    qpos = sequence.qpos[:, None].astype(float)  # (T, 1, n)
    qvel = sequence.qvel[:, None].astype(float)
    made = []
    for t in range(len(qpos) - 1):
        rubbing = friction * np.sign(qpos[t + 1] - qpos[t])
        made.append(Period(qpos[t], qvel[t], qpos[t + 1], qvel[t + 1], rubbing))
    return made


def test_the_inverse_of_a_recording_is_its_command(tmp_path):
    robot = write_arm(tmp_path, xml=XML.replace('frictionloss="0.05"', 'frictionloss="0"'))
    sequence = smooth(robot)
    inverse = AnalyticInverse.of(BatchSim(robot, [CONDITION]))
    told = np.concatenate([inverse([p]) for p in periods(sequence, 0.0)])
    np.testing.assert_allclose(told, sequence.ctrl[:-1], atol=2e-4)


def test_a_tendons_actuator_with_a_joints_number_is_no_servo(tmp_path):
    robot = write_arm(tmp_path)
    spec = build_spec(robot)
    for name in ("one", "other"):
        spec.add_tendon(name=name).wrap_joint("elbow", 1.0)
        pull = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_TENDON)
        pull.set_to_position(kp=0.0)
    scene = compile_spec(spec, robot.mjcf)
    own = BatchSim(robot, [EMPTY])
    inverse = AnalyticInverse(Batch(scene, nsim=1), scene, robot.joint_names, own.periods)
    assert inverse.agrees_with(AnalyticInverse.of(own), robot.qpos_range)


def test_friction_that_grows_with_the_motors_torque_is_overcome_too(tmp_path):
    robot = write_arm(tmp_path).with_identified(dict.fromkeys(("shoulder", "elbow"), LOADED))
    (sequence,) = replay([smooth(robot)], robot)
    inverse = AnalyticInverse.of(BatchSim(robot, [CONDITION]))
    told = np.concatenate([inverse([p]) for p in periods(sequence, 1.0)])
    speed = np.abs(sequence.qvel).astype(float)
    moving = (speed[:-1] > 0.1) & (speed[1:] > 0.1)
    assert moving.sum() > 50
    assert np.abs(told - sequence.ctrl[:-1])[moving].mean() < 1e-3


@pytest.mark.parametrize("count", [1, 2, 4, 10])
def test_states_within_a_period_follow_parabolic_speeds(count):
    h = 0.005
    i = np.arange(count + 1)
    speed = 0.3 + 0.2 * i - 0.03 * i**2
    position = np.concatenate([[0.0], np.cumsum(h * speed[1:])])
    known = np.array([h * speed[0], h * speed[-1], position[-1]])
    of_positions, of_speeds = weights_within_period(count, 12)
    before = of_positions @ known
    moved = of_speeds @ known
    np.testing.assert_allclose(before[:count], position[:-1], atol=1e-12)
    np.testing.assert_allclose(moved[: count + 1] / h, speed, atol=1e-12)


def test_inertia_is_mujocos(tmp_path):
    import mujoco

    robot = write_arm(tmp_path)
    sim = BatchSim(robot, [CONDITION])
    inertia = Inertia(sim.batch, next(iter(sim.models.values())), np.arange(2))
    sim.qpos[:] = [[0.3, -0.4]]
    sim.batch.forward()
    model = build_model(robot, 0.2)
    data = mujoco.MjData(model)
    full = np.zeros((2, 2))
    data.qpos[:] = [0.3, -0.4]
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(inertia.matrix(1)[0], full, atol=1e-12)


def test_torque_limits_bound_the_targets(tmp_path):
    weak = write_arm(tmp_path, TOML.replace("effort_limit = 5.0", "effort_limit = 0.1"))
    inverse = AnalyticInverse.of(BatchSim(weak, [CONDITION]))
    still = Period(*np.zeros((5, 1, 2)))
    assert np.abs(inverse([still])).max() <= 0.1 / 20.0 + 1e-12


def test_a_torque_speed_line_bounds_the_targets_of_a_moving_joint(tmp_path):
    """At half of its no-load speed a motor has half of its torque, however fast it is to become."""
    robot = write_arm(tmp_path, TOML.replace("effort_limit = 5.0", "effort_limit = 0.4"))
    robot = robot.with_identified({joint: {"no_load_speed": 2.0} for joint in robot.joint_names})
    inverse = AnalyticInverse.of(BatchSim(robot, [CONDITION]))
    at = np.zeros((1, 2))
    speed = np.ones((1, 2))
    targets = inverse([Period(at, speed, at + 0.02, speed + 1.0, at)])
    assert inverse.servos.high.max() == 0.4
    mean_position = 0.01  # rad
    torque = inverse.servos.kp * (targets - mean_position)
    np.testing.assert_allclose(torque, 0.2, rtol=1e-3)
