"""The drivers of the package keep the promises of `Driver`, and a driver that does not is told
which.
"""

from __future__ import annotations

import re
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hw.control.loopback import living
from hw.noted_arm import NotedArm

from gaponet.hw import conformance
from gaponet.hw.conformance import broken_promises
from gaponet.hw.control.driver import DriverError, Fault
from gaponet.hw.drivers.so101 import SO101Driver
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Machines that run tests are busy."""
    monkeypatch.setattr(conformance, "MAX_CALL_S", 1.0)


def broken(driver: NotedArm) -> list[str]:
    """What is found of the driver of an arm in simulated time."""
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


def in_degrees(state):
    return replace(state, qpos=np.rad2deg(state.qpos + 0.5))


def of_lists(state):
    return replace(state, qpos=list(state.qpos))


def without_count(state):
    return replace(state, refused=None)


def rounded(state):
    return replace(state, **{name: np.zeros(2) for name in ("qpos", "qvel", "tau", "temperature")})


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"address": ""}, "address is empty"),
        ({"joint_names": ("elbow", "shoulder")}, "joint_names are not robot.joint_names"),
        ({"commanded": ()}, "commanded is empty"),
        ({"commanded": ("knee",)}, "commanded has knee, no joint of the robot"),
        ({"at_end": "sleep"}, "at_end is 'sleep'"),
        ({"at_stop": "stops"}, "at_stop is 'stops'"),
        ({"kp": np.ones(3)}, "kp is not 2 finite numbers"),
        ({"kd": -np.ones(2)}, "kd is not 2 finite numbers"),
        ({"kp": np.ones(2)}, "kp of shoulder is 1 N·m/rad, and that of the robot folder is 20"),
        ({"qpos_range": np.zeros(2)}, r"qpos_range has shape \(2,\)"),
        ({"qpos_range": np.zeros((2, 2))}, "a lower limit that is not below the upper one"),
        ({"facts": {"gains": np.ones(2)}}, "facts cannot be stored as JSON"),
        ({"change": shorter}, r"qvel of a state is no array of shape \(2,\)"),
        ({"change": of_lists}, r"qpos of a state is no array of shape \(2,\)"),
        ({"change": without_count}, "refused of a state is None"),
        ({"change": in_degrees}, "rad outside its range"),
        ({"change": without_number}, "qpos of a state is not finite"),
        ({"change": of_another_clock}, "a state is from the future"),
        ({"change": of_the_past}, "a state is 10.0 s old"),
        ({"change": in_trouble}, "a state has the fault robot: motor 3 is hot"),
        ({"change": rounded}, "noisy is True, and two states have the same values"),
        ({"verify": lambda: Fault("obedience", "kp is 3")}, "verify reports kp is 3"),
        ({"verify": lambda: True}, "verify returns True"),
        ({"write": lambda ctrl: None}, "holding: write raised TypeError"),
        ({"write": lambda ctrl, weight: None}, r"shoulder was told to move by .0\.10 rad and"),
        ({"confirm": lambda: ""}, "confirm returns no words"),
        ({"watchdog": lambda: {"kind": "unheard"}}, "open_driver does not accept the options"),
        ({"damp": None}, "damping: damp raised TypeError"),
    ],
)
def test_a_broken_promise_is_named(arm, changes, sentence):
    found = broken(Wrong(arm, **changes))

    assert any(re.search(sentence, line) for line in found), found


def test_a_joint_that_is_moved_by_a_command_to_stay_is_named(arm):
    class Shifted(NotedArm):
        def write(self, ctrl, weight=1.0):
            super().write(ctrl + np.array([0.0, 0.5]), weight)

    assert any("elbow moved by" in line for line in broken(Shifted(arm)))


def test_a_joint_that_is_not_commanded_and_moves_is_named(arm):
    class Greedy(NotedArm):
        """It reads both joints and may command one."""

        commanded = ("shoulder",)

        def write(self, ctrl, weight=1.0):
            super().write(np.nan_to_num(ctrl, nan=0.9), weight)

    driver = Greedy(arm)
    driver.commanded = ("shoulder",)

    assert any("elbow moved by" in line and "not commanded" in line for line in broken(driver))


def test_joints_that_are_written_in_another_order_are_named(arm):
    class Swapped(NotedArm):
        start: np.ndarray | None = None

        def write(self, ctrl, weight=1.0):
            self.start = ctrl.copy() if self.start is None else self.start
            super().write(self.start + (ctrl - self.start)[::-1], weight)

    assert any("when elbow was told to; is the order" in line for line in broken(Swapped(arm)))


def test_with_the_true_positions_a_mistake_that_read_and_write_share_is_seen(arm):
    class Displaced(NotedArm):
        """Its zero is 0.3 rad off."""

        zero = 0.3

        def read(self):
            state = super().read()
            return replace(state, qpos=state.qpos + self.zero)

        def write(self, ctrl, weight=1.0):
            super().write(ctrl - self.zero, weight)

    class Right(Displaced):
        zero = 0.0

    def found(driver):
        positions = lambda: driver.unit.live.unit.true_qpos()[0]  # noqa: E731
        return broken_promises(driver, arm, positions=positions, clock=driver.clock)

    assert broken(Displaced(arm)) == []
    assert found(Right(arm)) == []
    assert any("0.3" in line and "simulated robot has it" in line for line in found(Displaced(arm)))


def test_slow_calls_are_named(arm, monkeypatch):
    monkeypatch.setattr(conformance, "MAX_CALL_S", 0.005)

    class Slow(NotedArm):
        def read(self):
            time.sleep(0.006)
            return super().read()

        def write(self, ctrl, weight=1.0):
            time.sleep(0.006)
            super().write(ctrl, weight)

    found = broken(Slow(arm))

    assert any(line.startswith("read takes") for line in found)
    assert any(line.startswith("write takes") for line in found)


def test_states_share_no_array(arm):
    class Thrifty(NotedArm):
        buffer = np.zeros(2)

        def read(self):
            state = super().read()
            self.buffer[:] = state.qpos
            return replace(state, qpos=self.buffer)

    assert "a later read changes the arrays of an earlier state" in broken(Thrifty(arm))


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

    assert found[0].startswith("the driver lacks address, joint_names")
