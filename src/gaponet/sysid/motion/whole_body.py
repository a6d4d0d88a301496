"""Motions of every joint: squats and steps in the air for robots with legs, tours of the joint space for any robot.

The base is fixed, so legs swing freely: what they show is their own actuators, and arms that move while all else does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.base.arrays import Array
from gaponet.sysid.motion.motion import GRID, fade, through
from gaponet.sysid.motion.upper_body import Kit

DURATION = 8.0  # s


def squat(kit: Kit, rng: np.random.Generator) -> Array:
    """Hips, knees and ankles together, twice, arms forward as a counterweight."""
    depth = rng.uniform(0.5, 0.9)
    down = kit.ready.copy()
    for side in ("left", "right"):
        _add(down, kit, f"{side}_hip_pitch", -depth)
        _add(down, kit, f"{side}_knee", 2 * depth)
        _add(down, kit, f"{side}_ankle_pitch", -depth * 0.9)
    for arm in kit.arms.values():
        down[arm.columns[0]] -= rng.uniform(0.3, 0.6)
    stops = np.array([kit.ready, down, kit.ready, down, kit.ready])
    return through(stops, np.full(4, rng.uniform(1.3, 1.7)), np.full(5, 0.4), GRID)


def march(kit: Kit, rng: np.random.Generator) -> Array:
    """Legs in turn, arms against them, torso a little: the rhythm of a gait."""
    time, ctrl, window = _start(kit)
    phase = 2 * np.pi * rng.uniform(0.5, 0.8) * time
    size = rng.uniform(0.25, 0.4)
    for side, p in (("left", phase), ("right", phase + np.pi)):
        swing = np.sin(p) * window
        lift = np.maximum(np.sin(p), 0.0) ** 2 * window
        _add(ctrl, kit, f"{side}_hip_pitch", -size * swing)
        _add(ctrl, kit, f"{side}_knee", 2.0 * size * lift)
        _add(ctrl, kit, f"{side}_ankle_pitch", -0.6 * size * lift)
        if side in kit.arms:
            ctrl[:, kit.arms[side].columns[0]] += 0.8 * size * swing
            ctrl[:, kit.arms[side].columns[3]] -= 0.4 * size * swing
    _add(ctrl, kit, "torso", 0.3 * size * np.sin(phase) * window)
    return ctrl


def sway(kit: Kit, rng: np.random.Generator) -> Array:
    """Sway from side to side with hip and ankle roll while the torso turns and the arms open."""
    time, ctrl, window = _start(kit)
    phase = 2 * np.pi * rng.uniform(0.25, 0.4) * time
    wave, opening = np.sin(phase) * window, 0.5 * (1 - np.cos(2 * phase)) * window
    for side in ("left", "right"):
        _add(ctrl, kit, f"{side}_hip_roll", 0.15 * wave)
        _add(ctrl, kit, f"{side}_ankle_roll", -0.12 * wave)
        _add(ctrl, kit, f"{side}_hip_yaw", 0.15 * wave)
    _add(ctrl, kit, "torso", rng.uniform(0.2, 0.5) * wave)
    for arm in kit.arms.values():
        ctrl[:, arm.columns[1]] += arm.sign * rng.uniform(0.3, 0.6) * opening
    return ctrl


def tour(kit: Kit, rng: np.random.Generator) -> Array:
    """Move all joints at once from one random posture to the next, a third of the range around the ready posture."""
    low, high = _box(kit, 0.3)
    stops = np.array([kit.ready, *rng.uniform(low, high, (4, len(low))), kit.ready])
    return through(stops, rng.uniform(1.0, 1.4, 5), np.full(6, 0.3), GRID)


def limber(kit: Kit, rng: np.random.Generator) -> Array:
    """Move all joints at once on slow sines with random phases."""
    time, ctrl, window = _start(kit)
    low, high = _box(kit, 0.3)
    for j in range(ctrl.shape[1]):
        frequency = rng.uniform(0.1, 0.5, 3)
        wave = np.sin(2 * np.pi * np.outer(time, frequency) + rng.uniform(0, 2 * np.pi, 3)).mean(axis=1)
        ctrl[:, j] += ((low[j] + high[j]) / 2 - kit.ready[j] + wave * (high[j] - low[j]) / 2) * window
    return ctrl


LEGGED = (squat, march, sway)
ANY = (tour, limber)
WHOLE_BODY: dict[str, Callable[[Kit, np.random.Generator], Array]] = {f.__name__: f for f in LEGGED + ANY}


def available(kit: Kit) -> list[str]:
    """Names of the whole-body motions that this robot can play."""
    legs = all(any(n.startswith(f"{s}_{j}") for n in kit.robot.joint_names) for s in ("left", "right") for j in _LEG)
    return [f.__name__ for f in (LEGGED if legs else ()) + ANY]


_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")


def _add(ctrl: Array, kit: Kit, start: str, values: Array | float) -> None:
    """Add values (T,) or one number to the joint whose name starts so; a robot without it is left as it is."""
    for i, name in enumerate(kit.robot.joint_names):
        if name.startswith(start):
            ctrl[..., i] += values


def _start(kit: Kit) -> tuple[Array, Array, Array]:
    steps = round(DURATION / GRID)
    return np.arange(steps) * GRID, np.repeat(kit.ready[None], steps, axis=0), fade(steps, GRID, 1.5)


def _box(kit: Kit, share: float) -> tuple[Array, Array]:
    """A share of every joint's range around the ready posture, at most 0.8 rad to either side."""
    low, high = kit.limits.low, kit.limits.high
    half = np.minimum(share * np.where(np.isfinite(high - low), high - low, 2.0), 0.8)
    return np.maximum(kit.ready - half, low), np.minimum(kit.ready + half, high)
