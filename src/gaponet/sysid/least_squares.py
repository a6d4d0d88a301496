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
# Of the last damping; all are evaluated together.
DAMPING_FACTORS = np.array([1e-3, 0.1, 1.0, 30.0])
DAMPING_BOUNDS = (1e-6, 1e3)
FIRST_DAMPING = 1e-2
MIN_RELATIVE_DECREASE = 1e-4  # of the cost, for another iteration
MIN_COST = 1e-300  # so that a cost of zero can be divided by
# Curvature that is damped beside a parameter's own, so that one without any takes no long step.
MEAN_CURVATURE_SHARE = 1e-3
MIN_CURVATURE = 1e-12

Progress = Callable[[Array], object]  # a true answer ends the search
# candidates (k, n, P) → errors (k, n, m), 1 where they begin to count linearly
Errors = Callable[[Array], Array]


def slopes(x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
    """Return errors (S, n, m) at x (S, n, P), and their differences over x, (S, n, m, P): forward,
    but backward where a step would leave `high`.
    """
    steps = np.where(x + DIFFERENCE_STEP > high, -DIFFERENCE_STEP, DIFFERENCE_STEP)  # (S, n, P)
    one_at_a_time = steps[..., None] * np.eye(x.shape[-1])  # (S, n, P, P)
    moved = x + np.moveaxis(one_at_a_time, -1, 0)  # (P, S, n, P)
    values = _evaluated(errors, np.concatenate([x[None], moved]))  # (1 + P, S, n, m)
    here = values[0]
    step_of_parameter = np.moveaxis(steps, -1, 0)[..., None]  # (P, S, n, 1)
    jac = (values[1:] - here) / step_of_parameter.astype(values.dtype)
    return here, np.moveaxis(jac, 0, -1)


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
    damping = np.full(x.shape[:2], FIRST_DAMPING)  # (S, n)
    best_x = x  # of each start, by the sum over problems
    best_cost = np.full(x.shape[:2], np.inf)
    for _ in range(iterations):
        errors, jac = problems.derive(x, problems.high, problems.errors)
        cost = soft_l1(errors)  # (S, n)
        best_x, best_cost = _better(best_x, best_cost, x, cost)
        tried = _damped_steps(problems, x, errors, jac, damping)  # (factors, S, n, P)
        tried_cost = soft_l1(_evaluated(problems.errors, tried))  # (factors, S, n)
        best_factor = tried_cost.argmin(axis=0)  # its number, (S, n)
        least_cost = tried_cost.min(axis=0)
        is_lower = least_cost < cost
        best_tried = np.take_along_axis(tried, best_factor[None, ..., None], axis=0)[0]
        x = np.where(is_lower[..., None], best_tried, x)
        factor = np.where(is_lower, DAMPING_FACTORS[best_factor], DAMPING_FACTORS[-1])
        damping = np.clip(damping * factor, *DAMPING_BOUNDS)
        is_over = progress(np.minimum(least_cost, cost).min(axis=0))
        decrease = np.where(is_lower, 1 - least_cost / np.maximum(cost, MIN_COST), 0.0)
        if is_over or (decrease < min_decrease).all():
            break
    cost = soft_l1(_evaluated(problems.errors, x[None]))[0]
    return _better(best_x, best_cost, x, cost)


def _damped_steps(
    problems: Problems,
    x: Array,
    errors: Array,
    jac: Array,
    damping: Array,
) -> Array:
    """Return the points after the Levenberg-Marquardt steps of all DAMPING_FACTORS from x (S, n,
    P), (factors, S, n, P).

    Args:
        errors, jac: At x, as of `slopes`.
        damping: The last one, (S, n).
    """
    normal, gradient = _normal_equations(errors, jac)
    low = problems.low - x
    high = problems.high - x
    steps = []
    for factor in DAMPING_FACTORS:
        steps.append(step(normal, gradient, low, high, factor * damping))
    return np.asarray(np.stack(steps) + x)


def _better(
    x: Array,
    cost: Array,
    other_x: Array,
    other_cost: Array,
) -> tuple[Array, Array]:
    """Return points (S, n, P) and their costs (S, n); of each start the other ones where these
    cost less in the sum over problems.
    """
    is_better = other_cost.sum(axis=1) < cost.sum(axis=1)  # (S,)
    better_x = np.where(is_better[:, None, None], other_x, x)
    better_cost = np.where(is_better[:, None], other_cost, cost)
    return better_x, better_cost


def _normal_equations(errors: Array, jac: Array) -> tuple[Array, Array]:
    """Return curvature (S, n, P, P) and gradient (S, n, P) of soft L1 costs, from errors (S, n, m)
    and their slopes (S, n, m, P).
    """
    weight = soft_l1_weight(errors)  # (S, n, m)
    transposed = np.swapaxes(jac, -1, -2)  # (S, n, P, m)
    normal = transposed @ (weight[..., None] * jac)
    gradient = transposed @ (weight * errors)[..., None]  # (S, n, P, 1)
    return normal.astype(float), gradient[..., 0].astype(float)


def agreed_slopes(
    x: Array,
    low: Array,
    high: Array,
    errors: Errors,
) -> tuple[Array, Array]:
    """Return errors and differences that both sides agree on: the smaller one, 0 where their signs
    differ.

    A joint that rests at the edge of breaking loose moves far for a step to one side; that is no
    derivative.
    """
    here, ahead = slopes(x, high, errors)
    # With x itself as the upper bound every step goes back; at the lower bound both go ahead.
    upper_bound = np.where(x - DIFFERENCE_STEP < low, high, x)
    _, behind = slopes(x, upper_bound, errors)
    smaller = np.sign(ahead) * np.minimum(abs(ahead), abs(behind))
    signs_agree = ahead * behind > 0
    return here, np.where(signs_agree, smaller, 0)


def step(
    normal: Array,
    gradient: Array,
    low: Array,
    high: Array,
    damping: Array,
) -> Array:
    """Return the minima of damped quadratics inside boxes, (…, P): parameters that leave a box are
    fixed at its edge, and the others are solved again.

    Args:
        normal, gradient: Curvature, (…, P, P), and gradient, (…, P).
        low, high: The box, (…, P).
        damping: (…).
    """
    parameters = gradient.shape[-1]
    own = np.einsum("...ii->...i", normal)  # curvature of each parameter, (…, P)
    curvature = own + MEAN_CURVATURE_SHARE * own.mean(axis=-1, keepdims=True)
    added = damping[..., None] * curvature + MIN_CURVATURE
    damped = normal + added[..., None] * np.eye(parameters)
    is_fixed = np.zeros(gradient.shape, bool)
    moved = np.zeros(gradient.shape)
    for _ in range(parameters):
        is_free = ~is_fixed
        both_free = is_free[..., :, None] & is_free[..., None, :]
        system = np.where(both_free, damped, np.eye(parameters))
        by_fixed = np.einsum("...ij,...j->...i", damped, np.where(is_fixed, moved, 0.0))
        right = np.where(is_free, -gradient - by_fixed, moved)
        solved = np.linalg.solve(system, right[..., None])[..., 0]
        moved = np.clip(solved, low, high)
        leaves = moved != solved
        if not leaves.any():
            break
        is_fixed |= leaves
    return moved


def better_half(x: Array, cost: Array) -> Array:
    """Return the cheaper half of every problem's starts, (S/2, n, P), the cheapest first."""
    cheapest_first = np.argsort(cost, axis=0)  # (S, n)
    kept = cheapest_first[: max(1, len(x) // 2)]
    return np.take_along_axis(x, kept[..., None], axis=0)


def soft_l1(errors: Array) -> Array:
    """Return the soft L1 cost, √(1 + e²) − 1, summed over the last axis."""
    return np.asarray((np.sqrt(1 + errors**2) - 1).sum(axis=-1, dtype=float))


def soft_l1_weight(errors: Array) -> Array:
    """Return the weights with which errors enter the gradient of the soft L1 cost."""
    return np.asarray(1 / np.sqrt(1 + errors**2))


def _evaluated(errors: Errors, tried: Array) -> Array:
    """Return errors of candidates (k, S, n, P), (k, S, n, m)."""
    candidates = tried.reshape(-1, *tried.shape[2:])  # (k · S, n, P)
    values = errors(candidates)
    return values.reshape(*tried.shape[:2], *values.shape[1:])
