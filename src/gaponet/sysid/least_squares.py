"""Levenberg-Marquardt for several small problems at once, each from several starts.

One simulation evaluates a candidate of every problem: each joint's parameters are judged by the
joint's own error. Rollouts with friction that sticks have many shallow minima. Starts far apart, of
which the better half goes on, find deeper minima than one path does; derivatives find the end of a
valley that random candidates miss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array

DIFFERENCE_STEP = 0.1  # large changes, of finite differences
DAMPING_FACTORS = np.array([1e-3, 0.1, 1.0, 30.0])  # of the last damping, evaluated together
DAMPING_BOUNDS = (1e-6, 1e3)
FIRST_DAMPING = 1e-2
MIN_RELATIVE_DECREASE = 1e-4  # of the cost, for another iteration

Progress = Callable[[Array], object]  # a true answer ends the search
# candidates (k, n, P) → errors (k, n, m), 1 where they begin to count linearly
Errors = Callable[[Array], Array]


def slopes(x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Return errors (S, n, m) at x (S, n, P), and their differences over x, (S, n, m, P): forward,
    but backward where a step would leave `high`.
    """
    steps = np.where(x + DIFFERENCE_STEP > high, -DIFFERENCE_STEP, DIFFERENCE_STEP)
    tried = np.concatenate(
        [x[None], x + np.moveaxis(steps[..., None] * np.eye(x.shape[-1]), -1, 0)]
    )
    values = _evaluated(errors, tried)
    jac = (values[1:] - values[0]) / np.moveaxis(steps, -1, 0)[..., None].astype(values.dtype)
    return values[0], np.moveaxis(jac, 0, -1)


@dataclass(frozen=True)
class Problems:
    """n problems of P parameters, whose errors are evaluated together.

    Attributes:
        errors: Function of candidates.
        low, high: Bounds, (n, P), in units in which a change of one is a large one.
        derive: Computes errors and slopes, as `slopes` does; another function may take fewer
            candidates than P + 1.
    """

    errors: Errors
    low: Array
    high: Array
    derive: Callable[[Array, Array, Errors], tuple[Array, Array]] = slopes


def descend(
    problems: Problems,
    x: Array,
    iterations: int,
    progress: Progress = lambda cost: None,
    min_decrease: float = MIN_RELATIVE_DECREASE,
) -> tuple[Array, Array]:
    """Minimise the soft L1 costs of n problems from S starts; return the points (S, n, P) and
    their costs (S, n).

    Each iteration tries the Levenberg-Marquardt steps of all DAMPING_FACTORS, and takes for every
    problem the best one that lowers its cost.

    Problems may disturb each other a little. Where a start became worse in the sum over problems,
    its best earlier point is returned.

    Args:
        x: Starts, (S, n, P).
        iterations: At most; each evaluates S·(P + 1 + len(DAMPING_FACTORS)) candidates.
        progress: Called after each iteration with the least cost of every problem, (n,); True ends
            the search.
        min_decrease: Ends the search when the relative decrease of every cost is smaller.
    """
    damping = np.full(x.shape[:2], FIRST_DAMPING)
    best_x = x  # of each start, by the sum over problems
    best_cost = np.full(x.shape[:2], np.inf)
    for _ in range(iterations):
        errors, jac = problems.derive(x, problems.high, problems.errors)
        cost = soft_l1(errors)  # (S, n)
        best_x, best_cost = _better(best_x, best_cost, x, cost)
        tried = _damped_steps(problems, x, errors, jac, damping)
        tried_cost = soft_l1(_evaluated(problems.errors, tried))  # (factors, S, n)
        choice = tried_cost.argmin(axis=0)  # (S, n)
        least = tried_cost.min(axis=0)
        is_lower = least < cost
        chosen = np.take_along_axis(tried, choice[None, ..., None], axis=0)[0]
        x = np.where(is_lower[..., None], chosen, x)
        factor = np.where(is_lower, DAMPING_FACTORS[choice], DAMPING_FACTORS[-1])
        damping = np.clip(damping * factor, *DAMPING_BOUNDS)
        decrease = np.where(is_lower, 1 - least / np.maximum(cost, 1e-300), 0.0)
        is_over = progress(np.minimum(least, cost).min(axis=0))
        if is_over or (decrease < min_decrease).all():
            break
    cost = soft_l1(_evaluated(problems.errors, x[None]))[0]
    return _better(best_x, best_cost, x, cost)


def _damped_steps(problems: Problems, x: Array, errors: Array, jac: Array, damping: Array) -> Array:
    """Return the points after the Levenberg-Marquardt steps of all DAMPING_FACTORS from x (S, n,
    P), (factors, S, n, P).

    Args:
        errors, jac: At x, as of `slopes`.
        damping: The last one, (S, n).
    """
    normal, gradient = _normal_equations(errors, jac)
    low = problems.low - x
    high = problems.high - x
    steps = [step(normal, gradient, low, high, factor * damping) for factor in DAMPING_FACTORS]
    return np.asarray(np.stack(steps) + x)


def _better(x: Array, cost: Array, other_x: Array, other_cost: Array) -> tuple[Array, Array]:
    """Return points (S, n, P) and their costs (S, n); of each start the other ones where these
    cost less in the sum over problems.
    """
    is_better = other_cost.sum(axis=1) < cost.sum(axis=1)  # (S,)
    points = np.where(is_better[:, None, None], other_x, x)
    return points, np.where(is_better[:, None], other_cost, cost)


def _normal_equations(errors: Array, jac: Array) -> tuple[Array, Array]:
    """Return curvature (S, n, P, P) and gradient (S, n, P) of soft L1 costs, from errors (S, n, m)
    and their slopes (S, n, m, P).
    """
    weight = 1 / np.sqrt(1 + errors**2)
    normal = np.swapaxes(jac, -1, -2) @ (weight[..., None] * jac)
    gradient = (np.swapaxes(jac, -1, -2) @ (weight * errors)[..., None])[..., 0]
    return normal.astype(float), gradient.astype(float)


def agreed_slopes(x: Array, low: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Return errors and differences that both sides agree on: the smaller one, 0 where their signs
    differ.

    A joint that rests at the edge of breaking loose moves far for a step to one side; that is no
    derivative.
    """
    here, ahead = slopes(x, high, errors)
    # With x itself as the upper bound every step goes back; at the lower bound both go ahead.
    backward = np.where(x - DIFFERENCE_STEP < low, high, x)
    _, behind = slopes(x, backward, errors)
    smaller = np.sign(ahead) * np.minimum(abs(ahead), abs(behind))
    return here, np.where(ahead * behind > 0, smaller, 0)


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
