"""Minimum-jerk moves: the straight, bell-shaped way from rest to rest (Flash & Hogan 1985)."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array

PEAK_SPEED = 1.875  # of a minimum-jerk move, over its mean speed
PEAK_ACCELERATION = 10 / 3**0.5  # of one, times its duration squared, over its length


def blend(s: Array) -> Array:
    """0 → 1 with zero velocity and acceleration at both ends; s is clipped to [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def through(points: Array, moves: Array, holds: Array, dt: float) -> Array:
    """Stop at every via point.

    Args:
        points: (k, n), rad.
        moves: Duration of the move to each next point, (k − 1,), s.
        holds: Rest at each point, (k,), s.
        dt: s.

    Returns:
        (T, n), rad.
    """
    points = np.atleast_2d(np.asarray(points, float))
    rows = [np.repeat(points[:1], max(1, round(holds[0] / dt)), axis=0)]
    for a, b, move, hold in zip(points[:-1], points[1:], moves, holds[1:], strict=True):
        steps = max(1, round(move / dt))
        rows.append(a + (b - a) * blend(np.arange(1, steps + 1) / steps)[:, None])
        rows.append(np.repeat(b[None], round(hold / dt), axis=0))
    return np.concatenate(rows)


def move_time(distance: Array, speed: float, least: float = 0.5) -> Array:
    """Duration of a minimum-jerk move whose peak speed is `speed` (rad/s), at least `least` s."""
    return np.maximum(PEAK_SPEED * np.abs(distance) / speed, least)


def fade(steps: int, dt: float, ramp: float) -> Array:
    """A window (steps,) that rises from 0 to 1 within `ramp` s, stays, and falls back: oscillations start at rest."""
    time = np.arange(steps) * dt
    return blend(time / ramp) * blend((time[-1] - time) / ramp)
