"""Clocks of a control loop. The wall clock is never used: it may be set while a robot moves."""

from __future__ import annotations

import gc
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Protocol

# Last part of a wait, spent in a busy loop: on a quiet Linux a sleep ends up to this much late.
SPIN_S = 0.0003

START_RANGE_S = (1e3, 1e6)  # of a simulated clock: computers are on for an hour or some days


class Clock(Protocol):
    """Monotonic time in s, and waiting for a time."""

    def now(self) -> float:
        """Return the s since some fixed moment."""

    def wait_until(self, deadline: float) -> float:
        """Return the time at or after an absolute deadline; at once if it has passed."""

    def suspended(self) -> float:
        """Return the s for which the computer was suspended since some fixed moment.

        `now` stood still meanwhile.
        """


class MonotonicClock:
    """The machine's monotonic clock, shared by all its processes."""

    def now(self) -> float:
        """Return the s since boot."""
        return time.monotonic()

    def wait_until(self, deadline: float) -> float:
        """Sleep until shortly before the deadline, then spin.

        Signal handlers run meanwhile and do not shorten it.
        """
        left = deadline - time.monotonic() - SPIN_S
        if left > 0:
            time.sleep(left)
        while (now := time.monotonic()) < deadline:
            pass
        return now

    def suspended(self) -> float:
        """Return the s since boot, on Linux; 0 where the operating system has no CLOCK_BOOTTIME."""
        if not hasattr(time, "CLOCK_BOOTTIME"):
            return 0.0
        # A process that is preempted between the two readings reads too little, never too much.
        return max(time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic() for _ in range(3))


class SimulatedClock:
    """Time that passes only in `wait_until`: a loop with a virtual robot runs as fast as it can.

    As on a real computer the time has no known start, so that code which mistakes a time for a
    duration fails.

    Attributes:
        seed: Of the start; drawn once in a process. Set it before clocks are made to repeat their
            starts.
        start: Time at which the clock began, s.
        suspended_s: What `suspended` returns.
    """

    seed: ClassVar[int] = random.SystemRandom().randrange(2**32)

    def __init__(self, start: float | None = None) -> None:
        """Start at a given time, s, or at one that follows from the seed."""
        if start is None:
            start = random.Random(self.seed).uniform(*START_RANGE_S)
        self.start = start
        self._now = start
        self.suspended_s = 0.0

    def now(self) -> float:
        """Return the simulated time, s."""
        return self._now

    def wait_until(self, deadline: float) -> float:
        """Advance to the deadline, s."""
        self._now = max(self._now, deadline)
        return self._now

    def advance(self, seconds: float) -> None:
        """Let some time pass outside `wait_until`, as code that takes long does."""
        self._now += seconds

    def suspended(self) -> float:
        """Return `suspended_s`."""
        return self.suspended_s


class Periods:
    """Control periods of a run: equally long; those that are missed are left out.

    Attributes:
        number: Of the present period.
        now: When it began, s.
        due: When the period after the last one should have begun, s. It is the present period,
            unless periods were missed.
    """

    def __init__(self, clock: Clock, dt: float) -> None:
        """dt: Control period, s."""
        self.number = 0
        self.now = 0.0
        self.due = 0.0
        self._clock = clock
        self._dt = dt
        self._start = 0.0  # of the first period, s
        self._due_number = 0  # of the period that is due; `number` skips those that were missed
        self._suspended_before = 0.0  # s

    def begin(self) -> None:
        """Begin the first period now."""
        self._start = self._clock.now()
        self.now = self._start

    def forget_suspends(self) -> None:
        """Let `suspended` count from now on."""
        self._suspended_before = self._clock.suspended()

    def wait(self) -> float:
        """Wait for the present period; return how late it begins, s."""
        self.now = self._clock.wait_until(self._start + self.number * self._dt)
        self.due = self._start + self._due_number * self._dt
        return self.now - self.due

    def end(self) -> int:
        """End the present period; return the number of periods that were missed meanwhile."""
        passed = int((self._clock.now() - self._start) / self._dt) - self.number  # whole periods
        self._due_number = self.number + 1
        self.number += max(1, passed)
        return max(passed - 1, 0)

    def suspended(self) -> float:
        """Return the s for which the computer was suspended."""
        return self._clock.suspended() - self._suspended_before


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Disable the garbage collector inside the block.

    One pass stands still for 13 ms or more, longer as a recording grows. Reference counts free what
    a period leaves.
    """
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
