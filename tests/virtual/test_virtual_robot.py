"""A virtual robot as a whole: with all effects off it is the nominal simulator, and each effect
shows its signature.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
from arm import XML, write_arm

from gaponet.robot.spec import load_robot
from gaponet.sim.batch import BatchSim
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model, idle_joints
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.physics import EFFECTS, Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

KP = 20.0  # of both joints of the test arm
FIELDS = {e: [f.name for f in fields(Physics) if f.metadata["effect"] == e] for e in EFFECTS}


def unit(n=2, **values):
    """A unit without any effect but these: one number for all joints."""
    off = neutral(n)
    return replace(off, **{k: np.full_like(getattr(off, k), v) for k, v in values.items()})


def run(robot, units, ctrl, payload=0.0, dt=0.02, start=None, **how):
    """Play (T, n) targets on every unit; true positions after each period (T, N, n) and the
    robots.
    """
    robots = VirtualRobot(robot, units, [(payload, "both")] * len(units), dt, **how)
    every = lambda row: np.repeat(row[None], len(units), axis=0)  # noqa: E731
    robots.reset(
        every(ctrl[0]), list(range(len(units))), start=None if start is None else every(start)
    )
    path = []
    for row in ctrl:
        robots.step(every(row))
        path.append(robots.true_qpos())
    return np.array(path), robots


def hold(shoulder, elbow=0.0, seconds=1.0, dt=0.02):
    return np.repeat(np.array([[shoulder, elbow]]), round(seconds / dt), axis=0)


def test_with_all_effects_off_h1_2_is_the_nominal_simulator_for_ten_seconds():
    robot = load_robot("h1_2")
    payloads = [(0.0, "both"), (3.0, "both"), (3.0, "left")]
    robots = VirtualRobot(robot, [neutral(27)] * 3, payloads, timestep=robot.timestep)
    time = np.arange(round(10 / robot.dt))[:, None] * robot.dt
    wave = 0.4 * np.sin(2 * np.pi * 0.4 * time + np.arange(27)) - 0.4 * np.sin(np.arange(27))
    robots.reset(np.repeat(wave[:1], 3, axis=0), [1, 2, 3])
    nominal = BatchSim(robot, [(mass, side, robot.dt) for mass, side in payloads])
    nominal.reset(slice(None), robots.true_qpos(), np.zeros(27))
    for row in wave:
        targets = np.repeat(row[None], 3, axis=0)
        robots.step(targets)
        nominal.step(targets)
        assert np.abs(robots.true_qpos() - nominal.qpos).max() < 1e-6


def test_standing_legs_change_nothing_for_the_arms():
    robot = load_robot("h1_2")
    locked = idle_joints(robot, robot.operated)
    arms = robot.index([n for n in robot.joint_names if n not in locked])
    time = np.arange(100)[:, None] * robot.dt
    ctrl = np.zeros((100, 27))
    ctrl[:, robot.operated_index] = 0.3 * np.sin(2 * time + np.arange(10)) - 0.3 * np.sin(
        np.arange(10)
    )
    physics = load_fleet("easy", robot).unit("virtual-1")
    whole, _ = run(robot, [physics], ctrl, 3.0)
    upper, _ = run(robot, [physics], ctrl, 3.0, locked=locked)
    assert len(locked) == 12
    assert np.abs(whole - upper)[..., arms].max() < 1e-6


def test_a_row_does_not_depend_on_its_company(arm):
    fleet = load_fleet("easy", arm)
    ctrl = hold(0.3) + 0.3 * np.sin(np.linspace(0, 9, 50))[:, None]
    alone, _ = run(arm, [fleet.unit("virtual-1")], ctrl, 0.2)
    among, _ = run(arm, [fleet.unit(f"virtual-{k}") for k in (1, 2, 3, 4)], ctrl, 0.2)
    assert np.array_equal(alone[:, 0], among[:, 0])


def test_a_weak_drive_sags_by_the_torque_over_what_it_delivers(arm):
    # holding level: τ = 9.81 · (0.3·0.1 + 0.2·0.3) = 0.883 N·m at the shoulder; friction off to see
    # PD alone
    model = build_model(arm)
    path, _ = run(arm, [unit(kp_scale=0.8), unit(kt_scale=0.8), unit()], hold(0.0, seconds=3.0))
    for i, share in enumerate((0.8, 0.8, 1.0)):
        q = path[-1, i]
        torque = static_torque(model, q[None])[0]
        # The nominal friction band, 0.05 N·m.
        assert (0.0 - q) * KP * share == pytest.approx(torque, abs=0.06)


def test_friction_opens_a_hysteresis_loop_of_twice_its_torque(arm):
    time = np.arange(0, 12, 0.02)
    # Up and down at 33 mrad/s, the arm nearly hanging.
    slow = 1.2 + 0.2 * np.abs((time / 6 + 1) % 2 - 1)
    ctrl = np.stack([slow, np.zeros_like(slow)], axis=1)
    width = {}
    for friction in (0.0, 0.3):
        path, _ = run(arm, [unit(friction=friction)], ctrl)
        q = path[:, 0, 0]
        # Same command, coming down and going up.
        width[friction] = q[len(q) * 3 // 4] - q[len(q) // 4]
    # Nominal friction and damping.
    assert width[0.0] == pytest.approx(2 * 0.05 / KP + 2 * 0.5 * 0.033 / KP, abs=1e-3)
    assert width[0.3] - width[0.0] == pytest.approx(2 * 0.3 / KP, rel=0.1)


def test_a_stuck_joint_does_not_creep(arm):
    path, _ = run(arm, [unit(friction=0.5)], hold(0.4, seconds=5.0), start=np.array([0.42, 0.01]))
    # Friction is a stiff constraint, not a rigid one: 20 µrad/s.
    assert np.abs(path[-1] - path[50]).max() < 1.2e-4


HANGING = np.array([1.4, np.pi / 2 - 1.4])  # no weight on the elbow


def pushed(elbow, seconds=0.4, dt=0.02):
    return np.repeat(HANGING[None] + [[0.0, elbow]], round(seconds / dt), axis=0)


def test_bristles_give_way_like_a_spring_and_come_back(arm):
    slowly = np.concatenate([np.linspace(0, 0.02, 50), np.linspace(0.02, 0, 50)])
    ctrl = HANGING + np.stack([0 * slowly, slowly], axis=1)
    path, _ = run(
        arm, [unit(friction=1.0, presliding=0.02), unit(friction=1.0)], ctrl, start=HANGING
    )
    q = path[:, :, 1] - HANGING[1]
    # 20 (0.02 − x) = 1.05 (1 − exp(−x / 0.02)) at 6.15 mrad; back, −20 x = −1.05 + 1.33 exp(−(6.15
    # mrad − x) / 0.02)
    assert q[49, 0] == pytest.approx(6.15e-3, rel=0.03)
    assert q[-1, 0] == pytest.approx(0.85e-3, abs=0.2e-3)
    assert np.abs(q[:, 1]).max() < 1e-4  # rigid friction holds


def test_a_robot_at_rest_stays_there_under_bristles(arm):
    path, _ = run(arm, [unit(friction=1.0, presliding=0.002)], hold(0.4, 0.3, 5.0))
    assert np.abs(path[-1] - path[0]).max() < 2.5e-6


def test_a_compliant_joint_hangs_below_what_its_encoder_says(arm):
    # 0.883 N·m at the shoulder through 0.1 rad at 5 N·m: 17.7 mrad that the encoder does not see
    path, robots = run(arm, [unit(windup=0.1), unit()], hold(0.0, seconds=3.0))
    seen = robots.read().qpos
    twist = seen[:, 0] - path[-1, :, 0]
    load = static_torque(build_model(arm), path[-1, :1])[0, 0]
    assert abs(load) == pytest.approx(0.883, rel=0.05)
    # Less what friction carries.
    assert twist[0] == pytest.approx(0.1 * load / 5.0, abs=0.05 * 0.1 / 5.0)
    assert twist[1] == 0.0
    # The drive holds its own side as well as ever.
    assert seen[0, 0] == pytest.approx(seen[1, 0], abs=0.006)


def test_the_current_loop_delays_by_its_time_constant(arm):
    given = []
    for time in (0.0, 0.05):
        _, robots = run(arm, [unit(current_time=time, friction=9.0)], pushed(0.0), start=HANGING)
        force = robots.batch.bind("actuator_force")  # of the call after this
        robots.step(pushed(0.1)[:1])
        given.append(force[0, 1])
    assert given[0] == pytest.approx(0.1 * KP, rel=0.01)
    assert given[1] == pytest.approx(0.1 * KP * (1 - np.exp(-0.02 / 0.05)), rel=0.02)


def test_delay_holds_the_joint_still_until_it_has_passed(arm):
    ctrl = np.concatenate([hold(1.0, seconds=0.2), hold(1.2, seconds=0.3)])
    path, _ = run(arm, [unit(), unit(delay=0.06)], ctrl)
    begun = np.abs(path - path[0]) > 1e-4
    # Three periods of 20 ms later.
    assert begun[:, :, 0].argmax(axis=0).tolist() == [10, 13]


def test_a_cable_pulls_towards_its_angle(arm):
    path, _ = run(arm, [unit(), unit(cable_stiffness=4.0, cable_angle=-1.0)], hold(1.4, 0.3, 2.0))
    q0, q1 = path[-1, :, 1]
    # 20 (0.3 − q) + 4 (−1 − q) = gravity, and 20 (0.3 − q0) = the same gravity: q = (20 q0 − 4) /
    # 24
    assert q1 == pytest.approx((20 * q0 - 4) / 24, abs=0.01)


def test_heavier_links_and_a_leaning_base_change_the_sag(arm):
    units = [unit(), unit(mass_scale=1.5), unit(tilt_pitch=0.2)]
    path, _ = run(arm, units, hold(0.0, 0.0, 3.0))
    sag = path[-1, :, 0]
    # 0.883 N·m of weight at the shoulder, ± friction band of 0.05 N·m on each
    assert sag[1] / sag[0] == pytest.approx(1.5, abs=0.17)
    assert sag[2] < sag[0]


def test_a_leaning_base_that_hangs_upside_down_stays_so(tmp_path):
    option = 'integrator="implicitfast"'
    hung = write_arm(tmp_path, xml=XML.replace(option, f'{option} gravity="0 0 9.81"'))
    path, _ = run(hung, [unit(), unit(tilt_pitch=0.02)], hold(0.0, 0.0, 3.0))
    upright, leaning = path[-1, :, 0]
    assert leaning == pytest.approx(upright, rel=0.1)


def test_a_bent_cable_widens_the_loop_of_its_neighbour(arm):
    ctrl = hold(0.0) + np.stack([np.zeros(50), 0.3 * np.sin(np.linspace(0, 6 * np.pi, 50))], axis=1)
    bent = ctrl + np.array([1.2, 0.0])
    straight = ctrl
    behind = []
    for motion in (straight, bent):
        path, _ = run(arm, [unit(), unit(drag=0.5)], motion)
        behind.append(np.abs(path[:, 1, 1] - path[:, 0, 1]).mean())
    assert behind[0] < 1e-3 < 5e-3 < behind[1]


def test_a_limb_whose_motors_ask_for_much_sags_more(arm):
    path, _ = run(arm, [unit(), unit(limb_loss=1.0)], hold(1.0), 0.2)
    light, _ = run(arm, [unit(), unit(limb_loss=1.0, limb_budget=10.0)], hold(1.0), 0.2)
    assert abs(path[-1, 1, 0] - 1.0) > abs(path[-1, 0, 0] - 1.0) + 5e-3
    assert np.abs(light[-1, 0] - light[-1, 1]).max() < 5e-4  # they came to rest apart


def test_a_leaning_base_is_gravity_from_elsewhere(arm):
    path, robots = run(arm, [unit(), unit(flex=0.02)], hold(1.0), 0.2)
    gravity = robots.batch.expand("opt.gravity")
    assert np.array_equal(gravity[0], [0, 0, -9.81])
    assert 0.01 < np.hypot(*gravity[1, :2]) / 9.81 < 0.2
    assert np.abs(path[-1, 0] - path[-1, 1]).max() > 1e-3


def test_a_payload_beside_the_palm_pulls_with_its_lever(arm):
    path, _ = run(arm, [unit(), unit(grip_x=0.05)], hold(1.0), 0.2)
    empty, _ = run(arm, [unit(), unit(grip_x=0.05)], hold(1.0))
    assert np.abs(path[-1, 0] - path[-1, 1]).max() > 1e-3
    assert np.abs(empty[-1, 0] - empty[-1, 1]).max() < 5e-4  # they came to rest apart


def test_churning_lags_with_the_square_of_the_speed(arm):
    lag = []
    for speed in (1.0, 2.0):
        ramp = np.repeat((speed * 0.02 * np.arange(40))[:, None] - 0.8, 2, axis=1)
        path, _ = run(arm, [unit(), unit(churning=0.2)], ramp)
        lag.append((path[-1, 0] - path[-1, 1])[1])
    assert 3.0 < lag[1] / lag[0] < 5.0


def test_firmware_smooths_small_steps_more_than_large_ones(arm):
    share = []
    for step in (0.01, 0.4):
        ctrl = hold(0.0, seconds=0.2)
        ctrl[1:, 1] = step
        path, _ = run(arm, [unit(), unit(smoothing=0.05, smoothing_lag=0.05)], ctrl)
        share.append(((path[:, 0, 1] - path[:, 1, 1]) / step).max())
    assert share[0] > 1.5 * share[1] > 0


def test_a_hot_drive_takes_gain_back(arm):
    robots = VirtualRobot(arm, [unit(derating=0.02)], [(0.2, "both")])
    sag = []
    for warmth in (0.0, 45.0):
        robots.reset(hold(1.0)[:1], [0], warmth)
        sag.append(abs(1.0 - robots.true_qpos()[0, 0]))
    assert sag[1] > 1.2 * sag[0] > 0


def test_readings_are_quantised_shifted_and_noisy_but_the_robot_is_not(arm):
    step = 0.01
    offset = 0.03
    physics = unit(encoder_step=step, zero_offset=offset, current_noise=0.2, velocity_noise=0.1)
    plain, _ = run(arm, [unit()], hold(1.0, seconds=2.0))
    path, robots = run(arm, [physics], hold(1.0, seconds=2.0))
    reading = robots.read()
    assert np.allclose(reading.qpos / step, np.round(reading.qpos / step))
    # It believes to be where it was told.
    assert path[-1, 0] == pytest.approx(plain[-1, 0] - offset, abs=6e-3)
    assert reading.qpos[0] == pytest.approx(path[-1, 0] + offset, abs=step / 2 + 1e-9)
    taus = []
    for _ in range(200):
        robots.step(hold(1.0)[:1])
        taus.append(robots.read().tau[0, 0])
    assert np.std(taus) == pytest.approx(0.2, rel=0.2)


def test_reading_twice_gives_the_same(arm):
    _, robots = run(arm, [load_fleet("easy", arm).unit("virtual-1")], hold(0.5))
    assert np.array_equal(robots.read().qpos, robots.read().qpos)


def test_current_tells_the_torque_that_the_motor_was_asked_for(arm):
    """tau is current times the rated torque constant: a weak magnet shows as too high a reading."""
    _, robots = run(arm, [unit(kt_scale=0.8)], hold(0.3, 0.2, 3.0), 0.3)
    force = robots.batch.bind("actuator_force")  # of the calls after this
    robots.step(hold(0.3, 0.2)[:1])
    assert robots.read().tau[0] * 0.8 == pytest.approx(force[0], abs=1e-3)


HARD = ("presliding", "thinning", "compliance", "current_loop", "torque_speed")
UNNAMED = ("drag", "churning", "limb_current", "derating", "smoothing", "flex", "grip")
MORE = {
    "stribeck": {"friction": np.full(2, 0.5)},
    "backlash": {"backlash": np.full(2, 0.03)},
    "supply": {"motor_constant": np.full(2, 0.3)},
}


def with_effect(robot, effect):
    """A unit with this effect alone, from a fleet that has it, and large enough to be seen."""
    if effect in HARD:
        physics = load_fleet("hard", robot).unit("virtual-1").only([effect])
        return replace(physics, no_load_speed=physics.no_load_speed / 10)
    if effect in UNNAMED:
        return load_fleet("unnamed", robot).unit("virtual-1").only([effect, "thermal"])
    physics = load_fleet("shifted", robot).unit("virtual-1").only([effect])
    return replace(physics, **MORE.get(effect, {}))


@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_has_a_switch_that_matters(arm, effect):
    """With one effect switched on, something that is seen differs from the robot without any."""
    physics = with_effect(arm, effect)
    ctrl = hold(0.2, 0.1, 2.0) + 0.6 * np.sin(np.linspace(0, 25, 100))[:, None]
    off = {field: getattr(unit(), field) for field in FIELDS[effect]}
    seen = []
    for u in (physics, replace(physics, **off)):
        robots = VirtualRobot(arm, [u], [(0.3, "both")])
        robots.reset(ctrl[:1], [0], 12.0, start=ctrl[:1])
        for row in ctrl:
            robots.step(row[None])
        r = robots.read()
        seen.append(np.concatenate([r.qpos, r.qvel, r.tau]))
    assert np.abs(seen[0] - seen[1]).max() > 1e-6


def test_a_centre_of_mass_at_the_origin_of_its_link_can_be_shifted(tmp_path):
    ball = XML.replace(
        'type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"', 'size="0.05"'
    )
    robot = write_arm(tmp_path / "arm", xml=ball)
    robots = VirtualRobot(robot, [unit(), unit(com_x=0.01)], [(0.0, "both")] * 2, 0.02)
    centres = robots.batch.bind("xipos")
    robots.batch.forward()

    upper = build_model(robot).body("upper").id
    plain, shifted = np.reshape(centres, (2, -1, 3))[:, upper]
    np.testing.assert_allclose(shifted - plain, (0.01, 0, 0))
