"""Levenberg-Marquardt for several small problems at once, each from several starts.

One simulation evaluates a candidate of every problem: each joint's parameters are judged by the
joint's own error. Rollouts with friction that sticks have many shallow minima. Starts far apart, of
which the better half goes on, find deeper minima than one path does; derivatives find the end of a
valley that random candidates miss.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.base.arrays import Array

DIFFERENCE_STEP = 0.1  # large changes, of finite differences
DAMPING_FACTORS = np.array([1e-3, 0.1, 1.0, 30.0])  # of the last best damping, evaluated together
MIN_RELATIVE_DECREASE = 1e-4  # of the cost, for another iteration

Progress = Callable[[Array], object]  # a true answer ends the search
# candidates (k, n, P) → errors (k, n, m), 1 where they begin to count linearly
Errors = Callable[[Array], Array]


def descend(
    x: Array,
    low: Array,
    high: Array,
    errors: Errors,
    iterations: int,
    progress: Progress = lambda cost: None,
    min_decrease: float = MIN_RELATIVE_DECREASE,
    derive: Callable[[Array, Array, Errors], tuple[Array, Array]] | None = None,
) -> tuple[Array, Array]:
    """Minimise the soft L1 costs of n problems from S starts; return the points (S, n, P) and
    their costs (S, n).

    Problems may disturb each other a little. Where a start became worse in the sum over problems,
    its best earlier point is returned.

    Args:
        x: Starts, (S, n, P), in units in which a change of one is a large one.
        low, high: Bounds, (n, P).
        errors: Function of candidates.
        iterations: At most; each evaluates S·(P + 1 + len(DAMPING_FACTORS)) candidates.
        progress: Called after each iteration with the least cost of every problem, (n,); True ends
            the search.
        min_decrease: Ends the search when the relative decrease of every cost is smaller.
        derive: Replaces `slopes`, where it takes fewer candidates than P + 1.
    """
    damping = np.full(x.shape[:2], 1e-2)
    best = np.full(x.shape[:2], np.inf)
    best_x = x
    best_total = np.full(x.shape[:2], np.inf)
    for _ in range(iterations):
        here, jac = (derive or slopes)(x, high, errors)
        weight = 1 / np.sqrt(1 + here**2)
        normal = (np.swapaxes(jac, -1, -2) @ (weight[..., None] * jac)).astype(float)
        gradient = (np.swapaxes(jac, -1, -2) @ (weight * here)[..., None])[..., 0].astype(float)
        best = soft_l1(here)
        better = best.sum(axis=1) < best_total.sum(axis=1)
        best_x = np.where(better[:, None, None], x, best_x)
        best_total = np.where(better[:, None], best, best_total)
        tried = (
            np.stack(
                [step(normal, gradient, low - x, high - x, s * damping) for s in DAMPING_FACTORS]
            )
            + x
        )
        costs = soft_l1(_evaluated(errors, tried))
        choice = costs.argmin(axis=0)
        least = costs.min(axis=0)
        lower = least < best
        x = np.where(
            lower[..., None], np.take_along_axis(tried, choice[None, ..., None], axis=0)[0], x
        )
        damping = np.clip(
            damping * np.where(lower, DAMPING_FACTORS[choice], DAMPING_FACTORS[-1]), 1e-6, 1e3
        )
        decrease = np.where(lower, 1 - least / np.maximum(best, 1e-300), 0.0)
        best = np.minimum(least, best)
        if progress(best.min(axis=0)) or (decrease < min_decrease).all():
            break
    best = soft_l1(_evaluated(errors, x[None]))[0]
    better = best.sum(axis=1) < best_total.sum(axis=1)
    return np.where(better[:, None, None], x, best_x), np.where(better[:, None], best, best_total)


def slopes(x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Return errors (S, n, m) at x (S, n, P), and their forward differences over x, (S, n, m,
    P).
    """
    steps = np.where(x + DIFFERENCE_STEP > high, -DIFFERENCE_STEP, DIFFERENCE_STEP)
    tried = np.concatenate(
        [x[None], x + np.moveaxis(steps[..., None] * np.eye(x.shape[-1]), -1, 0)]
    )
    values = _evaluated(errors, tried)
    jac = (values[1:] - values[0]) / np.moveaxis(steps, -1, 0)[..., None].astype(values.dtype)
    return values[0], np.moveaxis(jac, 0, -1)


def agreed_slopes(x: Array, low: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Return errors and differences that both sides agree on: the smaller one, 0 where their signs
    differ.

    A joint that rests at the edge of breaking loose moves far for a step to one side; that is no
    derivative.
    """
    ends = (high, np.where(x - DIFFERENCE_STEP < low, high, x))
    (here, ahead), (_, behind) = (slopes(x, end, errors) for end in ends)
    return here, np.where(
        ahead * behind > 0, np.sign(ahead) * np.minimum(abs(ahead), abs(behind)), 0
    )


def step(normal: Array, gradient: Array, low: Array, high: Array, damping: Array) -> Array:
    """Return the minima of damped quadratics inside boxes, (…, P): parameters that leave a box are
    fixed at its edge, and the others are solved again.
    """
    size = gradient.shape[-1]
    own = np.einsum("...ii->...i", normal)
    extra = damping[..., None] * (own + 1e-3 * own.mean(axis=-1, keepdims=True)) + 1e-12
    full = normal + extra[..., None] * np.eye(size)
    fixed = np.zeros(gradient.shape, bool)
    moved = np.zeros(gradient.shape)
    for _ in range(size):
        free = ~fixed
        system = np.where(free[..., :, None] & free[..., None, :], full, np.eye(size))
        right = -gradient - np.einsum("...ij,...j->...i", full, np.where(fixed, moved, 0.0))
        solved = np.linalg.solve(system, np.where(free, right, moved)[..., None])[..., 0]
        moved = np.clip(solved, low, high)
        if not (moved != solved).any():
            break
        fixed |= moved != solved
    return moved


def better_half(x: Array, cost: Array) -> Array:
    """Return the cheaper half of every problem's starts, (S/2, n, P), the cheapest first."""
    order = np.argsort(cost, axis=0)[: max(1, len(x) // 2)]
    return np.take_along_axis(x, order[..., None], axis=0)


def soft_l1(errors: Array) -> Array:
    """Return the soft L1 cost, √(1 + e²) − 1, summed over the last axis."""
    return np.asarray((np.sqrt(1 + errors**2) - 1).sum(axis=-1, dtype=float))


def _evaluated(errors: Errors, tried: Array) -> Array:
    """Return errors of candidates (k, S, n, P), (k, S, n, m)."""
    values = errors(tried.reshape(-1, *tried.shape[2:]))
    return values.reshape(*tried.shape[:2], *values.shape[1:])
