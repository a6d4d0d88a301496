"""Collision-free paths from one posture to another: straight, by way of home, or by random trees."""

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
_Straight = Callable[[Array, Array], Search[bool]]

TREE_STEP_RAD = 0.5  # growth of a tree in one step
MAX_GROWTHS = 250  # of both trees
SHORTCUT_ATTEMPTS = 60  # at corners of the path
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
        """Return the fastest trajectory within peak speed (rad/s) and acceleration (rad/s²), of at least `least` s."""
        far = np.abs(np.diff(points, axis=0)).max(axis=1)
        legs = move_time(far, speed, least if len(points) == 2 else MIN_LEG_S)
        legs = np.maximum(legs, np.sqrt(PEAK_ACCELERATION * far / acceleration))
        times = np.concatenate([[0.0], legs.cumsum()])
        return cls(points, times * max(1.0, least / times[-1]))

    @property
    def duration(self) -> float:
        """s."""
        return float(self.times[-1])

    def at(self, time: float) -> Array:
        """Return the posture at a time, (n,) rad."""
        leg = min(max(int(np.searchsorted(self.times, time)) - 1, 0), len(self.times) - 2)
        (a, b), (since, until) = self.points[leg : leg + 2], self.times[leg : leg + 2]
        return a + float(blend(np.array((time - since) / (until - since)))) * (b - a)

    def rows(self, dt: float) -> Array:
        """Return postures at a period of dt s, both ends included, (T, n) rad."""
        steps = max(1, round(self.duration / dt))
        return np.array([self.at(self.duration * k / steps) for k in range(steps + 1)])


def line(a: Array, b: Array) -> Array:
    """Return postures from a to b (n,) rad, at most POSTURE_STEP_RAD apart, both included, (T, n)."""
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
    """Return points (k, n) rad of a free path from start to goal, or None if none was found.

    It is straight if possible, else by way of home, else by two random trees that grow towards each other (RRT-Connect,
    Kuffner & LaValle 2000), with shortcuts.

    Args:
        start, goal, home: (n,) rad.
        low, high: Where to search, (n,) rad; a joint with equal bounds is not moved.
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
    rng = np.random.default_rng(seed)
    points = yield from _connect(straight, start, goal, low, high, rng)
    return None if points is None else (yield from _cut(straight, points, rng))


def _connect(
    straight: _Straight,
    start: Array,
    goal: Array,
    low: Array,
    high: Array,
    rng: np.random.Generator,
) -> Search[list[Array] | None]:
    trees = [([start], [-1]), ([goal], [-1])]  # postures, and from which each was reached
    for growth in range(MAX_GROWTHS):
        (here, came), (there, _) = trees
        reached = yield from _grow(
            straight, here, came, rng.uniform(low, high), once=growth % 8 > 0
        )
        if reached is not None:
            met = yield from _grow(straight, there, trees[1][1], here[reached], once=False)
            if met is not None and np.abs(there[met] - here[reached]).max() < 1e-9:
                halves = [_back(*tree, at) for tree, at in zip(trees, (reached, met), strict=True)]
                if growth % 2:
                    halves.reverse()
                return [*halves[0][::-1], *halves[1][1:]]
        trees.reverse()
    return None


def _grow(
    straight: _Straight, tree: list[Array], came: list[int], aim: Array, once: bool
) -> Search[int | None]:
    """Grow a tree towards `aim`, by one step or as far as possible; return the index of the last node, or None."""
    at = int(np.argmin(np.abs(np.array(tree) - aim).max(axis=1)))
    reached = None
    while (far := float(np.abs(aim - tree[at]).max())) > 1e-9:
        step = tree[at] + min(1.0, TREE_STEP_RAD / far) * (aim - tree[at])
        if not (yield from straight(tree[at], step)):
            break
        tree.append(step)
        came.append(at)
        reached = at = len(tree) - 1
        if once:
            break
    return reached


def _back(tree: list[Array], came: list[int], at: int) -> list[Array]:
    """Return the nodes from one to the root."""
    nodes = []
    while at >= 0:
        nodes.append(tree[at])
        at = came[at]
    return nodes


def _cut(straight: _Straight, points: list[Array], rng: np.random.Generator) -> Search[Array]:
    """Return the path with shortcuts."""
    for _ in range(SHORTCUT_ATTEMPTS):
        if len(points) == 2:
            break
        i, k = sorted(rng.choice(len(points), 2, replace=False))
        if k - i > 1 and (yield from straight(points[i], points[k])):
            points = [*points[: i + 1], *points[k:]]
    return np.array(points)
