"""Clocks of a control loop. The wall clock is never asked: it may be set while a robot moves."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

SPIN = 0.0003  # s: the last part of a wait is spent awake, since a sleep ends up to this much late on a quiet Linux


class Clock(Protocol):
    """Seconds that only grow, and waiting for one of them."""

    def now(self) -> float:
        """s since some fixed moment."""

    def wait_until(self, deadline: float) -> float:
        """Return at an absolute time, or at once if it has passed; gives the time of return."""

    def suspended(self) -> float:
        """s for which the computer was suspended, since some fixed moment; `now` stood still meanwhile."""


class MonotonicClock:
    """The machine's monotonic clock, shared by all processes of one machine."""

    def now(self) -> float:
        """s since boot."""
        return time.monotonic()

    def wait_until(self, deadline: float) -> float:
        """Sleep to shortly before the deadline, then spin. Signal handlers run meanwhile and do not shorten it."""
        left = deadline - time.monotonic() - SPIN
        if left > 0:
            time.sleep(left)
        while (now := time.monotonic()) < deadline:
            pass
        return now

    def suspended(self) -> float:
        """s since boot, on Linux; 0 where the operating system has no CLOCK_BOOTTIME."""
        if not hasattr(time, "CLOCK_BOOTTIME"):
            return 0.0
        # A process that is preempted between the two readings reads too little, never too much.
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic() for _ in range(3))


@contextmanager
def uncollected() -> Iterator[None]:
    """No garbage collection inside: one pass over all objects stands still for 13 ms or more, and for longer the longer
    a recording is. What a period leaves behind is freed all the same, by reference counts."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class SimulatedClock:
    """Time that passes only where somebody waits: a loop against a virtual robot runs as fast as it can."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self.suspended_s = 0.0

    def now(self) -> float:
        """s."""
        return self._now

    def wait_until(self, deadline: float) -> float:
        self._now = max(self._now, deadline)
        return self._now

    def suspended(self) -> float:
        """What `suspended_s` was set to."""
        return self.suspended_s
