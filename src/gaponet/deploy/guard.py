"""A second process that damps the robot if the controller dies or hangs: `python -m gaponet.deploy.guard JSON`.

The controller sends it a byte every period through a pipe. The pipe closes when the controller's process ends, however
it ends (kill -9 too), and no byte comes when it hangs. It holds the controller's lock as long as it lives, so no
other controller starts while it damps.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from typing import Any

from gaponet.deploy.driver import Driver, DriverError

BEAT, RELEASE, READY = b".", b"x", b"ready"


class Guard:
    """The controller's end."""

    def __init__(self, spec: dict[str, object], lock: int, hang: float, damp: float) -> None:
        """
        Args:
            spec: Of the driver (Driver.guard).
            lock: Descriptor of the controller's lock.
            hang: s without a sign of life after which it damps.
            damp: s for which it damps.
        """
        text = json.dumps(spec | {"hang": hang, "damp": damp})
        self._process = subprocess.Popen(
            [sys.executable, "-m", "gaponet.deploy.guard", text],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(lock,), start_new_session=True, bufsize=0,
        )  # fmt: skip
        assert self._process.stdin
        assert self._process.stdout
        self._in, self._out = self._process.stdin, self._process.stdout
        os.set_blocking(self._in.fileno(), False)

    def wait_ready(self, timeout: float = 20.0) -> None:
        """Return when it could damp.

        Raises:
            DriverError: It could not reach the robot.
        """
        ready, _, _ = select.select([self._out], [], [], timeout)
        if not ready or READY not in self._out.readline():
            self._process.kill()
            raise DriverError("the guard process could not reach the robot; see its message above")

    def beat(self) -> bool:
        """Say that the controller lives; False if the guard does not."""
        try:
            self._in.write(BEAT)
        except BlockingIOError:
            return True
        except (BrokenPipeError, ValueError):
            return False
        return self._process.poll() is None

    def release(self) -> None:
        """The controller has damped and stopped; the guard ends without doing anything."""
        try:
            os.set_blocking(self._in.fileno(), True)
            self._in.write(RELEASE)
            self._in.close()
        except (BrokenPipeError, ValueError):
            pass
        self._out.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()


def main(spec: dict[str, Any]) -> None:
    """Watch stdin; damp when it falls silent or ends."""
    from gaponet.deploy.drivers.open import open_driver

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    hang, damp, early = spec.pop("hang"), spec.pop("damp"), spec.pop("early")
    driver = open_driver(**spec)
    if early:
        driver.connect()
    sys.stdout.buffer.write(READY + b"\n")
    sys.stdout.buffer.flush()
    begun = False
    while True:
        readable, _, _ = select.select([0], [], [], hang if begun else None)
        data = os.read(0, 4096) if readable else b""
        if RELEASE in data:
            driver.close()
            return
        if not data:
            break
        begun = True
    why = "ended" if readable else f"was silent for {hang * 1e3:.0f} ms"
    print(f"guard: the controller {why}; damping {driver.address}", file=sys.stderr, flush=True)
    if not early:
        driver.connect()
    _damp(driver, damp)


def _damp(driver: Driver, seconds: float) -> None:
    start = time.monotonic()
    while (passed := time.monotonic() - start) < seconds:
        driver.damp(1.0 - passed / seconds)
        time.sleep(0.01)
    driver.close()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
