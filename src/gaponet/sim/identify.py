"""System identification: the servo parameters with which the simulator, running free, follows the recordings best.

Per operated joint: gain, damping, dry friction, armature, zero offset, command delay. Nonlinear least squares on free
runs of several seconds from recorded states; all finite differences of a Jacobian are stepped as one batch.

A servo's parameters act on its own joint first: what they do to the others is weaker by the ratio of the inertias. So
one simulation moves the same parameter of all joints, and each joint's error is put down to its own parameter: six
simulations for a Jacobian, however many joints. The cost is the true one, so that what is left out slows the descent a
little and moves no minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear

from gaponet.data.sequence import Sequence
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.model import build_model
from gaponet.sim.replay import Corrector, idle_limbs

Array = np.ndarray

WINDOW = 8.0  # s; what is fitted on a second or two does not hold over whole motions
WINDOWS = 40
EVALUATIONS = 20
SOFT = 0.01  # rad: errors beyond count linearly, so that one blocked joint does not decide
MAX_DELAY = 0.15  # s
MASSES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # kg: where the search for an unknown payload starts
MAX_MASS = 20.0  # kg
MASS_STEP = 0.1  # kg
TOGETHER = 0.05  # of the prior, where all joints leave their values by the same share: a cold day, a slow bus …
COMMON = ("damping", "frictionloss", "armature", "delay")  # … which does not turn zeros, nor soften gains
SETTLE = 0.1  # s: velocities at a window's start are measured ones

# Parameter → (lower, upper, finite-difference step), as a multiple of the scale in `_scales`.
BOUNDS = {
    "kp": (0.2, 8.0, 0.02),
    "damping": (0.0, 10.0, 0.02),
    "frictionloss": (0.0, 40.0, 0.05),
    "armature": (0.002, 10.0, 0.05),
    "offset": (-10.0, 10.0, 0.1),
    "delay": (0.0, MAX_DELAY / 0.02, 0.25),
}


@dataclass(frozen=True)
class Identified:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with identified parameters.
        before, after: RMS error of the windows, rad.
        warnings: What the recordings do not determine, or what ended at a bound.
        evaluations: Of the whole set of windows, Jacobians not counted.
        payload_mass, payload_std: kg in each hand that is said to carry, where it was asked for.
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
    problem = _Problem(parts, robot, nthread, fields, corrector, prior, unknown_payload)
    fit = descend(problem, evaluations, 1e-3 if prior else 1e-4, progress)
    before, after = problem.rms(problem.errors(problem.own()[None])[0]), problem.rms(fit.errors)
    mass = {"payload_mass": float(fit.x[-1]), "payload_std": problem.jackknife(fit)} if unknown_payload else {}
    doubts = problem.doubts(fit.x, fit.jac, after)
    return Identified(problem.robot_of(fit.x), before, after, doubts, fit.evaluations, **mass)


def cut(sequences: ListOf[Sequence], count: int) -> list[Sequence]:
    """Windows of WINDOW seconds (shorter where a recording is), evenly picked."""
    parts = []
    for s in sequences:
        rows = min(round(WINDOW / s.dt), len(s))
        parts += [s.rows(slice(a, a + rows)) for a in range(0, len(s) - rows + 1, rows)]
    parts = [p for p in parts if p.duration > 1.0]
    return [parts[i * len(parts) // min(count, len(parts))] for i in range(min(count, len(parts)))]


@dataclass(frozen=True)
class Fit:
    """Parameters (P,), errors (m,) and Jacobian (m, P) at the end, and how many evaluations it took."""

    x: Array
    errors: Array
    jac: Array
    evaluations: int


def descend(problem: _Problem, evaluations: int, tolerance: float, progress: Callable[[int, int, float], None]) -> Fit:
    """Levenberg and Marquardt within bounds: each step is the minimum of the damped quadratic inside the box.

    Many parameters end at a bound (no delay, no friction), where scipy's trust regions creep: two to four times the
    evaluations. Errors beyond SOFT count linearly, by weights (soft_l1).

    Args:
        problem: Its start, bounds, errors and Jacobian.
        evaluations: At most.
        tolerance: Ends when the cost falls by a smaller share.
        progress: Called with evaluations done, at most, and the present RMS error in rad.
    """
    x, (low, high) = problem.start(), problem.bounds()
    errors = problem.errors(x[None])[0]
    jac = problem.jacobian(x, errors)
    damping, count, fresh = 1e-2, 1, True
    progress(count, evaluations, problem.rms(errors))
    while count < evaluations:
        if not fresh:
            jac, fresh = problem.jacobian(x, errors), True
        weight = 1 / np.sqrt(1 + (errors / SOFT) ** 2)
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
        if 0 <= gained < tolerance or damping > 1e3:
            break
    return Fit(x, errors, jac, count)


def _soft(errors: Array) -> float:
    return float((np.sqrt(1 + (errors / SOFT) ** 2) - 1).sum())


class _Problem:
    """Windows, parameter vector ↔ robot, errors of many parameter vectors in one batch."""

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        nthread: int,
        fields: tuple[str, ...],
        corrector: Corrector | None,
        prior: float,
        unknown_payload: bool,
    ) -> None:
        self.parts, self.robot, self.nthread = parts, robot, nthread
        self.limits = {f: BOUNDS[f] for f in fields}
        self.corrector, self.prior, self.unknown_payload = corrector, prior, unknown_payload
        self.locked = idle_limbs(parts, robot)
        self.op, self.n = robot.operated_index, len(robot.operated)
        self.names = [(field, joint) for field in fields for joint in robot.operated]
        self.size = len(self.names) + unknown_payload
        free = [j for j in robot.joint_names if j not in self.locked]
        self.free, self.free_op = robot.index(free), np.array([free.index(j) for j in robot.operated])
        rows = max(map(len, parts))
        self.ctrl = np.stack([_held(s.ctrl[:, self.free], rows) for s in parts], axis=1).astype(float)
        self.real = np.stack([_held(s.qpos[:, self.op], rows) for s in parts], axis=1).astype(float)
        skip = np.array([[t >= SETTLE / s.dt and t < len(s) for s in parts] for t in range(rows)])
        self.counted = np.repeat(skip[1:, :, None], self.n, axis=2)
        self.rows = int(self.counted.sum())  # of the residual: simulated errors; those of the prior follow
        self.joint, self.window = (
            np.broadcast_to(i, self.counted.shape)[self.counted]
            for i in (np.arange(self.n), np.arange(len(parts))[:, None])
        )
        model = build_model(robot)
        dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
        gain = robot.kp[self.op]
        natural = gain * 0.05  # N·m·s/rad: a time constant of 50 ms
        self.scale = {
            "kp": gain,
            "damping": np.maximum(model.dof_damping[dof], 0.2 * natural),
            "frictionloss": np.maximum(model.dof_frictionloss[dof], 0.005 * gain),
            "armature": np.maximum(model.dof_armature[dof], 1e-3),
            "offset": np.full(self.n, 0.02),
            "delay": np.full(self.n, 0.02),
        }
        self.first = {
            "kp": gain, "damping": model.dof_damping[dof], "frictionloss": model.dof_frictionloss[dof],
            "armature": model.dof_armature[dof], "offset": robot.offset[self.op], "delay": robot.delay[self.op],
        }  # fmt: skip

    def start(self) -> Array:
        """The given robot, a little inside the bounds; a little late, since a delay of zero hides its gradient.

        An unknown payload starts at the mass of MASSES that fits best.
        """
        late = 0.005 if self.prior else 0.02  # s; with a prior the given robot is thought to be near
        x = self._inside(self.first | {"delay": np.maximum(self.first["delay"], late)})
        if not self.unknown_payload:
            return x
        xs = np.repeat(x[None], len(MASSES), axis=0)
        xs[:, -1] = np.maximum(MASSES, 1e-3)
        return xs[(self.errors(xs)[:, : self.rows] ** 2).sum(axis=1).argmin()]

    def own(self) -> Array:
        """The given robot, and the mean of the payloads said to be carried."""
        return self._inside(self.first)

    def _inside(self, values: dict[str, Array]) -> Array:
        low, high = self.bounds()
        mass = [np.mean([s.meta.payload_mass for s in self.parts], keepdims=True)] * self.unknown_payload
        return np.clip(
            np.concatenate([*(values[f] / self.scale[f] for f in self.limits), *mass]), low + 1e-3, high - 1e-3
        )

    def bounds(self) -> tuple[Array, Array]:
        """(P,) each."""
        low, high = (np.repeat([b[k] for b in self.limits.values()], self.n) for k in (0, 1))
        return (np.r_[low, 0.0], np.r_[high, MAX_MASS]) if self.unknown_payload else (low, high)

    def values(self, x: Array) -> dict[str, Array]:
        """(…, P) → field: (…, n) in SI; fields that are not fitted as they are."""
        x = np.asarray(x)[..., : len(self.names)]
        parts = np.split(x, len(self.limits), axis=-1)
        fitted = {f: part * self.scale[f] for f, part in zip(self.limits, parts, strict=True)}
        shape = (*x.shape[:-1], self.n)
        return {f: np.broadcast_to(own, shape) for f, own in self.first.items()} | fitted

    def robot_of(self, x: Array) -> RobotSpec:
        """The robot with these parameters; joints that are not operated keep theirs."""
        values = self.values(x)
        return self.robot.with_servos(
            {j: {f: float(f"{values[f][i]:.6g}") for f in self.limits} for i, j in enumerate(self.robot.operated)}
        )

    def rms(self, errors: Array) -> float:
        """Of the simulated errors, rad."""
        return float(np.sqrt((errors[: self.rows] ** 2).mean()))

    def errors(self, xs: Array) -> Array:
        """Free-run errors q_sim − q_real of counted rows, then the prior's, (k, m), of parameter vectors (k, P)."""
        k, m = len(xs), len(self.parts)
        late = np.array(self.robot.delay)
        late[self.op] = MAX_DELAY
        parts = [s for x in xs for s in self._carrying(x)]
        conditions = [(s.meta.payload_mass, s.meta.payload_side, s.dt) for s in parts]
        sim = BatchSim(replace(self.robot, delay=late), conditions, self.nthread, self.locked)
        self._write(sim, sim.models[conditions[0]], self.values(np.repeat(xs, m, axis=0)))
        tile = np.tile(self.ctrl, (1, k, 1))
        q0, v0 = (np.stack([getattr(s, f)[0, self.free] for s in parts]) for f in ("qpos", "qvel"))
        sim.reset(slice(None), q0, v0, past=tile[0][:, None])
        out = np.empty((len(tile) - 1, k, m, self.n))
        if self.corrector is not None:
            self.corrector.reset(parts)
        for t in range(len(out)):
            sim.step(tile[t] if self.corrector is None else self._corrected(t, tile[t], sim))
            out[t] = sim.qpos[:, self.free_op].reshape(k, m, self.n) - self.real[t + 1]
        errors = out.transpose(1, 0, 2, 3)[:, self.counted]
        if not self.prior:
            return errors
        return np.concatenate([errors, (xs - self.own())[:, : len(self.names)] @ self._prices().T], axis=1)

    def _carrying(self, x: Array) -> list[Sequence]:
        """The windows, with the payload of a parameter vector where theirs is not believed."""
        if not self.unknown_payload:
            return self.parts
        return [replace(s, meta=replace(s.meta, payload_mass=float(x[-1]))) for s in self.parts]

    def _prices(self) -> Array:
        """Prior residual by parameter, payload apart, (P, P); what all joints do together is cheaper."""
        common = np.full((self.n, self.n), (1 - TOGETHER) / self.n)
        blocks = [np.eye(self.n) - (common if f in COMMON else 0.0) for f in self.limits]
        return self.prior * np.asarray(block_diag(*blocks))

    def _corrected(self, t: int, target: Array, sim: BatchSim) -> Array:
        assert self.corrector is not None
        full = np.zeros((3, len(target), len(self.robot.joint_names)))
        full[:2] = self.robot.qpos_home
        for place, now in zip(full, (target, sim.qpos, sim.qvel), strict=True):
            place[:, self.free] = now
        return self.corrector.correct(t, *full)[:, self.free]

    def _write(self, sim: BatchSim, model: mujoco.MjModel, values: dict[str, Array]) -> None:
        joints = [model.joint(j) for j in self.robot.operated]
        dof = np.array([j.dofadr[0] for j in joints])
        act = np.array([model.actuator(j).id for j in self.robot.operated])
        gain, bias = sim.batch.expand("actuator_gainprm"), sim.batch.expand("actuator_biasprm")
        gain[:, act, 0], bias[:, act, 1] = values["kp"], -values["kp"]
        bias[:, act, 0] = values["kp"] * values["offset"]
        for name in ("damping", "frictionloss", "armature"):
            sim.batch.expand(f"dof_{name}")[:, dof] = values[name]
        sim.batch.expand("actuator_delay")[:, act] = values["delay"]

    def jacobian(self, x: Array, base: Array) -> Array:
        """Forward differences towards the inside of the bounds, one simulation for all joints' same field, (m, P).

        base: The errors at x.
        """
        fields = len(self.limits)
        steps = np.r_[np.repeat([b[2] for b in self.limits.values()], self.n), [MASS_STEP] * self.unknown_payload]
        steps = np.where(x + steps > self.bounds()[1], -steps, steps)
        moved = np.zeros((fields + self.unknown_payload, self.size))
        for field in range(fields):
            moved[field, field * self.n : (field + 1) * self.n] = 1.0
        if self.unknown_payload:
            moved[-1, -1] = 1.0
        change = (self.errors(x + moved * steps) - base)[:, : self.rows]
        jac = np.zeros((len(base), self.size))
        for field in range(fields):
            column = field * self.n + self.joint
            jac[np.arange(self.rows), column] = change[field] / steps[column]
        if self.unknown_payload:  # a payload loads every joint
            jac[: self.rows, -1] = change[-1] / steps[-1]
        if self.prior:
            jac[self.rows :, : len(self.names)] = self._prices()
        return jac

    def jackknife(self, fit: Fit) -> float:
        """Standard error of the payload mass, kg: by how much it moves when a window is left out (one step of Gauss).

        The model's own errors last as long as a motion, so that rows of a window say little about each other.
        """
        jac, error = fit.jac, fit.errors
        weight = 1 / np.sqrt(1 + (error / SOFT) ** 2)
        moved = []
        for window in range(len(self.parts)):
            keep = weight * np.r_[self.window != window, np.ones(len(error) - self.rows, bool)]
            moved.append(np.linalg.lstsq(jac.T @ (keep[:, None] * jac), -jac.T @ (keep * error))[0][-1])
        m = len(moved)
        return float(np.sqrt((m - 1) / m * np.square(moved - np.mean(moved)).sum())) if m > 1 else float("nan")

    def doubts(self, x: Array, jac: Array, rms: float) -> tuple[str, ...]:
        """Parameters at a bound, and those whose standard error exceeds half of what they may be."""
        x, low, high = (part[: len(self.names)] for part in (x, *self.bounds()))
        found = []
        # Errors of neighbouring rows are alike: about ten a second count as independent.
        jac = jac[: self.rows, : len(self.names)]
        rows_per_error = max(1.0, 0.1 / float(np.median([s.dt for s in self.parts])))
        covariance = np.linalg.pinv(jac.T @ jac) * rms**2 * rows_per_error
        scales = np.concatenate([self.scale[f] for f in self.limits])
        for (field, joint), value, error, a, b, scale in zip(
            self.names, x, np.sqrt(np.maximum(np.diag(covariance), 0.0)), low, high, scales, strict=True
        ):
            if (value - a < 1e-2 * (b - a) and a != 0) or b - value < 1e-2 * (b - a):
                found.append(
                    f"{joint}: {field} ended at its bound ({value * scale:.4g}); the model's form does not fit"
                )
            elif error > 0.5 * max(abs(value), 1.0):
                found.append(
                    f"{joint}: {field} {value * scale:.4g} ± {error * scale:.2g} is not determined by these logs"
                )
        return tuple(found)


def _held(x: Array, rows: int) -> Array:
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
