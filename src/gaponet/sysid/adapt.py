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
from gaponet.sysid.least_squares import DIFFERENCE_STEP, Errors, Problems, descend
from gaponet.sysid.robot_rollouts import WINDOW_S, RobotRollouts, cut

Field = Literal["kp", "damping", "frictionloss", "offset", "delay"]
FIELDS: tuple[Field, ...] = get_args(Field)
PRIOR_RAD = 0.3  # price of a large change of one joint
# The same price, relative, where all joints change by the same share: a cold day, a slow bus.
SHARED_PRIOR_RATIO = 0.05
# What such a day changes: it moves no zeros and softens no gains.
SHARED_FIELDS = ("damping", "frictionloss", "delay")
MAX_ITERATIONS = 4
MIN_DECREASE = 1e-3  # relative, of the cost, for another iteration
MAX_FOLDS = 4  # of motions that judge
# A window of this length is too short to validate another one.
MAX_SHORT_WINDOW_S = 4.0
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
    windows = cut(sequences, max(1, round(seconds / WINDOW_S)))
    judged = (np.zeros(0), np.zeros(0))
    accepted = True
    if judge:
        motions_of_sets = _motions_that_judge(windows)
        if motions_of_sets:
            judged = _cross_validated(motions_of_sets, robot, corrector)
            accepted = not Comparison("adapted", *judged).harmful
            windows = _windows_of(motions_of_sets)
        else:
            accepted = windows[0].duration > MAX_SHORT_WINDOW_S
    rollouts = RobotRollouts(windows, robot, corrector=corrector)
    problem = _Problem(rollouts, first_values(robot), robot.servo.kd[rollouts.op])
    done = 0

    def report(cost: Array) -> None:
        nonlocal done
        done += 1
        rms = ERROR_SCALE_RAD * float(np.sqrt(2 * cost[0] / problem.size))
        progress(done, MAX_ITERATIONS, rms)

    start = problem.changes.start(START_DELAY_S).reshape(1, 1, -1)
    problems = Problems(problem.errors, problem.low, problem.high, problem.slopes)
    x, _ = descend(problems, start, MAX_ITERATIONS, report, MIN_DECREASE)
    found = x[0, 0]  # (P,)
    before = problem.rms(np.zeros_like(found))
    after = problem.rms(found)
    if judge and after > (1 - MIN_RELATIVE_GAIN) * before:
        accepted = False
    values = problem.values(found[None])
    adapted = with_values(robot, {str(field): values[field][0] for field in FIELDS})
    return Adapted(adapted, before, after, judged, accepted)


# Windows of a recording that belong to one motion.
_Motion = list[Sequence]


def _motions_that_judge(windows: list[Sequence]) -> list[list[_Motion]]:
    """Return the motions of each set of joints that is recorded together.

    Each window of a set's single motion counts as a motion of its own where they are long. Short
    ones are left out, since nothing else of their set can judge them.
    """
    groups: dict[tuple[str, ...], dict[str, _Motion]] = {}
    for window in windows:
        motions_of_set = groups.setdefault(window.meta.unrecorded, {})
        motions_of_set.setdefault(window.meta.motion, []).append(window)
    that_judge = []
    for motions_of_set in groups.values():
        motions = list(motions_of_set.values())
        if len(motions) == 1 and motions[0][0].duration > MAX_SHORT_WINDOW_S:
            motions = [[window] for window in motions[0]]
        if len(motions) > 1:
            that_judge.append(motions)
    return that_judge


def _windows_of(motions_of_sets: list[list[_Motion]]) -> list[Sequence]:
    """Return the windows of all motions, set by set."""
    windows: list[Sequence] = []
    for motions in motions_of_sets:
        for motion in motions:
            windows += motion
    return windows


def _cross_validated(
    motions_of_sets: list[list[_Motion]],
    robot: RobotSpec,
    corrector: Corrector | None,
) -> tuple[Array, Array]:
    """Return the mean |error| of motions, of the robot and of the fit to the other motions,
    (motions,) rad each.
    """
    before = []
    after = []
    most_motions = max(len(motions) for motions in motions_of_sets)
    folds = min(MAX_FOLDS, most_motions)
    for number in range(folds):
        test: list[_Motion] = []
        rest: list[Sequence] = []
        for motions in motions_of_sets:
            test += motions[number::MAX_FOLDS]
            for i, motion in enumerate(motions):
                if i % MAX_FOLDS != number:
                    rest += motion
        fitted = adapt(rest, robot, len(rest) * WINDOW_S, corrector=corrector).robot
        for motion in test:
            before.append(rollout_errors(motion, robot).mean())
            after.append(rollout_errors(motion, fitted).mean())
    return np.array(before), np.array(after)


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
        self.size = int(rollouts.rows.sum())  # number of errors
        self.changes = Changes(first, FIELDS, kd_slack)
        self.low = self.changes.low.reshape(1, -1)
        self.high = self.changes.high.reshape(1, -1)
        self.prior = self._prior()

    def _prior(self) -> Array:
        """Return the errors of the prior over x, (P, P).

        A change of one joint costs the price. Taking a share of the mean over joints away from it
        makes a change that all joints share cheaper, by SHARED_PRIOR_RATIO.
        """
        price = PRIOR_RAD / ERROR_SCALE_RAD
        single = price * np.eye(self.n)
        mean_of_joints = np.full((self.n, self.n), price * (1 - SHARED_PRIOR_RATIO) / self.n)
        prior = np.zeros((self.low.size, self.low.size))
        for i, field in enumerate(FIELDS):
            block = single
            if field in SHARED_FIELDS:
                block = single - mean_of_joints
            if field == "kp":
                block = LARGE_KP_LOG_CHANGE * block
            here = np.arange(self.n) * len(FIELDS) + i  # of this field in x, joint by joint
            prior[np.ix_(here, here)] = block
        return prior

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
        x = xs[:, 0]  # (k, P)
        of_rollouts = self._errors(x).reshape(len(xs), -1)
        of_prior = x @ self.prior.T
        return np.concatenate([of_rollouts, of_prior], axis=1)[:, None]

    def slopes(self, x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
        """Return what least_squares.slopes does, for one start, by fewer candidates: x as it is,
        and each field changed in all joints at once.
        """
        own = x[0, 0]  # (P,)
        joint_of, field_of = np.divmod(np.arange(len(own)), len(FIELDS))  # of each entry of x
        step = np.where(own + DIFFERENCE_STEP > high[0], -DIFFERENCE_STEP, DIFFERENCE_STEP)
        candidates = [own]
        for number in range(len(FIELDS)):
            candidates.append(own + np.where(field_of == number, step, 0.0))
        here, *moved = self._errors(np.stack(candidates))  # (n, rows) each
        jac = np.zeros((*here.shape, len(own)), np.float32)
        for i, (joint, number) in enumerate(zip(joint_of, field_of, strict=True)):
            jac[joint, :, i] = (moved[number][joint] - here[joint]) / step[i]
        with_prior = np.concatenate([here.ravel(), self.prior @ own])
        slopes = np.concatenate([jac.reshape(-1, len(own)), self.prior])
        return with_prior[None, None], slopes[None, None]

    def _errors(self, xs: Array) -> Array:
        """Return errors of rollouts, (k, n, rows) in ERROR_SCALE_RAD."""
        return self.rollouts.flat_errors(self.values(xs)) / np.float32(ERROR_SCALE_RAD)
