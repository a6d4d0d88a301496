"""Levenberg and Marquardt for several small problems at once, each from several starts, tried out together.

One simulation tries a candidate of every problem at once: each joint's parameters are judged by the joint's own error.
Free runs with friction that sticks have many shallow minima; starts far apart, of which the better half goes on, find
deeper ones than one path does, and slopes find the end of a valley that random candidates do not.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.base.arrays import Array

STEP = 0.1  # of a parameter's scale, for forward differences
SHARES = np.array([1e-3, 0.1, 1.0, 30.0])  # of the damping that was best last, tried out together
FLAT = 1e-4

Errors = Callable[[Array], Array]  # candidates (k, n, P) → errors (k, n, m), 1 where they begin to count linearly


def descend(
    x: Array,
    low: Array,
    high: Array,
    errors: Errors,
    iterations: int,
    progress: Callable[[Array], None] = lambda cost: None,
    out_of_time: Callable[[], bool] = lambda: False,
    flat: float = FLAT,
    derive: Callable[[Array, Array, Errors], tuple[Array, Array]] | None = None,
) -> tuple[Array, Array]:
    """Starts, moved downhill, and their costs (soft squares, summed), (S, n).

    Problems may disturb each other a little: where that made a start worse as a whole, what it was is given back.

    Args:
        x: S starts of n problems of P parameters, (S, n, P), in units in which a change of one is a large one.
        low, high: Bounds, (n, P).
        errors: The function that gives the errors of candidates.
        iterations: At most; each tries S·(P + 1 + len(SHARES)) candidates.
        progress: Called after each with the least cost of every problem, (n,).
        out_of_time: Asked before each but the first.
        flat: Ends when no start's cost falls by a larger share.
        derive: In place of `slopes`, where it takes fewer candidates than P + 1.
    """
    damping = np.full(x.shape[:2], 1e-2)
    best = np.full(x.shape[:2], np.inf)
    kept, least_of = x, np.full(x.shape[:2], np.inf)
    for i in range(iterations):
        if i and out_of_time():
            break
        here, jac = (derive or slopes)(x, high, errors)
        weight = 1 / np.sqrt(1 + here**2)
        normal = (np.swapaxes(jac, -1, -2) @ (weight[..., None] * jac)).astype(float)
        slope = (np.swapaxes(jac, -1, -2) @ (weight * here)[..., None])[..., 0].astype(float)
        best = soft(here)
        less = best.sum(axis=1) < least_of.sum(axis=1)
        kept, least_of = np.where(less[:, None, None], x, kept), np.where(less[:, None], best, least_of)
        tried = np.stack([step(normal, slope, low - x, high - x, s * damping) for s in SHARES]) + x
        costs = soft(_every(errors, tried))
        which, least = costs.argmin(axis=0), costs.min(axis=0)
        better = least < best
        x = np.where(better[..., None], np.take_along_axis(tried, which[None, ..., None], axis=0)[0], x)
        damping = np.clip(damping * np.where(better, SHARES[which], SHARES[-1]), 1e-6, 1e3)
        fell = np.where(better, 1 - least / np.maximum(best, 1e-300), 0.0)
        best = np.minimum(least, best)
        progress(best.min(axis=0))
        if (fell < flat).all():
            break
    best = soft(_every(errors, x[None]))[0]
    less = best.sum(axis=1) < least_of.sum(axis=1)
    return np.where(less[:, None, None], x, kept), np.where(less[:, None], best, least_of)


def slopes(x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Errors (S, n, m) at x (S, n, P), and their slopes (S, n, m, P)."""
    steps = np.where(x + STEP > high, -STEP, STEP)
    tried = np.concatenate([x[None], x + np.moveaxis(steps[..., None] * np.eye(x.shape[-1]), -1, 0)])
    found = _every(errors, tried)
    jac = (found[1:] - found[0]) / np.moveaxis(steps, -1, 0)[..., None].astype(found.dtype)
    return found[0], np.moveaxis(jac, 0, -1)


def agreed_slopes(x: Array, low: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Errors and slopes of `slopes`, those that both sides agree on: of two the smaller, none where they have other
    signs. A joint that rests at the edge of breaking loose goes far for a step to one side, and that is no slope."""
    (here, ahead), (_, behind) = (slopes(x, h, errors) for h in (high, np.where(x - STEP < low, high, x)))
    return here, np.where(ahead * behind > 0, np.sign(ahead) * np.minimum(abs(ahead), abs(behind)), 0)


def step(normal: Array, slope: Array, low: Array, high: Array, damping: Array) -> Array:
    """Minima of damped quadratics inside boxes, (…, P): what leaves a box is held at its edge, the rest solved anew."""
    size = slope.shape[-1]
    own = np.einsum("...ii->...i", normal)
    extra = damping[..., None] * (own + 1e-3 * own.mean(axis=-1, keepdims=True)) + 1e-12
    full = normal + extra[..., None] * np.eye(size)
    held, moved = np.zeros(slope.shape, bool), np.zeros(slope.shape)
    for _ in range(size):
        free = ~held
        system = np.where(free[..., :, None] & free[..., None, :], full, np.eye(size))
        asked = -slope - np.einsum("...ij,...j->...i", full, np.where(held, moved, 0.0))
        solved = np.linalg.solve(system, np.where(free, asked, moved)[..., None])[..., 0]
        moved = np.clip(solved, low, high)
        if not (moved != solved).any():
            break
        held |= moved != solved
    return moved


def better_half(x: Array, cost: Array) -> Array:
    """The cheaper half of every problem's starts, (S/2, n, P), the cheapest first."""
    order = np.argsort(cost, axis=0)[: max(1, len(x) // 2)]
    return np.take_along_axis(x, order[..., None], axis=0)


def soft(errors: Array) -> Array:
    """Soft squares, summed over the last axis."""
    return np.asarray((np.sqrt(1 + errors**2) - 1).sum(axis=-1, dtype=float))


def _every(errors: Errors, tried: Array) -> Array:
    """Errors of candidates (k, S, n, P) → (k, S, n, m)."""
    found = errors(tried.reshape(-1, *tried.shape[2:]))
    return found.reshape(*tried.shape[:2], *found.shape[1:])
