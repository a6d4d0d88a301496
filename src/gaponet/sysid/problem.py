"""Fitting problem of servo parameters: errors of rollouts and of a prior, searches, and standard
errors.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model
from gaponet.sysid.acceptance import Covariance, Std
from gaponet.sysid.axes import CLASSIC, MIN_EXCITATION_RAD, WARM, Axes, Bounds, Values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, JointRollouts, balanced_values
from gaponet.sysid.least_squares import (
    DAMPING_FACTORS,
    Errors,
    Problems,
    Progress,
    agreed_slopes,
    better_half,
    descend,
)
from gaponet.sysid.robot_rollouts import RobotRollouts

ROBOT_WINDOWS = 8  # windows of the fit in the robot's simulator
STARTS = 4  # of each joint's search
START_STD = 2.0  # standard deviation of the starts around the first one, large changes
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
MIN_CLUSTERS = 24  # parts of the recordings that count as independent of each other
MIN_CORRELATION_TIME_S = 1.0
FIRST_CORRELATION_TIME_S = 4.0  # before it is estimated
MIN_CORRELATION = 0.05  # of an error with itself later; less counts as none
# Field → standard deviation of its logarithm around the robot file's value; damping counts with kd.
PRIOR_LOG_STD = {"kp": 0.5, "armature": 1.5, "damping": 1.0}
PRIORS = len(PRIOR_LOG_STD)
STATED_KP_LOG_STD = 0.1  # of a kp that recordings state, instead
MIN_SHARE = 1e-3  # of the file's value; a smaller value counts as this
# Of a fitted gain to the file's, or the reverse: one standard deviation of damping's prior. A
# larger ratio is doubted.
MAX_GAIN_RATIO = 2.7
# Of backlash, by the physics step and by what else crosses the gap (benchmarks/backlash.py).
RELATIVE_GAP_STD = 0.06
UNIFORM_STD = 0.29  # of what is uniformly distributed over one step
# Root of the sum of all rows' squared slopes over a parameter, errors per large change; a parameter
# with less counts as one that no row depends on.
MIN_SLOPE = 3e-5
UNKNOWN_STD = 1e3  # large changes, of a parameter that no row depends on
DERIVATIVE_STEP = 1e-3  # large changes, of the delta method
MAX_RELATIVE_STD = 0.15  # of a value and of its scale; beyond it the parameter is not determined


class _GainPrior:
    """Prior of kp, armature and damping around the robot file's values.

    It counts more against the recordings, the larger the residual of the best fit and the longer
    the residual's correlation time: both make the recordings less informative.

    Attributes:
        log_std: Field → standard deviation of its logarithm, also by joint (n,).
        residual: RMS error of each joint's best fit so far, (n,) rad.
        correlation_time: Duration of a recording that counts as one measurement, (n,) s.
    """

    def __init__(self, bounds: Bounds, row_period: float) -> None:
        self.residual = np.full(bounds.n, 1e-3)
        self.correlation_time = np.full(bounds.n, FIRST_CORRELATION_TIME_S)
        self._row_period = max(row_period, 0.01)
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
        return value + self._kd if field == "damping" else value

    def error_std(self) -> Array:
        """Return the standard deviation that one row's error has beside the prior, (n,) in
        ERROR_SCALE_RAD.
        """
        return np.asarray(
            self.residual / ERROR_SCALE_RAD * np.sqrt(self.correlation_time / self._row_period)
        )

    def errors(self, values: Values) -> Array:
        """Return the prior's errors of candidates (k, n), (k, n, PRIORS) in ERROR_SCALE_RAD."""
        errors = []
        for field, given in self._given.items():
            value = self._with_kd(field, values[field])
            log_change = np.log(np.maximum(value, MIN_SHARE * given) / given)
            errors.append(np.nan_to_num(log_change) * self.error_std() / self.log_std[field])
        return np.stack(errors, axis=-1)

    def state_kp(self, kp: Array, log_std: Array) -> None:
        """Let the prior of kp be around these values (n,), N·m/rad; nan where it stays."""
        stated = np.isfinite(kp)
        self._given = self._given | {"kp": np.where(stated, kp, self._given["kp"])}
        self.log_std = self.log_std | {"kp": np.where(stated, log_std, self.log_std["kp"])}

    def update_residual(self, cost: Array, rows: Array) -> None:
        """Take the residual from the cost of each joint's best fit, (n,)."""
        self.residual = np.maximum(ERROR_SCALE_RAD * np.sqrt(2 * cost / np.maximum(rows, 1)), 1e-5)

    def update_correlation_time(self, rollouts: JointRollouts, values: Values) -> None:
        """Estimate the correlation time from the errors of values (n,).

        It is the integral of the autocorrelation over lags of both signs, up to the first lag at
        which less than MIN_CORRELATION is left. The autocorrelation is the transform of the power
        spectrum; zeros as long as the window keep its ends apart.
        """
        errors = rollouts.errors({f: v[None] for f, v in values.items()})[0]  # (n, windows, rows)
        rows = errors.shape[-1]
        power = (np.abs(np.fft.rfft(errors, 2 * rows)) ** 2).sum(axis=1)
        correlation = np.fft.irfft(power)[:, :rows]  # (n, rows), by lag
        correlation /= np.maximum(correlation[:, :1], 1e-30)
        correlation *= np.cumprod(correlation > MIN_CORRELATION, axis=1)
        seconds = rollouts.dt * rollouts.windows.thin * (2 * correlation.sum(axis=1) - 1)
        self.correlation_time = np.maximum(seconds, MIN_CORRELATION_TIME_S)


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
        errors = (rollouts or self.rollouts).flat_errors(values)
        return np.concatenate(
            [errors / np.float32(ERROR_SCALE_RAD), self.prior.errors(values)],
            axis=2,
            dtype=np.float32,
        )

    def of_axes(self, axes: Axes, rollouts: JointRollouts | None = None) -> Errors:
        """Return `errors` as a function of values on axes."""
        return lambda x: self.errors(axes.values(x), rollouts)


class JointFit(FitProblem):
    """Fit of every joint by itself, the others moving as recorded."""

    rollouts: JointRollouts

    def __init__(self, rollouts: JointRollouts, robot: RobotSpec, bounds: Bounds) -> None:
        step = rollouts.dt / rollouts.windows.steps
        super().__init__(rollouts, robot, bounds, _GainPrior(bounds, rollouts.dt), step)

    def regressed(self) -> list[Values]:
        """Return two starts that balance the recorded accelerations: with the kp of the balance,
        and with all torques scaled to the file's kp.
        """
        kp_of_file = self.bounds.first["kp"]
        balanced = balanced_values(self.rollouts.windows)
        valid = balanced["kp"] > 0
        ratio = np.divide(kp_of_file, balanced["kp"], out=np.ones(self.bounds.n), where=valid)
        scaled = {f: x if f in ("offset", "delay") else x * ratio for f, x in balanced.items()}
        starts = []
        for values in (balanced, scaled):
            own_damping = values["damping"] - self.bounds.kd
            found = values | {"damping": own_damping}
            starts.append({f: np.where(valid, x, self.bounds.start[f]) for f, x in found.items()})
        return starts

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
        windows = (self.rollouts.shortened(SHORT_WINDOW_S), self.rollouts, self.rollouts)
        for rollouts, iterations in zip(windows, SEARCH_ITERATIONS, strict=True):
            errors = self.of_axes(axes, rollouts)
            x, cost = descend(Problems(errors, axes.low, axes.high), x, iterations, report)
            self.prior.update_residual(cost.min(axis=0), rollouts.rows)
            if rollouts is self.rollouts:
                x = better_half(x, cost)
        return _first_candidate(axes.values(x[:1]))

    def robot_fit(self, nthread: int) -> RobotFit:
        """Return the fit of the same robot in its simulator, with fewer windows; its prior begins
        as this one's.
        """
        parts = self.rollouts.parts
        some = np.unique(np.arange(ROBOT_WINDOWS) * len(parts) // ROBOT_WINDOWS)
        rollouts = RobotRollouts(
            [parts[i] for i in some], self.robot, nthread, touch=self.rollouts.windows.touch[some]
        )
        return RobotFit(rollouts, self.robot, self.bounds, copy.copy(self.prior), self.physics_step)


class RobotFit(FitProblem):
    """Fit of all joints in the simulator of the whole robot."""

    rollouts: RobotRollouts

    def search(self, fields: ListOf[str], rest: Values, starts: ListOf[Values]) -> RobotSearch:
        """Return a search for fields from starts (n,); fields of `rest` that are not fitted
        stay.
        """
        return RobotSearch(self, Axes(self.bounds, fields, rest), starts)

    def descend_chains(
        self, values: Values, report: Callable[[tuple[str, ...], Array], Progress]
    ) -> Values:
        """Fit values (n,) once more, with a joint's parameters judged by all joints of its
        kinematic chain.

        `report` makes the function that is called in each iteration, from names and row counts of
        the chains.
        """
        axes = Axes(self.bounds, robot_fields(values), values)
        chains = KinematicChains(self.robot)

        def errors(x: Array) -> Array:
            return chains.pack(self.errors(axes.values(chains.unpack(x))))

        rows = chains.pack(self.rollouts.rows[:, None]).sum(axis=1)
        names = tuple(self.robot.operated[i] for i in chains.joints[:, 0])
        x = chains.pack(axes.normalize(values)[None])
        low = chains.pack(axes.low)
        high = chains.pack(axes.high)
        candidates = x.shape[-1] + 1 + len(DAMPING_FACTORS)  # of one iteration
        iterations = max(1, min(MAX_CHAIN_ITERATIONS, MAX_CHAIN_CANDIDATES // candidates))
        x, _ = descend(
            Problems(errors, low, high),
            x,
            iterations,
            report(names, rows),
            MIN_CHAIN_COST_DECREASE,
        )
        return _first_candidate(axes.values(chains.unpack(x)))


class RobotSearch:
    """A search for parameters of all joints together, which may stop after any iterations and go
    on later.

    A joint's parameters are judged by the joint's own error.
    """

    def __init__(self, fit: RobotFit, axes: Axes, starts: ListOf[Values]) -> None:
        """Begin at starts (n,)."""
        self._fit = fit
        self._axes = axes
        self._x = np.stack([axes.normalize(v) for v in starts])  # (starts, n, P)
        self._cost = np.zeros((len(starts), fit.bounds.n))

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
        return _first_candidate(self._axes.values(self._x[self._best()]))

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
        tree = model.dof_treeid[robot.operated_index]
        chains = [np.flatnonzero(tree == t) for t in np.unique(tree)]
        places = max(map(len, chains))
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


def _first_candidate(values: Values) -> Values:
    """Return values (n,) of the first of k candidates (k, n), as arrays of their own."""
    return {field: value[0].copy() for field, value in values.items()}


def fitted_fields(values: dict[str, object] | Values, encoder: bool = False) -> list[str]:
    """Return the fields among values that a joint's search changes, in order.

    Args:
        encoder: encoder_step too. It is the recordings' own, and has no standard error.
    """
    fields = []
    for field in (*CLASSIC, "effort_limit", *SERVO_TERMS, *WARM[:2]):
        if field == "encoder_step" and not encoder:
            continue
        if field in values:
            fields.append(field)
    return fields


def robot_fields(values: Values) -> list[str]:
    """Return the fields among values that the fit in the robot's simulator changes."""
    every = (*CLASSIC, *SERVO_TERMS, *WARM[:2])
    return [f for f in every if f in values and not SERVO_FIELDS[f].single_joint]


@dataclass
class StandardErrors:
    """Standard errors of fitted values.

    Attributes:
        std: Joint → field → standard error in SI units.
        covariance: Joint → fields and their covariance on the axes of uncertainty.py.
        undetermined: Joint → fields that the recordings do not determine; all fields of unexcited
            joints.
        sentences: A sentence for each of these joints.
    """

    std: Std
    covariance: Covariance
    undetermined: dict[str, tuple[str, ...]]
    sentences: tuple[str, ...]


def standard_errors(problem: FitProblem, values: Values) -> StandardErrors:
    """Estimate the standard errors of values (n,): on the axes by `_covariance`, then in SI
    units.
    """
    names = fitted_fields(values)
    axes = Axes(problem.bounds, names, values)
    x = axes.normalize(values)  # (n, P)
    covariance, unseen = _covariance(problem, axes, x)
    std = _std_in_si(axes, x, values, covariance, unseen)
    for field, error in _discretisation_std(problem, values).items():
        std[field] = np.hypot(std[field], error)
    if "no_load_speed" in std:
        # A joint without a torque-speed line: zero on the axis, infinite in SI units.
        std["no_load_speed"] = np.where(values["no_load_speed"] > 0, std["no_load_speed"], 0.0)
    std_on_axes = np.sqrt(np.einsum("...ii->...i", covariance))
    is_free = axes.low < axes.high
    std_on_axes = std_on_axes + np.where(unseen & is_free, UNKNOWN_STD, 0)
    unknown = _undetermined(problem, values, axes, std, std_on_axes)
    unit = axes.unit[..., None]
    of_unseen = UNKNOWN_STD * np.eye(len(names)) * unseen[..., None, :]
    in_axis_units = unit * (covariance + of_unseen) * np.swapaxes(unit, -1, -2)
    result = StandardErrors({}, {}, {}, tuple(text for _, text in unknown.values()))
    for i, joint in enumerate(problem.robot.operated):
        result.std[joint] = {field: float(std[field][i]) for field in names}
        result.covariance[joint] = (names, in_axis_units[i])
        if joint in unknown:
            result.undetermined[joint], _ = unknown[joint]
    return result


def _covariance(problem: FitProblem, axes: Axes, x: Array) -> tuple[Array, Array]:
    """Return the covariance of values x (n, P) in large changes, (n, P, P), and which of them no
    row depends on, (n, P).

    This is the sandwich estimator with windows as clusters (Huber 1967; Liang and Zeger 1986):
    errors within a window are not independent, so the spread of the windows' gradients stands
    between two inverse curvatures. C clusters of P parameters are few, so the spread is multiplied
    by (C / (C − P))², the jackknife's correction at average leverage (MacKinnon and White 1985).
    The prior adds its own width where it holds a value. The square of a further Gauss-Newton step
    is added, since a search may end before the minimum.
    """
    errors_of_start, slopes_of_start = agreed_slopes(
        x[None], axes.low, axes.high, problem.of_axes(axes)
    )
    errors = errors_of_start[0]  # (n, rows + PRIORS)
    slopes = slopes_of_start[0]  # (n, rows + PRIORS, P)
    weight = 1 / np.sqrt(1 + errors**2)  # of soft L1
    gradient = slopes * (weight * errors)[..., None]
    by_cluster, _ = cluster_sums(gradient[:, :-PRIORS], problem.rollouts.window)  # (n, C, P)
    by_cluster -= by_cluster.mean(axis=1, keepdims=True)
    clusters = by_cluster.shape[1]
    correction = clusters / max(clusters - len(axes.names), 1)
    scatter = np.swapaxes(by_cluster, -1, -2) @ by_cluster * correction**2
    prior_slopes = slopes[:, -PRIORS:] * problem.prior.error_std()[:, None, None]
    scatter += np.swapaxes(prior_slopes, -1, -2) @ prior_slopes
    curvature = (np.swapaxes(slopes, -1, -2) @ (weight[..., None] * slopes)).astype(float)
    size = np.sqrt(np.einsum("...ii->...i", curvature))
    unseen = size < MIN_SLOPE
    is_fixed = axes.low == axes.high
    inverse = _inverse(curvature, np.where(unseen | is_fixed, np.inf, size))
    step = np.clip((inverse @ gradient.sum(axis=1)[..., None])[..., 0], -1, 1)
    return inverse @ scatter @ inverse + step[..., :, None] * step[..., None, :], unseen


def _std_in_si(axes: Axes, x: Array, values: Values, covariance: Array, unseen: Array) -> Values:
    """Return the standard errors of fields in SI units, (n,), by the delta method.

    Args:
        x, values: The fitted values in large changes, (n, P), and in SI units, (n,) each.
        covariance, unseen: As of `_covariance`.
    """
    ahead = [axes.values(x + DERIVATIVE_STEP * row) for row in np.eye(len(axes.names))]
    std = {}
    for field in axes.names:
        moved = [(one[field] - values[field]) / DERIVATIVE_STEP for one in ahead]
        slope = np.stack(moved, axis=-1)  # (n, P), SI units per large change
        known = np.sqrt(np.einsum("np,npq,nq->n", slope, covariance, slope))
        # A parameter that no row depends on may be wrong by a large change.
        std[field] = known + (np.abs(slope) * unseen).max(axis=1)
    return std


def contradicted_gains(bounds: Bounds, values: Values, std: Std) -> list[str]:
    """Return a sentence for each gain of the robot's file from which the recordings are far, for
    sure.

    Damping counts with kd, since a motion shows their sum. A gain of zero says nothing, and so does
    a joint that no command moves.

    Args:
        values: Fitted values, (n,).
        std: Joint → field → standard error.
    """
    total_given = bounds.first["damping"] + bounds.kd
    total_found = values["damping"] + bounds.kd
    sentences = []
    for i, (joint, errors) in enumerate(std.items()):
        gains = [
            ("kp", "N·m/rad", bounds.first["kp"][i], values["kp"][i], errors["kp"]),
            ("kd with damping", "N·m·s/rad", total_given[i], total_found[i], errors["damping"]),
        ]
        if bounds.unexcited[i]:
            continue
        for name, unit, given, found, error in gains:
            if given <= 0 or (name != "kp" and bounds.kd[i] <= 0):
                continue
            far = max(found, MIN_SHARE * given) / given
            surely = abs(found - given) > 2 * error
            if surely and not 1 / MAX_GAIN_RATIO < far < MAX_GAIN_RATIO:
                sentences.append(
                    f"{joint}: {name} of the file, {given:.3g} {unit}, contradicts the "
                    f"recordings, which show {format_uncertainty(found, error)}; check what the "
                    "servo was set to"
                )
    return sentences


def cluster_sums(x: Array, window: Array) -> tuple[Array, Array]:
    """Return sums of rows (n, rows, …) over clusters, (n, C, …), and the window of each cluster,
    (C,).

    Clusters are windows, or equal parts of them where there are fewer windows than MIN_CLUSTERS.

    Args:
        window: Window of each row, (rows,).
    """
    windows = int(window.max()) + 1
    parts = max(1, math.ceil(MIN_CLUSTERS / windows))  # of each window
    part = np.zeros(len(window), int)  # of each row
    for number in np.unique(window):
        rows = np.flatnonzero(window == number)
        part[rows] = np.arange(len(rows)) * parts // len(rows)
    cluster = window * parts + part
    sums = np.zeros((len(x), int(cluster.max()) + 1, *x.shape[2:]))
    np.add.at(sums, (slice(None), cluster), x)  # type: ignore[arg-type]
    return sums, np.arange(sums.shape[1]) // parts


def _discretisation_std(problem: FitProblem, values: Values) -> Values:
    """Return standard errors of damping, armature, delay, no-load speed and backlash by the
    physics step, (n,).
    """
    time_std = UNIFORM_STD * problem.physics_step  # s
    total_damping = values["damping"] + problem.robot.servo.kd[problem.robot.operated_index]
    std = {
        "damping": time_std * values["kp"],
        "armature": time_std * total_damping,
        "delay": np.full(len(total_damping), time_std),
    }
    if "no_load_speed" in values:  # the limit follows the speed a step late, half a step on average
        limit = values.get("effort_limit", problem.bounds.first["effort_limit"])
        inertia = problem.bounds.inertia + values["armature"]
        std["no_load_speed"] = problem.physics_step / 2 * limit / inertia
    if "backlash" in values:
        std["backlash"] = RELATIVE_GAP_STD * values["backlash"]
    return std


def _inverse(normal: Array, size: Array) -> Array:
    """Return inverses of (…, P, P) by their diagonals' roots (…, P); 0 for parameters whose size
    is infinite.
    """
    each = size[..., :, None] * size[..., None, :]
    fixed = np.eye(size.shape[-1]) * np.isinf(size)[..., None]
    return np.asarray(np.linalg.pinv(normal / each + fixed, rcond=1e-10, hermitian=True) / each)


def _undetermined(
    problem: FitProblem, values: Values, axes: Axes, std: Values, std_on_axes: Array
) -> dict[str, tuple[tuple[str, ...], str]]:
    """Return joint → fields that the recordings do not determine, and a sentence; all fields of
    unexcited joints.

    Args:
        std: Standard errors in SI units, (n,) each.
        std_on_axes: Standard errors in large changes, (n, P); torques are there divided by kp.
    """
    bounds = problem.bounds
    unknown = {}
    for i, joint in enumerate(problem.robot.operated):
        if bounds.unexcited[i]:
            why = (
                f"{joint}: not determined by these logs: no command moves it by "
                f"{MIN_EXCITATION_RAD:g} rad; it keeps the file's values but for what others that "
                "move it show (kp, damping, friction, offset); record its motion"
            )
            unknown[joint] = tuple(axes.names), why
            continue
        wide, also_over_kp = _wide_fields(values, axes, std, std_on_axes, i)
        if wide:
            texts = [f"{f} {format_uncertainty(values[f][i], std[f][i])}" for f in wide]
            advice = ""
            if set(also_over_kp) == {"kp"} and len(wide) > 1:
                advice = "; known as multiples of kp: take the values as a set"
            text = f"{joint}: not determined by these logs: {', '.join(texts)}{advice}"
            unknown[joint] = tuple(wide), text
    return unknown


def _wide_fields(
    values: Values, axes: Axes, std: Values, std_on_axes: Array, joint: int
) -> tuple[list[str], list[str]]:
    """Return the fields of a joint that the recordings do not determine, and which of them not
    even over kp.

    Arguments as of `_undetermined`. A speed without its friction or line says nothing.
    """
    x = axes.normalize(values)
    scale = axes.values(x + 1)
    without = set()
    for field, needed in (("stribeck_speed", "stribeck"), ("no_load_speed", "no_load_speed")):
        if field in values and not values[needed][joint]:
            without.add(field)
    wide = []
    also_over_kp = []
    for k, field in enumerate(axes.names):
        value = values[field][joint]
        large = max(abs(value), scale[field][joint] - value)
        if field in without or std[field][joint] <= MAX_RELATIVE_STD * large:
            continue
        wide.append(field)
        is_over_kp = SERVO_FIELDS[field].axis == "over kp"
        on_axis = MAX_RELATIVE_STD * max(abs(x[joint, k]), 1.0)
        if not is_over_kp or std_on_axes[joint, k] > on_axis:
            also_over_kp.append(field)
    return wide, also_over_kp
