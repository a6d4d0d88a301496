"""From which posture a joint can be moved over how much of its range."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.motion.feasible import Feasibility
from gaponet.sim.dynamics import static_torque

Array = np.ndarray

POINTS = 41  # across the range
CANDIDATES = 160
GRAVITY_SHARE = 0.85  # of the usable torque: leaves some to accelerate


@dataclass(frozen=True)
class Stage:
    """A posture (n,) rad and the interval of one joint that can be held from there at every payload."""

    posture: Array
    low: float
    high: float
    share: float  # of the joint's range


def find_stage(limits: Feasibility, joint: str, seed: int = 0) -> Stage:
    """The posture nearest to home from which `joint` reaches (nearly) as much of its range as from any tried one.

    The other operated joints of the same limb are varied at random; home itself is tried first.
    """
    robot = limits.robot
    j = robot.index([joint])[0]
    limb = _limb(limits.models[0], robot.operated, joint)
    columns = robot.index([name for name in limb if name != joint])
    rng = np.random.default_rng([seed, j])
    low, high = limits.low, limits.high
    best: Stage | None = None
    best_score = -np.inf
    for i in range(CANDIDATES):
        posture = np.clip(robot.qpos_home.copy(), low, high)
        reach = i / CANDIDATES * rng.uniform(0, 1, len(columns))  # near home first
        target = rng.uniform(low[columns], high[columns])
        posture[columns] += reach * (target - posture[columns])
        stage = _span(limits, posture, int(j))
        distance = float(np.abs(posture - robot.qpos_home)[columns].mean()) if len(columns) else 0.0
        score = stage.share - 0.05 * distance
        if score > best_score:
            best, best_score = stage, score
        if i == 0 and stage.share > 0.99:
            break
    assert best is not None
    return best


def _span(limits: Feasibility, posture: Array, j: int) -> Stage:
    """Longest run of the joint's range that is feasible from a posture."""
    grid = np.linspace(limits.low[j], limits.high[j], POINTS)
    rows = np.repeat(posture[None], POINTS, axis=0)
    rows[:, j] = grid
    share = np.max([np.abs(static_torque(m, rows)) for m in limits.models], axis=0) / limits.limit
    fits = (share <= GRAVITY_SHARE).all(axis=1)
    start, stop = longest_run(fits)
    if stop == start:
        return Stage(posture, grid[0], grid[0], 0.0)
    low, high = float(grid[start]), float(grid[stop - 1])
    full = np.diff(limits.robot.qpos_range[j])[0]
    return Stage(posture, low, high, (high - low) / float(full))


def longest_run(mask: Array) -> tuple[int, int]:
    """Start and stop of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    runs = edges.reshape(-1, 2)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(start), int(stop)


def _limb(model: mujoco.MjModel, operated: tuple[str, ...], joint: str) -> list[str]:
    """Operated joints on the same chain as `joint`: those it carries and those that carry it."""
    body = {name: int(model.joint(name).bodyid[0]) for name in operated}
    carried = lambda b: {b} | (carried(model.body_parentid[b]) if b else set())  # noqa: E731
    mine = body[joint]
    return [name for name, b in body.items() if b in carried(mine) or mine in carried(b)]
