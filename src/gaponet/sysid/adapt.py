"""Adaptation of a robot's servo parameters to one robot id or day, from half a minute of its log.

A prior keeps parameters that so little log does not determine at the robot's values; with a
corrector, the fit is made under it. Half a minute has more information about all joints together
than about one. So a change that all joints share costs less than a change of one joint.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import MIN_RELATIVE_GAIN, Comparison
from gaponet.sim.replay import Corrector, rollout_errors
from gaponet.sysid.axes import LARGE_KP_LOG_CHANGE, Changes, Values, first_values, with_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD
from gaponet.sysid.least_squares import DIFFERENCE_STEP, Errors, descend
from gaponet.sysid.robot_rollouts import WINDOW_S, RobotRollouts, cut

Field = Literal["kp", "damping", "frictionloss", "offset", "delay"]
FIELDS: tuple[Field, ...] = get_args(Field)
PRIOR_RAD = 0.3  # price of a large change of one joint
# the same where all joints change by the same share: a cold day, a slow bus
SHARED_PRIOR_RATIO = 0.05
# such a day moves no zeros and softens no gains
SHARED_FIELDS = (
    "damping",
    "frictionloss",
    "delay",
)
# at most; relative decrease of the cost for another one
ITERATIONS = 4
MIN_DECREASE = 1e-3
MAX_FOLDS = 4  # of motions that judge
MAX_SHORT_WINDOW_S = 4.0  # too short to validate another window
START_DELAY_S = 0.005  # a delay of zero has no slope


@dataclass(frozen=True)
class Adapted:
    """Result of an adaptation.

    Attributes:
        robot: The robot with fitted parameters.
        before, after: RMS error of the windows, rad.
        judged: Mean |error| of motions before, and with the fit to the other motions, (motions,)
            rad.
        accepted: True if the windows improve by 1 % and those motions do not become worse
            (`Comparison.harmful`); False for one short motion per joint. The prior weighs the
            evidence.
    """

    robot: RobotSpec
    before: float
    after: float
    judged: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
    accepted: bool = True


def adapt(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    seconds: float = 30.0,
    corrector: Corrector | None = None,
    progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    judge: bool = False,
) -> Adapted:
    """Fit FIELDS of all operated joints at once.

    Args:
        sequences: Recordings of one robot id; windows of 8 s are taken from them evenly.
        robot: Start and centre of the prior; its payload masses are taken as true.
        seconds: Duration of the windows together.
        corrector: Corrects the targets, as in replay.
        progress: Called with iterations done, at most, and the present RMS error in rad.
        judge: Judge by motions that are not fitted; joints with one short motion keep their values
            then.
    """
    parts = cut(sequences, max(1, round(seconds / WINDOW_S)))
    judged = _cross_validated(parts, robot, corrector) if judge else (np.zeros(0), np.zeros(0))
    accepted = not judge or parts[0].duration > MAX_SHORT_WINDOW_S
    if len(judged[0]):
        accepted = not Comparison("adapted", *judged).harmful
        parts = [
            parts[i] for motions in _motions_that_judge(parts) for motion in motions for i in motion
        ]
    rollouts = RobotRollouts(parts, robot, corrector=corrector)
    problem = _Problem(rollouts, first_values(robot), robot.kd[rollouts.op])
    done = 0

    def report(cost: Array) -> None:
        nonlocal done
        done += 1
        progress(done, ITERATIONS, ERROR_SCALE_RAD * float(np.sqrt(2 * cost[0] / problem.size)))

    x, _ = descend(
        problem.changes.start(START_DELAY_S).reshape(1, 1, -1),
        problem.low,
        problem.high,
        problem.errors,
        ITERATIONS,
        report,
        min_decrease=MIN_DECREASE,
        derive=problem.slopes,
    )
    before, after = (problem.rms(p) for p in (np.zeros_like(x[0, 0]), x[0, 0]))
    accepted = accepted and not (judge and after > (1 - MIN_RELATIVE_GAIN) * before)
    values = problem.values(x[0])
    return Adapted(
        with_values(robot, {str(f): values[f][0] for f in FIELDS}), before, after, judged, accepted
    )


def _motions_that_judge(parts: list[Sequence]) -> list[list[list[int]]]:
    """Return the windows of each motion, for each set of joints that is recorded together.

    A single motion of a set is divided into its windows where these are long. Else it is left out,
    since nothing else can judge it.
    """
    groups: dict[tuple[str, ...], dict[str, list[int]]] = {}
    for i, p in enumerate(parts):
        groups.setdefault(p.meta.unrecorded, {}).setdefault(p.meta.motion, []).append(i)
    every = [list(motions.values()) for motions in groups.values()]
    every = [
        [[i] for i in m[0]] if len(m) == 1 and parts[m[0][0]].duration > MAX_SHORT_WINDOW_S else m
        for m in every
    ]
    return [motions for motions in every if len(motions) > 1]


def _cross_validated(
    parts: list[Sequence], robot: RobotSpec, corrector: Corrector | None
) -> tuple[Array, Array]:
    """Return the mean |error| of motions, of the robot and of the fit to the other motions,
    (motions,) rad.
    """
    every = _motions_that_judge(parts)
    errors = list[tuple[float, ...]]()
    for k in range(min(MAX_FOLDS, max(map(len, every), default=0))):
        test = [motion for motions in every for motion in motions[k::MAX_FOLDS]]
        rest = [
            parts[i]
            for motions in every
            for motion in motions
            if motion not in test
            for i in motion
        ]
        both = robot, adapt(rest, robot, len(rest) * WINDOW_S, corrector=corrector).robot
        errors += [
            tuple(rollout_errors([parts[i] for i in motion], r).mean() for r in both)
            for motion in test
        ]
    before, after = np.array(errors).reshape(-1, 2).T
    return before, after


class _Problem:
    """All joints as one problem: x (P,) is the change of each field, joint by joint, in large
    changes.

    A servo's parameters act on its own joint first; on others they act less by the ratio of the
    inertias. So one simulation changes a field of all joints, and each joint's error counts for its
    own parameter: six simulations give all derivatives, however many joints.
    """

    def __init__(self, rollouts: RobotRollouts, first: Values, kd_slack: Array) -> None:
        self.rollouts = rollouts
        self.n = rollouts.n
        self.size = int(rollouts.rows.sum())
        self.changes = Changes(first, FIELDS, kd_slack)
        self.low, self.high = self.changes.low.reshape(1, -1), self.changes.high.reshape(1, -1)
        price = PRIOR_RAD / ERROR_SCALE_RAD
        single = price * np.eye(self.n)
        common = price * (1 - SHARED_PRIOR_RATIO) / self.n
        self.prior = np.zeros((self.low.size, self.low.size))  # errors of the prior over x
        for i, f in enumerate(FIELDS):
            here = np.arange(self.n) * len(FIELDS) + i
            weight = LARGE_KP_LOG_CHANGE if f == "kp" else 1.0
            self.prior[np.ix_(here, here)] = weight * (single - common * (f in SHARED_FIELDS))

    def values(self, xs: Array) -> Values:
        """Return candidates (k, P) as field → (k, n)."""
        return self.changes.values(xs.reshape(len(xs), self.n, len(FIELDS)))

    def rms(self, x: Array) -> float:
        """Return the RMS error of the windows, rad."""
        return ERROR_SCALE_RAD * float(np.sqrt(np.square(self._errors(x[None])).mean()))

    def errors(self, xs: Array) -> Array:
        """Return errors of candidates (k, 1, P), (k, 1, rows) in ERROR_SCALE_RAD: of all joints,
        then of the prior.
        """
        own = self._errors(xs[:, 0]).reshape(len(xs), -1)
        return np.concatenate([own, xs[:, 0] @ self.prior.T], axis=1)[:, None]

    def slopes(self, x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
        """Return what least_squares.slopes does, for one start, by fewer candidates."""
        here = x[0, 0]
        count = len(FIELDS)
        field = np.tile(np.arange(count), self.n)
        step = np.where(here + DIFFERENCE_STEP > high[0], -DIFFERENCE_STEP, DIFFERENCE_STEP)
        tried = here + np.concatenate(
            [np.zeros((1, len(here))), (field == np.arange(count)[:, None]) * step]
        )
        each = self._errors(tried)  # (1 + count, n, rows)
        jac = np.zeros((*each.shape[1:], len(here)), np.float32)
        for i in range(len(here)):
            joint = i // count
            jac[joint, :, i] = (each[1 + field[i], joint] - each[0, joint]) / step[i]
        base = np.concatenate([each[0].ravel(), self.prior @ here])
        return base[None, None], np.concatenate([jac.reshape(-1, len(here)), self.prior])[
            None, None
        ]

    def _errors(self, xs: Array) -> Array:
        """Return errors of rollouts, (k, n, rows) in ERROR_SCALE_RAD."""
        return self.rollouts.flat_errors(self.values(xs)) / np.float32(ERROR_SCALE_RAD)
