"""After a fault no position is sent: on a simulated H1-2 the commanded positions stand still,
without stiffness.

A damped joint keeps its momentum, so nothing is promised of its speed. The same of the watchdog,
which has sent nothing before.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from hw.control.loopback import RobotClock, living, received

from gaponet.hw import drivers
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import Driver, Fault, State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import FAULTS
from gaponet.hw.drivers.open import open_driver
from gaponet.hw.drivers.unitree import MOTOR_NAMES, UnitreeDriver
from gaponet.robot.spec import RobotSpec, load_robot

FAULT_PERIOD = 30  # of the run: the elbows are at their fastest
TORSO = MOTOR_NAMES.index("torso_joint")
DOMAIN = 200 + os.getpid() % 30


@pytest.fixture(scope="module")
def robot() -> RobotSpec:
    return load_robot("h1_2")


def swing(
    robot: RobotSpec,
    clock: RobotClock,
    kind: str,
    source: str = "robot",
    size: float = 0.3,
    damp: float = 0.5,
) -> Recording:
    """Both elbows swing by `size` rad until a fault that the robot, the sender of targets or the
    policy makes.
    """
    fault = Fault(kind, "made by a test")
    elbows = robot.index(["left_elbow_joint", "right_elbow_joint"])
    driver = UnitreeDriver(robot, domain=DOMAIN)
    read = driver.read
    period = 0

    def spoiled() -> State:
        state = read()
        if source == "robot" and period >= FAULT_PERIOD:
            return replace(state, fault=fault)
        return state

    def policy(k: int, state: State) -> np.ndarray | Fault | None:
        nonlocal period
        period = k
        if source == "sender" and k >= FAULT_PERIOD:
            return fault
        if source == "policy" and k >= FAULT_PERIOD:
            raise RuntimeError(fault.text)
        target = robot.qpos_home.copy()
        target[elbows] += size * np.sin(0.1 * k)
        return target

    driver.read = spoiled  # type: ignore[method-assign]
    config = ControlConfig(blend=0.5, blend_speed=2.0, settle=0.0, damp=damp)
    controller = Controller(driver, robot, config=config, clock=clock, watchdog=False)
    try:
        return controller.run(policy)
    except RuntimeError:
        return controller.recording


@pytest.mark.parametrize(
    ("kind", "source"),
    [*((kind, "robot") for kind in FAULTS), ("silence", "sender"), ("error", "policy")],
)
def test_after_a_fault_commanded_positions_stand_still_without_stiffness(
    robot, monkeypatch, kind, source
):
    clock = living(monkeypatch, robot)

    recording = swing(robot, clock, kind, source)

    assert recording.fault.kind == kind
    heard = received(clock.robot)
    stiff = np.delete(np.array(heard["kp"]), TORSO, axis=1).any(axis=1)
    last = int(np.flatnonzero(stiff).max())  # position command
    assert heard["time"][last] <= recording.fault.time + 1.0 / clock.robot.rate
    assert len(stiff) - last > 20, "it is damped for half a second"
    np.testing.assert_array_equal(np.ptp(heard["ctrl"][last:], axis=0), 0.0)


def test_joints_that_move_fast_at_a_fault_are_braked_within_a_tenth_of_a_second(robot, monkeypatch):
    """A measurement on a simulated robot with empty hands, and no promise."""
    clock = living(monkeypatch, robot)

    recording = swing(robot, clock, "stop", size=0.9, damp=2.0)

    times = np.array([time for time, _ in clock.truth])
    speeds = np.abs(np.gradient([qpos for _, qpos in clock.truth], times, axis=0)).max(axis=1)
    since = times - recording.fault.time
    assert speeds[np.abs(since) < 0.01].max() > 2.0
    assert speeds[since > 0.1].max() < 0.5


def watching(driver: UnitreeDriver) -> Driver:
    """The driver of a driver's watchdog: connected before the first command, and silent."""
    watchdog = open_driver(**driver.watchdog())
    watchdog.connect()
    return watchdog


@pytest.mark.parametrize(
    ("topic", "joints"),
    [("arm_sdk", "arms"), ("arm_sdk", "upper_body"), ("lowcmd", "arms"), ("lowcmd", "all")],
)
def test_a_watchdog_damps_the_joints_that_were_commanded_on_their_topic(
    robot, monkeypatch, topic, joints
):
    clock = living(monkeypatch, robot)
    driver = UnitreeDriver(robot, topic, joints, domain=DOMAIN)
    watchdog = watching(driver)
    driver.connect()
    driver.write(robot.qpos_home)
    clock.wait_until(clock.now() + 0.02)

    watchdog.damp(1.0)
    clock.wait_until(clock.now() + 0.02)

    command, *_, damping = clock.robot.heard
    assert damping["topic"] == command["topic"] == topic
    np.testing.assert_array_equal(damping["mode"], command["mode"])
    commanded = [MOTOR_NAMES.index(name) for name in driver.commanded]
    assert not damping["kp"][commanded].any()
    assert (damping["kd"][commanded] > 0).all()


def test_a_watchdog_is_on_the_domain_and_interface_of_its_driver(robot, monkeypatch):
    living(monkeypatch, robot)
    watching(UnitreeDriver(robot, domain=DOMAIN, interface="eth7"))
    assert drivers.dds.opened[-1] == (DOMAIN, "eth7")


def test_a_watchdog_holds_the_torso_where_it_is_and_not_where_it_was_at_its_connection(
    robot, monkeypatch
):
    clock = living(monkeypatch, robot)
    watchdog = watching(UnitreeDriver(robot, domain=DOMAIN))
    other = UnitreeDriver(robot, joints="upper_body", domain=DOMAIN)
    other.connect()
    turned = robot.qpos_home.copy()
    turned[robot.index(["torso_joint"])] = 0.3
    for _ in range(100):
        other.write(turned)
        clock.wait_until(clock.now() + 0.02)
    assert clock.robot.heard[-1]["qpos"][TORSO] > 0.2

    for _ in range(10):
        watchdog.damp(1.0)
        clock.wait_until(clock.now() + 0.02)

    damping = clock.robot.heard[-10:]
    assert {row["kp"][TORSO] for row in damping} == {
        robot.servo.kp[robot.index(["torso_joint"])[0]]
    }
    assert damping[0]["ctrl"][TORSO] == pytest.approx(damping[0]["qpos"][TORSO], abs=0.02)
    np.testing.assert_array_equal(np.ptp([row["ctrl"] for row in damping], axis=0), 0.0)


def test_a_watchdog_damps_although_the_bus_gives_no_states(robot, monkeypatch):
    clock = living(monkeypatch, robot)
    watchdog = watching(UnitreeDriver(robot, domain=DOMAIN))
    clock.robot.inject("stop", 0.0)

    for _ in range(5):
        watchdog.damp(1.0)
        clock.wait_until(clock.now() + 0.02)

    arms = np.delete(clock.robot.heard[-1]["kp"], TORSO)
    np.testing.assert_array_equal(arms, 0.0)
    assert (clock.robot.heard[-1]["kd"][TORSO + 1 :] > 0).all()
