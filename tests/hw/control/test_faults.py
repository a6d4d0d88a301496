"""Faults on real DDS: robot and controller in two processes, on loopback. What arrives at the robot is judged."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")

from hw.control.robot_process import RobotProcess

from gaponet.base.errors import UsageError
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.phases import ControlConfig, Phase
from gaponet.hw.control.publisher import sole_publisher
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import Limits, SafetyConfig
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

    return Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, config=SLOW, safety=SAFETY, watchdog=False).run(
        policy
    )


def steady(served: RobotProcess, attempt: Callable[[list[float]], Any], kind: str = "", tries: int = 8) -> Any:
    """What an attempt gives in which this machine kept time.

    A run that ended before the fault was there, or by a late period or an old state in its place, tells of this machine
    and not of the controller: again, and said. An attempt notes when it injects the fault, if it injects one.
    """
    for _ in range(tries):
        wait(is_free)  # of the watchdog of the last attempt
        served.ask("clear")
        injected: list[float] = []
        recording = attempt(injected)
        fault = recording.fault
        early = fault and kind and not (injected and fault.time > injected[0])
        if not early and not (fault and fault.kind in ("stale", "overrun") and fault.kind != kind):
            if fault and injected:
                passed = next((1e3 * (e.time - injected[0]) for e in recording.events if e.phase == Phase.DAMP), np.nan)
                print(f"{fault.kind}: damped {passed:.0f} ms after the fault, live, {SLOW.rate:g} Hz")
            return recording
        print(f"again: {fault.kind}, {fault.text}")
    pytest.fail(f"this machine is too busy: {tries} runs ended with {fault}")


def arms(heard: dict[str, list]) -> np.ndarray:
    """Stiffness that the robot heard, (commands, joints) without the torso, which is held while the arms damp."""
    return np.delete(np.array(heard["kp"]).reshape(-1, len(ROBOT.joint_names)), TORSO, axis=1)


def judge(recording: Recording, heard: dict[str, list]) -> None:
    """What the robot heard: never outside the limits, and once damped, damped for good."""
    arms = ROBOT.index(recording.commanded)
    ctrl, kp, _kd, _qvel = (np.array(heard[n])[:, arms] for n in ("ctrl", "kp", "kd", "qvel"))
    limits = Limits.of(ROBOT, recording.commanded, SAFETY)
    stiff = (kp > 0).all(axis=1)
    assert (stiff | (kp == 0).all(axis=1)).all()
    assert (np.diff(stiff.astype(int)) <= 0).all(), "a position command after damping"
    let_go = recording.fault is not None and recording.fault.kind == "obedience"  # held while the weight goes to 0
    assert heard["weight"][-1] == 0 if let_go else not stiff[-1]
    assert (ctrl[stiff] >= limits.low - 1e-6).all()
    assert (ctrl[stiff] <= limits.high + 1e-6).all()
    assert (np.abs(np.diff(ctrl[stiff], axis=0)) <= limits.speed * 0.1 + 1e-6).all()
    np.testing.assert_array_equal(np.array(heard["kp"])[:, :12], 0.0)  # legs are never commanded
    assert (np.array(heard["kp"])[:, TORSO] == ROBOT.kp[TORSO]).all(), "the torso is held"
    assert np.ptp(np.array(heard["ctrl"])[:, TORSO]) == 0, "where it was found"
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
        ("encoder", "frozen", 30), ("motor", "robot", 1), ("remote", "stop", 1), ("fall", "tilt", 1),
        ("machine", "robot", 1),
    ],
)  # fmt: skip
def test_a_fault_of_the_robot_ends_in_damp(served, fault, kind, periods):
    recording = steady(served, lambda injected: once(lambda: served.ask(f"fault {fault}"), injected), kind)
    assert recording.fault is not None
    # A joint that reads the same does not follow either: at 10 Hz the wide swing decides what is seen first.
    assert recording.fault.kind in ((kind, "obedience") if fault == "encoder" else (kind,)), recording.fault.text
    after = [r.state.time for r in recording.rows if r.phase == "run"][AT + 1 :]
    # Position commands between the fault and damping; a reading that stands still shows in states that come.
    assert (len(set(after)) if kind == "frozen" else len(after)) <= periods
    if fault == "encoder":
        require_command_near_frozen_encoder(recording, "left_elbow_joint")
    judge(recording, served.ask("heard"))


def require_command_near_frozen_encoder(recording: Recording, joint: str) -> None:
    """Once an encoder has stood still in four new states, no further command is more than 0.1 rad from where it froze.

    How long that takes depends on the swing's phase: the torque limit keeps commands near a reading that is frozen.
    """
    at, rows = ROBOT.index([joint])[0], [r for r in recording.rows if r.phase == "run"]
    rows = [b for a, b in itertools.pairwise(rows) if b.state.time > a.state.time]  # new states
    moved = np.flatnonzero(np.diff([r.state.qpos[at] for r in rows]))
    frozen_from = int(moved.max()) + 1
    command = np.array([r.ctrl[at] for r in rows])
    assert (np.abs(command[frozen_from + 3 : -1] - command[frozen_from - 1]) <= SAFETY.frozen_joint + 1e-6).all()


def test_a_step_of_the_robots_clock_is_no_fault_and_hides_none(served):
    """10 s ahead, and back again: the run goes on. Messages that cease are then seen as ever."""

    def attempt(injected: list[float]) -> Recording:
        def policy(k, state):
            word = {AT: "fault clock", AT + 5: "fault none", AT + 10: "fault clock", AT + 15: "fault stop"}.get(k)
            if k == AT + 15:
                injected.append(time.monotonic())
            if word:
                served.ask(word)
            return swing(k)

        return Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, config=SLOW, safety=SAFETY, watchdog=False).run(
            policy
        )

    recording = steady(served, attempt, "stale")
    assert recording.fault.kind == "stale", recording.fault.text
    assert 0 <= sum(r.phase == "run" for r in recording.rows) - (AT + 15 + 1) <= 2
    judge(recording, served.ask("heard"))


def test_a_g1_is_refused_and_hears_nothing(served):
    served.ask("clear")
    served.ask("machine 5")
    time.sleep(0.2)
    with pytest.raises(DriverError, match="not an H1-2: its mode_machine is 5, a G1's; nothing was sent"):
        once(lambda: None, [])
    assert served.ask("heard")["time"] == []
    served.ask("clear")


def test_a_stop_before_the_start_and_a_robot_that_is_never_ready_send_nothing(served):
    served.ask("clear")
    controller = Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, config=SLOW, safety=SAFETY)
    controller.stop("before the start")
    assert controller.run(lambda k, state: swing(k)).fault.kind == "stop"
    cold = SafetyConfig(acceleration=5.0, temperature=1.0)
    recording = Controller(UnitreeDriver(ROBOT, domain=DOMAIN), ROBOT, config=SLOW, safety=cold).run(
        lambda k, state: swing(k)
    )
    assert recording.fault.kind == "temperature"
    time.sleep(0.3)
    assert served.ask("heard")["time"] == []


CONTROLLER = """
import sys, time
from hw.control.test_faults import ROBOT, SAFETY, SLOW, swing
from gaponet.hw.control.controller import Controller
from gaponet.hw.drivers.unitree import UnitreeDriver
class Slow:
    def reset(self, target, payload_mass=None):
        print("preparing", flush=True)
        time.sleep(60)
driver, slow = UnitreeDriver(ROBOT, domain=int(sys.argv[1])), Slow() if "slow" in sys.argv else None
Controller(driver, ROBOT, config=SLOW, safety=SAFETY, compensator=slow).run(lambda k, state: swing(k))
"""


def test_a_controller_killed_while_its_compensator_prepares_has_sent_nothing_and_its_watchdog_neither(served):
    served.ask("clear")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(["tests", *sys.path])}
    process = subprocess.Popen(
        [sys.executable, "-c", CONTROLLER, str(DOMAIN), "slow"], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    assert process.stdout.readline() == "preparing\n"
    process.kill()
    process.wait()
    time.sleep(1.5)
    assert served.ask("heard")["time"] == []


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


def test_legs_are_commanded_only_when_asked_for_on_lowcmd():
    assert not any("hip" in j or "knee" in j or "ankle" in j for j in UnitreeDriver(ROBOT, "lowcmd").commanded)
    with pytest.raises(UsageError, match="does not take the legs"):
        UnitreeDriver(ROBOT, "arm_sdk", "all")
