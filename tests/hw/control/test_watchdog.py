"""The watchdog's process beside a robot that notes how it is damped, and the controller's end of it."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gaponet.hw.control import watchdog
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.stop import SIGNALS
from gaponet.hw.control.watchdog import STEPS, Watchdog

PATIENT, HANG, DAMP = 20.0, 0.5, 0.1  # s

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
    def close(self, hold=False): ...

drivers.open_driver = Robot
watchdog.main(json.loads(sys.argv[1]))
"""


@pytest.fixture
def notes(tmp_path: Path) -> Path:
    return tmp_path / "notes"


@pytest.fixture
def dog(notes: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Watchdog]:
    """A watchdog in a process of its own that could damp the robot; its parameter is after how many s it does."""
    monkeypatch.setattr(watchdog.child_process, "module_command", lambda _, text: [sys.executable, "-c", ROBOT, text])
    lock = os.open(notes.with_suffix(".lock"), os.O_CREAT | os.O_RDWR)
    dog = Watchdog({"early": True, "notes": str(notes)}, lock, getattr(request, "param", PATIENT), DAMP)
    os.close(lock)
    dog.wait_ready()
    yield dog
    dog._process.kill()
    dog._process.wait()


hanging = pytest.mark.parametrize("dog", [HANG], indirect=True)


def damped(notes: Path) -> np.ndarray:
    """Times (monotonic, s) and weights with which the robot was damped, (k, 2)."""
    return np.loadtxt(notes, ndmin=2)


def beat(dog: Watchdog, weight: float) -> None:
    """Beat, and wait until the watchdog has answered it."""
    assert dog.beat(weight)
    before = dog._answered
    while dog._answered == before and not dog.trouble():
        time.sleep(0.001)


def test_a_robot_is_damped_with_the_last_weight_that_was_commanded(dog, notes):
    beat(dog, 0.1)
    dog._in.write(bytes([round(STEPS * weight) for weight in (0.2, 0.8)]))  # two beats that are read at once
    dog.release(loose=True)
    dog._process.wait(20)
    weights = damped(notes)[:, 1]
    assert weights[0] == pytest.approx(0.8, abs=0.02), "what the robot still held goes on holding"
    assert weights[-1] == 0.0
    assert (np.diff(weights) <= 0).all()


def test_signals_that_ask_to_stop_end_the_controller_and_not_its_watchdog(dog, notes):
    beat(dog, 1.0)
    for number in SIGNALS:
        os.kill(dog._process.pid, number)
        beat(dog, 1.0)
        assert dog.trouble() == ""
    dog.release()
    assert dog._process.wait(20) == 0
    assert notes.read_text() == ""


@hanging
def test_a_watchdog_that_hangs_is_in_trouble_and_only_from_the_first_beat_on(dog):
    os.kill(dog._process.pid, signal.SIGSTOP)
    time.sleep(1.2 * HANG)
    assert dog.trouble() == ""
    for _ in range(1000):
        dog.beat(1.0)
        if dog.trouble():
            break
        time.sleep(HANG / 20)
    assert dog.trouble() == "the watchdog does not answer"
    os.kill(dog._process.pid, signal.SIGCONT)


@hanging
def test_a_watchdog_that_took_the_controller_for_hanging_says_so(dog, notes):
    beat(dog, 1.0)
    dog._process.wait(20)
    assert dog.fired()
    assert dog.trouble() == "the watchdog ended"
    assert not dog.beat(1.0)
    assert damped(notes)[0, 1] == 1.0


def test_a_watchdog_gives_up_after_ten_minutes_and_not_before(monkeypatch, capsys):
    now = [0.0]
    sleep = lambda seconds: now.__setitem__(0, now[0] + seconds)  # noqa: E731
    monkeypatch.setattr(watchdog, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))

    def silent():
        raise DriverError("nothing was heard")

    robot = SimpleNamespace(
        address="a robot", damp=lambda weight, share: None, confirm=silent, close=lambda: None, connect=lambda: None
    )
    watchdog._damp(robot, 2.0, 1.0, connected=True)
    assert 600 < now[0] < 601
    assert "gave up after 600 s; switch the supply off" in capsys.readouterr().err


@pytest.mark.faults
@pytest.mark.parametrize("dies", [False, True], ids=["silent", "ended"])
@hanging
def test_the_time_from_the_last_sign_of_life_to_damping_is_bounded(dog, notes, dies):
    beat(dog, 1.0)
    last = time.monotonic()
    if dies:
        dog.release(loose=True)
    dog._process.wait(20)
    first = damped(notes)[0, 0] - last
    assert (0.0 if dies else 0.9 * HANG) < first < (0.2 if dies else HANG + 0.2)


@pytest.mark.faults
@hanging
def test_the_time_after_which_a_watchdog_that_hangs_is_noticed_is_bounded(dog):
    beat(dog, 1.0)
    os.kill(dog._process.pid, signal.SIGSTOP)
    stopped = time.monotonic()
    while not dog.trouble():
        dog.beat(1.0)
        time.sleep(HANG / 5)
    assert 0.9 * HANG < time.monotonic() - stopped < 1.2 * HANG + 0.2
