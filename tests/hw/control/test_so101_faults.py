"""The watchdog on an SO-101's port: servos here, the controller in a process of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest
from servos import Servos, on_port

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


def wait_until_damped(port: str) -> None:
    """Wait for the watchdog's end: it holds the robot's lock as long."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with contextlib.suppress(UsageError), sole_publisher(port):
            return
        time.sleep(0.05)


@pytest.mark.parametrize(("how", "periods"), [(signal.SIGKILL, 0), (signal.SIGSTOP, 5)], ids=["killed", "stopped"])
def test_the_watchdog_switches_the_torque_off_when_the_controller_is_no_more(how, periods):
    servos = Servos()
    with on_port(servos) as port:
        controller = subprocess.Popen([sys.executable, "-c", CONTROLLER, port], stdout=subprocess.PIPE)
        torque = lambda: [servos.get(number, "torque") for number in range(1, 7)]  # noqa: E731
        try:
            assert controller.stdout
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
            wait_until_damped(port)
