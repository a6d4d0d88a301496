"""Ways from one posture to another that keep clear: straight where that is free, else around what is in between."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.collision import POSTURE_STEP_RAD
from gaponet.sysid.motion.motion import PEAK_ACCELERATION, blend, move_time

Free = Callable[[Array], bool]  # whether all postures (T, n) rad are
_T = TypeVar("_T")
Search = Generator[None, None, _T]  # looks for something in steps of a millisecond or so, one per next()
_Straight = Callable[[Array, Array], Search[bool]]

REACH = 0.5  # rad by which a tree grows at once
GROWTHS = 250  # before it is given up
CUTS = 60  # attempts to cut a corner
LEG = 0.5  # s, the least duration of one leg of several
ROWS = 16  # postures that are looked at in one step of a search


@dataclass(frozen=True)
class Trajectory:
    """Minimum-jerk moves from point to point, at rest at each.

    Attributes:
        points: (k, n) rad.
        times: When each is reached, (k,) s; the first is 0.
    """

    points: Array
    times: Array

    @classmethod
    def minimum_jerk(cls, points: Array, speed: float, acceleration: float, least: float) -> Trajectory:
        """The way as fast as peaks of speed (rad/s) and acceleration (rad/s²) allow, in at least `least` s."""
        far = np.abs(np.diff(points, axis=0)).max(axis=1)
        legs = move_time(far, speed, least if len(points) == 2 else LEG)
        legs = np.maximum(legs, np.sqrt(PEAK_ACCELERATION * far / acceleration))
        times = np.concatenate([[0.0], legs.cumsum()])
        return cls(points, times * max(1.0, least / times[-1]))

    @property
    def duration(self) -> float:
        """s."""
        return float(self.times[-1])

    def at(self, time: float) -> Array:
        """Posture (n,) rad."""
        leg = min(max(int(np.searchsorted(self.times, time)) - 1, 0), len(self.times) - 2)
        (a, b), (since, until) = self.points[leg : leg + 2], self.times[leg : leg + 2]
        return a + float(blend(np.array((time - since) / (until - since)))) * (b - a)

    def rows(self, dt: float) -> Array:
        """(T, n) rad at a period of dt s, both ends included."""
        steps = max(1, round(self.duration / dt))
        return np.array([self.at(self.duration * k / steps) for k in range(steps + 1)])


def line(a: Array, b: Array) -> Array:
    """Postures from a to b (n,) rad, both included, none further than FINE from the next, (T, n)."""
    return np.linspace(a, b, max(2, int(np.ceil(np.abs(b - a).max() / POSTURE_STEP_RAD)) + 1))


def finish_search(search: Search[_T]) -> _T:
    """Run a search to its end and return its result."""
    while True:
        try:
            next(search)
        except StopIteration as end:
            return end.value


def find_points(
    free: Free, start: Array, goal: Array, low: Array, high: Array, home: Array, seed: int = 0
) -> Search[Array | None]:
    """Points (k, n) rad of a polygon from start to goal along which all is free, or None where none was found.

    Straight if possible, else by way of home, else by two random trees that grow towards each other (RRT-Connect,
    Kuffner & LaValle 2000), with corners cut.

    Args:
        start, goal, home: (n,) rad.
        low, high: Where to search, (n,) rad; a joint with equal bounds is not moved.
    """

    def straight(a: Array, b: Array) -> Search[bool]:
        rows = line(a, b)
        for at in range(0, len(rows), ROWS):
            if not free(rows[at : at + ROWS]):
                return False
            yield
        return True

    if (yield from straight(start, goal)):
        return np.stack([start, goal])
    if (yield from straight(start, home)) and (yield from straight(home, goal)):
        return np.stack([start, home, goal])
    rng = np.random.default_rng(seed)
    points = yield from _connect(straight, start, goal, low, high, rng)
    return None if points is None else (yield from _cut(straight, points, rng))


def _connect(
    straight: _Straight, start: Array, goal: Array, low: Array, high: Array, rng: np.random.Generator
) -> Search[list[Array] | None]:
    trees = [([start], [-1]), ([goal], [-1])]  # postures, and from which each was reached
    for growth in range(GROWTHS):
        (here, came), (there, _) = trees
        reached = yield from _grow(straight, here, came, rng.uniform(low, high), once=growth % 8 > 0)
        if reached is not None:
            met = yield from _grow(straight, there, trees[1][1], here[reached], once=False)
            if met is not None and np.abs(there[met] - here[reached]).max() < 1e-9:
                halves = [_back(*tree, at) for tree, at in zip(trees, (reached, met), strict=True)]
                if growth % 2:
                    halves.reverse()
                return [*halves[0][::-1], *halves[1][1:]]
        trees.reverse()
    return None


def _grow(straight: _Straight, tree: list[Array], came: list[int], aim: Array, once: bool) -> Search[int | None]:
    """Grow a tree towards `aim`, once or as far as it goes; where it got to, None if nowhere."""
    at = int(np.argmin(np.abs(np.array(tree) - aim).max(axis=1)))
    reached = None
    while (far := float(np.abs(aim - tree[at]).max())) > 1e-9:
        step = tree[at] + min(1.0, REACH / far) * (aim - tree[at])
        if not (yield from straight(tree[at], step)):
            break
        tree.append(step)
        came.append(at)
        reached = at = len(tree) - 1
        if once:
            break
    return reached


def _back(tree: list[Array], came: list[int], at: int) -> list[Array]:
    """From a node to the root."""
    found = []
    while at >= 0:
        found.append(tree[at])
        at = came[at]
    return found


def _cut(straight: _Straight, points: list[Array], rng: np.random.Generator) -> Search[Array]:
    """The same with corners cut."""
    for _ in range(CUTS):
        if len(points) == 2:
            break
        i, k = sorted(rng.choice(len(points), 2, replace=False))
        if k - i > 1 and (yield from straight(points[i], points[k])):
            points = [*points[: i + 1], *points[k:]]
    return np.array(points)
