"""One unit's servo parameters near a robot's own, from half a minute of its log: least squares with a prior.

What so little log does not determine stays with the robot's values; with a corrector the fit is made under it.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.sim.free_runs import FreeRuns, Prior, rms
from gaponet.sim.replay import Corrector

WINDOW = 8.0  # s; what is fitted on a second or two does not hold over whole motions
SHORTEST = 0.8  # s


@dataclass(frozen=True)
class _Fit:
    """Parameters (P,), errors (n, rows) and Jacobian (n, rows, fields) at the end, and how many evaluations it took."""

    x: Array
    errors: Array
    jac: Array
    evaluations: int


@dataclass(frozen=True)
class Refitted:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with fitted parameters.
        before, after: RMS error of the windows, rad.
        payload_mass, payload_std: kg in each hand that is said to carry, where it was asked for.
    """

    robot: RobotSpec
    before: float
    after: float
    payload_mass: float | None = None
    payload_std: float | None = None


def refit(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    windows: int,
    fields: tuple[str, ...],
    corrector: Corrector | None,
    prior: Prior | None,
    evaluations: int,
    unknown_payload: bool = False,
    nthread: int = 0,
    progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    believed: bool = True,
) -> Refitted:
    """Fit parameters of all operated joints at once.

    Args:
        sequences: Recordings.
        robot: Where to start from; its payloads' masses are taken as true.
        windows: Free runs of 8 s, taken evenly from the recordings.
        fields: Which parameters; the others stay the robot's.
        corrector: Corrects the targets on the way, as in replay.
        prior: What leaving a robot's values costs.
        evaluations: At most so many.
        unknown_payload: Do not believe the recordings' payload mass; fit one for all of them.
        nthread: Threads, 0 for all cores.
        progress: Called with evaluations done, at most, and the present RMS error in rad.
        believed: Whether kd is what the servos have.
    """
    parts = cut(sequences, windows)
    problem = FreeRuns(parts, robot, nthread, fields, corrector, prior, unknown_payload, believed)
    fit = _descend(problem, problem.start(), evaluations, 1e-3, progress)
    before, after = rms(problem.errors(problem.own()[None])[0]), rms(fit.errors)
    mass = {"payload_mass": float(fit.x[-1]), "payload_std": _jackknife(problem, fit)} if unknown_payload else {}
    return Refitted(problem.robot_of(fit.x), before, after, **mass)


def cut(sequences: ListOf[Sequence], count: int) -> list[Sequence]:
    """Windows of WINDOW seconds (shorter where a recording is), evenly picked."""
    parts = []
    for s in sequences:
        rows = min(round(WINDOW / s.dt), len(s))
        parts += [s.rows(slice(a, a + rows)) for a in range(0, len(s) - rows + 1, rows)]
    parts = [p for p in parts if p.duration >= SHORTEST]
    if not parts:
        raise UsageError(f"no recording is as long as {SHORTEST:g} s; identification needs longer ones")
    return [parts[i * len(parts) // min(count, len(parts))] for i in range(min(count, len(parts)))]


def _jackknife(problem: FreeRuns, fit: _Fit) -> float:
    """Standard error of the payload mass, kg: by how much it moves when a window is left out (one step of Gauss).

    The model's own errors last as long as a motion, so that rows of a window say little about each other.
    """
    moved = []
    for window in range(len(problem.parts)):
        keep = problem.window != window
        matrix, side = problem.normal(fit.x, fit.errors[:, keep], fit.jac[:, keep])
        moved.append(np.linalg.lstsq(matrix, -side)[0][-1])
    m = len(moved)
    return float(np.sqrt((m - 1) / m * np.square(moved - np.mean(moved)).sum())) if m > 1 else float("nan")


def _descend(
    problem: FreeRuns,
    x: Array,
    evaluations: int,
    tolerance: float,
    progress: Callable[[int, int, float], None],
) -> _Fit:
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
    progress(count, evaluations, rms(errors))
    while count < evaluations:
        if not fresh:
            jac, fresh = problem.jacobian(x, errors), True
        normal, slope = problem.normal(x, errors, jac)
        normal[np.diag_indices_from(normal)] = normal.diagonal() * (1 + damping) + 1e-12
        root = np.linalg.cholesky(normal).T
        step = lsq_linear(root, -np.linalg.solve(root.T, slope), (low - x - 1e-12, high - x + 1e-12)).x
        trial = np.clip(x + step, low, high)
        tried = problem.errors(trial[None])[0]
        count += 1
        gained = 1 - problem.cost(trial, tried) / problem.cost(x, errors)
        damping = max(damping / 10, 1e-3) if gained > 0 else damping * 30
        if gained > 0:
            x, errors, fresh = trial, tried, False
        progress(count, evaluations, rms(errors))
        if 0 <= gained < tolerance or damping > 10:
            break
    return _Fit(x, errors, jac, count)
