"""Keys, signals and refusals that stop a robot, on a pseudo-terminal."""

from __future__ import annotations

import os
import select
import termios
from collections.abc import Iterator

import numpy as np
import pytest
from hw.noted_arm import DT, MOTION, NotedArm, acting, control

from gaponet.base.errors import UsageError
from gaponet.hw.control.stop import StopKeys, StopRequest
from gaponet.hw.targets.policy import motion_policy

KEYS = {
    "Ctrl-S": b"\x13",
    "Ctrl-Q": b"\x11",
    "Ctrl-Z": b"\x1a",
    "Ctrl-backslash": b"\x1c",
    "Ctrl-C": b"\x03",
    "Ctrl-V": b"\x16",
    "Ctrl-O": b"\x0f",
    "Ctrl-D": b"\x04",
    "Enter": b"\r",
    "Escape": b"\x1b",
    "letter": b"x",
}


class Terminal:
    """A pseudo-terminal on standard input."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        self.before = termios.tcgetattr(self.slave)

    def type(self, key: bytes) -> None:
        os.write(self.master, key)
        # Until it has arrived; a terminal that keeps it lets the motion go on.
        select.select([self.slave], [], [], 2)


@pytest.fixture
def terminal(monkeypatch) -> Iterator[Terminal]:
    made = Terminal()
    with open(made.slave) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield made
    os.close(made.master)


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_every_key_stops_a_motion_in_the_next_period_and_the_terminal_is_as_before(
    arm, terminal, key
):
    recording = control(NotedArm(arm)).run(acting(lambda: terminal.type(key)), keys=True)
    assert recording.fault is not None
    assert "asked to stop: key " in recording.fault.text
    assert sum(row.phase == "run" for row in recording.rows) == 21
    assert termios.tcgetattr(terminal.slave) == terminal.before


def test_all_keys_are_read_so_that_none_reaches_the_shell(terminal):
    with StopKeys(stop := StopRequest()) as keys:
        terminal.type(b"abc")
        keys.poll()
        assert stop.reason == "key 'a'"
        assert not select.select([terminal.slave], [], [], 0)[0]


def test_a_key_between_consent_and_first_command_leaves_the_robot_uncommanded(arm, terminal):
    driver = NotedArm(arm)
    controller = control(driver, on_connect=lambda _: os.write(terminal.master, b"x"))
    recording = controller.run(motion_policy(MOTION, DT), keys=True)
    assert "key 'x'; nothing was commanded" in recording.fault.text
    assert (driver.sent, driver.closed) == ([], [True])


def test_a_refusal_of_the_connected_robot_leaves_it_uncommanded_and_held(arm, terminal):
    def refuse(_):
        raise UsageError("no")

    driver = NotedArm(arm)
    with pytest.raises(UsageError, match="no"):
        control(driver, on_connect=refuse).run(motion_policy(MOTION, DT), keys=True)
    assert (driver.sent, driver.closed) == ([], [True])
    assert termios.tcgetattr(terminal.slave) == terminal.before


def test_a_terminal_that_ends_stops(terminal):
    with StopKeys(stop := StopRequest()) as keys:
        keys.poll()
        assert stop.reason is None
        os.close(terminal.master)
        keys.poll()
    terminal.master = os.open(os.devnull, os.O_RDONLY)  # for the fixture to close
    assert "the terminal is gone" in stop.reason


def test_a_policy_that_raises_leaves_the_terminal_as_before(arm, terminal):
    with pytest.raises(ZeroDivisionError):
        control(NotedArm(arm)).run(lambda k, state: np.zeros(2) / (k // k), keys=True)
    assert termios.tcgetattr(terminal.slave) == terminal.before
