"""A second process that damps the robot if the controller dies or hangs.

It damps as after a fault that is not the robot's own, and goes on until the robot confirms it, for RETRY at most.
The controller sends it a byte every period through a pipe, from just before its first command on: the weight of that
command. The pipe closes when the controller's process ends, however it ends (kill -9 too), and no byte comes when it
hangs. If no byte ever came, nothing was commanded, and nothing is sent. It answers each byte with one of its own, so
that the controller notices a watchdog that hangs. It holds the controller's lock as long as it lives, so no other
controller starts while it damps.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from typing import Any

from gaponet.base import child_process
from gaponet.hw.control.driver import Driver, DriverError

RELEASE = b"\xff"
READY, ANSWER, FIRED = b"\x01", b"\x02", b"\x03"  # what the watchdog says, one byte each
STEPS = 200  # a beat is a weight in these parts of 1
RETRY = 600.0  # s for which it tries to damp a robot that does not confirm it
EVERY, AGAIN = 0.01, 0.1  # s between two messages, and after one that failed


class Watchdog:
    """The controller's end."""

    def __init__(self, spec: dict[str, object], lock: int, hang: float, damp: float) -> None:
        """
        Args:
            spec: What the driver says of itself (Driver.watchdog).
            lock: Descriptor of the controller's lock.
            hang: s without a sign of life after which it damps, and without an answer after which it counts as hanging.
            damp: s for which it damps.
        """
        text = json.dumps(spec | {"hang": hang, "damp": damp})
        self._process = subprocess.Popen(
            child_process.module_command("gaponet.hw.control.watchdog", text),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(lock,), start_new_session=True, bufsize=0,
        )  # fmt: skip
        assert self._process.stdin
        assert self._process.stdout
        self._in, self._out = self._process.stdin, self._process.stdout
        for pipe in (self._in, self._out):
            os.set_blocking(pipe.fileno(), False)
        self._fired, self._hang = False, hang
        self._answered: float | None = None  # monotonic s of the last answer, or of the first beat; None before it

    def wait_ready(self, timeout: float = 20.0) -> None:
        """Return when it could damp.

        Raises:
            DriverError: It could not reach the robot.
        """
        ready, _, _ = select.select([self._out], [], [], timeout)
        if not ready or self._out.read(1) != READY:
            self._process.kill()
            raise DriverError("the watchdog could not reach the robot; see its message above")

    def trouble(self) -> str:
        """Return why this watchdog cannot damp the robot, that it ended or does not answer; empty if it can."""
        if self.fired() or self._process.poll() is not None:
            return "the watchdog ended"
        silent = self._answered is not None and time.monotonic() - self._answered > self._hang
        return "the watchdog does not answer" if silent else ""

    def fired(self) -> bool:
        """Whether the watchdog damps the robot or has damped it: nothing more may be sent."""
        said = self._out.read(4096) or b""  # None: nothing new; does not wait
        if ANSWER in said:
            self._answered = time.monotonic()
        self._fired = self._fired or FIRED in said
        return self._fired

    def beat(self, weight: float) -> bool:
        """Say that the controller lives and has commanded the robot with this weight; False if the watchdog is gone."""
        if self._answered is None:
            self._answered = time.monotonic()
        try:
            self._in.write(bytes([round(STEPS * weight)]))
        except BlockingIOError:
            return True
        except (BrokenPipeError, ValueError):
            return False
        return self._process.poll() is None

    def release(self, loose: bool = False) -> None:
        """The controller has stopped; the watchdog ends without doing anything.

        Args:
            loose: Nobody confirmed that the robot is damped: the watchdog is left alone, and goes on trying.
        """
        try:
            os.set_blocking(self._in.fileno(), True)
            if not loose:
                self._in.write(RELEASE)
            self._in.close()
        except (BrokenPipeError, ValueError):
            pass
        self._out.close()
        if loose:
            return
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()


def main(spec: dict[str, Any]) -> None:
    """Watch stdin; damp when it falls silent or ends."""
    from gaponet.hw.control.stop import SIGNALS
    from gaponet.hw.drivers.open import open_driver

    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    hang, damp, early = spec.pop("hang"), spec.pop("damp"), spec.pop("early")
    driver = open_driver(**spec)
    if early:
        driver.connect()
    _say(READY)
    weight = None  # of the controller's last command; None: nothing was commanded
    while True:
        readable, _, _ = select.select([0], [], [], None if weight is None else hang)
        data = os.read(0, 4096) if readable else b""
        if not data or RELEASE in data:
            break
        weight = data[-1] / STEPS
        _say(ANSWER)
    if weight is None or RELEASE in data:
        driver.close(hold=True)
        return
    _say(FIRED)
    why = "ended" if readable else f"was silent for {hang * 1e3:.0f} ms"
    print(f"watchdog: the controller {why}; damping {driver.address}", file=sys.stderr, flush=True)
    _damp(driver, damp, weight, connected=early)


def _say(word: bytes) -> None:
    with contextlib.suppress(BrokenPipeError):  # a controller that was killed does not listen
        os.write(1, word)


def _damp(driver: Driver, seconds: float, weight: float, connected: bool) -> None:
    """Damp for some seconds from when the robot could be reached, until it confirms it; what fails is tried again."""
    began, since, said = time.monotonic(), None, ""
    tell = lambda text: print(f"watchdog: {driver.address} {text}", file=sys.stderr, flush=True)  # noqa: E731
    while True:
        now, wait = time.monotonic(), EVERY
        left = 1.0 if since is None else max(1.0 - (now - since) / seconds, 0.0)
        try:
            if not connected:
                driver.connect()
                connected = True
            driver.damp(weight * left, left)
            since = since or now
            if not left:
                tell(driver.confirm())
                break
        except (DriverError, OSError) as error:
            wait = AGAIN
            if str(error) != said:
                said = str(error)
                tell(f"could NOT be damped: switch the supply off ({said}); trying again")
            if time.monotonic() - began > RETRY:
                tell(f"could NOT be damped: gave up after {RETRY:g} s; switch the supply off")
                break
        time.sleep(wait)
    driver.close()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
