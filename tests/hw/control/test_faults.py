"""Robots on real buses, controller and watchdog in processes of their own: make faults.

What arrives is judged.

test_obedience.py has the faults of the robots themselves, in simulated time.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hw.control.robot_process import RobotProcess
from servos import Servos, on_port

from gaponet.base.errors import UsageError
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.publisher import sole_publisher
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot

pytestmark = pytest.mark.faults

DOMAIN = 20 + os.getpid() % 150
CALM = SafetyConfig(acceleration=2.0)  # at a slow rate a state is so old before it is too old
ROBOT = load_robot("h1_2")
TORSO = ROBOT.index(["torso_joint"])[0]
BUSY_S = 0.4  # by which what happens on a machine that runs tests may be later than promised
ENDS = pytest.mark.parametrize(
    ("how", "periods"),
    [(signal.SIGKILL, 0), (signal.SIGSTOP, 5), (signal.SIGTERM, 1)],
    ids=["KILL", "STOP", "TERM"],
)


def slow(rate: float) -> ControlConfig:
    """Machines that run tests are busy."""
    return ControlConfig(rate=rate, blend=0.3, blend_speed=4.0, settle=0.0, damp=0.3)


def swing(k: int) -> np.ndarray:
    """Both arms swing wider than they may."""
    target = ROBOT.qpos_home.copy()
    target[13:] += 2.5 * np.sin(0.8 * k)
    return target


H1_2 = """
import sys
from hw.control.test_faults import CALM, ROBOT, slow, swing
from gaponet.hw.control.controller import Controller
from gaponet.hw.drivers.unitree import UnitreeDriver
driver = UnitreeDriver(ROBOT, domain=int(sys.argv[1]))
Controller(driver, ROBOT, config=slow(10), safety=CALM).run(lambda k, state: swing(k))
"""
SO101 = """
import sys, numpy as np
from hw.control.test_faults import CALM, slow
from gaponet.hw.control.controller import Controller
from gaponet.hw.drivers.so101 import SO101Driver
from gaponet.robot.spec import load_robot
robot = load_robot("so101")
driver = SO101Driver(robot, sys.argv[1], timeout=0.1)
Controller(driver, robot, config=slow(4), safety=CALM).run(lambda k, state: np.zeros(6))
"""


def started(program: str, address: object) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    return subprocess.Popen([sys.executable, "-c", program, str(address)], env=environment)


def wait(done, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_free(address: str) -> bool:
    """True if no watchdog is at it any more."""
    try:
        with sole_publisher(address):
            return True
    except UsageError:
        return False


@pytest.fixture(scope="module")
def served() -> Iterator[RobotProcess]:
    pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")
    robot = RobotProcess(DOMAIN)
    yield robot
    robot.kill()


def arms(heard: dict[str, list]) -> np.ndarray:
    """Stiffness that the robot heard, (commands, joints) without the torso, which is held while
    the arms damp.
    """
    return np.delete(np.array(heard["kp"]).reshape(-1, len(ROBOT.joint_names)), TORSO, axis=1)


@ENDS
def test_a_controller_that_dies_or_hangs_leaves_a_damped_robot(served, how, periods):
    heard = lambda: served.ask("heard")  # noqa: E731
    for _ in range(8):
        driver = UnitreeDriver(ROBOT, domain=DOMAIN)
        wait(lambda driver=driver: is_free(driver.address))
        served.ask("clear")
        process = started(H1_2, DOMAIN)
        try:
            wait(lambda process=process: len(arms(heard())) > 10 or process.poll() is not None)
            # Another process commands this robot; if not, that process has ended.
            with contextlib.suppress(UsageError):
                Controller(driver, ROBOT, config=slow(10), watchdog=False).run(
                    lambda k, state: None
                )
                wait(lambda process=process: process.poll() is not None)
            if process.poll() is not None or not arms(heard())[-1].any():
                continue  # a late period has ended it
            ended = time.monotonic()
            process.send_signal(how)
            wait(lambda: not arms(heard())[-1].any())
            wait(lambda: heard()["weight"][-1] < 0.05)  # in the end the arms are handed back
            said = heard()
            stiff = arms(said).any(axis=1)
            at = np.array(said["time"])
            weight = np.array(said["weight"])
            assert (np.diff(stiff.astype(int)) <= 0).all()
            damped = int(stiff.sum())
            assert at[damped] - ended < periods / 10 + BUSY_S
            assert weight[damped] == pytest.approx(weight[damped - 1], abs=0.01), (
                "they are not handed back at once"
            )
            handed = at[damped:][weight[damped:] < 0.05][0] - at[damped]
            assert 0.5 * 0.3 < handed < 0.3 + BUSY_S
            # Who comes back from standing still has nothing more to say.
            process.send_signal(signal.SIGCONT)
            process.wait(20)
            time.sleep(0.3)
            assert not arms(heard())[-1].any()
            return
        finally:
            process.kill()
            process.wait()
    pytest.fail("this machine is too busy: no controller lived until it was to be ended")


@ENDS
def test_the_watchdog_switches_the_torque_off_when_the_controller_is_no_more(how, periods):
    pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")
    servos = Servos()
    torque = lambda: [servos.get(number, "torque") for number in range(1, 7)]  # noqa: E731
    with on_port(servos) as port:
        process = started(SO101, port)
        try:
            wait(lambda: torque() == [1] * 6 or process.poll() is not None)
            process.send_signal(how)
            # The damping, and opening the port.
            wait(lambda: torque() == [0] * 6, periods / 4 + 0.3 + 2.0)
        finally:
            process.kill()
            process.wait()
            wait(lambda: is_free(port), 30)


def test_live_targets_are_followed_until_their_sender_dies_and_then_the_robot_damps(
    served, tmp_path
):
    pytest.importorskip("zmq", reason="pip install 'gaponet[zmq]'")
    from gaponet.hw.targets.client import RemoteRobot

    address = f"ipc://{tmp_path}/targets"
    hold = 0.5
    bus = [
        "--driver",
        "unitree",
        "--domain",
        str(DOMAIN),
        "--rate",
        "10",
        "--safety.acceleration",
        "2",
    ]
    words = [
        "run",
        *bus,
        "--targets",
        "zmq",
        "--live.address",
        address,
        "--live.hold",
        str(hold),
        "--yes",
        "--json",
    ]
    for _ in range(8):
        wait(lambda: is_free(UnitreeDriver(ROBOT, domain=DOMAIN).address))
        served.ask("clear")
        control = subprocess.Popen(
            [sys.executable, "-m", "gaponet", *words], stdout=subprocess.PIPE, text=True
        )
        sender = RemoteRobot(address, patience=60.0)
        for k, _ in zip(range(80), sender, strict=False):
            sender.send({"left_elbow_joint": 0.2 * np.sin(0.1 * k)})
        early = sender.ended
        sender.close(end=False)
        died = time.monotonic()
        result = json.loads(control.communicate(timeout=60)[0])
        if not early:  # this machine kept time
            break
    assert result["events"][-2][2] == "silence", result["events"]
    assert (control.returncode, result["targets"]["taken"] > 30) == (3, True)
    heard = served.ask("heard")
    stiff = arms(heard).any(axis=1)
    assert (np.diff(stiff.astype(int)) <= 0).all(), "a position command after damping"
    assert 0 < heard["time"][int(stiff.sum())] - died < hold + 0.1 + BUSY_S


def test_two_publishers_on_the_bus_are_refused(served):
    # Elsewhere DDS remembers killed controllers for 10 s.
    first = UnitreeDriver(ROBOT, domain=DOMAIN + 2)
    robot = RobotProcess(DOMAIN + 2)
    try:
        first.connect()
        with pytest.raises(DriverError, match="publish"):
            UnitreeDriver(ROBOT, domain=DOMAIN + 2).connect()
    finally:
        first.close()
        robot.kill()


def test_a_program_that_sends_commands_later_is_reported_and_one_that_only_connects_is_not(served):
    robot = RobotProcess(DOMAIN + 3)
    driver = UnitreeDriver(ROBOT, domain=DOMAIN + 3)
    other = UnitreeDriver(ROBOT, domain=DOMAIN + 3, sole=False)
    try:
        driver.connect()
        other.connect()
        for _ in range(20):
            driver.damp()
            assert driver.read().fault is None
            time.sleep(0.02)
        other.damp()
        wait(lambda: driver.read().fault is not None, 5.0)
        fault = driver.read().fault
        assert fault.kind == "source"
        assert f"process {os.getpid()}" in fault.text
    finally:
        driver.close()
        other.close()
        robot.kill()


def test_without_a_robot_it_says_where_it_looked(served):
    with pytest.raises(DriverError, match="nobody"):
        UnitreeDriver(ROBOT, domain=231).connect()
    with pytest.raises(DriverError, match="eth99"):
        UnitreeDriver(ROBOT, interface="eth99").connect()
