"""Fitting problem of servo parameters: errors of rollouts and of a prior, and searches."""

from __future__ import annotations

import copy
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model
from gaponet.sysid.axes import (
    CLASSIC,
    WARM_SLOPES,
    Axes,
    Bounds,
    Values,
    first_candidate,
    one_candidate,
)
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, JointRollouts, balanced_values
from gaponet.sysid.least_squares import (
    DAMPING_FACTORS,
    Errors,
    Problems,
    Progress,
    better_half,
    descend,
)
from gaponet.sysid.robot_rollouts import RobotRollouts

ROBOT_WINDOWS = 8  # windows of the fit in the robot's simulator
STARTS = 4  # of each joint's search
# Standard deviation of the starts around the first one, large changes.
START_STD = 2.0
SHORT_WINDOW_S = 0.5  # a search begins with windows this short
# Iterations of a joint's search: all starts on short windows, all on whole windows, and the better
# half.
SEARCH_ITERATIONS = (10, 8, 15)
# Of the fit of kinematic chains: iterations, and candidates of each chain that they simulate.
MAX_CHAIN_ITERATIONS = 8
MAX_CHAIN_CANDIDATES = 160
# Relative decrease of the cost from which another iteration in the robot's simulator follows.
MIN_COST_DECREASE = 2e-3
MIN_CHAIN_COST_DECREASE = 2e-4
MIN_ROW_PERIOD_S = 0.01  # of rows that count as measurements of their own
FIRST_RESIDUAL_RAD = 1e-3  # before the first search
MIN_RESIDUAL_RAD = 1e-5
MIN_CORRELATION_TIME_S = 1.0
FIRST_CORRELATION_TIME_S = 4.0  # before it is estimated
MIN_CORRELATION = 0.05  # of an error with itself later; less counts as none
MIN_SQUARED_ERROR = 1e-30  # rad², so that it can be divided by
# Field → standard deviation of its logarithm around the robot file's value; damping counts with kd.
PRIOR_LOG_STD = {"kp": 0.5, "armature": 1.5, "damping": 1.0}
PRIORS = len(PRIOR_LOG_STD)
STATED_KP_LOG_STD = 0.1  # of a kp that recordings state, instead
# Over the file's value: a smaller gain counts as this.
MIN_GAIN_OVER_FILE = 1e-3


class _GainPrior:
    """Prior of kp, armature and damping around the robot file's values.

    It counts more against the recordings, the larger the residual of the best fit and the longer
    the residual's correlation time: both make the recordings less informative.

    Attributes:
        log_std: Field → standard deviation of its logarithm, also by joint (n,).
        residual: RMS error of each joint's best fit so far, (n,) rad.
        correlation_time: Duration of a recording that counts as one measurement, (n,) s.
    """

    def __init__(self, bounds: Bounds, row_period: float | Array) -> None:
        """Take the time between rows that count, s; also by joint, (n,)."""
        self.residual = np.full(bounds.n, FIRST_RESIDUAL_RAD)
        self.correlation_time = np.full(bounds.n, FIRST_CORRELATION_TIME_S)
        self._row_period = row_period
        self.log_std: dict[str, float | Array] = dict(PRIOR_LOG_STD)
        if bounds.stated:
            self.log_std["kp"] = STATED_KP_LOG_STD
        self._kd = bounds.kd
        self._given: Values = {}  # the file's values, (n,); nan where it states none
        for field in self.log_std:
            value = self._with_kd(field, bounds.first[field])
            self._given[field] = np.where(value > 0, value, np.nan)

    def _with_kd(self, field: str, value: Array) -> Array:
        """Return values of a field; damping with the servo's kd, since a motion shows their sum."""
        if field == "damping":
            return np.asarray(value + self._kd)
        return value

    def error_std(self) -> Array:
        """Return the standard deviation that one row's error has beside the prior, (n,) in
        ERROR_SCALE_RAD.
        """
        rows_of_one_measurement = self.correlation_time / self._row_period
        return np.asarray(self.residual / ERROR_SCALE_RAD * np.sqrt(rows_of_one_measurement))

    def errors(self, values: Values) -> Array:
        """Return the prior's errors of candidates (k, n), (k, n, PRIORS) in ERROR_SCALE_RAD."""
        errors = []
        for field, given in self._given.items():
            value = self._with_kd(field, values[field])
            log_change = np.log(np.maximum(value, MIN_GAIN_OVER_FILE * given) / given)
            errors.append(np.nan_to_num(log_change) * self.error_std() / self.log_std[field])
        return np.stack(errors, axis=-1)

    def state_kp(self, kp: Array, log_std: Array) -> None:
        """Let the prior of kp be around these values (n,), N·m/rad; nan where it stays."""
        is_stated = np.isfinite(kp)
        given = np.where(is_stated, kp, self._given["kp"])
        std = np.where(is_stated, log_std, self.log_std["kp"])
        # New dictionaries, since a copy of the prior shares the old ones.
        self._given = self._given | {"kp": given}
        self.log_std = self.log_std | {"kp": std}

    def update_residual(self, cost: Array, rows: Array) -> None:
        """Take the residual from the cost of each joint's best fit, (n,)."""
        rms = ERROR_SCALE_RAD * np.sqrt(2 * cost / np.maximum(rows, 1))
        self.residual = np.maximum(rms, MIN_RESIDUAL_RAD)

    def update_correlation_time(self, rollouts: JointRollouts, values: Values) -> None:
        """Estimate the correlation time from the errors of values (n,).

        It is the integral of the autocorrelation over lags of both signs, up to the first lag at
        which less than MIN_CORRELATION is left. Of windows at several rates, it is the mean,
        weighted by the integral of their squared errors, as windows of one rate are weighted too.
        """
        errors = rollouts.errors(one_candidate(values))[0]  # (n, windows, rows)
        times = []  # of the windows of each spacing, (n,) s
        weights = []
        for windows, period, stride in rollouts.spacings:
            own = np.ascontiguousarray(errors[:, windows, :: stride // rollouts.windows.thin])
            correlation = _autocorrelation(own)
            square = correlation[:, 0]
            correlation = correlation / np.maximum(correlation[:, :1], MIN_SQUARED_ERROR)
            correlation *= np.cumprod(correlation > MIN_CORRELATION, axis=1)
            times.append(period * stride * (2 * correlation.sum(axis=1) - 1))
            weights.append(square * period * stride)
        share = np.array(weights) / np.maximum(np.sum(weights, axis=0), MIN_SQUARED_ERROR)
        seconds = (share * np.array(times)).sum(axis=0)
        self.correlation_time = np.maximum(seconds, MIN_CORRELATION_TIME_S)


def _row_period(rollouts: JointRollouts) -> float | Array:
    """Return the mean time between rows that count, s; by joint, (n,), if windows have several
    rates.
    """
    if len(rollouts.spacings) == 1:
        return max(rollouts.dt, MIN_ROW_PERIOD_S)
    mean = rollouts.seconds / np.maximum(rollouts.rows, 1)
    return np.asarray(np.maximum(mean, MIN_ROW_PERIOD_S))


def _autocorrelation(errors: Array) -> Array:
    """Return the sum over windows of the autocorrelation of errors (n, windows, rows), by lag,
    (n, rows).

    It is the transform of the power spectrum; zeros as long as the window keep its ends apart.
    """
    rows = errors.shape[-1]
    power = (np.abs(np.fft.rfft(errors, 2 * rows)) ** 2).sum(axis=1)
    return np.asarray(np.fft.irfft(power)[:, :rows])


@dataclass
class FitProblem:
    """Least-squares problem of n joints: rollouts of one kind, bounds and the prior."""

    rollouts: JointRollouts | RobotRollouts
    robot: RobotSpec
    bounds: Bounds
    prior: _GainPrior
    physics_step: float  # s

    def errors(self, values: Values, rollouts: JointRollouts | None = None) -> Array:
        """Return errors of candidates (k, n), (k, n, rows + PRIORS) in ERROR_SCALE_RAD; the last
        are the prior's.
        """
        of_rollouts = (rollouts or self.rollouts).flat_errors(values)
        scaled = of_rollouts / np.float32(ERROR_SCALE_RAD)
        of_prior = self.prior.errors(values)
        return np.concatenate([scaled, of_prior], axis=2, dtype=np.float32)

    def of_axes(self, axes: Axes, rollouts: JointRollouts | None = None) -> Errors:
        """Return `errors` as a function of values on axes."""
        return lambda x: self.errors(axes.values(x), rollouts)


class JointFit(FitProblem):
    """Fit of every joint by itself, the others moving as recorded."""

    rollouts: JointRollouts

    def __init__(
        self,
        rollouts: JointRollouts,
        robot: RobotSpec,
        bounds: Bounds,
    ) -> None:
        step = rollouts.dt / rollouts.windows.steps
        prior = _GainPrior(bounds, _row_period(rollouts))
        super().__init__(rollouts, robot, bounds, prior, step)

    def regressed(self) -> list[Values]:
        """Return two starts that balance the recorded accelerations: with the kp of the balance,
        and with all torques scaled to the file's kp.
        """
        kp_of_file = self.bounds.first["kp"]
        balanced = balanced_values(self.rollouts.windows)
        is_valid = balanced["kp"] > 0
        one = np.ones(self.bounds.n)
        ratio = np.divide(kp_of_file, balanced["kp"], out=one, where=is_valid)
        scaled = balanced.copy()
        for field in ("kp", "damping", "frictionloss", "armature"):
            scaled[field] = balanced[field] * ratio
        return [self._start(balanced, is_valid), self._start(scaled, is_valid)]

    def _start(self, balanced: Values, is_valid: Array) -> Values:
        """Return a start with values (n,) that balance the accelerations where these are valid; the
        servo's kd is part of their damping.
        """
        own_damping = balanced["damping"] - self.bounds.kd
        start = {}
        for field, value in (balanced | {"damping": own_damping}).items():
            start[field] = np.where(is_valid, value, self.bounds.start[field])
        return start

    def search(
        self,
        start: Values,
        others: ListOf[Values] = (),
        *,
        report: Progress = lambda cost: None,
    ) -> Values:
        """Fit the classic fields and those of the servo model that `start` has; return values (n,).

        Arguments as of `search_fields`.
        """
        return self.search_fields(fitted_fields(start, encoder=True), start, others, report=report)

    def search_fields(
        self,
        fields: ListOf[str],
        start: Values,
        others: ListOf[Values] = (),
        *,
        report: Progress = lambda cost: None,
    ) -> Values:
        """Fit these fields alone; return values (n,), the others as in `start`.

        Args:
            start: First start, (n,); STARTS in all are drawn around it.
            others: At most two starts in place of drawn ones.
            report: Called in each iteration, as of `least_squares.descend`.
        """
        axes = Axes(self.bounds, fields, start)
        rng = np.random.default_rng(0)
        x = np.repeat(axes.normalize(start)[None], STARTS, axis=0)  # (STARTS, n, P)
        x[1:] += START_STD * rng.standard_normal(x[1:].shape)
        for i, other in enumerate(others):
            x[2 + i] = axes.normalize(start | other)
        x = np.clip(x, axes.low, axes.high)
        stages = (self.rollouts.shortened(SHORT_WINDOW_S), self.rollouts, self.rollouts)
        for rollouts, iterations in zip(stages, SEARCH_ITERATIONS, strict=True):
            errors = self.of_axes(axes, rollouts)
            x, cost = descend(Problems(errors, axes.low, axes.high), x, iterations, report)
            self.prior.update_residual(cost.min(axis=0), rollouts.rows)
            if rollouts is self.rollouts:
                x = better_half(x, cost)
        return first_candidate(axes.values(x[:1]))

    def robot_fit(self, nthread: int) -> RobotFit:
        """Return the fit of the same robot in its simulator, with fewer windows; its prior begins
        as this one's.
        """
        parts = self.rollouts.parts
        some = np.unique(np.arange(ROBOT_WINDOWS) * len(parts) // ROBOT_WINDOWS)  # evenly
        rollouts = RobotRollouts(
            [parts[i] for i in some], self.robot, nthread, touch=self.rollouts.windows.touch[some]
        )
        return RobotFit(rollouts, self.robot, self.bounds, copy.copy(self.prior), self.physics_step)


class RobotFit(FitProblem):
    """Fit of all joints in the simulator of the whole robot."""

    rollouts: RobotRollouts

    def search(
        self,
        fields: ListOf[str],
        rest: Values,
        starts: ListOf[Values],
    ) -> RobotSearch:
        """Return a search for fields from starts (n,); fields of `rest` that are not fitted
        stay.
        """
        return RobotSearch(self, Axes(self.bounds, fields, rest), starts)

    def descend_chains(
        self,
        values: Values,
        report: Callable[[tuple[str, ...], Array], Progress],
    ) -> Values:
        """Fit values (n,) once more, with a joint's parameters judged by all joints of its
        kinematic chain.

        `report` makes the function that is called in each iteration, from names and row counts of
        the chains.
        """
        axes = Axes(self.bounds, robot_fields(values), values)
        chains = KinematicChains(self.robot)

        def errors(x: Array) -> Array:
            of_joints = self.errors(axes.values(chains.unpack(x)))
            return chains.pack(of_joints)

        rows = chains.pack(self.rollouts.rows[:, None]).sum(axis=1)
        names = tuple(self.robot.operated[i] for i in chains.joints[:, 0])
        x = chains.pack(axes.normalize(values)[None])
        low = chains.pack(axes.low)
        high = chains.pack(axes.high)
        candidates = x.shape[-1] + 1 + len(DAMPING_FACTORS)  # of one iteration
        iterations = max(1, min(MAX_CHAIN_ITERATIONS, MAX_CHAIN_CANDIDATES // candidates))
        problems = Problems(errors, low, high)
        x, _ = descend(problems, x, iterations, report(names, rows), MIN_CHAIN_COST_DECREASE)
        return first_candidate(axes.values(chains.unpack(x)))


class RobotSearch:
    """A search for parameters of all joints together, which may stop after any iterations and go
    on later.

    A joint's parameters are judged by the joint's own error.
    """

    def __init__(self, fit: RobotFit, axes: Axes, starts: ListOf[Values]) -> None:
        """Begin at starts (n,)."""
        self._fit = fit
        self._axes = axes
        self._x = np.stack([axes.normalize(values) for values in starts])  # (starts, n, P)
        self._cost = np.zeros((len(starts), fit.bounds.n))  # of each start and joint

    def iterate(self, count: int, report: Progress = lambda cost: None) -> None:
        """Go on for at most `count` iterations."""
        axes = self._axes
        problems = Problems(self._fit.of_axes(axes), axes.low, axes.high)
        self._x, self._cost = descend(problems, self._x, count, report, MIN_COST_DECREASE)
        self._fit.prior.update_residual(self._cost.min(axis=0), self._fit.rollouts.rows)

    def keep_better_starts(self) -> None:
        """Keep the better start of every joint, and the start that is better in the sum over
        joints if it differs.
        """
        x = better_half(self._x, self._cost)[:1]
        cost = self._cost.min(axis=0)[None]
        best = self._best()
        if not np.array_equal(x, self._x[best]):
            x = np.concatenate([x, self._x[best]])
            cost = np.concatenate([cost, self._cost[best]])
        self._x = x
        self._cost = cost

    @property
    def values(self) -> Values:
        """Values (n,) of the best start."""
        return first_candidate(self._axes.values(self._x[self._best()]))

    def _best(self) -> slice:
        """Return where the start with the least cost in the sum over joints is: a slice of one."""
        number = int(self._cost.sum(axis=1).argmin())
        return slice(number, number + 1)


class KinematicChains:
    """Kinematic chains, such as the arms of a humanoid: joints that move each other.

    A chain has as many places as the longest one has joints. The values of joints, (…, n, P), are
    packed as values of chains, (…, chains, places · P); places without a joint hold 0.

    Attributes:
        joints: Operated joint in each place, (chains, places); −1 for none.
    """

    def __init__(self, robot: RobotSpec) -> None:
        model = build_model(robot.with_table(None), physics_only=True)
        tree_of_joint = model.dof_treeid[robot.operated_index]
        chains = [np.flatnonzero(tree_of_joint == tree) for tree in np.unique(tree_of_joint)]
        places = max(len(chain) for chain in chains)
        self.joints = np.full((len(chains), places), -1)
        for row, chain in zip(self.joints, chains, strict=True):
            row[: len(chain)] = chain

    def pack(self, x: Array) -> Array:
        """Return values of joints as values of chains."""
        none = np.zeros_like(x[..., :1, :])  # which −1 takes
        in_places = np.concatenate([x, none], axis=-2)[..., self.joints, :]
        return in_places.reshape(*x.shape[:-2], len(self.joints), -1)

    def unpack(self, x: Array) -> Array:
        """Return values of chains as values of joints."""
        joint_in_place = self.joints.ravel().tolist()
        joints = sum(joint >= 0 for joint in joint_in_place)
        place_of_joint = [joint_in_place.index(joint) for joint in range(joints)]
        in_places = x.reshape(*x.shape[:-2], self.joints.size, -1)
        return np.asarray(in_places[..., place_of_joint, :])


def fitted_fields(values: dict[str, object] | Values, encoder: bool = False) -> list[str]:
    """Return the fields among values that a joint's search changes, in order.

    Args:
        encoder: encoder_step too. It is the recordings' own, and has no standard error.
    """
    fields = []
    for field in (*CLASSIC, "effort_limit", *SERVO_TERMS, *WARM_SLOPES):
        if field == "encoder_step" and not encoder:
            continue
        if field in values:
            fields.append(field)
    return fields


def robot_fields(values: Values) -> list[str]:
    """Return the fields among values that the fit in the robot's simulator changes."""
    fields = []
    for field in (*CLASSIC, *SERVO_TERMS, *WARM_SLOPES):
        if field in values and not SERVO_FIELDS[field].single_joint:
            fields.append(field)
    return fields
