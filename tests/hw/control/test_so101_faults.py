"""The watchdog on an SO-101's wire: servos and controller in processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

from gaponet.base.errors import UsageError
from gaponet.hw.control.publisher import sole_publisher

pytestmark = pytest.mark.faults

RATE = 4  # Hz: machines that run tests are busy
CONTROLLER = f"""
import sys, numpy as np
from gaponet.hw.control.controller import ControlConfig, Controller
from gaponet.hw.drivers.so101 import SO101Driver
from gaponet.hw.control.safety import SafetyConfig
from gaponet.robot.spec import load_robot
robot = load_robot("so101")
config = ControlConfig(rate={RATE}, blend=0.5, blend_speed=4.0, settle=0.0, damp=0.3)
def policy(k, state):
    if k == 5: print("moving", flush=True)
    return np.zeros(6)
driver, calm = SO101Driver(robot, sys.argv[1], timeout=0.1), SafetyConfig(acceleration=2.0)
Controller(driver, robot, config=config, safety=calm).run(policy)
"""


def let_go(port: str) -> None:
    """Wait until the watchdog has damped: it holds the robot's lock as long."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with contextlib.suppress(UsageError), sole_publisher(port):
            return
        time.sleep(0.05)


@pytest.mark.parametrize(("how", "periods"), [(signal.SIGKILL, 0), (signal.SIGSTOP, 5)], ids=["killed", "stopped"])
def test_the_watchdog_switches_the_torque_off_when_the_controller_is_no_more(how, periods):
    file = Path(__file__).parent / "servo_process.py"
    servos = subprocess.Popen([sys.executable, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    port = servos.stdout.readline().decode().strip()
    controller = subprocess.Popen([sys.executable, "-c", CONTROLLER, port], stdout=subprocess.PIPE)

    def torque() -> list[int]:
        servos.stdin.write(b"torque\n")
        return json.loads(servos.stdout.readline())

    try:
        assert controller.stdout.readline() == b"moving\n"
        assert torque() == [1] * 6
        os.kill(controller.pid, how)
        deadline = time.monotonic() + periods / RATE + 0.3 + 2.0  # the damping, and opening the port
        while torque() != [0] * 6 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert torque() == [0] * 6
    finally:
        controller.kill()
        controller.wait()
        let_go(port)
        servos.kill()
        servos.wait()
