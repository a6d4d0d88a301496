"""Watchdog: a second process that damps the robot if the controller dies or hangs.

In each period, from just before its first command on, the controller sends the watchdog a byte
through a pipe: the weight of that command. The watchdog answers each byte, so that the controller
notices a watchdog that hangs. The pipe closes when the controller's process ends, however it ends;
if it hangs, no byte comes for WATCHDOG_PERIODS of controller.py. Then the watchdog damps the robot,
as after a fault that is not the robot's own, until the robot confirms it, for at most MAX_RETRY_S.
Without any byte nothing was commanded, and the watchdog sends nothing. It holds the controller's
lock as long as it lives, so that no other controller starts while it damps.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from gaponet.base import child_process
from gaponet.hw.control.driver import Driver, DriverError

RELEASE = b"\xff"  # from the controller: it has stopped, and the watchdog ends
READY = b"\x01"  # from the watchdog, as the next two
ANSWER = b"\x02"
FIRED = b"\x03"
WEIGHT_STEPS = 200  # a heartbeat is the weight in steps of 1/200
MAX_RETRY_S = 600.0  # for which it tries to damp a robot that does not confirm it
DAMP_INTERVAL_S = 0.01  # between two damping messages
RETRY_INTERVAL_S = 0.1  # after a damping message that failed
READY_TIMEOUT_S = 20.0
END_TIMEOUT_S = 5.0
MESSAGES_TIMEOUT_S = 1.0  # at the end, for messages that nobody has read yet
STDERR = 2
NUMBER = re.compile(r"[\d.]+")


class Watchdog:
    """The controller's end.

    Attributes:
        process: The process that damps the robot.
        unanswered_since: When the first heartbeat without an answer was sent, s of time.monotonic;
            None: all are answered.
    """

    def __init__(self, spec: dict[str, object], lock: int, timeout: float, damp: float) -> None:
        """
        Args:
            spec: How to open the robot (Driver.watchdog).
            lock: Descriptor of the controller's lock.
            timeout: s without a heartbeat after which it damps, and without an answer after which
                it counts as hanging.
            damp: Duration of damping, s.
        """
        text = json.dumps(spec | {"timeout": timeout, "damp": damp})
        self.process = subprocess.Popen(
            child_process.module_command("gaponet.hw.control.watchdog", text),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(lock,),
            start_new_session=True,
            bufsize=0,
        )
        assert self.process.stdin
        assert self.process.stdout
        self._in = self.process.stdin
        self._out = self.process.stdout
        for pipe in (self._in, self._out):
            os.set_blocking(pipe.fileno(), False)
        self._fired = False
        self._timeout = timeout
        self.unanswered_since: float | None = None

    def wait_ready(self) -> None:
        """Return when it could damp the robot.

        Raises:
            DriverError: It could not reach the robot.
        """
        ready, _, _ = select.select([self._out], [], [], READY_TIMEOUT_S)
        if not ready or self._out.read(1) != READY:
            self.process.kill()
            raise DriverError("the watchdog could not reach the robot; see its message above")

    def problem(self) -> str:
        """Return why this watchdog cannot damp the robot: it ended or does not answer.

        Empty if it can.
        """
        if self.fired() or self.process.poll() is not None:
            return "the watchdog ended"
        return "the watchdog does not answer" if self._hangs() else ""

    def fired(self) -> bool:
        """Return True if the watchdog damps the robot or has damped it: nothing more may be
        sent.
        """
        if self._out.closed:
            return self._fired
        answer = self._out.read(4096) or b""  # None: nothing new; does not wait
        if ANSWER in answer:
            self.unanswered_since = None
        self._fired = self._fired or FIRED in answer
        return self._fired

    def beat(self, weight: float) -> bool:
        """Send a heartbeat with the weight of the command that follows.

        Return False if the watchdog has ended.
        """
        if self.unanswered_since is None:
            self.unanswered_since = time.monotonic()
        try:
            self._in.write(bytes([round(WEIGHT_STEPS * weight)]))
        except BlockingIOError:  # the pipe is full: the watchdog hangs; `problem` says so
            return True
        except (BrokenPipeError, ValueError):
            return False
        return self.process.poll() is None

    def can_damp(self) -> bool:
        """Return True unless the watchdog has died or hangs."""
        return self.process.poll() in (None, 0) and not self._hangs()

    def is_damping(self) -> bool:
        """Return True if the watchdog damps the robot, or has done so; False if it died of it."""
        return self.fired() and self.can_damp()

    def _hangs(self) -> bool:
        """Return True if it does not answer; while it damps it answers nothing."""
        if self.fired() or self.unanswered_since is None:
            return False
        return time.monotonic() - self.unanswered_since > self._timeout

    def release(self, unconfirmed: bool = False) -> None:
        """Let the watchdog end without sending anything: the controller has stopped.

        A watchdog that has begun to damp goes on. A second call does nothing.

        Args:
            unconfirmed: The robot is not known to be damped: the watchdog damps it and goes on
                trying.
        """
        if self._in.closed:
            return
        with contextlib.suppress(BrokenPipeError):
            os.set_blocking(self._in.fileno(), True)
            if not unconfirmed:
                self._in.write(RELEASE)
        with contextlib.suppress(BrokenPipeError):
            self._in.close()
        try:
            self.process.wait(0 if unconfirmed else END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            if not unconfirmed and not self.fired():
                self.process.kill()
        self.fired()  # the last look
        self._out.close()


def main(spec: dict[str, Any]) -> None:
    """Read heartbeats from stdin; damp the robot when they cease or stdin ends."""
    from gaponet.hw.control.stop import STOP_SIGNALS
    from gaponet.hw.drivers.open import open_driver

    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    timeout = spec.pop("timeout")
    damp = spec.pop("damp")
    _open_stderr()
    messages = Messages()
    driver = open_driver(**spec)
    driver.connect()
    _send(READY)
    weight = None  # of the controller's last command; None: nothing was commanded
    while True:
        readable, _, _ = select.select([0], [], [], None if weight is None else timeout)
        data = os.read(0, 4096) if readable else b""
        if not data or RELEASE in data:
            break
        weight = data[-1] / WEIGHT_STEPS
        _send(ANSWER)
    if weight is None or RELEASE in data:
        driver.close(hold=True)
        return
    _send(FIRED)
    why = "ended" if readable else f"was silent for {timeout * 1e3:.0f} ms"
    messages.say(f"watchdog: the controller {why}; damping {driver.address}")
    damp_robot(driver, damp, weight, messages.say)
    messages.finish()


def _open_stderr() -> None:
    """Let messages go nowhere where stderr is closed: the robot's connection would get its number,
    and the messages.
    """
    try:
        os.fstat(STDERR)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), STDERR)


class Messages:
    """Lines on stderr, written by a thread of their own.

    A full disk, a closed terminal or a pipe that nobody reads delays no damping.
    """

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    def say(self, line: str) -> None:
        """Write a line when stderr takes it."""
        self._lines.put(line)

    def finish(self) -> None:
        """Wait for the lines, but not for a reader that is not there."""
        self._lines.put(None)
        self._writer.join(MESSAGES_TIMEOUT_S)

    def _write(self) -> None:
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError):
                os.write(STDERR, f"{line}\n".encode())


def _send(word: bytes) -> None:
    with contextlib.suppress(BrokenPipeError):  # a controller that was killed does not listen
        os.write(1, word)


def damp_robot(driver: Driver, seconds: float, weight: float, say: Callable[[str], None]) -> None:
    """Damp for some seconds from the first success on, and until the robot confirms it.

    Retry what fails, and `say` so.
    """
    start = time.monotonic()
    damping_since = None
    last_failure = ""  # without its numbers: an age in it changes with each try

    def report(text: str) -> None:
        say(f"watchdog: {driver.address} {text}")

    while True:
        now = time.monotonic()
        wait = DAMP_INTERVAL_S
        left = 1.0 if damping_since is None else max(1.0 - (now - damping_since) / seconds, 0.0)
        try:
            driver.damp(weight * left, left)
            damping_since = damping_since or now
            if not left:
                report(driver.confirm())
                break
        except Exception as error:  # of any kind: try again
            wait = RETRY_INTERVAL_S
            failure = NUMBER.sub("", str(error))
            if failure != last_failure:
                last_failure = failure
                report(f"could NOT be damped: switch the supply off ({error}); trying again")
            if time.monotonic() - start > MAX_RETRY_S:
                report(
                    f"could NOT be damped: gave up after {MAX_RETRY_S:g} s; switch the supply off"
                )
                break
        time.sleep(wait)
    driver.close()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
