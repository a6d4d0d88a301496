"""System identification: the servo parameters with which the simulator, running free, follows the recordings best.

Per operated joint: gain, damping, dry friction, armature, zero offset, command delay; then, each only where it lowers
the error of recordings that are not fitted, the terms of the servo's law (sim/servo.py). Fitted on windows of 8 s,
every joint on its own beside the recording (sim/joint_runs.py), by least squares from several starts
(sim/multistart.py); then what the robot touches, in the simulator of the whole robot (sim/touching.py).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.signals import encoder_step
from gaponet.metrics import standard_error
from gaponet.robot import LAW, RobotSpec
from gaponet.sim.joint_runs import SOFT, JointRuns
from gaponet.sim.model import build_model
from gaponet.sim.multistart import better_half, descend
from gaponet.sim.refit import cut
from gaponet.sim.shared import ITERATIONS as SHARED_ITERATIONS
from gaponet.sim.shared import far_from_published, same_servos, share
from gaponet.sim.touching import GENERATIONS as TABLE_GENERATIONS
from gaponet.sim.touching import Touch, fit_table, low_windows, tip_heights, touching_below
from gaponet.text import measured

Array = np.ndarray
Values = dict[str, Array]  # field → (n,) of the operated joints
Std = dict[str, dict[str, float]]  # joint → field → standard error

WINDOWS = 40
STARTS, SPREAD = 4, 2.0  # of each search, and how far apart in the parameters' scales
SHORT = 0.5  # s: a search begins with runs so short
SEARCH = (10, 8, 15)  # iterations: of all starts on short runs, of all on whole windows, of the better half
FIRST_DELAY = 0.02  # s: a delay of zero hides what it does
MAX_DELAY = 0.15  # s
AGAIN, AGAIN_STEPS, BESIDE = 8, 6, 1.0  # fits for the standard errors, their iterations, how far beside they begin
WIDE = 0.15  # a standard error so large, of the value and of its scale: not determined
PRICES = {"kp": 2e-3, "armature": 2e-4}  # of e times the given one: both trade against all the others
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
# The search's axes: what a motion shows is a torque over kp, whatever kp is.
LOGARITHM = ("kp", "stribeck_speed")
OVER_KP = ("damping", "frictionloss", "armature", "stribeck", "min_torque", "effort_limit")

Progress = Callable[[float, float, str], None]  # iterations done, in all, what is fitted and its error


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
        std: Joint → field → standard error; none of a shared law.
        tried: The terms of the law in the order tried.
        touch: What was found about the table; None where nothing may touch.
        shared: Type of servo whose joints were given one law, with the errors before and after.
    """

    robot: RobotSpec
    before: float
    after: float
    warnings: tuple[str, ...]
    std: Std
    tried: tuple[Tried, ...]
    touch: Touch | None
    shared: tuple[Tried, ...] = ()


def identify(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence] = (),
    windows: int = WINDOWS,
    terms: tuple[str, ...] = DEFAULT_TERMS,
    table: bool = True,
    shared: bool = False,
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
        shared: In the end give joints with one type of servo (robot.servos) one law.
        nthread: Threads for the table, 0 for all cores.
        progress: Called in each iteration.
    """
    each, same = sum(SEARCH), same_servos(robot) if shared else {}
    before_shared = each * (1 + len(terms)) + AGAIN_STEPS
    before_table = before_shared + SHARED_ITERATIONS * len(same)
    total = before_table + TABLE_GENERATIONS * bool(table and robot.tips)

    def tell(what: str, done: int) -> Callable[[float], None]:
        step = itertools.count(done + 1)
        return lambda error: progress(min(next(step), total), total, f"{what} {error * 1e3:.2f} mrad")

    robot = with_stops(robot, sequences)
    heights = tip_heights(sequences, robot)
    below = touching_below(robot, heights)
    parts = cut(sequences, windows)
    fit = Fit(JointRuns(parts, robot, below), robot, sequences)
    start = fit.start()
    before = fit.mean_error(start)
    values = fit.search(CLASSIC, start, tell("servos", 0))
    judge = JointRuns(list(validation), robot, below) if validation else None
    tried = []
    for i, term in enumerate(terms, 1):
        richer = fit.with_term(values, term)
        richer = fit.search(fit.fields_of(richer), richer, tell(term, each * i))
        if judge is None:
            values = richer
            continue
        tried.append(Tried(term, *(motion_errors(judge, v) for v in (values, richer))))
        if tried[-1].kept:
            values = richer
    std = fit.uncertainty(values, tell("standard errors", before_shared - AGAIN_STEPS))
    common = []
    for k, (servo, places) in enumerate(same.items()):
        armature, step = float(fit.first["armature"][places].mean()), before_shared + SHARED_ITERATIONS * k
        mine = share(fit.runs, values, places, armature, tell(f"one {servo}", step))
        common.append(Tried(servo, *(motion_errors(judge or fit.runs, v) for v in (values, mine))))
        values, std = mine, std | {robot.operated[i]: {} for i in places}
    found = fit.robot(values)
    touch = None
    if table and robot.tips:
        low, lowest = low_windows(sequences, heights, below), min(h.min() for h in heights)
        touch = fit_table(low, found, lowest, nthread, tell("table", before_table))
        found = touch.robot
    doubts = (*fit.doubts(values, std), *far_from_published(found))
    return Identified(found, before, fit.mean_error(values), doubts, std, tuple(tried), touch, tuple(common))


class Axes:
    """Fields as the search sees them: (…, n, P), in units in which a change of one is a large one."""

    def __init__(self, fit: Fit, fields: ListOf[str], rest: Values) -> None:
        self.names, self.rest = list(dict.fromkeys(fields)), rest
        low, high, self.unit = (np.stack([fit.limits[f][i] for f in self.names], axis=1) for i in range(3))
        self.low, self.high = low / self.unit, high / self.unit

    def of(self, values: Values) -> Array:
        """From values, inside the bounds."""
        kp = values["kp"]
        seen = [
            np.log(np.maximum(values[f], 1e-9)) if f in LOGARITHM else values[f] / kp ** (f in OVER_KP)
            for f in self.names
        ]
        return np.clip(np.stack(seen, axis=-1) / self.unit, self.low, self.high)

    def values(self, x: Array) -> Values:
        """To values; fields that are not searched stay."""
        own = dict(zip(self.names, np.moveaxis(x * self.unit, -1, 0), strict=True))
        found = {f: np.broadcast_to(v, x.shape[:-1]) for f, v in self.rest.items()} | own
        found |= {f: np.exp(own[f]) for f in LOGARITHM if f in own}
        return found | {f: own[f] * found["kp"] for f in OVER_KP if f in own}


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
        one, heavy = np.ones(self.n), self.first["armature"] / kp
        # Field → lowest, highest, and a change that is a large one, (n,) each, on the search's axes.
        self.limits: dict[str, tuple[Array, Array, Array]] = {
            "kp": (np.log(0.2 * kp), np.log(8.0 * kp), 0.3 * one),
            "damping": (0 * one, 0.5 * one, 0.015 * one),
            "frictionloss": (0 * one, 0.2 * one, 0.005 * one),
            "armature": (0.02 * heavy, 10 * heavy, 0.4 * heavy),
            "offset": (-0.2 * one, 0.2 * one, 0.01 * one),
            "delay": (0 * one, MAX_DELAY * one, 0.005 * one),
            "stribeck": (0 * one, 0.1 * one, 0.002 * one),
            "stribeck_speed": (np.log(0.005) * one, 0 * one, 0.3 * one),
            "friction_motor": (0 * one, 0.8 * one, 0.05 * one),
            "friction_external": (0 * one, 0.8 * one, 0.05 * one),
            "min_torque": (0 * one, 0.05 * one, 0.002 * one),
            "effort_limit": (0.05 * limit / kp, 5 * limit / kp, 0.2 * limit / kp),
            "encoder_step": (counts, counts, one),
        }
        self.guess = {"stribeck": 0.003 * kp, "stribeck_speed": 0.05 * one, "friction_motor": 0.05 * one,
                      "friction_external": 0.02 * one, "effort_limit": 0.6 * limit,  # one that is too high is not felt
                      "min_torque": 0.003 * kp, "encoder_step": counts}  # fmt: skip

    def start(self) -> Values:
        """The given robot, a little late."""
        own = self.first | {"delay": np.maximum(self.first["delay"], FIRST_DELAY)}
        return {f: own[f] for f in CLASSIC} | {f: own[f] for f in LAW if own[f].any()}

    def fields_of(self, values: Values) -> list[str]:
        """Names, classic ones first."""
        return [f for f in (*CLASSIC, "effort_limit", *LAW) if f in values]

    def with_term(self, values: Values, term: str) -> Values:
        """Values with a first guess at a term's fields."""
        return values | {f: self.guess[f] for f in TERMS[term]}

    def search(self, fields: ListOf[str], start: Values, tell: Callable[[float], None]) -> Values:
        """Fit these fields from a start, and from STARTS − 1 beside it; those of `start` not among them stay."""
        axes = Axes(self, fields, start)
        rng = np.random.default_rng(0)
        x = np.repeat(axes.of(start)[None], STARTS, axis=0)
        x[1:] += SPREAD * rng.standard_normal(x[1:].shape)
        x = np.clip(x, axes.low, axes.high)
        for runs, iterations in zip((self.runs.shortened(SHORT), self.runs, self.runs), SEARCH, strict=True):
            errors = partial(lambda runs, xs: self.errors(axes.values(xs), runs), runs)
            x, cost = descend(x, axes.low, axes.high, errors, iterations, self.telling(runs, tell))
            if runs is self.runs:
                x = better_half(x, cost)
        return {f: v[0].copy() for f, v in axes.values(x[:1]).items()}

    def telling(self, runs: JointRuns, tell: Callable[[float], None]) -> Callable[[Array], None]:
        """Costs, (n,), told as a root mean square in rad."""
        rows = max(int(runs.counted.sum()), 1)
        return lambda cost: tell(SOFT * float(np.sqrt(2 * cost.mean() / rows)))

    def errors(self, values: Values, runs: JointRuns) -> Array:
        """Of (k, n) values, (k, n, windows · rows), in SOFT; then, two more, what kp and armature cost."""
        found = np.moveaxis(runs.errors(values), (1, 3, 2, 0), (0, 1, 2, 3)) / np.float32(SOFT)
        given = {f: np.where(v > 0, v, np.nan) for f, v in (("kp", self.first["kp"]), ("armature", self.armature))}
        far = [np.nan_to_num(np.log(values[f] / v)) * np.sqrt(2 * PRICES[f]) for f, v in given.items()]
        far = np.sqrt(runs.counted.sum()) * np.stack(far, axis=-1)
        return np.concatenate([found.reshape(*found.shape[:2], -1), far], axis=2, dtype=np.float32)

    def mean_error(self, values: Values) -> float:
        """Of the windows, rad."""
        return float(motion_errors(self.runs, values).mean())

    def robot(self, values: Values) -> RobotSpec:
        """The robot with these values."""
        joints = self.base.operated
        return self.base.with_servos(
            {j: {f: float(f"{v[i]:.6g}") for f, v in values.items()} for i, j in enumerate(joints)}
        )

    def uncertainty(self, values: Values, tell: Callable[[float], None] = lambda error: None) -> Std:
        """Standard errors, joint → field: how far from these values fits end that begin beside them and give every
        window a random weight (a Bayesian bootstrap, Rubin 1981), without PRICES. Slopes would say less: the surface is
        rough."""
        names = [f for f in self.fields_of(values) if f != "encoder_step"]
        axes, windows = Axes(self, names, values), self.runs.counted.shape[1]
        rng = np.random.default_rng(1)
        weight = np.sqrt(rng.dirichlet(np.ones(windows), AGAIN) * windows).astype(np.float32)
        weight = np.append(np.repeat(weight, len(self.runs.ctrl), axis=1), np.zeros((AGAIN, 2), np.float32), axis=1)

        def errors(xs: Array) -> Array:
            found = self.errors(axes.values(xs), self.runs)
            return found * np.tile(weight, (len(xs) // AGAIN, 1))[:, None]

        x = axes.of(values) + BESIDE * rng.standard_normal((AGAIN, self.n, len(names)))
        x = np.clip(x, axes.low, axes.high)
        x, _ = descend(x, axes.low, axes.high, errors, AGAIN_STEPS, self.telling(self.runs, tell))
        ends = axes.values(x)
        std = {f: np.sqrt(np.square(ends[f] - values[f]).mean(axis=0)) for f in names}
        return {j: {f: float(std[f][i]) for f in names} for i, j in enumerate(self.base.operated)}

    def doubts(self, values: Values, std: Std) -> tuple[str, ...]:
        """Parameters at a bound, and those whose standard error is as large as what they may mean."""
        names, found = [f for f in self.fields_of(values) if f != "encoder_step"], []
        axes = Axes(self, names, values)
        x = axes.of(values)
        edge = ((x - axes.low < 0.02) & (axes.low != 0)) | (axes.high - x < 0.02)
        ahead = axes.values(x + 1)
        for i, joint in enumerate(self.base.operated):
            wide = []
            for k, f in enumerate(names):
                value, error = values[f][i], std[joint].get(f, 0.0)
                if edge[i, k]:
                    found.append(f"{joint}: {f} ended at its bound ({value:.4g}); the model's form does not fit")
                elif error > WIDE * max(abs(value), ahead[f][i] - value):
                    wide.append(f"{f} {measured(value, error)}")
            if wide:
                found.append(f"{joint}: not determined by these logs: {', '.join(wide)}")
        return tuple(found)


def motion_errors(runs: JointRuns, values: Values) -> Array:
    """Mean |error| of each window over counted rows and joints, (windows,) rad; windows without such rows left out."""
    errors = np.abs(runs.errors({f: v[None] for f, v in values.items()}))[:, 0].mean(axis=2)
    counted = runs.counted.sum(axis=0)
    return np.asarray(errors.sum(axis=0)[counted > 0] / counted[counted > 0])


STOPPED, OFTEN = 0.1, 50  # rad that commands go beyond a stop, and differ there; rows that must show it


def with_stops(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """The robot with joint stops narrower than the MJCF's, where commands go on and the joint stays.

    A joint that hangs far behind one command is loaded or stuck: several commands must have met the stop.
    """
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(robot.operated, robot.operated_index, strict=True):
        qpos, ctrl = (np.concatenate([getattr(s, f)[:, i] for s in sequences]) for f in ("qpos", "ctrl"))
        for name, sign in (("stop_low", -1.0), ("stop_high", 1.0)):
            end = float((sign * qpos).max())
            pressed = (sign * ctrl > end + STOPPED) & (sign * qpos > end - 0.005)
            met = pressed.sum() >= OFTEN and np.ptp(ctrl[pressed]) > STOPPED
            if met and sign * robot.qpos_range[i, int(sign > 0)] > end + 0.01:
                servos.setdefault(joint, {})[name] = round(sign * end, 4)
    return robot.with_servos(servos) if servos else robot
