"""The hidden laws one by one, with numbers worked by hand."""

from dataclasses import replace

import numpy as np
import pytest

from gaponet.virtual.motor import (
    COPPER_COEFFICIENT,
    Backlash,
    Bristles,
    CommandLink,
    Thermal,
    cogging_torque,
    friction_limit,
    speed_factor,
    supply_factor,
)
from gaponet.virtual.physics import Physics, neutral, stack


def one(**values: float) -> Physics:
    """A single joint with these parameters and no other effect, stacked to (1, 1)."""
    unit = neutral(1)
    return stack([replace(unit, **{k: np.array([v]) for k, v in values.items()})], np.array([0]))


def limit(physics, qvel=0.0, torque=0.0, push=0.0, nominal=0.2):
    value = friction_limit(
        physics, np.array([nominal]), *(np.array([[x]]) for x in (qvel, torque, push))
    )
    return float(value[0, 0])


def test_without_effect_friction_is_the_nominal_one():
    assert limit(one(), qvel=1.0, torque=5.0, push=1.0) == 0.2


def test_stribeck_peak_is_halved_at_its_speed():
    p = one(friction=1.0, stribeck=0.4, stribeck_speed=0.1)
    assert limit(p) == pytest.approx(0.2 + 1.4)
    assert limit(p, qvel=0.1) == pytest.approx(0.2 + 1.2)
    assert limit(p, qvel=10.0) == pytest.approx(0.2 + 1.0, abs=1e-3)


def test_friction_differs_with_direction_and_a_stuck_joint_uses_the_way_it_is_pushed():
    p = one(friction=1.0, friction_asymmetry=0.1)
    assert limit(p, qvel=1.0) == pytest.approx(1.3)
    assert limit(p, qvel=-1.0) == pytest.approx(1.1)
    assert limit(p, qvel=0.0, push=-0.5) == pytest.approx(1.1)


def test_a_gear_loses_less_when_driving_than_when_driven():
    p = one(efficiency=0.8)
    assert limit(p, qvel=1.0, torque=10.0, nominal=0.0) == pytest.approx(2.0)  # (1 − 0.8) · 10
    assert limit(p, qvel=-1.0, torque=10.0, nominal=0.0) == pytest.approx(2.5)  # (1/0.8 − 1) · 10


def test_warmth_takes_from_dry_friction_and_not_from_the_gears_part():
    p = one(friction=1.0, efficiency=0.8)
    value = friction_limit(
        p, np.array([0.2]), *(np.array([[x]]) for x in (1.0, 10.0, 0.0)), np.array([[0.5]])
    )
    assert float(value[0, 0]) == pytest.approx(0.5 * 1.2 + 2.0)
    thermal = Thermal(one(thinning=0.01))
    thermal.reset(np.array([[45.0]]))
    # 20 K: 82 % is left
    assert float(thermal.thinning_factor()[0, 0]) == pytest.approx(np.exp(-0.2))


def slide(bristles, path, g=1.2, h=1e-3):
    """Torque of bristles after a joint has followed speeds, one a millisecond."""
    for v in path:
        bristles.step(np.array([[g]]), np.array([[v]]), h)
    return float(bristles.torque[0, 0])


def test_bristles_bend_as_the_exponential_of_dahl():
    # σ = (0.2 + 1.0) / 2 mrad = 600 N·m/rad; after 2 mrad one way 1 − 1/e of the limit, after 20
    # mrad all of it
    p = one(friction=1.0, presliding=0.002)
    cold = np.array([[0.0]])
    bristles = Bristles(p, np.array([0.2]))
    bristles.reset(cold, np.array([[1.2]]))
    assert slide(bristles, [0.01] * 200) == pytest.approx(1.2 * (1 - np.exp(-1)))
    assert slide(bristles, [0.01] * 1800) == pytest.approx(1.2, rel=1e-3)
    # back by 2 mrad: from +1.2 towards −1.2, 1 − 1/e of the way
    assert slide(bristles, [-0.01] * 200) == pytest.approx(-1.2 + 2.4 * np.exp(-1), rel=1e-3)


def test_bristles_keep_their_torque_at_rest_and_start_with_what_they_are_given():
    bristles = Bristles(one(friction=1.0, presliding=0.002), np.array([0.2]))
    bristles.reset(np.array([[0.7]]), np.array([[1.2]]))
    assert slide(bristles, [0.0] * 1000) == 0.7
    bristles.reset(np.array([[-9.0]]), np.array([[1.2]]))
    assert slide(bristles, []) == -1.2


def test_torque_falls_from_the_corner_to_the_no_load_speed():
    p = one(no_load_speed=10.0, corner=0.6)
    share = lambda v: float(speed_factor(p, np.array([[v]]))[0, 0])  # noqa: E731
    assert [share(v) for v in (-20.0, 0.0, 6.0, 10.0, 12.0)] == pytest.approx(
        [1.0, 1.0, 1.0, 0.0, 0.0]
    )
    assert share(8.0) == pytest.approx(0.5)
    assert float(speed_factor(one(), np.array([[1e3]]))[0, 0]) == 1.0


def test_backlash_is_crossed_in_the_time_of_a_free_rotor():
    play = Backlash(one(backlash=0.02), np.array([0.1]))
    torque = np.array([[1.0]])
    h = 1e-4
    play.reset(-torque)
    steps = next(k for k in range(1, 10000) if play.step(torque, h)[0, 0] == 1.0)
    assert steps * h == pytest.approx(np.sqrt(2 * 0.02 * 0.1 / 1.0), rel=0.01)  # 63 ms
    assert play.step(torque, h)[0, 0] == 1.0  # and stays


def test_backlash_opens_only_when_the_torque_turns():
    play = Backlash(one(backlash=0.02), np.array([0.1]))
    play.reset(np.array([[2.0]]))
    assert play.step(np.array([[0.1]]), 0.002)[0, 0] == 1.0
    assert play.step(np.array([[-0.1]]), 0.002)[0, 0] == 0.0
    assert Backlash(one(), np.array([0.1])).step(np.array([[-1.0]]), 0.002)[0, 0] == 1.0


def test_a_motor_without_armature_crosses_its_backlash_at_once():
    play = Backlash(one(backlash=0.02), np.array([0.0]))
    play.reset(np.array([[1.0]]))
    with np.errstate(all="raise"):
        assert play.step(np.array([[-1.0]]), 0.002)[0, 0] == 1.0


def test_heating_curve_has_the_winding_time_constant():
    # 4 N·m at 2 N·m/√W: 4 W through 3 K/W, 12 K at last, 63.2 % of it after one time constant
    p = one(
        motor_constant=2.0,
        winding_resistance=3.0,
        winding_time=20.0,
        housing_resistance=1.0,
        housing_time=1e9,
    )
    thermal = Thermal(p)
    thermal.reset(np.array([[25.0]]))
    for _ in range(1000):
        thermal.step(np.array([[16.0]]), 0.02)
    rise = float(thermal.winding[0, 0]) - 25.0
    assert rise == pytest.approx(12.0 * (1 - np.exp(-1)), rel=COPPER_COEFFICIENT * 12.0)
    for _ in range(1000):
        thermal.step(np.array([[0.0]]), 0.02)
    assert float(thermal.winding[0, 0]) - 25.0 == pytest.approx(rise * np.exp(-1), rel=0.01)


def test_the_housing_settles_where_its_resistance_says():
    p = one(
        motor_constant=2.0,
        winding_resistance=3.0,
        winding_time=5.0,
        housing_resistance=2.0,
        housing_time=20.0,
    )
    thermal = Thermal(p)
    thermal.reset(np.array([[25.0]]))
    for _ in range(20000):
        thermal.step(np.array([[4.0]]), 0.02)
    heat = float(thermal.heat(np.array([[4.0]]))[0, 0])  # 1 W and what warm copper adds
    assert float(thermal.housing[0, 0]) - 25.0 == pytest.approx(2.0 * heat, rel=1e-3)
    assert float(thermal.winding[0, 0] - thermal.housing[0, 0]) == pytest.approx(
        3.0 * heat, rel=1e-3
    )


def test_torque_constant_falls_with_temperature():
    thermal = Thermal(one(kt_scale=0.95, kt_drift=0.001))
    thermal.reset(np.array([[75.0]]))
    assert float(thermal.kt()[0, 0]) == pytest.approx(0.95 * 0.95)


def test_a_loaded_battery_sags_by_ohms_law():
    p = one(supply_voltage=50.0, supply_resistance=0.5)
    assert float(supply_factor(p, np.array([[200.0]]))[0, 0]) == pytest.approx(1 - 4.0 * 0.5 / 50.0)
    assert float(supply_factor(one(), np.array([[200.0]]))[0, 0]) == 1.0


def test_cogging_repeats_over_the_turn():
    p = one(cogging=0.3, cogging_count=4.0, cogging_phase=0.0)
    angle = np.array([[np.pi / 8], [np.pi / 8 + np.pi / 2], [0.0]])
    assert cogging_torque(p, angle)[:, 0].tolist() == pytest.approx([0.3, 0.3, 0.0])


def played(physics, chances, times, dt=0.02):
    """Commands 1, 2, 3, … sent every dt; what is in force at `times`."""
    link = CommandLink(physics, dt)
    link.reset(np.array([[0.0]]))
    sent = 0
    out = []
    for time in times:
        while sent * dt <= time + 1e-12:
            link.send(np.array([[sent + 1.0]]), sent * dt, np.array([chances[sent % len(chances)]]))
            sent += 1
        out.append(float(link.read(time)[0, 0]))
    return out


def test_a_command_arrives_after_the_delay():
    assert played(one(delay=0.03), [(0.0, 1.0)], [0.0, 0.028, 0.03, 0.048, 0.05]) == [0, 0, 1, 1, 2]
    assert played(one(), [(0.0, 1.0)], [0.0, 0.02]) == [1, 2]


def test_a_delay_of_many_periods_loses_nothing():
    assert played(one(delay=0.5), [(0.0, 1.0)], [0.49, 0.5, 0.51, 0.52, 1.0]) == [0, 1, 1, 2, 26]


def test_a_lost_packet_leaves_the_one_before_in_force():
    chances = [(0.0, 0.9), (0.0, 0.1), (0.0, 0.9)]  # the second of three is below 0.5
    assert played(one(drop=0.5), chances, [0.0, 0.02, 0.04]) == [1, 1, 3]


def test_a_late_packet_does_not_undo_a_newer_one():
    chances = [(1.0, 1.0), (0.0, 1.0)]  # the first is 50 ms late, the second on time
    assert played(one(jitter=0.05), chances, [0.0, 0.02, 0.035, 0.052]) == [0, 2, 2, 2]
