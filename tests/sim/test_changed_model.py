"""Simulators with other gains, damping, friction, inertias, delay and mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gaponet.base.errors import UsageError
from gaponet.robot.simulator_change import SimulatorChange, SimulatorRanges
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import build_model

PAYLOAD_KG = 0.3
CHANGE = SimulatorChange(
    kp=(0.5, 2.0, 1.5, 0.7, 1.0, 1.0),
    damping=(3.0, 0.5, 1.0, 2.0, 1.0, 1.0),
    armature=2.5,
    friction=3.0,
    delay=0.013,
    mount=(0.01, -0.02, 0.015),
)


def rebuilt(robot: RobotSpec, change: SimulatorChange) -> RobotSpec:
    """Return the robot with the values of the change, as somebody would write them into its
    files.
    """
    model = build_model(robot)
    mounts = []
    for mount in robot.payload_mounts:
        mounts.append(replace(mount, pos=tuple(np.add(mount.pos, change.mount))))
    servo = replace(
        robot.servo,
        kp=robot.servo.kp * change.kp,
        kd=robot.servo.kd * change.damping,
        damping=model.dof_damping.reshape(len(robot.joint_names), -1)[:, 0] * change.damping,
        armature=model.dof_armature * change.armature,
        frictionloss=model.dof_frictionloss * change.friction,
        delay=robot.servo.delay + change.delay,
    )
    return replace(robot, servo=servo, payload_mounts=tuple(mounts))


def swing(sim: BatchSim, robot: RobotSpec) -> np.ndarray:
    """Return the positions of all simulations over half a second of moving targets, (25,
    simulations, n) rad.
    """
    home = np.tile(robot.qpos_home, (sim.num_envs, 1))
    sim.reset(slice(None), home, 0 * home, past=home[:, None])
    positions = []
    for t in range(25):
        sim.step(home + 0.3 * np.sin(0.4 * t + np.arange(len(robot.servo.kp))))
        positions.append(sim.qpos.copy())
    return np.array(positions)


def test_a_changed_simulator_moves_like_one_that_is_built_with_its_values() -> None:
    robot = load_robot("so101")
    condition = Condition(PAYLOAD_KG, "both", robot.dt)
    other = rebuilt(robot, CHANGE)

    changed = swing(BatchSim(robot, [condition._replace(simulator=CHANGE)], 1), robot)
    built = swing(BatchSim(other, [condition], 1), robot)

    assert np.abs(changed - built).max() < 1e-9
    assert np.abs(changed - swing(BatchSim(robot, [condition], 1), robot)).max() > 0.01


def test_simulators_side_by_side_do_not_change_each_other() -> None:
    robot = load_robot("so101")
    condition = Condition(PAYLOAD_KG, "both", robot.dt)
    conditions = [condition, condition._replace(simulator=CHANGE)]

    together = swing(BatchSim(robot, conditions, 1), robot)
    alone = swing(BatchSim(robot, [condition], 1), robot)

    assert np.array_equal(together[:, 0], alone[:, 0])


def test_draws_depend_on_the_seed_alone_and_stay_within_their_ranges() -> None:
    ranges = SimulatorRanges()

    drawn = ranges.draw(6, 50, seed=3)

    assert drawn == ranges.draw(6, 50, seed=3)
    assert drawn[0] != ranges.draw(6, 50, seed=4)[0]
    kp = np.array([change.kp for change in drawn])
    assert ranges.kp[0] <= kp.min() < kp.max() <= ranges.kp[1]
    assert max(change.delay for change in drawn) <= ranges.delay


def test_a_change_for_another_number_of_joints_is_refused() -> None:
    robot = load_robot("so101")
    condition = Condition(0.0, "both", robot.dt, simulator=SimulatorChange((1.0,), (1.0,)))

    with pytest.raises(UsageError, match="joints"):
        BatchSim(robot, [condition], 1)


def test_a_robot_with_a_servo_model_has_no_changed_simulators() -> None:
    sticky = load_robot("so101").with_identified(
        {"shoulder_pan": {"stribeck": 0.1, "stribeck_speed": 0.1}}
    )
    condition = Condition(0.0, "both", sticky.dt, simulator=CHANGE)

    with pytest.raises(UsageError, match="servo"):
        BatchSim(sticky, [condition], 1)
