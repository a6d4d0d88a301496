"""Faults on an SO-101's wire: servos in a process of their own go wrong while they move. What they heard is judged."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

from gaponet.errors import UsageError
from gaponet.robot import load_robot
from gaponet_robots.control.controller import ControlConfig, Controller
from gaponet_robots.control.publisher import sole_publisher
from gaponet_robots.control.recording import Recording
from gaponet_robots.control.safety import SafetyConfig
from gaponet_robots.drivers.so101 import SO101Driver

pytestmark = pytest.mark.faults

ROBOT = load_robot("so101")
SLOW = ControlConfig(rate=4, blend=0.5, blend_speed=4.0, settle=0.0, damp=0.5)  # machines that run tests are busy
CALM = SafetyConfig(acceleration=2.0)  # so that a state may be a few 100 ms old
TIMEOUT = 0.1  # s of silence
AT = 4  # period of the run in which they go wrong
HERE = Path(__file__).parent


class ServoProcess:
    """The other end of the wire."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "servo_process.py")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )
        self.port = self._line()

    def _line(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline().decode().strip()

    def tell(self, word: str) -> None:
        assert self.process.stdin
        self.process.stdin.write(f"{word}\n".encode())

    def ask(self) -> dict[str, list[int]]:
        self.tell("ask")
        return json.loads(self._line())


@pytest.fixture
def servos() -> Iterator[ServoProcess]:
    servos = ServoProcess()
    yield servos
    servos.process.kill()
    servos.process.wait()


def move(servos: ServoProcess, fault: str) -> Recording:
    """Play a motion during which the servos go wrong; again where a late period of this machine ended it before."""
    for _ in range(8):
        recording = once(servos, fault)
        late = recording.fault and recording.fault.kind in ("overrun", "stale")
        reached = len(recording.during("run")) > AT
        if not late or (fault in ("dead", "silent", "corrupt", "late", "babble") and reached):
            return recording
        servos.tell("well")
    pytest.fail(f"this machine is too busy: {recording.fault}")


def once(servos: ServoProcess, fault: str) -> Recording:
    driver = SO101Driver(ROBOT, servos.port, timeout=TIMEOUT)

    def policy(k: int, state: object) -> np.ndarray | None:
        if k == AT and fault != "none":
            servos.tell(fault)
        return None if k > 12 else np.array([0.2 * np.sin(0.3 * k), *np.zeros(5)])

    return Controller(driver, ROBOT, config=SLOW, safety=CALM, watchdog=False).run(policy)


@pytest.mark.parametrize(
    ("fault", "kinds"),
    [
        ("overload", {"robot"}), ("overheat", {"robot"}), ("voltage", {"robot"}), ("sensor", {"robot"}),
        ("dead", {"stale", "overrun"}), ("silent", {"stale", "overrun"}), ("corrupt", {"stale", "overrun", "checksum"}),
        ("late", {"stale", "overrun"}), ("babble", {"stale", "overrun", "checksum"}),
    ],
)  # fmt: skip
def test_servos_that_go_wrong_hear_that_periods_goal_and_at_most_two_more_before_they_are_let_go(servos, fault, kinds):
    recording = move(servos, fault)
    assert recording.fault is not None
    assert recording.fault.kind in kinds
    heard = servos.ask()
    assert heard["torque"] == [0] * 6
    assert heard["goals"] <= 3


@pytest.mark.parametrize("fault", ["none", "lossy", "noisy"])
def test_a_bus_that_loses_or_damages_a_reply_now_and_then_goes_on_and_ends_held(servos, fault):
    recording = move(servos, fault)
    assert recording.fault is None, recording.fault
    assert servos.ask()["torque"] == [1] * 6


def let_go(port: str) -> None:
    """Wait until the watchdog has damped: it holds the robot's lock as long."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with contextlib.suppress(UsageError), sole_publisher(port):
            return
        time.sleep(0.05)


@pytest.mark.parametrize(("how", "periods"), [(signal.SIGKILL, 0), (signal.SIGSTOP, 5)], ids=["killed", "stopped"])
def test_the_watchdog_switches_the_torque_off_when_the_controller_is_no_more(servos, how, periods, tmp_path):
    script = (
        "import sys, numpy as np\n"
        "from gaponet_robots.control.controller import ControlConfig, Controller\n"
        "from gaponet_robots.drivers.so101 import SO101Driver\n"
        "from gaponet_robots.control.safety import SafetyConfig\n"
        "from gaponet.robot import load_robot\n"
        "robot = load_robot('so101')\n"
        "config = ControlConfig(rate=4, blend=0.5, blend_speed=4.0, settle=0.0, damp=0.3)\n"
        "def policy(k, state):\n"
        "    if k == 5: print('moving', flush=True)\n"
        "    return np.zeros(6)\n"
        f"driver, calm = SO101Driver(robot, sys.argv[1], timeout={TIMEOUT}), SafetyConfig(acceleration=2.0)\n"
        "Controller(driver, robot, config=config, safety=calm).run(policy)\n"
    )
    controller = subprocess.Popen([sys.executable, "-c", script, servos.port], stdout=subprocess.PIPE)
    try:
        assert controller.stdout.readline() == b"moving\n"
        assert servos.ask()["torque"] == [1] * 6
        os.kill(controller.pid, how)
        deadline = time.monotonic() + periods / SLOW.rate + 0.3 + 2.0  # the damping, and opening the port
        while servos.ask()["torque"] != [0] * 6 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert servos.ask()["torque"] == [0] * 6
    finally:
        controller.kill()
        controller.wait()
        let_go(servos.port)
