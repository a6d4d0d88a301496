"""Adaptation of a robot's servo parameters to one robot id or day, from half a minute of its log.

A prior keeps parameters that so little log does not determine at the robot's values; with a corrector, the fit is made
under it. Half a minute has more information about all joints together than about one. So a change that all joints share
costs less than a change of one joint.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import MIN_RELATIVE_GAIN, Comparison
from gaponet.sim.replay import Corrector, rollout_errors
from gaponet.sysid.axes import LARGE_KP_LOG_CHANGE, Bounds, Changes, Values, with_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD
from gaponet.sysid.least_squares import DIFFERENCE_STEP, Errors, descend
from gaponet.sysid.robot_rollouts import WINDOW_S, RobotRollouts, cut

Field = Literal["kp", "damping", "frictionloss", "offset", "delay"]
FIELDS: tuple[Field, ...] = get_args(Field)
PRIOR_RAD = 0.3  # price of a large change of one joint
SHARED_PRIOR_RATIO = 0.05  # the same where all joints change by the same share: a cold day, a slow bus
SHARED_FIELDS = ("damping", "frictionloss", "delay")  # such a day moves no zeros and softens no gains
ITERATIONS, MIN_DECREASE = 4, 1e-3  # at most; relative decrease of the cost for another one
MAX_FOLDS = 4  # of motions that judge
MAX_SHORT_WINDOW_S = 4.0  # too short to validate another window
START_DELAY_S = 0.005  # a delay of zero has no slope
START_MASSES_KG = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # of an unknown payload
MAX_MASS_KG = 20.0


@dataclass(frozen=True)
class Adapted:
    """Result of an adaptation.

    Attributes:
        robot: The robot with fitted parameters.
        before, after: RMS error of the windows, rad.
        payload_mass, payload_std: kg in each hand that carries; None unless the payload is unknown.
        judged: Mean |error| of motions before, and with the fit to the other motions, (motions,) rad.
        accepted: True if the windows improve by 1 % and those motions do not become worse (`Comparison.harmful`); False
            for one short motion per joint. The prior weighs the evidence.
    """

    robot: RobotSpec
    before: float
    after: float
    payload_mass: float | None = None
    payload_std: float | None = None
    judged: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
    accepted: bool = True


def adapt(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    seconds: float = 30.0,
    unknown_payload: bool = False,
    corrector: Corrector | None = None,
    progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    judge: bool = False,
) -> Adapted:
    """Fit FIELDS of all operated joints at once.

    Args:
        sequences: Recordings of one robot id; windows of 8 s are taken from them evenly.
        robot: Start and centre of the prior; its payload masses are taken as true.
        seconds: Duration of the windows together.
        unknown_payload: Fit one payload mass for all recordings, instead of the recorded one.
        corrector: Corrects the targets, as in replay.
        progress: Called with iterations done, at most, and the present RMS error in rad.
        judge: Judge by motions that are not fitted; joints with one short motion keep their values then.

    Raises:
        UsageError: The payload is unknown and the recordings are filed under several masses.
    """
    payloads = sorted({s.meta.payload_mass for s in sequences})
    if unknown_payload and len(payloads) > 1:
        raise UsageError(
            f"these recordings are filed under {', '.join(f'{p:g}' for p in payloads)} kg; an unknown payload must be "
            "one and the same: give recordings of one mass"
        )
    parts = cut(sequences, max(1, round(seconds / WINDOW_S)))
    judged = _cross_validated(parts, robot, corrector) if judge else (np.zeros(0), np.zeros(0))
    accepted = not judge or parts[0].duration > MAX_SHORT_WINDOW_S
    if len(judged[0]):
        accepted = not Comparison("adapted", *judged).harmful
        parts = [parts[i] for motions in _motions_that_judge(parts) for motion in motions for i in motion]
    rollouts = RobotRollouts(parts, robot, corrector=corrector)
    problem = _Problem(rollouts, Bounds(robot, sequences).first, unknown_payload, robot.kd[rollouts.op])
    done = 0

    def report(cost: Array) -> None:
        nonlocal done
        done += 1
        progress(done, ITERATIONS, ERROR_SCALE_RAD * float(np.sqrt(2 * cost[0] / problem.size)))

    x, _ = descend(
        problem.start(payloads[0])[None, None], problem.low, problem.high, problem.errors, ITERATIONS, report,
        min_decrease=MIN_DECREASE, derive=problem.slopes,
    )  # fmt: skip
    before, after = (problem.rms(p) for p in (problem.own(float(np.mean(payloads))), x[0, 0]))
    accepted = accepted and not (judge and after > (1 - MIN_RELATIVE_GAIN) * before)
    mass = {"payload_mass": float(x[0, 0, -1]), "payload_std": problem.payload_std(x)} if unknown_payload else {}
    return Adapted(problem.robot_with(x[0, 0]), before, after, **mass, judged=judged, accepted=accepted)


def _motions_that_judge(parts: list[Sequence]) -> list[list[list[int]]]:
    """Return the windows of each motion, for each set of joints that is recorded together.

    A single motion of a set is divided into its windows where these are long. Else it is left out, since nothing else
    can judge it.
    """
    groups: dict[tuple[str, ...], dict[str, list[int]]] = {}
    for i, p in enumerate(parts):
        groups.setdefault(p.meta.unrecorded, {}).setdefault(p.meta.motion, []).append(i)
    every = [list(motions.values()) for motions in groups.values()]
    every = [[[i] for i in m[0]] if len(m) == 1 and parts[m[0][0]].duration > MAX_SHORT_WINDOW_S else m for m in every]
    return [motions for motions in every if len(motions) > 1]


def _cross_validated(parts: list[Sequence], robot: RobotSpec, corrector: Corrector | None) -> tuple[Array, Array]:
    """Return the mean |error| of motions, of the robot and of the fit to the other motions, (motions,) rad."""
    every, errors = _motions_that_judge(parts), list[tuple[float, ...]]()
    for k in range(min(MAX_FOLDS, max(map(len, every), default=0))):
        test = [motion for motions in every for motion in motions[k::MAX_FOLDS]]
        rest = [parts[i] for motions in every for motion in motions if motion not in test for i in motion]
        both = robot, adapt(rest, robot, len(rest) * WINDOW_S, corrector=corrector).robot
        errors += [tuple(rollout_errors([parts[i] for i in motion], r).mean() for r in both) for motion in test]
    before, after = np.array(errors).reshape(-1, 2).T
    return before, after


class _Problem:
    """All joints as one problem: x (P,) is the change of each field, joint by joint, in large changes; then the payload
    mass in kg if it is unknown.

    A servo's parameters act on its own joint first; on others they act less by the ratio of the inertias. So one
    simulation changes a field of all joints, and each joint's error counts for its own parameter: six simulations give
    all derivatives, however many joints. A payload loads all of them.
    """

    def __init__(self, rollouts: RobotRollouts, first: Values, unknown_payload: bool, kd_slack: Array) -> None:
        self.rollouts, self.unknown, self.n = rollouts, unknown_payload, rollouts.n
        self.size, self.changes = int(rollouts.rows.sum()), Changes(first, FIELDS, kd_slack)
        self.low = np.append(self.changes.low, [0.0] * unknown_payload)[None]
        self.high = np.append(self.changes.high, [MAX_MASS_KG] * unknown_payload)[None]
        price = PRIOR_RAD / ERROR_SCALE_RAD
        single, common = price * np.eye(self.n), price * (1 - SHARED_PRIOR_RATIO) / self.n
        self.prior = np.zeros((len(FIELDS) * self.n, self.low.size))  # errors of the prior over x
        for i, f in enumerate(FIELDS):
            here = np.arange(self.n) * len(FIELDS) + i
            weight = LARGE_KP_LOG_CHANGE if f == "kp" else 1.0
            self.prior[np.ix_(here, here)] = weight * (single - common * (f in SHARED_FIELDS))

    def own(self, mass: float) -> Array:
        """Return x of the robot as it is, with a payload of `mass` kg."""
        return np.append(np.zeros(self.n * len(FIELDS)), [mass] * self.unknown)

    def start(self, mass: float) -> Array:
        """Return the start: the robot with a delay; an unknown payload is the best mass of START_MASSES_KG."""
        x = np.append(self.changes.start(START_DELAY_S), [mass] * self.unknown)
        if not self.unknown:
            return x
        xs = np.repeat(x[None], len(START_MASSES_KG), axis=0)
        xs[:, -1] = START_MASSES_KG
        return np.asarray(xs[np.square(self._errors(xs)).sum(axis=(1, 2)).argmin()])

    def values(self, x: Array) -> Values:
        """Return x (k, P) as field → (k, n)."""
        return self.changes.values(x[:, : self.n * len(FIELDS)].reshape(len(x), self.n, len(FIELDS)))

    def robot_with(self, x: Array) -> RobotSpec:
        """Return the robot with parameters x (P,); joints that are not operated keep theirs."""
        values = self.values(x[None])
        return with_values(self.rollouts.robot, {f: values[f][0] for f in FIELDS})

    def rms(self, x: Array) -> float:
        """Return the RMS error of the windows, rad."""
        return ERROR_SCALE_RAD * float(np.sqrt(np.square(self._errors(x[None])).mean()))

    def errors(self, xs: Array) -> Array:
        """Return errors of candidates (k, 1, P), (k, 1, rows) in ERROR_SCALE_RAD: of all joints, then of the prior."""
        own = self._errors(xs[:, 0]).reshape(len(xs), -1)
        return np.concatenate([own, xs[:, 0] @ self.prior.T], axis=1)[:, None]

    def slopes(self, x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
        """Return what least_squares.slopes does, for one start, by fewer candidates."""
        here, count = x[0, 0], len(FIELDS) + self.unknown
        field = np.append(np.tile(np.arange(len(FIELDS)), self.n), [count - 1] * self.unknown).astype(int)
        step = np.where(here + DIFFERENCE_STEP > high[0], -DIFFERENCE_STEP, DIFFERENCE_STEP)
        tried = here + np.concatenate([np.zeros((1, len(here))), (field == np.arange(count)[:, None]) * step])
        each = self._errors(tried)  # (1 + count, n, rows)
        rows = each.shape[2]
        jac = np.zeros((self.n, rows, len(here)), np.float32)
        for i in range(len(here)):
            mine = slice(None) if self.unknown and i == len(here) - 1 else i // len(FIELDS)
            jac[mine, :, i] = (each[1 + field[i], mine] - each[0, mine]) / step[i]
        base = np.concatenate([each[0].ravel(), self.prior @ here])
        return base[None, None], np.concatenate([jac.reshape(-1, len(here)), self.prior])[None, None]

    def payload_std(self, x: Array) -> float:
        """Return the standard error of the payload mass, kg, by a jackknife over windows (one Gauss-Newton step each).

        Errors of the model last as long as a motion, so rows of a window are not independent.
        """
        here, jac = (y[0, 0] for y in self.slopes(x, self.high, self.errors))
        window = np.append(
            np.tile(self.rollouts.window, self.n), np.full(len(here) - self.n * len(self.rollouts.window), -1)
        )
        weight, moved = 1 / np.sqrt(1 + here**2), []
        for left_out in range(len(self.rollouts.parts)):
            w = weight * (window != left_out)
            moved.append(np.linalg.lstsq(jac.T @ (w[:, None] * jac), -jac.T @ (w * here))[0][-1])
        m = len(moved)
        return float(np.sqrt((m - 1) / m * np.square(moved - np.mean(moved)).sum())) if m > 1 else float("nan")

    def _errors(self, xs: Array) -> Array:
        """Return errors of rollouts, (k, n, rows) in ERROR_SCALE_RAD."""
        parts = self.rollouts.parts
        if self.unknown:
            parts = [replace(s, meta=replace(s.meta, payload_mass=float(x[-1]))) for x in xs for s in parts]
        return self.rollouts.flat_errors(self.values(xs), parts if self.unknown else None) / np.float32(ERROR_SCALE_RAD)
