"""The posture from which a joint can be moved, and over how much of its range."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.sim.dynamics import static_torque
from gaponet.sysid.motion.feasible import Feasibility

POINTS = 41  # across the range
CANDIDATES = 400
ENOUGH = 0.91  # of the joint's range: stop looking; the margins to the stops take 1 or 2 %
GRAVITY_SHARE = 0.9  # of the usable torque: leaves some to accelerate


@dataclass(frozen=True)
class Stage:
    """A posture (n,) rad and the interval of one joint that can be held from there at every payload."""

    posture: Array
    low: float
    high: float
    share: float  # of the joint's range


def find_stage(limits: Feasibility, joint: str, seed: int = 0) -> Stage:
    """A posture near home from which `joint` reaches all of its range, or the most of it that was found.

    Home itself is tried first, then the other operated joints of the same limb are varied at random, ever further.
    Neither gravity at any payload nor the body may be in the way.
    """
    robot = limits.robot
    j = robot.index([joint])[0]
    limb = _limb(limits.models[0], robot.operated, joint)
    columns = robot.index([name for name in limb if name != joint])
    rng = np.random.default_rng([seed, j])
    low, high = limits.low, limits.high
    home = np.clip(robot.qpos_home, low, high)
    best = _span(limits, home, int(j))
    for i in range(CANDIDATES):
        if best.share >= ENOUGH:
            break
        posture = home.copy()
        reach = min(1.0, 1.5 * i / CANDIDATES) * rng.uniform(0, 1, len(columns))  # near home first
        posture[columns] += reach * (rng.uniform(low[columns], high[columns]) - home[columns])
        stage = _span(limits, posture, int(j))
        if stage.share > best.share:
            best = stage
    return best


def _span(limits: Feasibility, posture: Array, j: int) -> Stage:
    """Longest run of the joint's range that is feasible from a posture."""
    grid = np.linspace(limits.low[j], limits.high[j], POINTS)
    rows = np.repeat(posture[None], POINTS, axis=0)
    rows[:, j] = grid
    fits = limits.collision.distance(rows) >= limits.collision.clearance
    if np.diff(longest_run(fits))[0] < POINTS // 2:
        return Stage(posture, grid[0], grid[0], 0.0)
    share = np.max([np.abs(static_torque(m, rows)) for m in limits.models], axis=0) / limits.limit
    fits &= (share <= GRAVITY_SHARE).all(axis=1)
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
    mine = body[joint]
    return [name for name, b in body.items() if b in carriers(model, mine) or mine in carriers(model, b)]


def carriers(model: mujoco.MjModel, body: int) -> set[int]:
    """The body and all it hangs on, without the world."""
    chain = set()
    while body:
        chain.add(body)
        body = int(model.body_parentid[body])
    return chain
