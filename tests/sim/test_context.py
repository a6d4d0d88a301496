"""Context: the simulator's answers to fixed probes at rest."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from arm import write_arm

from gaponet.nn.artifact import KnownSimulators
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.robot.simulator_change import SimulatorChange, SimulatorRanges
from gaponet.robot.spec import load_robot
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts, scene_context
from gaponet.sim.model import build_model, build_spec, compile_spec

ROBOT = load_robot("so101")
EMPTY = Condition(0.0, "both", ROBOT.dt)
SAME = SimulatorChange(kp=(1.0,) * 6, damping=(1.0,) * 6)


def test_a_softer_joint_answers_its_own_probe_less_and_no_other_joint_changes_its_answer_much() -> (
    None
):
    softer = replace(SAME, kp=(0.25, *SAME.kp[1:]))

    own, other = contexts(ROBOT, [EMPTY, EMPTY._replace(simulator=softer)])

    by_joint = other.reshape(8, 5) - own.reshape(8, 5)
    position_late = by_joint[5]  # the difference that the own probe makes, after 0.2 s
    assert position_late[0] < -0.02
    assert np.abs(position_late[1:]).max() < 0.005


def test_a_later_servo_has_moved_less_when_it_is_read_first() -> None:
    later = replace(SAME, delay=0.02)

    own, other = contexts(ROBOT, [EMPTY, EMPTY._replace(simulator=later)])

    assert (other.reshape(8, 5)[1] < own.reshape(8, 5)[1]).all()


def test_simulators_are_probed_with_empty_hands() -> None:
    carrying = EMPTY._replace(payload_mass=0.5)

    empty, told = contexts(ROBOT, [EMPTY, carrying])

    assert np.array_equal(empty, told)


def test_a_loaded_arm_sags_before_its_probe() -> None:
    carrying = EMPTY._replace(payload_mass=0.5)

    empty, loaded = contexts(ROBOT, [EMPTY, carrying], loaded=True)

    null_position = 4  # of the null probe, after 0.2 s
    shoulder_lift = 1
    sag = loaded.reshape(8, 5)[null_position] - empty.reshape(8, 5)[null_position]
    assert abs(sag[shoulder_lift]) > 0.005


def test_a_scene_answers_as_the_simulator_that_it_was_built_from() -> None:
    scene = build_model(ROBOT)

    in_scene = scene_context(scene, ROBOT, ROBOT.dt)

    assert np.abs(in_scene - contexts(ROBOT, [EMPTY])[0]).max() < 1e-6


def test_a_scenes_actuators_of_tendons_are_not_taken_for_servos(tmp_path) -> None:
    robot = write_arm(tmp_path / "arm")
    spec = build_spec(robot)
    tendon = spec.add_tendon(name="both")
    tendon.wrap_joint("elbow", 1.0)
    for i in range(2):
        pull = spec.add_actuator(name=f"pull{i}", target="both")
        pull.trntype = mujoco.mjtTrn.mjTRN_TENDON
        pull.set_to_position(kp=0.0)

    in_scene = scene_context(compile_spec(spec, robot.mjcf), robot, robot.dt)

    assert np.abs(in_scene - scene_context(build_model(robot), robot, robot.dt)).max() < 1e-4


@pytest.mark.parametrize("samples", [None, 0, 40])
def test_a_scene_with_late_servos_answers_as_the_simulator_that_it_was_built_from(samples) -> None:
    """The first servo's buffer may be of another length, as in exports, or missing."""
    delay = np.full(6, 0.015)
    if samples == 0:
        delay[0] = 0.0
    late = ROBOT.with_servo(delay=delay)
    spec = build_spec(late)
    if samples is not None:
        spec.actuators[0].nsample = samples

    in_scene = scene_context(compile_spec(spec, late.mjcf), late, late.dt)

    assert np.abs(in_scene - contexts(late, [EMPTY])[0]).max() < 1e-6


def test_a_rate_of_control_does_not_change_positions_read_at_the_same_time() -> None:
    (slow,) = contexts(ROBOT, [EMPTY._replace(dt=0.02)])
    (fast,) = contexts(ROBOT, [EMPTY._replace(dt=0.01)])

    positions = [0, 1, 4, 5]
    difference = slow.reshape(8, 5)[positions] - fast.reshape(8, 5)[positions]
    assert np.abs(difference).max() < 1e-3


def test_distance_is_zero_within_the_answers_of_training_and_grows_beyond() -> None:
    conditions = [EMPTY._replace(simulator=s) for s in SimulatorRanges().draw(6, 30, seed=1)]
    trained = contexts(ROBOT, conditions)
    known = KnownSimulators.of(trained[0], trained)

    assert known.distance(trained[3]) == 0.0
    assert np.isclose(known.distance(known.high + (known.high - known.low)), 1.0)
    again = KnownSimulators.from_card(known.to_card())
    assert np.allclose(again.low, known.low, atol=1e-6)


def test_the_branch_sees_the_context_alone_and_the_trunk_the_rest() -> None:
    config = ModelConfig(context=True)
    net = build_network(config, 5)
    x = torch.randn(3, config.input_dim(5))
    net.fit_inputs(torch.randn(50, config.input_dim(5)))

    prepared = net.prepare(x)
    x[:, net.features.layout.context] += 1.0
    moved = net.prepare(x)

    changed = (prepared != moved).any(0).any(0)
    assert changed[5 : net.branch_inputs].all()  # after the joint's number
    assert not changed[net.branch_inputs :].any()
