"""The watchdog's process beside a robot that notes how it is damped, and the controller's end of
it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hw.noted_arm import DT, MOTION, NotedArm, acting, control, phases

from gaponet.hw.control import watchdog
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.stop import STOP_SIGNALS
from gaponet.hw.control.watchdog import WEIGHT_STEPS, Watchdog
from gaponet.hw.targets.policy import motion_policy

# S.
PATIENT = 20.0
HANG = 0.5
DAMP = 0.1

ROBOT = """
import json, sys, time
from pathlib import Path
from gaponet.hw.control import watchdog
from gaponet.hw.drivers import open as drivers

class Robot:
    address = "a robot"
    def __init__(self, notes):
        self.notes = open(notes, "w")
    def connect(self): ...
    def damp(self, weight, share):
        print(time.monotonic(), weight, file=self.notes, flush=True)
    def confirm(self):
        return "let go"
    def close(self, hold=False):
        print("closed, held" if hold else "# closed", file=self.notes, flush=True)

drivers.open_driver = Robot
watchdog.main(json.loads(sys.argv[1]))
"""


def robot_command(_: str, text: str) -> list[str]:
    """The command of a watchdog's process beside the robot that notes how it is damped."""
    return [sys.executable, "-c", ROBOT, text]


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    return tmp_path / "notes"


@pytest.fixture
def dog(
    notes: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Watchdog]:
    """A watchdog in a process of its own that could damp the robot; its parameter is after how
    many s it does.
    """
    monkeypatch.setattr(watchdog.child_process, "module_command", robot_command)
    lock = os.open(notes.with_suffix(".lock"), os.O_CREAT | os.O_RDWR)
    fcntl.flock(lock, fcntl.LOCK_EX)
    dog = Watchdog({"notes": str(notes)}, lock, getattr(request, "param", PATIENT), DAMP)
    os.close(lock)
    dog.wait_ready()
    yield dog
    dog.process.kill()
    dog.process.wait()


@pytest.fixture
def robot_process(notes: Path) -> Iterator[Callable[[int], subprocess.Popen[bytes]]]:
    """Starts a watchdog's process with some stderr; it is ready to damp."""
    started: list[subprocess.Popen[bytes]] = []

    def start(stderr: int) -> subprocess.Popen[bytes]:
        spec = json.dumps({"notes": str(notes), "timeout": PATIENT, "damp": DAMP})
        process = subprocess.Popen(
            [sys.executable, "-c", ROBOT, spec],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            bufsize=0,
        )
        started.append(process)
        assert process.stdout.read(1) == watchdog.READY
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


hanging = pytest.mark.parametrize("dog", [HANG], indirect=True)


def damped(notes: Path) -> np.ndarray:
    """Times (monotonic, s) and weights with which the robot was damped, (k, 2)."""
    return np.loadtxt(notes, ndmin=2)


def beat(dog: Watchdog, weight: float) -> None:
    """Beat, and wait until the watchdog has answered it."""
    assert dog.beat(weight)
    while dog.unanswered_since is not None and not dog.problem():
        time.sleep(0.001)


def test_a_robot_is_damped_with_the_last_weight_that_was_commanded(dog, notes):
    beat(dog, 0.1)
    # Two beats that are read at once.
    dog.process.stdin.write(bytes([round(WEIGHT_STEPS * weight) for weight in (0.2, 0.8)]))
    dog.release(unconfirmed=True)
    dog.process.wait(20)
    weights = damped(notes)[:, 1]
    assert weights[0] == pytest.approx(0.8, abs=0.02), "what the robot still held goes on holding"
    assert weights[-1] == 0.0
    assert (np.diff(weights) <= 0).all()


def test_it_holds_the_controllers_lock_until_its_end(dog, notes):
    with open(notes.with_suffix(".lock")) as file:
        with pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        dog.release()
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_a_watchdog_without_any_heartbeat_sends_nothing(dog, notes):
    dog.release(unconfirmed=True)
    assert dog.process.wait(20) == 0
    assert notes.read_text() == "closed, held\n"


def test_signals_that_ask_to_stop_end_the_controller_and_not_its_watchdog(dog, notes):
    beat(dog, 1.0)
    for number in STOP_SIGNALS:
        os.kill(dog.process.pid, number)
        beat(dog, 1.0)
        assert dog.problem() == ""
    dog.release()
    assert dog.process.wait(20) == 0
    assert notes.read_text() == "closed, held\n"


@hanging
def test_a_watchdog_that_hangs_is_in_trouble_and_only_from_the_first_beat_on(dog):
    os.kill(dog.process.pid, signal.SIGSTOP)
    time.sleep(1.2 * HANG)
    assert dog.problem() == ""
    for _ in range(1000):
        dog.beat(1.0)
        if dog.problem():
            break
        time.sleep(HANG / 20)
    assert dog.problem() == "the watchdog does not answer"
    assert not dog.can_damp(), "nobody is told to trust it"
    os.kill(dog.process.pid, signal.SIGCONT)


@hanging
def test_a_watchdog_that_took_the_controller_for_hanging_says_so(dog, notes):
    beat(dog, 1.0)
    dog.process.wait(20)
    assert dog.fired()
    assert dog.problem() == "the watchdog ended"
    assert not dog.beat(1.0)
    assert damped(notes)[0, 1] == 1.0


@hanging
def test_a_watchdog_that_took_the_robot_before_it_was_released_is_not_overlooked(dog):
    beat(dog, 1.0)
    dog.process.wait(20)
    dog.release()
    assert dog.fired()
    assert dog.can_damp(), "it has done so"


@pytest.mark.parametrize("stops", [False, True])
def test_a_run_beside_a_watchdog_of_its_own_ends_held_and_a_stop_damped(
    arm, notes, monkeypatch, stops
):
    monkeypatch.setattr(watchdog.child_process, "module_command", robot_command)
    monkeypatch.setattr("gaponet.hw.control.controller.WATCHDOG_PERIODS", PATIENT / DT)
    driver = NotedArm(arm)
    driver.watchdog = lambda: {"notes": str(notes)}
    controller = control(driver)
    policy = acting(lambda: controller.stop("enough")) if stops else motion_policy(MOTION, DT)
    recording = controller.run(policy)
    assert phases(recording)[-1] == "stopped"
    assert driver.closed == [not stops]
    assert controller.output.watchdog.process.wait(20) == 0
    assert notes.read_text() == "closed, held\n", "it sent nothing"


def test_what_a_watchdog_does_is_said(notes, robot_process):
    process = robot_process(subprocess.PIPE)
    os.write(process.stdin.fileno(), bytes([WEIGHT_STEPS]))
    process.stdin.close()
    said = process.stderr.read().decode()
    process.stderr.close()
    assert "the controller ended; damping a robot" in said
    assert "a robot let go" in said


@pytest.mark.parametrize("reader", ["a full disk", "one that has ended", "one that hangs"])
def test_a_watchdog_whose_messages_nobody_takes_damps_all_the_same(notes, robot_process, reader):
    if reader == "a full disk":
        stderr = os.open("/dev/full", os.O_WRONLY)
    else:
        out, stderr = os.pipe()
        if reader == "one that has ended":
            os.close(out)
        else:
            os.set_blocking(stderr, False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(stderr, bytes(4096))
            os.set_blocking(stderr, True)
    process = robot_process(stderr)
    os.write(process.stdin.fileno(), bytes([WEIGHT_STEPS]))
    process.stdin.close()
    assert process.wait(20) == 0
    assert damped(notes)[-1, 1] == 0.0


def test_without_stderr_no_message_reaches_the_robots_connection(notes):
    spec = json.dumps({"notes": str(notes), "timeout": PATIENT, "damp": DAMP})
    line = [sys.executable, "-c", ROBOT, spec]
    process = subprocess.run(
        ["/bin/sh", "-c", 'exec "$@" 2>&-', "sh", *line], input=bytes([WEIGHT_STEPS]), check=True
    )
    assert process.returncode == 0
    assert damped(notes)[-1, 1] == 0.0


@pytest.mark.parametrize("dog", [HANG], indirect=True)
def test_a_controller_that_comes_back_does_not_end_a_watchdog_that_damps(dog, notes, monkeypatch):
    monkeypatch.setattr(watchdog, "END_TIMEOUT_S", 0.01)
    beat(dog, 1.0)
    os.kill(dog.process.pid, signal.SIGSTOP)
    time.sleep(1.2 * HANG)
    os.kill(dog.process.pid, signal.SIGCONT)
    while not dog.fired():
        time.sleep(0.001)
    assert dog.is_damping()
    dog.release()
    dog.release()
    assert dog.process.wait(20) == 0
    assert damped(notes)[-1, 1] == 0.0


class LooseRobot:
    """A robot in simulated time of which some calls fail."""

    address = "/dev/loose"

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **fails: object) -> None:
        """fails: method → numbers of its calls that fail; None: all."""
        self.now = 0.0
        self.fails = fails
        self.calls = []
        self.counts = Counter()
        clock = SimpleNamespace(
            monotonic=lambda: self.now, sleep=lambda s: setattr(self, "now", self.now + s)
        )
        monkeypatch.setattr(watchdog, "time", clock)

    def __getattr__(self, name: str):
        def call(*values: float, hold: bool = False) -> str:
            self.calls.append((name, *values))
            self.counts[name] += 1
            if name in self.fails and (
                self.fails[name] is None or self.counts[name] in self.fails[name]
            ):
                raise (RuntimeError if name == "damp" else DriverError)(f"{name} failed")
            return "let go"

        return call


def test_what_fails_is_tried_again_until_the_robot_is_damped(monkeypatch):
    robot = LooseRobot(monkeypatch, damp=(2, 3), confirm=(1, 2))
    said: list[str] = []
    watchdog.damp_robot(robot, 0.1, 0.5, said.append)
    assert (robot.counts["confirm"], robot.counts["close"]) == (3, 1)
    weights = [values[0] for name, *values in robot.calls if name == "damp"]
    assert weights[0] == 0.5
    assert weights[-1] == 0.0
    assert "could NOT be damped: switch the supply off (damp failed); trying again" in said[0]
    assert "(confirm failed)" in said[1]
    assert said[2:] == ["watchdog: /dev/loose let go"]


def test_a_watchdog_gives_up_after_ten_minutes_and_not_before(monkeypatch):
    robot = LooseRobot(monkeypatch, confirm=None)
    said: list[str] = []
    watchdog.damp_robot(robot, 2.0, 1.0, said.append)
    assert 600 < robot.now < 601
    assert robot.counts["close"] == 1
    assert "gave up after 600 s; switch the supply off" in said[-1]


def test_a_failure_is_reported_once_although_the_age_in_its_text_changes(monkeypatch):
    robot = LooseRobot(monkeypatch)
    said: list[str] = []

    def damp(weight: float, share: float) -> None:
        raise DriverError(f"nothing was heard of the robot for {robot.now:.1f} s")

    robot.damp = damp
    watchdog.damp_robot(robot, 2.0, 1.0, said.append)
    assert sum("trying again" in text for text in said) == 1


@pytest.mark.parametrize(
    ("words", "damped"), [((b"\x64", b"\xc8"), True), ((b"\x64", b"\xff"), False)]
)
def test_a_watchdog_waits_for_the_next_heartbeat_as_long_as_it_is_told_and_then_damps(
    monkeypatch, words, damped
):
    """Without time: the pipes are lists, and the wait for a heartbeat is what select is given."""
    robot = LooseRobot(monkeypatch)
    waits = []
    said = []
    heartbeats = iter(words)

    def wait(reads, _, __, timeout):
        waits.append(timeout)
        return (reads if len(waits) <= len(words) else [], [], [])

    monkeypatch.setattr("gaponet.hw.drivers.open.open_driver", lambda **spec: robot)
    monkeypatch.setattr(watchdog.select, "select", wait)
    monkeypatch.setattr(watchdog.os, "read", lambda *_: next(heartbeats))
    monkeypatch.setattr(watchdog.os, "write", lambda to, word: to == 1 and said.append(word))
    monkeypatch.setattr(watchdog.signal, "signal", lambda *_: None)
    watchdog.main({"timeout": HANG, "damp": DAMP})
    assert waits == [None, HANG, HANG][: len(waits)], "before the first one it waits for ever"
    assert said == [
        watchdog.READY,
        watchdog.ANSWER,
        *([watchdog.ANSWER, watchdog.FIRED] if damped else []),
    ]
    assert [values[0] for name, *values in robot.calls if name == "damp"][:1] == (
        [1.0] if damped else []
    )


def test_a_watchdog_that_cannot_reach_the_robot_is_an_error(notes, monkeypatch):
    monkeypatch.setattr(
        watchdog.child_process,
        "module_command",
        lambda *_: [sys.executable, "-c", "raise SystemExit"],
    )
    with open(os.devnull) as lock, pytest.raises(DriverError, match="reach"):
        Watchdog({}, lock.fileno(), HANG, DAMP).wait_ready()


@pytest.mark.faults
@pytest.mark.parametrize("dies", [False, True], ids=["silent", "ended"])
@hanging
def test_the_time_from_the_last_sign_of_life_to_damping_is_bounded(dog, notes, dies):
    beat(dog, 1.0)
    last = time.monotonic()
    if dies:
        dog.release(unconfirmed=True)
    dog.process.wait(20)
    first = damped(notes)[0, 0] - last
    assert (0.0 if dies else 0.9 * HANG) < first < (0.2 if dies else HANG + 0.2)
