"""Which arm may stand still and push: only one whose hand carries the stated payload."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

ELBOW = "left_elbow_joint"
PAYLOAD_KG = 5.0
PERIODS = 100
STEP_RAD = 0.005  # of the command in a period


def push(payload_side: str) -> Fault | None:
    """Return the fault of a left elbow that stands still and pushes with 0.6 of its effort limit,
    against gravity, while its command goes on by 0.5 rad.
    """
    robot = load_robot("h1_2")
    driver = UnitreeDriver(robot)
    controller = Controller(
        driver, robot, unchecked=True, payload_mass=PAYLOAD_KG, payload_side=payload_side
    )
    joints = robot.index(driver.commanded)
    elbow = robot.index([ELBOW])[0]
    qpos = robot.qpos_home.copy()
    load = static_torque(build_model(robot, PAYLOAD_KG), qpos[None])[0, elbow]
    up = np.sign(load)
    still = np.zeros(len(qpos))
    tau = still.copy()
    tau[elbow] = 0.6 * up * robot.servo.effort_limit[elbow]
    for period in range(PERIODS):
        command = qpos.copy()
        command[elbow] += up * STEP_RAD * period
        output = SimpleNamespace(limits=controller.limits, expected=lambda: command[joints])  # noqa: B023
        state = State(0.02 * period, qpos, still, tau, still)
        fault = controller.following.check(state, output)
        if fault is not None:
            return fault
    return None


@pytest.mark.parametrize("side", ["both", "left"])
def test_an_arm_with_the_payload_in_its_hand_may_push_against_it(side):
    assert push(side) is None


def test_an_arm_whose_hand_is_empty_may_not_push_for_a_payload_in_the_other_hand():
    fault = push("right")

    assert fault is not None
    assert fault.kind == "obedience"
    assert ELBOW in fault.text
