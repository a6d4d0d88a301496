"""The servo's terms: friction by speed and load, least torque, encoder steps; one definition for
every simulator.
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from arm import TOML, write_arm

from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.batch import BatchSim
from gaponet.sim.model import build_model, build_spec
from gaponet.sim.servo import (
    SERVO_RECORD,
    friction_limit,
    joint_friction,
    motor_limits,
    present,
    requested_torque,
    servo_bias,
    servo_torque,
    torque_range,
)


def servo_model(robot, **values):
    return robot.with_identified(dict.fromkeys(robot.joint_names, values))


def pull(robot, torque, seconds=0.3):
    """Speed of the elbow after a steady torque on it, from rest, no gravity, (rad/s)."""
    sim = BatchSim(servo_model(robot, kp=1e-3), [(0.0, "both", 0.02)], 1)
    sim.batch.expand("opt.gravity")[:] = 0.0
    sim.reset(slice(None), np.zeros((1, 2)), np.zeros((1, 2)))
    sim.batch.bind("qfrc_applied")[:] = [0.0, torque]
    for _ in range(round(seconds / 0.02)):
        sim.step(np.zeros((1, 2)))
    return float(sim.qvel[0, 1])


def test_friction_at_rest_exceeds_that_in_motion(arm):
    sticky = servo_model(arm, stribeck=0.1, stribeck_speed=0.05)  # frictionloss is 0.05
    assert abs(pull(servo_model(arm, stribeck=0.1), 0.14)) < 1e-4  # without a speed it ends at once
    assert pull(arm, 0.1) > 0.05
    assert abs(pull(sticky, 0.14)) < 1e-4
    # Once it slides fast the difference is gone: damping 0.5 alone takes what is beyond 0.05 N·m.
    assert pull(sticky, 1.05, 0.5) == pytest.approx(2.0, rel=0.02)


def test_stribeck_friction_falls_to_a_share_of_1_over_e_at_its_speed():
    terms = {"stribeck": np.array([0.2]), "stribeck_speed": np.array([0.1])}
    qvel = np.array([0.0, 0.1, -0.1, 10.0])
    friction = friction_limit(terms, 0.05, qvel, 0.0, 0.0)
    at_speed = 0.05 + 0.2 / np.e
    np.testing.assert_allclose(friction, [0.25, at_speed, at_speed, 0.05], rtol=1e-6)


def test_a_loaded_motor_has_more_friction(tmp_path):
    robot = servo_model(
        write_arm(tmp_path / "arm"), frictionloss=0.0, friction_motor=0.2, damping=3.0
    )
    sim = BatchSim(robot, [(0.0, "both", 0.02)] * 2, 1)
    home = np.zeros((2, 2))
    sim.reset(slice(None), home, home)
    for _ in range(200):
        sim.step(home)
    rest = sim.qpos[0].copy()
    held = -0.2 * 9.81 * 0.1  # N·m: the fore arm's weight
    # Friction carries the rest.
    assert abs(sim.servo_model.state.torque[0, 1]) == pytest.approx(abs(held) / 1.2, rel=0.05)
    # What friction may take there, it takes: a small push moves nothing.
    sim.batch.bind("qfrc_applied")[1] = [0.0, 0.2 * held]
    for _ in range(100):
        sim.step(home)
    np.testing.assert_allclose(sim.qpos[1], rest, atol=2e-4)


def test_a_coarse_encoder_hides_small_errors(arm):
    robot = servo_model(arm, encoder_step=0.02, frictionloss=0.0, damping=1.0)
    sim = BatchSim(robot, [(0.0, "both", 0.02)], 1)
    sim.batch.expand("opt.gravity")[:] = 0.0
    sim.reset(slice(None), np.full((1, 2), 0.008), np.zeros((1, 2)))
    for _ in range(50):
        sim.step(np.zeros((1, 2)))
    np.testing.assert_allclose(sim.qpos, 0.008, atol=1e-9)


def test_a_minimum_torque_overcomes_friction_at_small_errors(arm):
    still = {"frictionloss": 0.2, "encoder_step": 0.0015}
    ends = []
    for least in (0.0, 0.4):
        sim = BatchSim(servo_model(arm, **still, min_torque=least), [(0.0, "both", 0.02)], 1)
        sim.batch.expand("opt.gravity")[:] = 0.0
        sim.reset(slice(None), np.full((1, 2), 0.006), np.zeros((1, 2)))
        for _ in range(100):
            sim.step(np.zeros((1, 2)))
        ends.append(np.abs(sim.qpos).max())
    assert ends[0] > 0.005 > 0.003 > ends[1]


def test_a_servo_model_of_zeros_is_bit_identical_to_none(arm):
    conditions = [(0.5, "both", 0.02)] * 3
    without = BatchSim(arm, conditions, 1, servo_model=False)
    sims = [without, BatchSim(arm, conditions, 1, servo_model=True)]
    rng = np.random.default_rng(0)
    for sim in sims:
        sim.reset(slice(None), np.full((3, 2), 0.1), np.zeros((3, 2)))
    for _ in range(50):
        target = rng.normal(0, 0.3, (3, 2))
        for sim in sims:
            sim.step(target)
    np.testing.assert_array_equal(sims[0].qpos, sims[1].qpos)


def test_a_restored_state_continues_identically(arm):
    robot = servo_model(
        arm, stribeck=0.1, stribeck_speed=0.05, friction_motor=0.2, friction_external=0.1
    )
    sim = BatchSim(robot, [(0.5, "both", 0.02)] * 2, 1)
    sim.reset(slice(None), np.full((2, 2), 0.1), np.zeros((2, 2)))
    for _ in range(20):
        sim.step(np.full((2, 2), 0.3))
    kept = sim.state()
    ends = []
    for _ in range(2):
        sim.set_state(kept)
        for _ in range(20):
            sim.step(np.full((2, 2), -0.2))
        ends.append(sim.qpos.copy())
    np.testing.assert_array_equal(*ends)


def random_servos(count):
    """Servos with and without each term, and states near and far from their targets."""
    rng = np.random.default_rng(0)
    servos = np.zeros(count, SERVO_RECORD)
    for name in SERVO_RECORD.names:
        servos[name] = rng.uniform(0.01, 1.0, count) * rng.integers(0, 2, count)
    servos["effort_limit"] = 2.0
    state = {
        "kp": rng.uniform(1, 50, count),
        "aim": rng.normal(0, 0.5, count),
        "qpos": rng.normal(0, 0.5, count),
        "qvel": rng.normal(0, 2, count),
        "torque": rng.normal(0, 1, count),
        "load": rng.normal(0, 1, count),
    }
    return servos, state


def test_a_servo_of_the_simulator_is_one_of_the_arrays_that_exports_take():
    servos, state = random_servos(200)
    terms = present({name: servos[name] for name in SERVO_TERMS})
    kp, aim, qpos, qvel, torque, load = state.values()
    wanted = servo_torque(terms, kp, aim, qpos)
    friction = friction_limit(terms, servos["frictionloss"], qvel, torque, load)
    limits = np.transpose(torque_range(servos["effort_limit"], qvel / terms["no_load_speed"]))
    for i, servo in enumerate(servos.view(np.recarray)):
        assert requested_torque(servo, kp[i], aim[i], qpos[i]) == pytest.approx(wanted[i], abs=1e-9)
        assert motor_limits(servo, qvel[i]) == pytest.approx(limits[i], abs=1e-9)
        here = joint_friction(servo, qvel[i], torque[i], load[i])
        assert here == pytest.approx(friction[i], abs=1e-9)


@pytest.mark.parametrize("library", [np.array, torch.tensor])
@pytest.mark.parametrize("term", ["min_torque", "encoder_step"])
def test_a_joint_without_a_gain_keeps_its_bias_beside_one_with_a_servo_model(term, library):
    kp = library([20.0, 0.0])
    bias = library([0.4, 0.1])  # N·m: of an aim 0.02 rad ahead
    rest = library([0.0, 0.0])  # rad
    found = servo_bias({term: library([0.05, 0.0])}, kp, bias, rest, rest)
    np.testing.assert_allclose(found, [0.4, 0.1])


def direct_current_model(robot, kp, kd, no_load, limit):
    """The robot with MuJoCo's <dcmotor> of this no-load speed and stall torque in every joint."""
    spec = build_spec(robot)
    volts = 12.0
    constant = volts / no_load
    resistance = constant * volts / limit
    gains = [kp, 0, kd, 0, 0, volts]
    for servo in spec.actuators:
        servo.set_to_dcmotor(
            motorconst=[constant, 0], resistance=resistance, controller=gains, ctrlspec=1
        )
    return spec.compile()


@pytest.mark.skipif(
    mujoco.__version__ < "4", reason="MuJoCo's DC motor takes no position before MuJoCo 4"
)
def test_a_torque_falls_with_speed_and_brakes_whole(arm):
    """Between ± effort_limit the motor is MuJoCo's own <dcmotor> behind a current controller."""
    kp = 20.0
    kd = 0.5
    limit = 2.0
    no_load = 2.0
    rows = 150
    values = {
        "kp": kp,
        "effort_limit": limit,
        "no_load_speed": no_load,
        "damping": 0.1,
        "frictionloss": 0.0,
    }
    robot = replace(servo_model(arm, **values).with_servo(kd=np.full(2, kd)), timestep=0.0005)
    model = direct_current_model(robot, kp, kd, no_load, limit)
    data = mujoco.MjData(model)
    sim = BatchSim(robot, [(0.0, "both", 0.02)], 1)
    targets = np.repeat(np.random.default_rng(0).uniform(-1, 1, (rows // 30, 2)), 30, axis=0)
    sim.reset(slice(None), targets[:1], np.zeros((1, 2)))
    data.qpos[:] = targets[0]
    qpos = []
    torque = []
    qvel = []
    for target in targets:
        sim.step(target[None])
        data.ctrl[:] = target
        mujoco.mj_step(model, data, robot.decimation)
        qpos.append(sim.qpos[0] - data.qpos)
        torque.append(sim.torque[0].copy())
        qvel.append(sim.qvel[0].copy())
    # rad; both step by half a millisecond, MuJoCo's back-EMF implicitly.
    assert np.abs(qpos).mean() < 2e-3
    driving = np.sign(torque) * np.array(qvel) / no_load
    assert driving.max() > 0.3  # it is a matter of speed
    assert (np.abs(torque) <= limit * np.minimum(1, 1 - driving) + 0.05).all()
    assert np.abs(torque)[driving < 0].max() == pytest.approx(limit)


def test_the_mujoco_model_holds_the_servo_model(arm):
    model = build_model(servo_model(arm, stribeck=0.1, stribeck_speed=0.05))
    assert model.actuator_user[0].tolist() == [0.1, 0.05] + [0.0] * (len(SERVO_TERMS) - 2)
    assert build_model(arm).nuser_actuator == 0


def test_a_zero_turns_the_arm_under_the_same_reading(tmp_path):
    robot = write_arm(tmp_path / "arm", toml=TOML)
    turned = robot.with_identified({"shoulder": {"zero": 0.3}})
    places = []
    for r, angle in ((robot, 0.3), (turned, 0.0)):
        model = build_model(r)
        data = mujoco.MjData(model)
        data.qpos[:] = [angle, 0.0]
        mujoco.mj_forward(model, data)
        places.append(data.body("fore").xpos.copy())
    np.testing.assert_allclose(*places, atol=1e-12)


def test_a_speed_that_is_written_moves_the_motor_behind_a_gap_and_a_new_batch_takes_its_state(arm):
    home = np.zeros((1, 2))
    robots = servo_model(arm), servo_model(arm, backlash=1e-9), servo_model(arm, backlash=0.02)
    sims = [BatchSim(robot, [(0.0, "both", 0.02)], 1) for robot in robots]
    for sim in sims:
        sim.reset(slice(None), home, home)
        sim.qvel[:] = 2.0
        sim.step(home)
    np.testing.assert_allclose(sims[1].qvel, sims[0].qvel, atol=0.05)
    again = BatchSim(robots[2], [(0.0, "both", 0.02)], 1)
    again.set_state(sims[2].state())
    for sim in (again, sims[2]):
        for target in (0.3, -0.3):
            sim.step(home + target)
    np.testing.assert_array_equal(again.qpos, sims[2].qpos)
