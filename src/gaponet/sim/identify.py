"""System identification: the servo parameters with which the simulator, running free, follows the recordings best.

Per operated joint: gain, damping, dry friction, armature, zero offset, command delay; then, each only where it lowers
the error of recordings that are not fitted, the terms of the servo's law (sim/servo.py). Fitted on windows of 8 s,
every joint on its own beside the recording (sim/joint_runs.py), by separable CMA-ES; then what the robot touches, in
the simulator of the whole robot (sim/touching.py).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.metrics import standard_error
from gaponet.robot import LAW, RobotSpec
from gaponet.sim.evolve import evolve
from gaponet.sim.joint_runs import JointRuns
from gaponet.sim.model import build_model
from gaponet.sim.refit import cut
from gaponet.sim.touching import GENERATIONS as TABLE_GENERATIONS
from gaponet.sim.touching import Touch, fit_table, low_windows, tip_heights, touching_below

Array = np.ndarray
Values = dict[str, Array]  # field → (n,) of the operated joints

WINDOWS = 40
GENERATIONS, MORE = 120, 60  # of the classic fields, and for each term
FIRST_DELAY = 0.02  # s: a delay of zero hides what it does
MAX_DELAY = 0.15  # s
BLIND, NOISE = 1e-9, 1e-4  # rad² and rad: what no log resolves
HEAVY = 2e-4  # price of an armature e times the MJCF's: it trades against delay and damping
CLASSIC = ("kp", "damping", "frictionloss", "armature", "offset", "delay")
TERMS: dict[str, tuple[str, ...]] = {
    "stribeck": ("stribeck", "stribeck_speed"),
    "load": ("friction_motor",),
    "limit": ("effort_limit",),
    "external": ("friction_external",),
    "min_torque": ("min_torque",),
    "encoder": ("encoder_step",),
}
DEFAULT_TERMS = ("stribeck", "load")

Progress = Callable[[float, float, str], None]  # generations done, in all, what is fitted and its error


@dataclass(frozen=True)
class Tried:
    """A term of the servo's law, with the errors of the recordings that judged it, (motions,) rad."""

    name: str
    before: Array
    after: Array

    @property
    def gain(self) -> tuple[float, float]:
        """By how much the mean fell, and its standard error over motions (paired), rad."""
        less = self.before - self.after
        return float(less.mean()), standard_error(less)

    @property
    def kept(self) -> bool:
        """Whether it fell by more than its standard error."""
        fell, error = self.gain
        return fell > (0.0 if np.isnan(error) else error)


@dataclass(frozen=True)
class Identified:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with identified parameters.
        before, after: Mean |error| of the windows, rad, joints on their own.
        warnings: What the recordings do not determine, or what ended at a bound.
        std: Joint → field → standard error.
        tried: The terms of the law in the order tried.
        touch: What was found about the table; None where nothing may touch.
    """

    robot: RobotSpec
    before: float
    after: float
    warnings: tuple[str, ...]
    std: dict[str, dict[str, float]]
    tried: tuple[Tried, ...]
    touch: Touch | None


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence] = (),
    windows: int = WINDOWS,
    terms: tuple[str, ...] = DEFAULT_TERMS,
    table: bool = True,
    nthread: int = 0,
    progress: Progress = lambda done, total, note: None,
) -> Identified:
    """Fit the parameters of all operated joints.

    Args:
        sequences: Recordings to fit on; validation and test motions stay out.
        robot: Where to start from; its payloads' masses are taken as true.
        validation: Recordings that judge the terms; without them every term is kept.
        windows: Free runs of 8 s, taken evenly from the recordings.
        terms: Of the servo's law, from TERMS, in the order in which they are tried.
        table: Look for a table under the robot's tips.
        nthread: Threads for the table, 0 for all cores.
        progress: Called in each generation.
    """
    total = GENERATIONS + MORE * len(terms) + TABLE_GENERATIONS * bool(table and robot.tips)
    done = itertools.count(1)

    def tell(what: str) -> Callable[[float], None]:
        return lambda error: progress(min(next(done), total), total, f"{what} {error * 1e3:.2f} mrad")

    robot = with_stops(robot, sequences)
    heights = tip_heights(sequences, robot)
    below = touching_below(robot, heights)
    parts = cut(sequences, windows)
    fit = Fit(JointRuns(parts, robot, below), robot, sequences)
    start = fit.start()
    before = fit.mean_error(start)
    values = fit.descend(CLASSIC, start, GENERATIONS, tell("servos"))
    judge = JointRuns(list(validation), robot, below) if validation else None
    tried = []
    for term in terms:
        fields = tuple(fit.fields_of(values)) + TERMS[term]
        richer = fit.descend(fields, fit.with_term(values, term), MORE, tell(term))
        if judge is None:
            values = richer
            continue
        tried.append(Tried(term, *(motion_errors(judge, v) for v in (values, richer))))
        if tried[-1].kept:
            values = richer
    found = fit.robot(values)
    touch = None
    if table and robot.tips:
        low, lowest = low_windows(sequences, heights, below), min(h.min() for h in heights)
        touch = fit_table(low, found, lowest, nthread, tell("table"))
        found = touch.robot
    std = fit.uncertainty(values)
    return Identified(found, before, fit.mean_error(values), fit.doubts(values, std), std, tuple(tried), touch)


class Fit:
    """The windows of a fit, and what a parameter may be."""

    def __init__(self, runs: JointRuns, robot: RobotSpec, sequences: ListOf[Sequence]) -> None:
        self.runs, self.base, self.op, self.n = runs, robot, robot.operated_index, len(robot.operated)
        model = build_model(replace(robot, table=None))
        dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
        kp, limit = robot.kp[self.op], robot.effort_limit[self.op]
        self.armature = model.dof_armature[dof]
        self.first: Values = {
            "kp": kp, "damping": model.dof_damping[dof], "frictionloss": model.dof_frictionloss[dof],
            "armature": np.maximum(self.armature, 1e-3),
            **{f: getattr(robot, f)[self.op] for f in ("offset", "delay", "effort_limit", *LAW)},
        }  # fmt: skip
        counts = np.array([encoder_step([s.qpos[:, j] for s in sequences]) for j in self.op])
        one = np.ones(self.n)
        # Field → lowest, highest, and a change that is a large one, (n,) each.
        self.limits: dict[str, tuple[Array, Array, Array]] = {
            "kp": (0.2 * kp, 8.0 * kp, 0.2 * kp),
            "damping": (0 * kp, 0.5 * kp, 0.015 * kp),
            "frictionloss": (0 * kp, 0.2 * kp, 0.005 * kp),
            "armature": (0.1 * self.first["armature"], 10 * self.first["armature"], 0.4 * self.first["armature"]),
            "offset": (-0.2 * one, 0.2 * one, 0.01 * one),
            "delay": (0 * one, MAX_DELAY * one, 0.005 * one),
            "stribeck": (0 * kp, 0.1 * kp, 0.002 * kp),
            "stribeck_speed": (0.005 * one, 1.0 * one, 0.03 * one),
            "friction_motor": (0 * one, 0.8 * one, 0.05 * one),
            "friction_external": (0 * one, 0.8 * one, 0.05 * one),
            "min_torque": (0 * kp, 0.05 * kp, 0.002 * kp),
            "effort_limit": (0.2 * limit, 3 * limit, 0.2 * limit),
            "encoder_step": (counts, counts, one),
        }
        self.guess = {"stribeck": 0.003 * kp, "stribeck_speed": 0.05 * one, "friction_motor": 0.05 * one,
                      "friction_external": 0.02 * one, "effort_limit": 0.6 * limit,  # one that is too high is not felt
                      "min_torque": 0.003 * kp, "encoder_step": counts}  # fmt: skip

    def start(self) -> Values:
        """The given robot, a little late."""
        own = self.first | {"delay": np.maximum(self.first["delay"], FIRST_DELAY)}
        return {f: np.clip(own[f], *self.limits[f][:2]) for f in CLASSIC} | {f: own[f] for f in LAW if own[f].any()}

    def fields_of(self, values: Values) -> list[str]:
        """Names, classic ones first."""
        return [f for f in (*CLASSIC, "effort_limit", *LAW) if f in values]

    def with_term(self, values: Values, term: str) -> Values:
        """Values with a first guess at a term's fields."""
        return values | {f: self.guess[f] for f in TERMS[term]}

    def descend(
        self, fields: tuple[str, ...], start: Values, generations: int, tell: Callable[[float], None]
    ) -> Values:
        """Fit these fields from a start; those of `start` that are not among them stay."""
        names = list(dict.fromkeys(fields))
        low, high, unit = (np.stack([self.limits[f][i] for f in names], axis=1) for i in range(3))
        x = np.clip(np.stack([start[f] for f in names], axis=1), low, high)

        def values_of(xs: Array) -> Values:
            kept = {f: np.broadcast_to(v, xs.shape[:-1]) for f, v in start.items() if f not in names}
            return kept | {f: xs[..., i] * unit[:, i] for i, f in enumerate(names)}

        def cost(xs: Array) -> Array:
            values = values_of(xs)
            errors = self.runs.errors(values)
            tell(float(np.abs(errors).sum(axis=(0, 2)).min(axis=0).mean() / max(self.runs.counted.sum(), 1)))
            known = self.armature > 0
            far = np.log(values["armature"] / np.where(known, self.armature, 1.0)) ** 2
            return self.runs.cost(errors) + HEAVY * np.where(known, far, 0.0)

        best = evolve(x / unit, low / unit, high / unit, cost, generations)
        return {f: v.copy() for f, v in values_of(best).items()}

    def mean_error(self, values: Values) -> float:
        """Of the windows, rad."""
        return float(motion_errors(self.runs, values).mean())

    def robot(self, values: Values) -> RobotSpec:
        """The robot with these values."""
        joints = self.base.operated
        return self.base.with_servos(
            {j: {f: float(f"{v[i]:.6g}") for f, v in values.items()} for i, j in enumerate(joints)}
        )

    def uncertainty(self, values: Values) -> dict[str, dict[str, float]]:
        """Standard errors, joint → field, from the errors' slopes; windows count as independent, rows do not."""
        names = [f for f in self.fields_of(values) if f != "encoder_step"]
        steps = {f: 0.1 * self.limits[f][2] for f in names}
        tried = {f: np.tile(v, (len(names) + 1, 1)) for f, v in values.items()}
        for k, f in enumerate(names, 1):
            tried[f][k] += np.where(values[f] + steps[f] > self.limits[f][1], -steps[f], steps[f])
        errors = self.runs.errors(tried)
        found = {}
        rows_per_error = max(1.0, 0.1 / self.runs.dt)  # about ten a second count as independent
        for i, joint in enumerate(self.base.operated):
            e = errors[..., i][self.runs.counted.nonzero()[0], :, self.runs.counted.nonzero()[1]]  # (rows, k)
            jac = np.stack([(e[:, k] - e[:, 0]) / (tried[f][k, i] - values[f][i]) for k, f in enumerate(names, 1)], 1)
            scale = np.array([self.limits[f][2][i] for f in names])
            inverse = np.linalg.inv((jac * scale).T @ (jac * scale) + BLIND * np.eye(len(names)))
            variance = inverse.diagonal() * max(np.square(e[:, 0]).mean(), NOISE**2) * rows_per_error
            found[joint] = dict(zip(names, (scale * np.sqrt(np.maximum(variance, 0.0))).tolist(), strict=True))
        return found

    def doubts(self, values: Values, std: dict[str, dict[str, float]]) -> tuple[str, ...]:
        """Parameters at a bound, and those whose standard error is as large as what they may mean."""
        found = []
        for i, joint in enumerate(self.base.operated):
            for f in self.fields_of(values):
                value, (low, high, unit) = values[f][i], (x[i] for x in self.limits[f])
                if f == "encoder_step":
                    continue
                edge = 0.02 * unit
                if (value - low < edge and low != 0) or high - value < edge:
                    found.append(f"{joint}: {f} ended at its bound ({value:.4g}); the model's form does not fit")
                elif std[joint][f] > max(0.5 * abs(value), unit):
                    found.append(f"{joint}: {f} {value:.4g} ± {std[joint][f]:.2g} is not determined by these logs")
        return tuple(found)


def motion_errors(runs: JointRuns, values: Values) -> Array:
    """Mean |error| of each window over counted rows and joints, (windows,) rad; windows without such rows left out."""
    errors = np.abs(runs.errors({f: v[None] for f, v in values.items()}))[:, 0].mean(axis=2)
    counted = runs.counted.sum(axis=0)
    return np.asarray(errors.sum(axis=0)[counted > 0] / counted[counted > 0])


STOPPED, AGAIN = 0.1, 50  # rad that commands go beyond a stop, and rows that must show it


def with_stops(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """The robot with joint stops narrower than the MJCF's, where commands go on and the joint stays."""
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(robot.operated, robot.operated_index, strict=True):
        qpos, ctrl = (np.concatenate([getattr(s, f)[:, i] for s in sequences]) for f in ("qpos", "ctrl"))
        for name, sign in (("stop_low", -1.0), ("stop_high", 1.0)):
            end = float((sign * qpos).max())
            pressed = (sign * ctrl > end + STOPPED) & (sign * qpos > end - 0.005)
            if pressed.sum() >= AGAIN and sign * robot.qpos_range[i, int(sign > 0)] > end + 0.01:
                servos.setdefault(joint, {})[name] = round(sign * end, 4)
    return robot.with_servos(servos) if servos else robot
