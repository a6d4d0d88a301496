"""Faults on real DDS: robot and controller in two processes, on loopback. What arrives at the robot is judged."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")

from robots.control.robot_process import RobotProcess

from gaponet.errors import UsageError
from gaponet.robot import RobotSpec, load_robot
from gaponet_robots.control.controller import Controller
from gaponet_robots.control.driver import DriverError
from gaponet_robots.control.phases import ControlConfig, Phase
from gaponet_robots.control.recording import Recording
from gaponet_robots.control.safety import Limits, SafetyConfig
from gaponet_robots.drivers.unitree import UnitreeDriver

pytestmark = pytest.mark.faults

DOMAIN = 20 + os.getpid() % 150
SLOW = ControlConfig(rate=10, blend=0.3, blend_speed=4.0, settle=0.0, damp=0.3)  # machines that run tests are busy
SAFETY = SafetyConfig(acceleration=5.0)  # at 10 Hz a state is so old before it is too old
ROBOT = load_robot("h1_2")
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


def run(at_fault, robot: RobotSpec = ROBOT, domain: int = DOMAIN) -> Recording:
    """Swing; do something in period AT; give up long after."""

    injected = [0.0]

    def policy(k, state):
        if k == AT:
            injected[0] = time.monotonic()
            at_fault()
        return swing(k) if k < AT + 30 else None

    driver = UnitreeDriver(robot, domain=domain)
    recording = Controller(driver, robot, SLOW, SAFETY, guard=False).run(policy)
    damped = next((e.time for e in recording.events if e.phase == Phase.DAMP), float("nan"))
    kind = recording.fault.kind if recording.fault else "none"
    print(f"{kind}: damped {1e3 * (damped - injected[0]):.0f} ms after the fault, live, {SLOW.rate:g} Hz")
    return recording


def judge(recording: Recording, heard: dict[str, list]) -> None:
    """What the robot heard: never outside the limits, and once damped, damped for good."""
    arms = ROBOT.index(recording.commanded)
    ctrl, kp, _kd, _qvel = (np.array(heard[n])[:, arms] for n in ("ctrl", "kp", "kd", "qvel"))
    limits = Limits.of(ROBOT, recording.commanded, SAFETY)
    stiff = (kp > 0).all(axis=1)
    assert (stiff | (kp == 0).all(axis=1)).all()
    assert (np.diff(stiff.astype(int)) <= 0).all(), "a position command after damping"
    assert not stiff[-1]
    assert (ctrl[stiff] >= limits.low - 1e-6).all()
    assert (ctrl[stiff] <= limits.high + 1e-6).all()
    assert (np.abs(np.diff(ctrl[stiff], axis=0)) <= limits.speed * 0.1 + 1e-6).all()
    np.testing.assert_array_equal(np.array(heard["kp"])[:, :12], 0.0)  # legs are never commanded
    torso = ROBOT.index(["torso_joint"])
    assert (np.array(heard["kp"])[:, torso] == ROBOT.kp[torso]).all(), "the torso is held"
    assert np.ptp(np.array(heard["ctrl"])[:, torso]) == 0, "where it was found"
    assert heard["refused"] == 0
    for row in recording.rows:
        if row.ctrl is not None:
            asked = limits.kp * (row.ctrl[arms] - row.state.qpos[arms]) - limits.kd * row.state.qvel[arms]
            assert (np.abs(asked) <= limits.effort + 1e-6).all()


@pytest.mark.parametrize(
    ("fault", "kind", "periods"),
    [
        ("stop", "stale", 2), ("repeat", "stale", 2), ("late", "stale", 2), ("checksum", "stale", 2),
        ("freeze", "frozen", 2), ("nan", "nan", 1), ("jump", "jump", 1), ("hot", "temperature", 1),
        ("encoder", "frozen", 6), ("motor", "robot", 1), ("remote", "stop", 1), ("fall", "tilt", 1),
        ("machine", "robot", 1),
    ],
)  # fmt: skip
def test_a_fault_of_the_robot_ends_in_damp(served, fault, kind, periods):
    served.ask("clear")
    recording = run(lambda: served.ask(f"fault {fault}"))
    assert recording.fault is not None
    assert recording.fault.kind == kind, recording.fault.text
    sent_after = sum(r.phase == "run" for r in recording.rows) - (AT + 1)
    assert 0 <= sent_after <= periods  # position commands between the fault and damping
    judge(recording, served.ask("heard"))


def test_a_step_of_the_robots_clock_is_no_fault_and_hides_none(served):
    """10 s ahead, and back again: the run goes on. Messages that cease are then seen as ever."""
    served.ask("clear")

    def policy(k, state):
        word = {AT: "fault clock", AT + 5: "fault none", AT + 10: "fault clock", AT + 15: "fault stop"}.get(k)
        if word:
            served.ask(word)
        return swing(k)

    recording = Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, SLOW, SAFETY, guard=False).run(policy)
    assert recording.fault.kind == "stale", recording.fault.text
    assert 0 <= sum(r.phase == "run" for r in recording.rows) - (AT + 15 + 1) <= 2
    judge(recording, served.ask("heard"))


def test_a_robot_that_comes_back_is_not_commanded_again(served):
    domain = DOMAIN + 1
    robots = [RobotProcess(domain)]

    def cut():
        robots[0].kill()

    driver = UnitreeDriver(ROBOT, domain=domain)
    config = ControlConfig(rate=10, blend=0.3, blend_speed=4.0, settle=0.0, damp=8.0)
    controller = Controller(driver, ROBOT, config, SAFETY, guard=False)

    def policy(k, state):
        if k == AT:
            cut()
        return swing(k)

    def told(event):
        if event.phase == "damp":
            robots.append(RobotProcess(domain))

    controller._on_event = told
    recording = controller.run(policy)
    assert recording.fault.kind == "stale", recording.fault.text
    heard = robots[1].ask("heard")
    robots[1].kill()
    assert len(heard["kp"]) > 0
    np.testing.assert_array_equal(np.delete(heard["kp"], 12, axis=1), 0.0)  # the torso is held while the arms damp


def test_a_g1_is_refused_and_hears_nothing(served):
    served.ask("clear")
    served.ask("machine 5")
    time.sleep(0.2)
    with pytest.raises(DriverError, match="not an H1-2: its mode_machine is 5, a G1's; nothing was sent"):
        run(lambda: None)
    assert served.ask("heard")["time"] == []
    served.ask("clear")


def test_a_stop_before_the_start_and_a_robot_that_is_never_ready_send_nothing(served):
    served.ask("clear")
    controller = Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, SLOW, SAFETY)
    controller.stop("before the start")
    assert controller.run(lambda k, state: swing(k)).fault.kind == "stop"
    cold = SafetyConfig(acceleration=5.0, temperature=1.0)
    recording = Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, SLOW, cold).run(lambda k, state: swing(k))
    assert recording.fault.kind == "temperature"
    time.sleep(0.3)
    assert served.ask("heard")["time"] == []


def test_a_good_run_ends_with_the_arms_held_until_they_are_the_robots_again(served):
    served.ask("clear")
    driver = UnitreeDriver(ROBOT, domain=DOMAIN)
    recording = Controller(driver, ROBOT, SLOW, SAFETY).run(lambda k, state: ROBOT.qpos_home if k < 10 else None)
    assert recording.fault is None
    heard = served.ask("heard")
    arms = ROBOT.index(recording.commanded)
    assert (np.array(heard["kp"])[:, arms] > 0).all(), "no damping: the arms would sink"
    assert heard["weight"][-1] == 0.0
    sunk = recording.rows[-1].state.qpos - recording.rows[0].state.qpos
    assert np.abs(sunk).max() < 0.05


def test_a_policy_that_crashes_leaves_a_damped_robot(served):
    served.ask("clear")

    def crash():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(crash)
    time.sleep(0.3)
    kp = np.array(served.ask("heard")["kp"])
    damped = (kp == 0).all(axis=1)
    assert damped.sum() >= 3, "SLOW damps for three periods"
    assert (np.diff(damped.astype(int)) >= 0).all()


PREPARING = """
import sys, time
from robots.control.test_faults import ROBOT, SAFETY, SLOW, swing
from gaponet_robots.control.controller import Controller
from gaponet_robots.drivers.unitree import UnitreeDriver
class Slow:
    def reset(self, target, payload_mass=None):
        print("preparing", flush=True)
        time.sleep(60)
Controller(UnitreeDriver(ROBOT, domain=int(sys.argv[1])), ROBOT, SLOW, SAFETY, Slow()).run(lambda k, state: swing(k))
"""


def test_a_controller_killed_while_its_compensator_prepares_has_sent_nothing_and_its_guard_neither(served):
    served.ask("clear")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    process = subprocess.Popen(
        [sys.executable, "-c", PREPARING, str(DOMAIN)], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    assert process.stdout.readline() == "preparing\n"
    process.kill()
    process.wait()
    time.sleep(1.5)
    assert served.ask("heard")["time"] == []


CONTROLLER = """
import sys
from robots.control.test_faults import ROBOT, SAFETY, SLOW, swing
from gaponet_robots.control.controller import Controller
from gaponet_robots.drivers.unitree import UnitreeDriver
Controller(UnitreeDriver(ROBOT, domain=int(sys.argv[1])), ROBOT, SLOW, SAFETY).run(lambda k, state: swing(k))
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_a_controller_that_dies_or_hangs_leaves_a_damped_robot(served, how):
    served.ask("clear")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    process = subprocess.Popen([sys.executable, "-c", CONTROLLER, str(DOMAIN)], env=environment)
    try:
        wait(lambda: len(served.ask("heard")["kp"]) > 10)
        with pytest.raises(UsageError, match="another process commands this robot"):
            run(lambda: None)
        process.send_signal(how)
        wait(lambda: not np.any(served.ask("heard")["kp"][-1]))
        heard = served.ask("heard")
        stiff = np.any(heard["kp"], axis=1)
        assert (np.diff(stiff.astype(int)) <= 0).all()
        wait(lambda: served.ask("heard")["weight"][-1] < 0.05)  # in the end the arms are handed back
        process.send_signal(signal.SIGCONT)  # who comes back from standing still has nothing more to say
        process.wait(20)
        time.sleep(0.3)
        assert not np.any(served.ask("heard")["kp"][-1])
    finally:
        process.kill()
        process.wait()


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


def test_legs_are_commanded_only_when_asked_for_on_lowcmd():
    assert not any("hip" in j or "knee" in j or "ankle" in j for j in UnitreeDriver(ROBOT, "lowcmd").commanded)
    with pytest.raises(UsageError, match="does not take the legs"):
        UnitreeDriver(ROBOT, "arm_sdk", "all")
