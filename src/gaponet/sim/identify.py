"""System identification: the servo parameters with which the simulator, running free, follows the recordings best.

Per operated joint: gain, damping, dry friction, armature, zero offset, command delay. Nonlinear least squares on free
runs of several seconds from recorded states, first as if joints did nothing to each other (sim/free_runs.py), which
comes near the minimum; then a few steps with what joints of a limb do to each other.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.sim.descent import Fit, descend, weights
from gaponet.sim.free_runs import BOUNDS, FreeRuns
from gaponet.sim.replay import Corrector

WINDOW = 8.0  # s; what is fitted on a second or two does not hold over whole motions
WINDOWS = 40
EVALUATIONS, POLISH = 20, 4  # with joints on their own, and with all of a limb


@dataclass(frozen=True)
class Identified:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with identified parameters.
        before, after: RMS error of the windows, rad.
        warnings: What the recordings do not determine, or what ended at a bound.
        evaluations: How often the whole set of windows was simulated, Jacobians not counted.
        payload_mass, payload_std: Estimated kg in each hand that carries, and its standard error, where asked for.
    """

    robot: RobotSpec
    before: float
    after: float
    warnings: tuple[str, ...]
    evaluations: int
    payload_mass: float | None = None
    payload_std: float | None = None


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    windows: int = WINDOWS,
    nthread: int = 0,
    progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    fields: tuple[str, ...] = tuple(BOUNDS),
    corrector: Corrector | None = None,
    prior: float = 0.0,
    evaluations: int = EVALUATIONS,
    unknown_payload: bool = False,
) -> Identified:
    """Fit the parameters of all operated joints at once.

    Args:
        sequences: Recordings to fit on; validation and test motions stay out.
        robot: Where to start from; its payloads' masses are taken as true.
        windows: Free runs of 8 s, taken evenly from the recordings.
        nthread: Threads, 0 for all cores.
        progress: Called with evaluations done, at most, and the present RMS error in rad.
        fields: Which parameters; the others stay the robot's.
        corrector: Corrects the targets on the way, as in replay.
        prior: Price of leaving the robot's own values, rad per scale: for logs too short to determine everything. All
            joints together leave them for a twentieth of it, gains and zero offsets apart.
        evaluations: At most so many.
        unknown_payload: Do not believe the recordings' payload mass; fit one for all of them.
    """
    parts = cut(sequences, windows)
    if not parts:
        raise UsageError("no recording is longer than a second; identification needs longer ones")
    problem = FreeRuns(parts, robot, nthread, fields, corrector, prior, unknown_payload)
    fit = descend(problem, problem.start(), evaluations, 1e-3, progress)
    if not prior:
        fit = descend(problem, fit.x, POLISH, 1e-4, progress, alone=False)
    before, after = problem.rms(problem.errors(problem.own()[None])[0]), problem.rms(fit.errors)
    mass = {"payload_mass": float(fit.x[-1]), "payload_std": jackknife(problem, fit)} if unknown_payload else {}
    return Identified(problem.robot_of(fit.x), before, after, doubts(problem, fit), fit.evaluations, **mass)


def cut(sequences: ListOf[Sequence], count: int) -> list[Sequence]:
    """Windows of WINDOW seconds (shorter where a recording is), evenly picked."""
    parts = []
    for s in sequences:
        rows = min(round(WINDOW / s.dt), len(s))
        parts += [s.rows(slice(a, a + rows)) for a in range(0, len(s) - rows + 1, rows)]
    parts = [p for p in parts if p.duration > 1.0]
    return [parts[i * len(parts) // min(count, len(parts))] for i in range(min(count, len(parts)))]


def jackknife(problem: FreeRuns, fit: Fit) -> float:
    """Standard error of the payload mass, kg: by how much it moves when a window is left out (one step of Gauss).

    The model's own errors last as long as a motion, so that rows of a window say little about each other.
    """
    jac, error = fit.jac, fit.errors
    weight = weights(error)
    moved = []
    for window in range(len(problem.parts)):
        keep = weight * np.r_[problem.window != window, np.ones(len(error) - problem.rows, bool)]
        moved.append(np.linalg.lstsq(jac.T @ (keep[:, None] * jac), -jac.T @ (keep * error))[0][-1])
    m = len(moved)
    return float(np.sqrt((m - 1) / m * np.square(moved - np.mean(moved)).sum())) if m > 1 else float("nan")


def doubts(problem: FreeRuns, fit: Fit) -> tuple[str, ...]:
    """Parameters at a bound, and those whose standard error exceeds half of what they may be."""
    x, low, high = (part[: len(problem.names)] for part in (fit.x, *problem.bounds()))
    found = []
    # Errors of neighbouring rows are alike: about ten a second count as independent.
    jac = fit.jac[: problem.rows, : len(problem.names)]
    rows_per_error = max(1.0, 0.1 / float(np.median([s.dt for s in problem.parts])))
    covariance = np.linalg.pinv(jac.T @ jac) * problem.rms(fit.errors) ** 2 * rows_per_error
    scales = np.concatenate([problem.scale[f] for f in problem.limits])
    for (field, joint), value, error, a, b, scale in zip(
        problem.names, x, np.sqrt(np.maximum(np.diag(covariance), 0.0)), low, high, scales, strict=True
    ):
        if (value - a < 1e-2 * (b - a) and a != 0) or b - value < 1e-2 * (b - a):
            found.append(f"{joint}: {field} ended at its bound ({value * scale:.4g}); the model's form does not fit")
        elif error > 0.5 * max(abs(value), 1.0):
            found.append(f"{joint}: {field} {value * scale:.4g} ± {error * scale:.2g} is not determined by these logs")
    return tuple(found)
