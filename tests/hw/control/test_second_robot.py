"""Two H1-2, or two programs that command one, on one bus: refused before the start, damped during
a run.

In simulated time, and on a real DDS bus.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hw.control.loopback import RobotClock, living
from hw.noted_arm import phases

from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.recording import Recording
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.open import open_driver
from gaponet.hw.drivers.unitree import MOTOR_NAMES, UnitreeDriver
from gaponet.hw.drivers.unitree_link import UnitreeLink
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.unitree_virtual import VirtualH12

PERIOD_S = 0.02
ELBOW = MOTOR_NAMES.index("left_elbow_joint")
DOMAIN = 200 + os.getpid() % 30


@pytest.fixture(scope="module")
def robot() -> RobotSpec:
    return load_robot("h1_2")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, robot: RobotSpec) -> RobotClock:
    return living(monkeypatch, robot)


def stiff_commands(robot: VirtualH12) -> list[dict]:
    """Commands that a robot received and that held or moved its elbow."""
    return [row for row in robot.heard if row["kp"][ELBOW] > 0]


def sway(robot: RobotSpec, clock: RobotClock, during: Callable[[int], None]) -> Recording:
    """Both elbows sway for 2 s; `during` is called with the period of the run."""
    elbow = robot.index(["left_elbow_joint"])[0]

    def policy(k: int, state: object) -> np.ndarray | None:
        during(k)
        target = robot.qpos_home.copy()
        target[elbow] += 0.3 * (1 + np.sin(0.06 * k))
        return target if k < 100 else None

    config = ControlConfig(blend=0.5, blend_speed=2.0, settle=0.1, damp=0.5)
    driver = UnitreeDriver(robot, domain=DOMAIN)
    return Controller(driver, robot, config=config, clock=clock, watchdog=False).run(policy)


def test_two_robots_on_one_bus_are_refused_and_neither_is_commanded(robot, clock):
    second = clock.add_robot()

    with pytest.raises(DriverError, match="robots"):
        sway(robot, clock, during=lambda k: None)

    assert clock.robot.heard == []
    assert second.heard == []


def test_a_second_robot_that_appears_while_a_person_reads_the_plan_is_refused(robot, clock):
    driver = UnitreeDriver(robot, domain=DOMAIN)
    controller = Controller(
        driver, robot, clock=clock, watchdog=False, on_connect=lambda _: clock.add_robot()
    )

    recording = controller.run(lambda k, state: robot.qpos_home if k < 10 else None)

    assert recording.fault.kind == "source"
    assert "nothing was commanded" in recording.fault.text
    assert clock.robot.heard == []


@pytest.fixture(scope="module")
def joined(robot: RobotSpec) -> Iterator[tuple[Recording, RobotClock]]:
    """A run in which a second robot, in another pose, appears after some periods; and its clock."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        clock = living(monkeypatch, robot)

        def during(k: int) -> None:
            if k == 30:
                clock.add_robot().live.unit.reset(robot.qpos_home[None] + 0.3, [1])

        yield sway(robot, clock, during), clock


def test_a_second_robot_that_appears_during_a_run_is_damped_within_three_periods(joined):
    recording, clock = joined

    (second,) = clock.seconds
    assert recording.fault.kind == "source"
    assert phases(recording)[-2:] == ["damp", "stopped"]
    for each in (clock.robot, second):
        stiff = [row["time"] for row in stiff_commands(each)]
        damped = next(row["time"] for row in each.heard if row["kp"][ELBOW] == 0)
        assert len([time for time in stiff if time > recording.fault.time]) == 0
        assert damped - second.heard[0]["time"] <= 3 * PERIOD_S


def test_states_of_a_second_robot_are_never_taken_for_those_of_the_first(joined):
    recording, _ = joined

    read = np.array([row.state.qpos for row in recording.rows])
    assert np.abs(np.diff(read, axis=0)).max() < 0.1


def test_a_run_with_a_second_robot_is_no_data(joined):
    recording, _ = joined

    assert "second robot" in recording.disobedience


def test_the_recording_names_the_robot_that_the_states_are_from(robot, clock):
    recording = sway(robot, clock, during=lambda k: None)

    assert recording.fault is None
    assert recording.meta["source"] == "rt/lowstate on lo, of robot 1"


def test_a_watchdog_also_damps_when_there_are_two_robots(robot, clock):
    clock.add_robot()
    watchdog = open_driver(**UnitreeDriver(robot, domain=DOMAIN).watchdog())

    watchdog.connect()
    watchdog.damp(1.0)
    clock.wait_until(clock.now() + PERIOD_S)

    for each in (clock.robot, *clock.seconds):
        assert each.heard[-1]["kp"][ELBOW] == 0


COMMAND = np.zeros(hg.LowCmd.wire_size, np.uint8)  # of another program


def other_program() -> UnitreeLink:
    """Another program that commands the robot on our topic, once it is open."""
    return UnitreeLink("arm_sdk", DOMAIN, "lo", sole=False, silent=False)


@pytest.fixture
def commanded_twice(robot: RobotSpec, clock: RobotClock) -> Recording:
    """A run during which another program connects, and later sends commands."""
    other = other_program()

    def during(k: int) -> None:
        if k == 20:
            other.open()
        if k >= 40:
            other.send(COMMAND)

    return sway(robot, clock, during)


def test_a_program_that_begins_to_command_the_robot_during_a_run_is_the_fault_source(
    commanded_twice,
):
    assert commanded_twice.fault.kind == "source"
    assert "another program commands the robot on rt/arm_sdk" in commanded_twice.fault.text
    assert phases(commanded_twice)[-2:] == ["damp", "stopped"]


def test_a_run_in_which_another_program_commanded_the_robot_is_no_data(commanded_twice):
    assert "another program" in commanded_twice.disobedience


def test_a_program_that_connects_and_sends_nothing_ends_no_run(robot, clock):
    other = other_program()

    recording = sway(robot, clock, during=lambda k: other.open() if k == 20 else None)

    assert recording.fault is None


def test_a_program_that_commands_the_robot_while_a_person_reads_the_plan_prevents_the_start(
    robot, clock
):
    def command_once(_: object) -> None:
        other = other_program()
        other.open()
        other.send(COMMAND)

    driver = UnitreeDriver(robot, domain=DOMAIN)
    controller = Controller(driver, robot, clock=clock, watchdog=False, on_connect=command_once)

    recording = controller.run(lambda k, state: robot.qpos_home if k < 10 else None)

    assert recording.fault.kind == "source"
    assert "nothing was commanded" in recording.fault.text
    assert stiff_commands(clock.robot) == []


def test_a_stall_after_which_the_watchdog_damped_the_robot_is_reported_as_a_stall(robot, clock):
    watchdog = other_program()

    def during(k: int) -> None:
        if k == 20:
            watchdog.open()
        if k == 40:
            clock.wait_until(clock.now() + 0.4)
            watchdog.send(COMMAND)

    recording = sway(robot, clock, during)

    assert recording.fault.kind == "overrun"
