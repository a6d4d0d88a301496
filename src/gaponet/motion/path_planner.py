"""Collision-free paths from one posture to another: straight or by way of home."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.motion.motion import PEAK_ACCELERATION, blend, move_time
from gaponet.robot.collision import POSTURE_STEP_RAD

Free = Callable[[Array], bool]  # whether all postures (T, n) rad are
_T = TypeVar("_T")
Search = Generator[None, None, _T]  # works in steps of about a millisecond, one per next()

MIN_LEG_S = 0.5  # of one leg of several
ROWS_PER_STEP = 16  # postures that one step of a search checks


@dataclass(frozen=True)
class Trajectory:
    """Minimum-jerk moves from point to point, at rest at each."""

    points: Array  # (k, n) rad
    times: Array  # when each is reached, (k,) s; the first is 0

    @classmethod
    def minimum_jerk(
        cls, points: Array, speed: float, acceleration: float, least: float
    ) -> Trajectory:
        """Return the fastest trajectory within limits.

        Args:
            points: (k, n) rad.
            speed: Peak speed, rad/s.
            acceleration: Peak acceleration, rad/s².
            least: Least duration, s.
        """
        far = np.abs(np.diff(points, axis=0)).max(axis=1)  # of the joint that goes furthest, rad
        shortest = least if len(points) == 2 else MIN_LEG_S
        by_speed = move_time(far, speed, shortest)
        by_acceleration = np.sqrt(PEAK_ACCELERATION * far / acceleration)
        legs = np.maximum(by_speed, by_acceleration)  # s
        times = np.concatenate([[0.0], legs.cumsum()])
        return cls(points, times * max(1.0, least / times[-1]))

    @property
    def duration(self) -> float:
        """s."""
        return float(self.times[-1])

    def at(self, time: float) -> Array:
        """Return the posture at a time, (n,) rad."""
        last_leg = len(self.times) - 2
        leg = int(np.searchsorted(self.times, time)) - 1
        leg = min(max(leg, 0), last_leg)
        start, stop = self.points[leg : leg + 2]
        since, until = self.times[leg : leg + 2]
        share = np.array((time - since) / (until - since))
        result: Array = start + float(blend(share)) * (stop - start)
        return result

    def rows(self, dt: float) -> Array:
        """Return postures at a period of dt s, both ends included, (T, n) rad."""
        steps = max(1, round(self.duration / dt))
        return np.array([self.at(self.duration * k / steps) for k in range(steps + 1)])


def line(a: Array, b: Array) -> Array:
    """Return postures (T, n) rad from a to b, both included, at most POSTURE_STEP_RAD apart."""
    steps = int(np.ceil(np.abs(b - a).max() / POSTURE_STEP_RAD))
    return np.linspace(a, b, max(1, steps) + 1)


def finish_search(search: Search[_T]) -> _T:
    """Run a search to its end and return its result."""
    while True:
        try:
            next(search)
        except StopIteration as end:
            result: _T = end.value
            return result


def find_points(free: Free, start: Array, goal: Array, home: Array) -> Search[Array | None]:
    """Return points (k, n) rad of a free path from start to goal, straight if possible, else by way
    of home.

    None if neither is free. Nothing else is tried: a person decides how a robot gets out of a
    place.

    Args:
        start, goal, home: (n,) rad.
    """

    def straight(a: Array, b: Array) -> Search[bool]:
        rows = line(a, b)
        for at in range(0, len(rows), ROWS_PER_STEP):
            if not free(rows[at : at + ROWS_PER_STEP]):
                return False
            yield
        return True

    if (yield from straight(start, goal)):
        return np.stack([start, goal])
    if (yield from straight(start, home)) and (yield from straight(home, goal)):
        return np.stack([start, home, goal])
    return None
