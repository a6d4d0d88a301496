"""The drivers of the package keep the promises of `Driver`, and a driver that does not is told
which.
"""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hw.control.loopback import living
from hw.noted_arm import NotedArm

from gaponet.hw.conformance import broken_promises
from gaponet.hw.control.driver import DriverError, Fault
from gaponet.hw.drivers.so101 import SO101Driver
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot


def broken(driver: NotedArm) -> list[str]:
    return broken_promises(
        driver, driver.robot, commands=lambda: len(driver.sent), clock=driver.clock
    )


def test_the_driver_of_a_virtual_robot_keeps_all_promises(arm):
    assert broken(NotedArm(arm)) == []


def test_the_driver_of_the_h1_2_keeps_all_promises(monkeypatch):
    robot = load_robot("h1_2")
    clock = living(monkeypatch, robot)

    found = broken_promises(
        UnitreeDriver(robot), robot, commands=lambda: len(clock.robot.heard), clock=clock
    )

    assert found == []


def test_the_driver_of_the_so101_keeps_all_promises(so101, wire):
    assert broken_promises(SO101Driver(so101, timeout=0.001), so101) == []


class Wrong(NotedArm):
    """An arm whose driver breaks one promise."""

    def __init__(self, robot: Any, **changes: Any) -> None:
        super().__init__(robot, change=changes.pop("change", lambda state: state))
        vars(self).update(changes)


def shorter(state):
    return replace(state, qvel=state.qvel[:1])


def without_number(state):
    return replace(state, qpos=state.qpos * np.nan)


def of_another_clock(state):
    return replace(state, time=state.time + 1e4)


def of_the_past(state):
    return replace(state, time=state.time - 10.0)


def in_trouble(state):
    return replace(state, fault=Fault("robot", "motor 3 is hot"))


def rounded(state):
    return replace(state, **{name: np.zeros(2) for name in ("qpos", "qvel", "tau", "temperature")})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"address": ""}, "address is empty"),
        ({"joint_names": ("elbow", "shoulder")}, "joint_names are not robot.joint_names"),
        ({"commanded": ()}, "commanded is empty"),
        ({"at_end": "sleep"}, "at_end is 'sleep'"),
        ({"at_stop": "stops"}, "at_stop is 'stops'"),
        ({"kp": np.ones(3)}, "kp is not 2 finite numbers"),
        ({"kd": -np.ones(2)}, "kd is not 2 finite numbers"),
        ({"qpos_range": np.zeros(2)}, r"qpos_range has shape \(2,\)"),
        ({"facts": {"gains": np.ones(2)}}, "facts cannot be stored as JSON"),
        ({"change": shorter}, r"qvel of a state has shape \(1,\)"),
        ({"change": without_number}, "qpos of a state is not finite"),
        ({"change": of_another_clock}, "a state is from the future"),
        ({"change": of_the_past}, "a state is 10.0 s old"),
        ({"change": in_trouble}, "a state has the fault robot: motor 3 is hot"),
        ({"change": rounded}, "noisy is True, and two states have the same values"),
        ({"verify": lambda: Fault("obedience", "kp is 3")}, "verify reports kp is 3"),
        ({"confirm": lambda: ""}, "confirm returns no words"),
        ({"watchdog": lambda: {"kind": "unheard"}}, "open_driver does not accept the options"),
        ({"damp": None}, "damping: damp raised TypeError"),
    ],
)
def test_a_broken_promise_is_named(arm, changes, sentence):
    found = broken(Wrong(arm, **changes))

    assert any(re.search(sentence, line) for line in found), found


def test_a_joint_that_is_moved_by_a_command_to_stay_is_named(arm):
    class Crossed(NotedArm):
        def write(self, ctrl, weight=1.0):
            super().write(ctrl + np.array([0.0, 0.5]), weight)

    assert any("elbow moved by" in line for line in broken(Crossed(arm)))


def test_a_driver_that_commands_when_it_must_not_is_told_where(arm):
    class Eager(NotedArm):
        def connect(self):
            super().connect()
            self.damp()

        def read(self):
            state = super().read()
            self.damp()
            return state

    found = broken(Eager(arm))

    assert "connect sends a command" in found
    assert "read sends a command" in found


def test_a_driver_that_changes_its_command_is_named(arm):
    class Careless(NotedArm):
        def write(self, ctrl, weight=1.0):
            super().write(ctrl, weight)
            ctrl += 0.001

    assert "write changes the array that it is given" in broken(Careless(arm))


def test_a_state_of_the_same_time_has_the_same_values(arm):
    class Frozen(NotedArm):
        def read(self):
            return replace(super().read(), time=self.clock.start)

    found = broken(Frozen(arm))

    assert "two states have the same time and other values" in found
    assert "no new state came within 0.2 s" in found


def test_a_driver_that_cannot_connect_says_so_and_is_closed(arm):
    class Absent(NotedArm):
        def connect(self):
            raise DriverError("nobody answers")

    driver = Absent(arm)

    assert broken(driver) == ["connecting: connect raised DriverError('nobody answers')"]
    assert driver.closed == [True, False]


def test_a_driver_without_a_member_is_told_which(arm):
    driver: Any = SimpleNamespace(close=lambda hold=False: None)

    found = broken_promises(driver, arm)

    assert "it lacks address, joint_names" in found[0]
