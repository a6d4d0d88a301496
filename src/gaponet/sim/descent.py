"""Least squares within bounds, for errors that a simulator makes: few evaluations, whatever the steps are worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from gaponet.sim.free_runs import FreeRuns

Array = np.ndarray

SOFT = 0.01  # rad: errors beyond count linearly, so that one blocked joint does not decide


@dataclass(frozen=True)
class Fit:
    """Parameters (P,), errors (m,) and Jacobian (m, P) at the end, and how many evaluations it took."""

    x: Array
    errors: Array
    jac: Array
    evaluations: int


def descend(
    problem: FreeRuns,
    x: Array,
    evaluations: int,
    tolerance: float,
    progress: Callable[[int, int, float], None],
) -> Fit:
    """Levenberg and Marquardt within bounds: each step is the minimum of the damped quadratic inside the box.

    Many parameters end at a bound (no delay, no friction), where scipy's trust regions creep: two to four times the
    evaluations. Errors beyond SOFT count linearly, by weights (soft_l1).

    Args:
        problem: Its bounds, errors and Jacobian.
        x: Start, (P,).
        evaluations: At most.
        tolerance: Ends when the cost falls by a smaller share.
        progress: Called with evaluations done, at most, and the present RMS error in rad.
    """
    low, high = problem.bounds()
    errors = problem.errors(x[None])[0]
    jac = problem.jacobian(x, errors)
    damping, count, fresh = 1e-2, 1, True
    progress(count, evaluations, problem.rms(errors))
    while count < evaluations:
        if not fresh:
            jac, fresh = problem.jacobian(x, errors), True
        weight = weights(errors)
        normal, slope = jac.T @ (weight[:, None] * jac), jac.T @ (weight * errors)
        normal[np.diag_indices_from(normal)] = normal.diagonal() * (1 + damping) + 1e-12
        root = np.linalg.cholesky(normal).T
        step = lsq_linear(root, -np.linalg.solve(root.T, slope), (low - x - 1e-12, high - x + 1e-12)).x
        trial = np.clip(x + step, low, high)
        tried = problem.errors(trial[None])[0]
        count += 1
        gained = 1 - _soft(tried) / _soft(errors)
        damping = max(damping / 10, 1e-3) if gained > 0 else damping * 30
        if gained > 0:
            x, errors, fresh = trial, tried, False
        progress(count, evaluations, problem.rms(errors))
        if 0 <= gained < tolerance or damping > 10:
            break
    return Fit(x, errors, jac, count)


def weights(errors: Array) -> Array:
    """Weights of the errors that give the soft_l1 loss."""
    return np.asarray(1 / np.sqrt(1 + (errors / SOFT) ** 2))


def _soft(errors: Array) -> float:
    return float((np.sqrt(1 + (errors / SOFT) ** 2) - 1).sum())
