"""A virtual arm with weak servos: what knows of them is nearer to it, and what knows nothing earns
nothing.
"""

from dataclasses import replace

import numpy as np
import pytest
from weak_arm import model

from gaponet.experiments.paper import goals, measure
from gaponet.experiments.paper.commands import REFERENCE_WAY
from gaponet.experiments.paper.measure import (
    Delivery,
    Recorded,
    held_offsets,
    measure_alignment,
    measure_commands,
    measure_delivery,
    record_unit,
)
from gaponet.motion.motion import Motion
from gaponet.sim.replay import replay


@pytest.fixture(scope="module", autouse=True)
def short_rests():
    """The arm is at rest within half a second, and stands within one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "REST_S", 0.5)
        patch.setattr(measure, "HOLD_S", 1.0)
        patch.setattr(goals, "REST_S", 0.5)
        yield


@pytest.fixture(scope="module")
def recorded(unit):
    return record_unit(unit)


@pytest.fixture(scope="module")
def plain(unit):
    return measure_commands(unit, None)


def q_dis(measured):
    return np.mean(measured["q_dis"])


def test_the_unit_is_recorded_with_every_payload_from_the_motion_s_first_row(unit, recorded):
    assert recorded.motions == ["motion1", "motion1", "motion0", "motion0"]
    assert recorded.payloads == [0.0, 0.4, 0.0, 0.4]
    np.testing.assert_allclose(recorded.durations, [79 * 0.02, 79 * 0.02, 59 * 0.02, 59 * 0.02])
    first = recorded.sequences[0]
    np.testing.assert_allclose(first.ctrl, unit.motions[1].ctrl, rtol=1e-6)
    assert np.abs(first.qpos[0] - first.ctrl[0]).max() < 0.1  # at rest, it sags


def test_the_delta_action_of_the_truth_aligns_the_simulator(robot, recorded):
    nominal = q_dis(measure_alignment(recorded, robot, None))
    half = q_dis(measure_alignment(recorded, robot, model(robot, 0.5)))
    exact = q_dis(measure_alignment(recorded, robot, model(robot, 1.0)))
    assert exact < half < nominal
    assert exact < 0.3 * nominal


def test_an_untrained_network_leaves_the_simulator_as_it_is(robot, recorded):
    nominal = measure_alignment(recorded, robot, None)
    untrained = measure_alignment(recorded, robot, model(robot, 0.0))
    assert untrained == nominal


def test_an_untrained_network_earns_nothing_in_any_way_of_commanding(robot, unit, plain):
    untrained = measure_commands(unit, model(robot, 0.0))
    for way, reference in REFERENCE_WAY.items():
        np.testing.assert_allclose(untrained[way], plain[reference], rtol=1e-6)


def test_the_delta_action_of_the_truth_improves_commands(robot, unit, plain):
    exact = measure_commands(unit, model(robot, 1.0))
    assert np.mean(exact["delta"]) < np.mean(plain["raw"])
    assert np.mean(exact["both"]) < np.mean(plain["feedforward"])


def at_100_hz(unit):
    """The unit with its motions, which last as long, at half the control period."""
    motions = []
    for motion in unit.motions:
        faster = Motion(motion.name, "whole_body", unit.dt, motion.ctrl).sample(0.01)
        motions.append(replace(motion, ctrl=faster))
    return replace(unit, motions=motions, dt=0.01)


def test_a_unit_that_is_commanded_twice_as_often_moves_for_as_long_and_as_fast(unit, recorded):
    faster = record_unit(at_100_hz(unit))
    np.testing.assert_allclose(faster.durations, recorded.durations, atol=0.02)
    for fast, slow in zip(faster.sequences, recorded.sequences, strict=True):
        speed = np.abs(slow.qvel).mean()  # rad/s
        assert np.abs(fast.qvel).mean() == pytest.approx(speed, rel=0.1)


def test_a_network_corrects_commands_at_the_rate_of_the_recordings(robot, unit):
    faster = replace(unit, dt=0.01)
    plain = measure_commands(faster, None)
    exact = measure_commands(faster, model(robot, 1.0, dt=0.01))
    assert np.mean(exact["delta"]) < np.mean(plain["raw"])


def test_hands_are_delivered_to_their_goals_in_the_same_time_at_another_rate(unit):
    (slow,) = Delivery.plan(unit).plans
    (fast,) = Delivery.plan(replace(unit, dt=0.01)).plans
    np.testing.assert_array_equal(fast.goals, slow.goals)
    assert len(fast.ctrl) == pytest.approx(2 * len(slow.ctrl), abs=4)


def test_gaps_are_counted_above_each_threshold(robot, recorded):
    first = recorded.sequences[0]
    (simulated,) = replay([first], robot, lock_idle=True)
    qpos = np.array(simulated.qpos)
    qpos[1:21, 0] += 0.2
    qpos[1:11, 1] += 0.6
    large = measure_alignment(Recorded([replace(first, qpos=qpos)]), robot, None)["large_gaps"]
    values = 2 * 79  # two joints; the first of 80 rows is the start
    assert large == {"0.1": [30 / values], "0.5": [10 / values]}


def test_an_untrained_network_earns_nothing_in_delivery(robot, unit, monkeypatch):
    monkeypatch.setattr(measure, "HOLD_S", 0.2)  # that the hands come to rest does not matter
    monkeypatch.setattr(measure, "AVERAGED_S", 0.1)
    monkeypatch.setattr(goals, "REST_S", 0.1)
    delivery = Delivery.plan(unit)
    plain = measure_delivery(unit, delivery, None)
    untrained = measure_delivery(unit, delivery, model(robot, 0.0))
    for way, reference in REFERENCE_WAY.items():
        np.testing.assert_allclose(untrained[way]["offset"], plain[reference]["offset"], rtol=1e-5)
    assert np.shape(plain["raw"]["offset"])[0] == 2  # payloads
    assert np.shape(plain["raw"]["offset"])[2] == 3  # axes


def test_an_offset_is_that_of_the_last_second_of_a_hold(unit):
    plan = Delivery.plan(unit).plans[0]
    hands = np.zeros((len(plan.ctrl), 1, 3))
    for goal, leave in zip(plan.goals, plan.leave, strict=True):
        hands[leave - 50 : leave, 0] = goal[0] + [0.01, 0.0, -0.02]
    for away in held_offsets(hands, plan, 0.02):
        np.testing.assert_allclose(away, np.tile([0.01, 0.0, -0.02], (50, 1)))
