"""Real DDS: robot and controller in processes of their own, on loopback. What arrives at the robot is judged.

test_obedience.py has the faults themselves, in simulated time.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")

from hw.control.loopback import judge
from hw.control.robot_process import RobotProcess

from gaponet.base.errors import UsageError
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.phases import ControlConfig, Phase
from gaponet.hw.control.publisher import sole_publisher
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot

pytestmark = pytest.mark.faults

DOMAIN = 20 + os.getpid() % 150
SLOW = ControlConfig(rate=10, blend=0.3, blend_speed=4.0, settle=0.0, damp=0.3)  # machines that run tests are busy
SAFETY = SafetyConfig(acceleration=5.0)  # at 10 Hz a state is so old before it is too old
ROBOT = load_robot("h1_2")
TORSO = ROBOT.index(["torso_joint"])[0]
AT = 4  # period of the run in which the fault is injected


@pytest.fixture(scope="module")
def served() -> Iterator[RobotProcess]:
    robot = RobotProcess(DOMAIN)
    yield robot
    robot.kill()


def swing(k: int) -> np.ndarray:
    """Both arms swing wider than they may."""
    target = ROBOT.qpos_home.copy()
    target[13:] += 2.5 * np.sin(0.8 * k)
    return target


def once(at_fault: Callable[[], object], injected: list[float]) -> Recording:
    """Swing; do something in period AT, and note when; give up long after."""

    def policy(k, state):
        if k == AT:
            injected.append(time.monotonic())
            at_fault()
        return swing(k) if k < AT + 30 else None

    driver = UnitreeDriver(ROBOT, domain=DOMAIN)
    return Controller(driver, ROBOT, config=SLOW, safety=SAFETY, watchdog=False).run(policy)


def arms(heard: dict[str, list]) -> np.ndarray:
    """Stiffness that the robot heard, (commands, joints) without the torso, which is held while the arms damp."""
    return np.delete(np.array(heard["kp"]).reshape(-1, len(ROBOT.joint_names)), TORSO, axis=1)


@pytest.mark.parametrize(
    ("fault", "kind", "periods"),
    [("stop", "stale", 2), ("checksum", "stale", 2), ("freeze", "frozen", 2), ("remote", "stop", 1)],
)
def test_a_fault_of_the_robot_ends_in_damp(served, fault, kind, periods):
    for _ in range(8):
        wait(is_free)  # of the watchdog of the last attempt
        served.ask("clear")
        injected: list[float] = []
        recording = once(lambda: served.ask(f"fault {fault}"), injected)
        ended = recording.fault
        if ended and ended.kind == kind and injected and ended.time > injected[0]:
            break
        print(f"again, this machine was too busy: {ended}")
    assert ended is not None
    assert ended.kind == kind, ended.text
    damped = next(event.time for event in recording.events if event.phase == Phase.DAMP)
    print(f"{kind}: damped {1e3 * (damped - injected[0]):.0f} ms after the fault, live, {SLOW.rate:g} Hz")
    after = [r.state.time for r in recording.rows if r.phase == "run"][AT + 1 :]
    # Position commands between the fault and damping; a reading that stands still shows in states that come.
    assert (len(set(after)) if kind == "frozen" else len(after)) <= periods
    heard = served.ask("heard")
    assert heard["refused"] == 0
    judge(recording, heard, ROBOT, SAFETY)


CONTROLLER = """
import sys
from hw.control.test_faults import ROBOT, SAFETY, SLOW, swing
from gaponet.hw.control.controller import Controller
from gaponet.hw.drivers.unitree import UnitreeDriver
driver = UnitreeDriver(ROBOT, domain=int(sys.argv[1]))
Controller(driver, ROBOT, config=SLOW, safety=SAFETY).run(lambda k, state: swing(k))
"""


BUSY_S = 0.4  # by which what happens on a machine that runs tests may be later than promised


@pytest.mark.parametrize(
    ("how", "periods"), [(signal.SIGKILL, 0), (signal.SIGSTOP, 5), (signal.SIGTERM, 1)], ids=["KILL", "STOP", "TERM"]
)
def test_a_controller_that_dies_or_hangs_leaves_a_damped_robot(served, how, periods):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    for _ in range(8):
        wait(is_free)
        served.ask("clear")
        process = subprocess.Popen([sys.executable, "-c", CONTROLLER, str(DOMAIN)], env=environment)
        try:
            wait(lambda process=process: len(arms(served.ask("heard"))) > 10 or process.poll() is not None)
            refused = False
            try:
                once(lambda: None, [])
            except UsageError as error:
                refused = "another process commands this robot" in str(error)
            if not refused:  # then it had ended: of two that live one is refused
                wait(lambda process=process: process.poll() is not None)
            if process.poll() is not None or not arms(served.ask("heard"))[-1].any():
                continue  # a late period has ended it
            ended = time.monotonic()
            process.send_signal(how)
            wait(lambda: not arms(served.ask("heard"))[-1].any())
            wait(lambda: served.ask("heard")["weight"][-1] < 0.05)  # in the end the arms are handed back
            heard = served.ask("heard")
            stiff, at, weight = arms(heard).any(axis=1), np.array(heard["time"]), np.array(heard["weight"])
            assert (np.diff(stiff.astype(int)) <= 0).all()
            damped = int(stiff.sum())
            assert at[damped] - ended < periods / SLOW.rate + BUSY_S
            assert weight[damped] == pytest.approx(weight[damped - 1], abs=0.01), "they are not handed back at once"
            handed = at[damped:][weight[damped:] < 0.05][0] - at[damped]
            assert 0.5 * SLOW.damp < handed < SLOW.damp + BUSY_S
            process.send_signal(signal.SIGCONT)  # who comes back from standing still has nothing more to say
            process.wait(20)
            time.sleep(0.3)
            assert not arms(served.ask("heard"))[-1].any()
            return
        finally:
            process.kill()
            process.wait()
    pytest.fail("this machine is too busy: no controller lived until it was to be ended")


def is_free() -> bool:
    """Whether no watchdog is at it any more."""
    try:
        with sole_publisher(UnitreeDriver(ROBOT, domain=DOMAIN).address):
            return True
    except UsageError:
        return False


def wait(done, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_two_publishers_on_the_bus_are_refused():
    domain = DOMAIN + 2  # of its own: on the other one, DDS remembers controllers that were killed above for 10 s
    robot, first = RobotProcess(domain), UnitreeDriver(ROBOT, domain=domain)
    try:
        first.connect()
        with pytest.raises(DriverError, match="publish rt/arm_sdk"):
            UnitreeDriver(ROBOT, domain=domain).connect()
    finally:
        first.close()
        robot.kill()


def test_without_a_robot_it_says_where_it_looked():
    with pytest.raises(DriverError, match="nobody speaks on rt/lowstate, domain 231, interface lo"):
        UnitreeDriver(ROBOT, domain=231).connect()
    with pytest.raises(DriverError, match="no network interface 'eth99'"):
        UnitreeDriver(ROBOT, interface="eth99").connect()
