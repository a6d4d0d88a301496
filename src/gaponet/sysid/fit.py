"""System identification: the servo parameters with which the simulator, running free, follows the recordings best.

Per operated joint: kp, total damping, dry friction, armature, zero offset, command delay; then, each only where it
lowers the error of recordings that are not fitted, the terms of the servo model (sim/servo.py). First every joint on
its own beside the recording (sysid/joint_rollouts.py), from several starts; then all of them together in the simulator
of the whole robot (sysid/robot_rollouts.py), from there and from the robot's file: least squares both times
(sysid/least_squares.py). Validation motions choose among the given robot and what was found on the way; then comes what
the robot touches (sysid/table_contact.py); then a fit that begins with recorded torque is a rival to all that
(gaponet/sysid/torque.py).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import stdtrit

from gaponet.base.text import format_uncertainty
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim.metrics import standard_error
from gaponet.sim.model import build_model
from gaponet.sysid.axes import CLASSIC, OVER_KP, STILL, Axes, Bounds, Values
from gaponet.sysid.joint_rollouts import SOFT, JointRollouts
from gaponet.sysid.least_squares import agreed_slopes, better_half, descend
from gaponet.sysid.robot_rollouts import RobotRollouts, cut
from gaponet.sysid.shared_servo import far_from_published, same_servos, share
from gaponet.sysid.table_contact import Touch, fit_table, low_windows, tip_heights, touching_below

Array = np.ndarray
Std = dict[str, dict[str, float]]  # joint → field → standard error
Covariance = dict[str, tuple[list[str], Array]]  # joint → fields (P), (P, P)

WINDOWS, WHOLE = 40, 8  # windows of joints on their own, and of the whole robot
STARTS, SPREAD = 4, 2.0  # of each search, and how far apart in the parameters' scales
SHORT = 0.5  # s: a search begins with runs so short
SEARCH = (10, 8, 15)  # iterations: of all starts on short runs, of all on whole windows, of the better half
TOGETHER = (2, 3)  # iterations of the whole robot, joint by joint: from both starts, from the better one
LIMBS, LIMB_RUNS = 8, 160  # and of limbs, whose joints answer for each other: iterations, and candidates of all
ENOUGH, LITTLE = 2e-3, 2e-4  # of the whole robot's cost, of the limbs': a fall that is worth another iteration
POLISH = 2  # iterations of the whole robot with a term of the law
CLUSTERS = 24  # parts of the recordings that are thought independent of each other, at least
WIDE = 0.15  # a standard error so large, of the value and of its scale: not determined
SURE = 0.84  # of Student's distribution, one side: one standard error where motions are many
HALF = 0.29  # standard deviation of what lies anywhere within one step
LASTS = (1.0, 4.0)  # s of recording that count as one measurement beside a belief: at least, before it is known
FAINT = 0.05  # a correlation that is none
BELIEF = {"kp": 0.5, "armature": 1.5}  # standard deviation of the logarithm of a file's value
TOLD = 0.1  # the same of a kp that recordings state
BETTER, ALONE_BETTER = 0.01, 0.1  # of an error: a fall by more is an improvement, on several motions and on one
PARTS = {"joints": 0.3, "whole": 0.4}  # of a budget; terms of the law share what is left
TERMS: dict[str, tuple[str, ...]] = {
    "stribeck": ("stribeck", "stribeck_speed"),
    "load": ("friction_motor",),
    "limit": ("effort_limit",),
    "external": ("friction_external",),
    "min_torque": ("min_torque",),
    "encoder": ("encoder_step",),
}
DEFAULT_TERMS = ("stribeck", "load")
ALONE = ("effort_limit", "encoder_step")  # fields that only joints on their own are searched for
CHECK = {
    "kp": "check its unit (N·m/rad) and the payload that was told",
    "damping": "check kp's unit, and that commands are positions",
    "frictionloss": "check kp's unit, and that nothing held the joint",
    "armature": "check the masses in the MJCF and kp's unit",
    "offset": "check the joint's zero and its sign",
    "delay": "check that commands and states have one clock",
    "effort_limit": "check effort_limit in robot.toml",
}

Progress = Callable[[float, float, str], None]  # iterations done, in all, what is fitted and its error


@dataclass(frozen=True)
class Tried:
    """A candidate beside another one, with the errors of the recordings that judged them, (motions,) rad."""

    name: str
    before: Array
    after: Array

    @property
    def gain(self) -> tuple[float, float]:
        """The fall of the mean, and its standard error over motions (paired), rad."""
        less = self.before - self.after
        return float(less.mean()), standard_error(less)

    @property
    def kept(self) -> bool:
        """Whether it fell by more than a hundredth, and motions by more of their own than the standard error of that,
        wider where they are few (Student's); on one motion by more than a tenth."""
        few, least = len(self.before) - 1, BETTER if len(self.before) > 1 else ALONE_BETTER
        share = (self.before - self.after) / np.maximum(self.before + self.after, 1e-12)
        sure = not few or share.mean() > stdtrit(few, SURE) * standard_error(share)
        return bool(sure and self.gain[0] > least * self.before.mean())


@dataclass(frozen=True)
class Identified:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with identified parameters; as it was given where nothing did better.
        before, after: Mean |error| of the motions that judged, rad: of the given robot, of this one.
        chosen: What did best: given, joints (each alone), whole (all together), limbs (as one), mixed, torque or ramp.
        warnings: What ended at a bound, what to look at, and what the recordings do not determine (last).
        undetermined: Joint → fields that the recordings do not determine; all of a joint that is never moved.
        std: Joint → field → standard error; none of a shared law.
        tried: The terms of the law in the order tried; then torque and ramps, by motions.
        touch: What was found about the table; None where nothing may touch.
        shared: Type of servo whose joints were given one law, with the errors before and after.
        by_joint: Joint → mean |error| before and after, rad.
        covariance: Joint → of its fields on the axes of sysid/uncertainty.py; none of a shared law.
        judged: The robot that the validation motions judged, where `robot` was fitted to them, too, afterwards.
    """

    robot: RobotSpec
    before: float
    after: float
    chosen: str
    warnings: tuple[str, ...]
    std: Std
    tried: tuple[Tried, ...]
    touch: Touch | None
    shared: tuple[Tried, ...] = ()
    by_joint: dict[str, tuple[float, float]] | None = None
    covariance: Covariance = field(default_factory=dict)
    undetermined: dict[str, tuple[str, ...]] = field(default_factory=dict)
    judged: RobotSpec | None = None

    @property
    def better(self) -> bool:
        """Whether it is another robot than the given one."""
        return self.chosen != "given" or bool(self.touch and self.touch.kept)

    def no_gain(self, robot: RobotSpec, given: Array, left: Array) -> str:
        """Why an identification writes nothing, and what to record."""
        by_joint = self.by_joint or {}
        worst = sorted(by_joint, key=lambda joint: -by_joint[joint][0])[:3]
        told = ", ".join(f"{joint} {1e3 * by_joint[joint][0]:.2f}" for joint in worst)
        why = f"; {self.warnings[0]}" if self.warnings else ""
        return (
            f"nothing is written: nothing that was fitted follows the {len(given)} validation motion(s) better than "
            f"{robot.name} as it is ({1e3 * given.mean():.2f} mrad, best fit {1e3 * left.mean():.2f}; worst {told}). "
            "Record gaponet excite's motions, every joint over its range, slow and fast, and look at gaponet doctor"
            f"{why}"
        )


class Clock:
    """How far a fit is, told with what is fitted; and, where its time is limited, when a search has had its part."""

    def __init__(self, seconds: float | None, terms: int, progress: Progress) -> None:
        each = [sum(SEARCH), sum(TOGETHER) + LIMBS, *[sum(SEARCH) + POLISH] * terms]
        self.began, self.seconds, self.progress = time.monotonic(), seconds, progress
        self.steps = np.cumsum(each).tolist()  # iterations until the end of each search
        self.iterations, self.done, self.end = self.steps[-1], 0, np.inf
        progress(0, self.iterations, "inertias along the recordings")

    def share(self, part: float, search: int) -> None:
        """The search of this number may take this part of the time that is left."""
        gone = time.monotonic() - self.began
        self.end = np.inf if self.seconds is None else gone + part * max(self.seconds - gone, 0.0)
        self.done = self.steps[search - 1] if search else 0

    def over(self) -> bool:
        """Whether the present search has had its time."""
        return time.monotonic() - self.began > self.end

    def table(self, error: float) -> None:
        """The table's search, which no budget counts; error in rad."""
        self.progress(self.iterations, self.iterations, f"table {error * 1e3:.2f} mrad")

    def tell(self, what: str, joints: tuple[str, ...], rows: Array) -> Callable[[Array], None]:
        """To be called in each iteration with every joint's cost, (n,)."""

        def told(cost: Array) -> None:
            each = 1e3 * SOFT * np.sqrt(2 * cost / np.maximum(rows, 1))
            note = f"{what}: {each.mean():.2f} mrad, {joints[int(each.argmax())]} {each.max():.2f}"
            self.done += 1
            self.progress(min(self.done, self.iterations), self.iterations, note)

        return told


def fit_robot(
    sequences: ListOf[Sequence], robot: RobotSpec, validation: ListOf[Sequence], windows: int, terms: tuple[str, ...],
    table: bool, shared: bool, nthread: int, progress: Progress, stops: bool, budget: float | None,
) -> Identified:  # fmt: skip
    """Fit to positions, with targets that move as the robot's servos are said to move them; arguments as of
    sysid.identify.identify."""
    clock = Clock(budget, len(terms), progress)
    given, robot = robot, with_stops(robot, sequences)  # for the fit; what nobody confirmed is taken back in the end
    heights = tip_heights(sequences, robot)
    below, parts = touching_below(robot, heights), cut(sequences, windows)
    fit = Fit(JointRollouts(parts, robot, below, nthread), robot, Bounds(robot, sequences))
    judge, first = _Judge(list(validation) or parts, robot, below, nthread), fit.bounds.first
    whole, candidates = _classic(fit, clock, nthread)
    chosen, values = judge.best(candidates)
    base = values if chosen != "given" else candidates["limbs"]
    tried, values = _with_terms(fit, whole, judge, terms, values, base, clock)
    chosen = "whole" if chosen == "given" and any(t.kept for t in tried) else chosen
    std, over_kp = whole.uncertainty(values)
    common = []
    for servo, places in (same_servos(robot) if shared else {}).items():
        mine = share(fit.runs, values, places, fit.bounds.start["armature"][places].mean(), lambda error: None)
        common.append(Tried(servo, judge.errors(values), judge.errors(mine)))
        values, std, chosen = mine, std | {robot.operated[i]: {} for i in places}, "whole"

    found, touch = fit.robot(values) if chosen != "given" else robot, None
    if table and robot.tips:
        low, lowest = low_windows(sequences, heights, below), min(h.min() for h in heights)
        touch = fit_table(low, found, lowest, nthread, clock.table, validation)
        found = touch.robot
    if not stops:
        found = replace(found, stop_low=given.stop_low, stop_high=given.stop_high)
        found = given if chosen == "given" and not (touch and touch.kept) else found
    unknown = fit.undetermined(values, std, over_kp)
    doubts = (*fit.bounds_met(values), *_asked_stops(given, robot), *far_from_published(found),
              *(text for _, text in unknown.values()))  # fmt: skip
    began, ended = (float(judge.errors(v).mean()) for v in (first, values))
    each = zip(*(judge.by_joint(v).tolist() for v in (first, values)), strict=True)
    by_joint = dict(zip(robot.operated, each, strict=True))
    sure = {j: whole.covariance[j] for j in robot.operated if std[j]}
    wide = {joint: fields for joint, (fields, _) in unknown.items()}
    clock.progress(clock.iterations, clock.iterations, "the robot that was found, and what torque says of it")
    return Identified(found, began, ended, chosen, doubts, std, tried, touch, tuple(common), by_joint, sure, wide)


def _classic(fit: Fit, clock: Clock, nthread: int) -> tuple[Fit, dict[str, Values]]:
    """The classic fields, joints on their own and then together: the whole robot's fit, and what may be chosen."""
    bounds = fit.bounds
    clock.share(PARTS["joints"], 0)
    alone = fit.search(CLASSIC, bounds.start, clock, "joints, each on its own", fit.balanced())
    fit.learn_lasting(alone)
    whole = fit.whole(nthread)
    clock.share(PARTS["whole"] / (1 - PARTS["joints"]), 1)
    first = np.stack([Axes(whole.bounds, CLASSIC, bounds.start).of(v) for v in (alone, bounds.start)])
    together = whole.descend(CLASSIC, bounds.start, first, TOGETHER, clock, "whole robot")
    limbs = whole.limbs(together, clock)
    return whole, {"given": bounds.first, "limbs": limbs, "joints": alone, "whole": together}


def _with_terms(
    fit: Fit, whole: Fit, judge: _Judge, terms: tuple[str, ...], values: Values, base: Values, clock: Clock
) -> tuple[tuple[Tried, ...], Values]:
    """Terms of the law, each fitted from the base and kept in it where it does better than the values."""
    tried: list[Tried] = []
    for i, term in enumerate(terms):
        clock.share(1 / (len(terms) - i + 1), 2 + i)
        richer = fit.search(TERMS[term], base | {f: fit.bounds.guess[f] for f in TERMS[term]}, clock, term)
        if not set(TERMS[term]) & set(ALONE):
            searched = fit.fields_of(richer)
            x = Axes(whole.bounds, searched, richer).of(richer)[None]
            polished = whole.descend(searched, richer, x, (POLISH,), clock, f"{term}, whole robot")
            richer = min(richer, polished, key=lambda v: float(judge.errors(v).mean()))
        tried.append(Tried(term, judge.errors(values), judge.errors(richer)))
        if tried[-1].kept:  # a term that is nothing in every joint only gave the others more iterations
            values = base = {f: v for f, v in richer.items() if f not in TERMS[term] or richer[TERMS[term][0]].any()}
    return tuple(tried), values


class _Judge:
    """Motions that were not fitted, whole, in the whole robot's simulator; repetitions count as one."""

    def __init__(self, sequences: list[Sequence], robot: RobotSpec, below: float, nthread: int) -> None:
        self.runs = RobotRollouts(sequences, robot, nthread, touch=_touching_rows(sequences, robot, below))
        # Repetitions and gains of what one unit plays with one payload are one judge.
        of = [(s.meta.motion, s.meta.unit_id, s.meta.payload_mass, s.meta.payload_side) for s in sequences]
        each = [np.array([one == key for one in of])[self.runs.window] for key in dict.fromkeys(of)]
        self.motions = [rows for rows in each if rows.any()]
        self.known: dict[bytes, Array] = {}

    def _sums(self, values: Values) -> tuple[Array, Array]:
        """Sums of |error| over counted rows, rad, and how many, of motions and joints, (motions, n) each."""
        key = b"".join(f.encode() + values[f].tobytes() for f in sorted(values))
        if key not in self.known:
            size = np.abs(self.runs.run({f: v[None] for f, v in values.items()}))[0]
            self.known[key] = np.stack([size[:, rows].sum(axis=1) for rows in self.motions])
        return self.known[key], np.stack([self.runs.recorded[:, rows].sum(axis=1) for rows in self.motions])

    def errors(self, values: Values) -> Array:
        """Mean |error| of each motion, (motions,) rad."""
        total, count = self._sums(values)
        return np.asarray(total.sum(axis=1) / np.maximum(count.sum(axis=1), 1))

    def by_joint(self, values: Values) -> Array:
        """Mean |error| of each joint, (n,) rad."""
        total, count = self._sums(values)
        return np.asarray((total / np.maximum(count, 1)).sum(axis=0) / np.maximum((count > 0).sum(axis=0), 1))

    def best(self, candidates: dict[str, Values]) -> tuple[str, Values]:
        """Name and values of what does best: the first fit; another one where it is surely better, or by a tenth; what
        was chosen joint by joint where it is surely better; the given robot where no fit is better by a hundredth."""
        given, first, *others = candidates
        joints = np.array([self.by_joint(v) for v in candidates.values()])
        which = joints.argmin(axis=0)
        if len(set(which.tolist())) > 1:  # what did best for each joint: may do best for all
            fields = set.intersection(*(set(v) for v in candidates.values()))
            rows = {f: np.stack([v[f] for v in candidates.values()]) for f in fields}
            candidates = candidates | {"mixed": {f: x[which, np.arange(len(which))] for f, x in rows.items()}}
        costs, name = {name: self.errors(v) for name, v in candidates.items()}, first
        for other in (*others, *(candidates.keys() & {"mixed"})):
            far = other != "mixed" and costs[other].mean() < (1 - ALONE_BETTER) * costs[name].mean()
            name = other if far or Tried(other, costs[name], costs[other]).kept else name
        name = name if costs[name].mean() < (1 - BETTER) * costs[given].mean() else given
        return name, candidates[name]


def _touching_rows(sequences: ListOf[Sequence], robot: RobotSpec, below: float) -> Array | None:
    """Rows in which a tip is below a height, (sequences, rows)."""
    if not robot.tips:
        return None
    heights = tip_heights(sequences, robot)
    rows = max(map(len, heights))
    return np.array([np.r_[h < below, np.zeros(rows - len(h), bool)] for h in heights])


class _Limbs:
    """Joints that move each other, side by side: numbers of joints (…, n, P) and of limbs (…, limbs, most · P)."""

    def __init__(self, robot: RobotSpec) -> None:
        model = build_model(replace(robot, table=None), bare=True)
        tree = model.dof_treeid[[model.joint(j).dofadr[0] for j in robot.operated]]
        limbs = [np.flatnonzero(tree == t) for t in np.unique(tree)]
        most = max(map(len, limbs))
        self.at = np.array([[*limb, *[-1] * (most - len(limb))] for limb in limbs])  # (limbs, most), -1 for no joint

    def pack(self, x: Array) -> Array:
        """Values of joints → of limbs; 0 where a limb has fewer."""
        padded = np.concatenate([x, np.zeros_like(x[..., :1, :])], axis=-2)[..., self.at, :]
        return padded.reshape(*x.shape[:-2], len(self.at), -1)

    def unpack(self, x: Array) -> Array:
        """Values of limbs → of joints."""
        split = x.reshape(*x.shape[:-2], self.at.size, -1)
        return np.asarray(split[..., np.argsort(self.at.ravel(), kind="stable")[(self.at < 0).sum() :], :])


class Fit:
    """Windows of recordings, joints on their own or the whole robot, and what a parameter may be."""

    def __init__(
        self, runs: JointRollouts, robot: RobotSpec, bounds: Bounds, whole: RobotRollouts | None = None
    ) -> None:
        self.runs, self.base, self.bounds, self.company = runs, robot, bounds, whole
        self.n = len(robot.operated)
        self.noise = np.full(self.n, 1e-3)  # rad: what the best fit of each joint leaves, by then
        self.lasts = np.full(self.n, LASTS[1])  # s: how long that lasts
        self.together = _Limbs(robot)
        self.covariance: Covariance = {}  # where `uncertainty` was asked last

    def whole(self, nthread: int) -> Fit:
        """The same in the simulator of the whole robot, with fewer windows; it begins to move where this one ended."""
        parts = self.runs.parts
        some = np.unique(np.arange(WHOLE) * len(parts) // WHOLE)
        runs = RobotRollouts([parts[i] for i in some], self.base, nthread, touch=self.runs.touch[some])
        fit = Fit(self.runs, self.base, self.bounds, runs)
        fit.noise, fit.lasts = self.noise, self.lasts
        return fit

    def fields_of(self, values: Values) -> list[str]:
        """Names that the whole robot can be searched for, classic ones first."""
        return [f for f in (*CLASSIC, *SERVO_TERMS) if f in values and f not in ALONE]

    def balanced(self) -> list[Values]:
        """What balances the recorded accelerations, by itself and with the file's kp."""
        own, first, balanced = self.bounds.start, self.bounds.first["kp"], self.runs.regressed()
        known = balanced["kp"] > 0
        more = np.divide(first, balanced["kp"], out=np.ones(self.n), where=known)
        scaled = {f: x if f in ("offset", "delay") else x * more for f, x in balanced.items()}
        return [
            {f: np.where(known, x - self.bounds.spare * (f == "damping"), own[f]) for f, x in values.items()}
            for values in (balanced, scaled)
        ]

    def search(
        self, fields: ListOf[str], start: Values, clock: Clock, what: str, others: ListOf[Values] = ()
    ) -> Values:
        """Fit the classic fields, those of the law that `start` has and these, every joint on its own, from a start,
        from at most two others, and from some beside the first, STARTS in all."""
        names = [f for f in (*CLASSIC, "effort_limit", *SERVO_TERMS) if f in start or f in fields]
        axes = Axes(self.bounds, names, start)
        rng = np.random.default_rng(0)
        x = np.repeat(axes.of(start)[None], STARTS, axis=0)
        x[1:] += SPREAD * rng.standard_normal(x[1:].shape)
        for i, one in enumerate(others):
            x[2 + i] = axes.of(one)
        x = np.clip(x, axes.low, axes.high)
        for runs, iterations in zip((self.runs.shortened(SHORT), self.runs, self.runs), SEARCH, strict=True):
            tell = clock.tell(what, self.base.operated, runs.rows)
            errors = lambda xs, runs=runs: self.errors(axes.values(xs), runs)  # noqa: E731
            x, cost = descend(x, axes.low, axes.high, errors, iterations, tell, clock.over)
            self.learn(cost.min(axis=0), runs.rows)
            if runs is self.runs:
                x = better_half(x, cost)
        return {f: v[0].copy() for f, v in axes.values(x[:1]).items()}

    def descend(
        self, fields: ListOf[str], rest: Values, x: Array, iterations: ListOf[int], clock: Clock, what: str
    ) -> Values:
        """Fit these fields in the simulator of the whole robot, from starts on their axes, of which half go on."""
        assert self.company is not None
        runs, axes = self.company, Axes(self.bounds, fields, rest)
        tell = clock.tell(what, self.base.operated, runs.rows)
        for i, count in enumerate(iterations):
            errors = lambda xs: self.errors(axes.values(xs), runs)  # noqa: E731
            x, cost = descend(x, axes.low, axes.high, errors, count, tell, clock.over, ENOUGH)
            self.learn(cost.min(axis=0), runs.rows)
            if i < len(iterations) - 1:
                # Of every joint the better start; all of one start where that does better together.
                x = np.concatenate([better_half(x, cost)[:1], x[[cost.sum(axis=1).argmin()]]])
                x = x[:1] if np.array_equal(x[0], x[1]) else x
        return {f: v[0].copy() for f, v in axes.values(x[[cost.sum(axis=1).argmin()]]).items()}

    def limbs(self, values: Values, clock: Clock) -> Values:
        """Fit what `descend` found once more, a joint's parameters by the errors of all joints of its limb."""
        assert self.company is not None
        runs, axes, limbs = self.company, Axes(self.bounds, self.fields_of(values), values), self.together
        errors = lambda xs: limbs.pack(self.errors(axes.values(limbs.unpack(xs)), runs))  # noqa: E731
        rows, first = limbs.pack(runs.rows[:, None]).sum(axis=1), [self.base.operated[i] for i in limbs.at[:, 0]]
        x, (low, high) = limbs.pack(axes.of(values)[None]), map(limbs.pack, (axes.low, axes.high))
        tell = clock.tell("limbs", tuple(first), rows)
        count = max(1, min(LIMBS, LIMB_RUNS // (x.shape[-1] + 5)))
        x, _ = descend(x, low, high, errors, count, tell, clock.over, LITTLE)
        return {f: v[0].copy() for f, v in axes.values(limbs.unpack(x)).items()}

    def learn(self, cost: Array, rows: Array) -> None:
        """What the best fit leaves of each joint says how much a file's value weighs."""
        self.noise = np.maximum(SOFT * np.sqrt(2 * cost / np.maximum(rows, 1)), 1e-5)

    def learn_lasting(self, values: Values) -> None:
        """What an error of each joint says of itself later: so long it is one measurement beside a belief."""
        found = self.runs.errors({f: v[None] for f, v in values.items()})[0]  # (n, windows, rows)
        power = (np.abs(np.fft.rfft(found, 2 * found.shape[-1])) ** 2).sum(axis=1)
        alike = np.fft.irfft(power)[:, : found.shape[-1]]
        alike /= np.maximum(alike[:, :1], 1e-30)
        alike *= np.cumprod(alike > FAINT, axis=1)
        self.lasts = np.maximum(self.runs.dt * self.runs.thin * (2 * alike.sum(axis=1) - 1), LASTS[0])

    def errors(self, values: Values, runs: JointRollouts | RobotRollouts) -> Array:
        """Errors of (k, n) values, (k, n, rows), in SOFT; two more: how far kp and armature are from the file's."""
        if isinstance(runs, JointRollouts):
            found = runs.errors(values)
            found = found.reshape(*found.shape[:2], -1)
        else:
            found = runs.run(values)
        told = BELIEF | ({"kp": TOLD} if self.bounds.stated else {})
        given = {f: np.where(self.bounds.first[f] > 0, self.bounds.first[f], np.nan) for f in told}
        far = [np.nan_to_num(np.log(np.maximum(values[f], 1e-9) / v)) * self._one() / told[f] for f, v in given.items()]
        return np.concatenate([found / np.float32(SOFT), np.stack(far, axis=-1)], axis=2, dtype=np.float32)

    def _one(self) -> Array:
        """The standard deviation of an error that counts as one beside a belief, (n,) in SOFT."""
        return np.asarray(self.noise / SOFT * np.sqrt(self.lasts / max(self.runs.dt, 0.01)))

    def robot(self, values: Values) -> RobotSpec:
        """The robot with these values."""
        joints = self.base.operated
        return self.base.with_servos(
            {j: {f: float(f"{v[i]:.6g}") for f, v in values.items()} for i, j in enumerate(joints)}
        )

    def uncertainty(self, values: Values) -> tuple[Std, Std]:
        """Standard errors, joint → field, of the values and of those that are searched over kp: from slopes,
        windows that pull against each other, how wide a belief is that holds a value, and how far a step more goes."""
        names = [f for f in (*CLASSIC, "effort_limit", *SERVO_TERMS) if f in values and f != "encoder_step"]
        axes, runs = Axes(self.bounds, names, values), self.runs if self.company is None else self.company
        x = axes.of(values)
        asked = agreed_slopes(x[None], axes.low, axes.high, lambda xs: self.errors(axes.values(xs), runs))
        here, jac = (y[0] for y in asked)
        weight = 1 / np.sqrt(1 + here**2)
        pull = jac * (weight * here)[..., None]  # (n, rows + 2, P)
        window = runs.window
        parts = max(1, -(-CLUSTERS // (int(window.max()) + 1)))  # of a window, where there are few
        order, turn = np.argsort(window, kind="stable"), np.zeros(len(window), int)
        turn[order] = np.concatenate([np.arange(c) * parts // c for c in np.unique(window, return_counts=True)[1]])
        clusters = int((cluster := window * parts + turn).max()) + 1
        each = np.zeros((self.n, clusters, len(names)))
        np.add.at(each, (slice(None), cluster), pull[:, :-2])  # type: ignore[arg-type]
        each -= each.mean(axis=1, keepdims=True)
        believed = jac[:, -2:] * self._one()[:, None, None]
        normal = (np.swapaxes(jac, -1, -2) @ (weight[..., None] * jac)).astype(float)
        few = clusters / max(clusters - len(names), 1)  # squared, as a jackknife of so few clusters has it
        spread = np.swapaxes(each, -1, -2) @ each * few**2
        spread += np.swapaxes(believed, -1, -2) @ believed
        # What no row has to say of a parameter is as unknown as before: then it is the file's, or nobody's.
        size = np.sqrt(np.einsum("...ii->...i", normal))
        lost = size < 3e-5
        inverse = _inverse(normal, np.where(lost | (axes.low == axes.high), np.inf, size))
        step = np.clip((inverse @ pull.sum(axis=1)[..., None])[..., 0], -1, 1)
        cov = inverse @ spread @ inverse + step[..., :, None] * step[..., None, :]
        width = np.sqrt(np.einsum("...ii->...i", cov)) + np.where(lost & (axes.low < axes.high), 1e3, 0)
        ahead = [axes.values(x + 1e-3 * row) for row in np.eye(len(names))]
        by = {f: np.stack([(a[f] - values[f]) / 1e-3 for a in ahead], axis=-1) for f in names}
        std = {f: np.sqrt(np.einsum("np,npq,nq->n", g, cov, g)) + (np.abs(g) * lost).max(axis=1) for f, g in by.items()}
        std |= {f: np.hypot(std[f], error) for f, error in self._stepped(values).items()}
        joints, unit = self.base.operated, axes.unit[..., None]
        wide = unit * (cov + 1e3 * np.eye(len(names)) * lost[..., None, :]) * np.swapaxes(unit, -1, -2)
        self.covariance = {j: (names, wide[i]) for i, j in enumerate(joints)}
        found = {j: {f: float(std[f][i]) for f in names} for i, j in enumerate(joints)}
        return found, {j: {f: float(width[i, k]) for k, f in enumerate(names)} for i, j in enumerate(joints)}

    def _stepped(self, values: Values) -> Values:
        """What the physics step may take for damping, armature or delay: a step's length beside time that runs on."""
        h = HALF * self.runs.dt / self.runs.count
        total = values["damping"] + self.base.kd[self.base.operated_index]
        return {"damping": h * values["kp"], "armature": h * total, "delay": np.full(self.n, h)}

    def bounds_met(self, values: Values) -> tuple[str, ...]:
        """Every parameter at a bound, with what to check; no friction, armature or delay at all are ordinary."""
        names = [f for f in (*CLASSIC, "effort_limit", *SERVO_TERMS) if f in values and f != "encoder_step"]
        axes, found = Axes(self.bounds, names, values), []
        x = axes.of(values)
        for i, joint in enumerate(self.base.operated):
            for k, f in enumerate(names):
                held = axes.low[i, k] == axes.high[i, k]
                below = x[i, k] - axes.low[i, k] < 0.02 and (f == "damping" or axes.low[i, k] != 0)
                held |= f == "stribeck_speed" and not values["stribeck"][i]
                if held or not (below or axes.high[i, k] - x[i, k] < 0.02):
                    continue
                if f == "damping" and below and not self.bounds.spare[i] and self.base.kd[self.base.operated_index[i]]:
                    what = "0 beside the kd that the recordings state; less would fit better: check that kd"
                elif f == "damping" and below:
                    what = "none at all; check that commands are what the servo was given, and their clock"
                else:
                    end, check = "least" if below else "most", CHECK.get(f, "the law does not fit")
                    what = f"{values[f][i]:.4g}, the {end} that is tried; {check}"
                found.append(f"{joint}: {f} ended at its bound: {what}")
        return tuple(found)

    def undetermined(self, values: Values, std: Std, over_kp: Std) -> dict[str, tuple[tuple[str, ...], str]]:
        """Joints that stood, and parameters whose standard error is as large as what they may mean: joint → fields, and
        what is to be said."""
        names = [f for f in (*CLASSIC, "effort_limit", *SERVO_TERMS) if f in values and f != "encoder_step"]
        found: dict[str, tuple[tuple[str, ...], str]] = {}
        axes = Axes(self.bounds, names, values)
        x = axes.of(values)
        ahead = axes.values(x + 1)
        for i, joint in enumerate(self.base.operated):
            if self.bounds.still[i]:
                why = (
                    f"{joint}: not determined by these logs: no command moves it by {STILL:g} rad; it keeps the file's "
                    "values but for what others that move it show (kp, damping, friction, offset); record its motion"
                )
                found[joint] = tuple(names), why
                continue
            wide, alone = {}, []
            for k, f in enumerate(names):
                if f == "stribeck_speed" and not values["stribeck"][i]:
                    continue
                value, error = values[f][i], std[joint].get(f, 0.0)
                if error > WIDE * max(abs(value), ahead[f][i] - value):
                    wide[f] = f"{f} {format_uncertainty(value, error)}"
                    ratio = over_kp.get(joint, {}).get(f, np.inf)
                    if f not in OVER_KP or ratio > WIDE * max(abs(x[i, k]), 1.0):
                        alone.append(f)
            together = set(alone) == {"kp"} and len(wide) > 1
            as_set = "; known as multiples of kp: take the values as a set" if together else ""
            if wide:
                told = ", ".join(wide.values())
                found[joint] = tuple(wide), f"{joint}: not determined by these logs: {told}{as_set}"
        return found


def _inverse(normal: Array, size: Array) -> Array:
    """Inverses of (…, P, P), by their diagonals' roots (…, P); 0 of parameters whose size is infinite."""
    each = size[..., :, None] * size[..., None, :]
    held = np.eye(size.shape[-1]) * np.isinf(size)[..., None]
    return np.asarray(np.linalg.pinv(normal / each + held, rcond=1e-10, hermitian=True) / each)


STOPPED, OFTEN = 0.1, 50  # rad that commands go beyond a stop, and further there; rows that must show it


def with_stops(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """The robot with joint stops narrower than the MJCF's, where commands go on and the joint stays.

    A joint that hangs far behind is loaded, or stuck as its command comes back: a stop is where a command went on by
    STOPPED after the joint had come to its end, twice at least.
    """
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(robot.operated, robot.operated_index, strict=True):
        for name, sign in (("stop_low", -1.0), ("stop_high", 1.0)):
            paths = [(sign * s.ctrl[:, i], sign * s.qpos[:, i]) for s in sequences]
            end = max(float(qpos.max()) for _, qpos in paths)
            against = [c for ctrl, qpos in paths for c in _against(ctrl, qpos, end)]
            went_on = [c.max() - c[0] > STOPPED for c in against]
            met = sum(map(len, against)) >= OFTEN and sum(went_on) > 1
            if met and sign * robot.qpos_range[i, int(sign > 0)] > end + 0.01:
                servos.setdefault(joint, {})[name] = round(sign * end, 4)
    return robot.with_servos(servos) if servos else robot


def _against(ctrl: Array, qpos: Array, end: float) -> list[Array]:
    """Commands well beyond the end of a joint's way while it is there, each time by itself; all of one direction."""
    rows = np.flatnonzero((ctrl > end + STOPPED) & (qpos > end - 0.005))
    return np.split(ctrl[rows], np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []


def _asked_stops(given: RobotSpec, met: RobotSpec) -> list[str]:
    """Where joints stayed behind several commands: a question, since what was met may have been anything."""
    found = []
    for joint, i in zip(given.operated, given.operated_index, strict=True):
        for name, which in (("stop_low", 0), ("stop_high", 1)):
            stop = float(getattr(met, name)[i])
            if np.isfinite(stop) and stop != getattr(given, name)[i]:
                usual = given.qpos_range[i, which]
                found.append(
                    f"{joint}: stayed at {stop:.3f} rad where commands went on towards {usual:.3f}: if that is a stop, "
                    "identify with --stops; if something was in its way, leave those motions out"
                )
    return found
