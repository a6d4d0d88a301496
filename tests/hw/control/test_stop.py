"""Keys and signals that stop a robot: on a pseudo-terminal, and in the watchdog."""

from __future__ import annotations

import os
import select
import termios
from collections.abc import Iterator

import numpy as np
import pytest
from arm import commands

from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.stop import SIGNALS, Keys, StopRequest
from gaponet.hw.control.watchdog import Watchdog
from gaponet.hw.targets.policy import play
from gaponet.sysid.motion.motion import Motion
from gaponet.testing.fleet import load_fleet
from gaponet.testing.virtual_driver import VirtualDriver

QUICK = ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1, damp=0.1)
MOTION = Motion("sway", "whole_body", 0.02, commands(40, seed=1))
KEYS = {
    "Ctrl-S": b"\x13", "Ctrl-Q": b"\x11", "Ctrl-Z": b"\x1a", "Ctrl-backslash": b"\x1c", "Ctrl-C": b"\x03",
    "Ctrl-V": b"\x16", "Ctrl-O": b"\x0f", "Ctrl-D": b"\x04", "Enter": b"\r", "Escape": b"\x1b", "letter": b"x",
}  # fmt: skip


class Arm(VirtualDriver):
    """Notes how often it is commanded, and how it is closed."""

    def __init__(self, robot) -> None:
        super().__init__(robot, load_fleet("easy", robot).unit("virtual-1"), SimulatedClock(), period=0.01)
        self.commands, self.held = 0, None

    def write(self, ctrl, weight=1.0):
        self.commands += 1
        super().write(ctrl, weight)

    def close(self, hold=False):
        self.held = hold


class Terminal:
    """A pseudo-terminal on standard input."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        self.before = termios.tcgetattr(self.slave)

    def type(self, key: bytes) -> None:
        os.write(self.master, key)
        select.select([self.slave], [], [], 2)  # until it has arrived; a terminal that keeps it lets the motion go on


@pytest.fixture
def terminal(monkeypatch) -> Iterator[Terminal]:
    made = Terminal()
    with open(made.slave) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield made
    os.close(made.master)


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_every_key_stops_a_motion_in_the_next_period_and_the_terminal_is_as_before(arm, terminal, key):
    controller = Controller(driver := Arm(arm), arm, config=QUICK, clock=driver.clock)
    motion = play(MOTION, 0.02)

    def policy(k, state):
        if k == 20:
            terminal.type(key)
        return motion(k, state)

    recording = controller.run(policy, keys=True)
    assert recording.fault is not None
    assert "asked to stop: key " in recording.fault.text
    assert sum(row.phase == "run" for row in recording.rows) == 21
    assert termios.tcgetattr(terminal.slave) == terminal.before


def test_a_key_between_consent_and_first_command_leaves_the_robot_uncommanded(arm, terminal):
    driver = Arm(arm)
    controller = Controller(
        driver, arm, config=QUICK, clock=driver.clock, on_connect=lambda _: os.write(terminal.master, b"x")
    )
    recording = controller.run(play(MOTION, 0.02), keys=True)
    assert "key 'x'; nothing was commanded" in recording.fault.text
    assert driver.commands == 0
    assert driver.held


def test_who_refuses_a_connected_robot_leaves_it_uncommanded_and_held(arm, terminal):
    def refuse(_):
        raise UsageError("no")

    driver = Arm(arm)
    with pytest.raises(UsageError, match="no"):
        Controller(driver, arm, config=QUICK, clock=driver.clock, on_connect=refuse).run(play(MOTION, 0.02), keys=True)
    assert driver.commands == 0
    assert driver.held is True
    assert termios.tcgetattr(terminal.slave) == terminal.before


def test_a_terminal_that_ends_stops(terminal):
    with Keys(stop := StopRequest()) as keys:
        keys.poll()
        assert stop.reason is None
        os.close(terminal.master)
        keys.poll()
    terminal.master = os.open(os.devnull, os.O_RDONLY)  # for the fixture to close
    assert "the terminal is gone" in stop.reason


def test_a_policy_that_raises_leaves_the_terminal_as_before(arm, terminal):
    driver = Arm(arm)
    with pytest.raises(ZeroDivisionError):
        Controller(driver, arm, config=QUICK, clock=driver.clock).run(
            lambda k, state: np.zeros(2) / (k // k), keys=True
        )
    assert termios.tcgetattr(terminal.slave) == terminal.before


def test_the_watchdog_outlives_every_signal_that_stops_the_controller(so101):
    pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")
    spec = {"kind": "so101", "robot": str(so101.folder), "early": False, "port": "/dev/none"}
    with open(os.devnull) as lock:
        watchdog = Watchdog(spec, lock.fileno(), hang=60.0, damp=0.1)
    watchdog.wait_ready()
    for number in SIGNALS:
        watchdog._process.send_signal(number)
    watchdog.release()
    assert watchdog._process.returncode == 0
