"""Standard errors of fitted values, and what they say: values that the recordings do not determine,
and gains of the robot's file that they contradict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.sysid.acceptance import Covariance, Std
from gaponet.sysid.axes import MIN_EXCITATION_RAD, Axes, Bounds, Values
from gaponet.sysid.least_squares import agreed_slopes, soft_l1_weight
from gaponet.sysid.problem import MIN_GAIN_OVER_FILE, PRIORS, FitProblem, fitted_fields

# Parts of the recordings that count as independent of each other.
MIN_CLUSTERS = 24
# Of a fitted gain to the file's, or the reverse: one standard deviation of damping's prior. A
# larger ratio is doubted.
MAX_GAIN_RATIO = 2.7
MIN_DOUBT = 2.0  # standard errors between a fitted gain and the file's
# Of backlash, by the physics step and by what else crosses the gap (benchmarks/backlash.py).
RELATIVE_GAP_STD = 0.06
UNIFORM_STD = 0.29  # of what is uniformly distributed over one step
# Root of the sum of all rows' squared slopes over a parameter, errors per large change; a parameter
# with less counts as one that no row depends on.
MIN_SLOPE = 3e-5
UNKNOWN_STD = 1e3  # large changes, of a parameter that no row depends on
DERIVATIVE_STEP = 1e-3  # large changes, of the delta method
# Of a value and of its scale: beyond it the parameter is not determined.
MAX_RELATIVE_STD = 0.15
# Speed → the field without which it has no effect.
NEEDED_BY_SPEED = {"stribeck_speed": "stribeck", "no_load_speed": "no_load_speed"}


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
    is_free = axes.low < axes.high
    of_unseen = np.where(unseen & is_free, UNKNOWN_STD, 0)
    std_on_axes = np.sqrt(np.einsum("...ii->...i", covariance)) + of_unseen
    unknown = _undetermined(problem, values, axes, std, std_on_axes)
    in_axis_units = _in_axis_units(axes, covariance, unseen)
    result = StandardErrors({}, {}, {}, tuple(one.sentence for one in unknown.values()))
    for i, joint in enumerate(problem.robot.operated):
        result.std[joint] = {field: float(std[field][i]) for field in names}
        result.covariance[joint] = (names, in_axis_units[i])
        if joint in unknown:
            result.undetermined[joint] = unknown[joint].fields
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
    of_axes = problem.of_axes(axes)
    errors_of_start, slopes_of_start = agreed_slopes(x[None], axes.low, axes.high, of_axes)
    errors = errors_of_start[0]  # (n, rows + PRIORS)
    slopes = slopes_of_start[0]  # (n, rows + PRIORS, P)
    weight = soft_l1_weight(errors)
    gradient = slopes * (weight * errors)[..., None]
    curvature = (np.swapaxes(slopes, -1, -2) @ (weight[..., None] * slopes)).astype(float)
    size = np.sqrt(np.einsum("...ii->...i", curvature))  # (n, P)
    unseen = size < MIN_SLOPE
    is_fixed = axes.low == axes.high
    inverse = _inverse(curvature, np.where(unseen | is_fixed, np.inf, size))
    scatter = cluster_scatter(gradient[:, :-PRIORS], problem.rollouts.window)
    prior_slopes = slopes[:, -PRIORS:] * problem.prior.error_std()[:, None, None]
    scatter += np.swapaxes(prior_slopes, -1, -2) @ prior_slopes
    step = (inverse @ gradient.sum(axis=1)[..., None])[..., 0]  # (n, P)
    step = np.clip(step, -1, 1)
    squared_step = step[..., :, None] * step[..., None, :]
    return inverse @ scatter @ inverse + squared_step, unseen


def cluster_scatter(gradient: Array, window: Array) -> Array:
    """Return the spread over clusters of gradients (n, rows, P), (n, P, P); the window of each row,
    (rows,).

    With the correction of the delete-one jackknife: C clusters and P parameters make it larger by
    (C / (C − P))².
    """
    by_cluster, _ = cluster_sums(gradient, window)  # (n, C, P)
    by_cluster -= by_cluster.mean(axis=1, keepdims=True)
    _, clusters, parameters = by_cluster.shape
    correction = clusters / max(clusters - parameters, 1)
    return np.asarray(np.swapaxes(by_cluster, -1, -2) @ by_cluster * correction**2)


def _in_axis_units(axes: Axes, covariance: Array, unseen: Array) -> Array:
    """Return a covariance in large changes, (n, P, P), in units of the axes, with UNKNOWN_STD for
    parameters that no row depends on, (n, P).
    """
    unit = axes.unit[..., None]
    of_unseen = UNKNOWN_STD * np.eye(len(axes.names)) * unseen[..., None, :]
    return np.asarray(unit * (covariance + of_unseen) * np.swapaxes(unit, -1, -2))


def _std_in_si(
    axes: Axes,
    x: Array,
    values: Values,
    covariance: Array,
    unseen: Array,
) -> Values:
    """Return the standard errors of fields in SI units, (n,), by the delta method.

    Args:
        x, values: The fitted values in large changes, (n, P), and in SI units, (n,) each.
        covariance, unseen: As of `_covariance`.
    """
    moved = [axes.values(x + DERIVATIVE_STEP * row) for row in np.eye(len(axes.names))]
    std = {}
    for field in axes.names:
        change = np.stack([of_one[field] - values[field] for of_one in moved], axis=-1)
        slope = change / DERIVATIVE_STEP  # (n, P), SI units per large change
        known = np.sqrt(np.einsum("np,npq,nq->n", slope, covariance, slope))
        # A parameter that no row depends on may be wrong by a large change.
        std[field] = known + (np.abs(slope) * unseen).max(axis=1)
    return std


class _Gain(NamedTuple):
    """A gain of a joint: the file's value, the fitted one, and its standard error."""

    name: str
    unit: str
    given: float
    found: float
    error: float

    @property
    def is_contradicted(self) -> bool:
        """True if the fitted value is far from the file's, for sure; a file's zero says nothing."""
        is_sure = abs(self.found - self.given) > MIN_DOUBT * self.error
        if self.given <= 0 or not is_sure:
            return False
        ratio = max(self.found, MIN_GAIN_OVER_FILE * self.given) / self.given
        return not 1 / MAX_GAIN_RATIO < ratio < MAX_GAIN_RATIO


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
        if bounds.unexcited[i]:
            continue
        gains = [_Gain("kp", "N·m/rad", bounds.first["kp"][i], values["kp"][i], errors["kp"])]
        if bounds.kd[i] > 0:
            kd = ("kd with damping", "N·m·s/rad")
            gains.append(_Gain(*kd, total_given[i], total_found[i], errors["damping"]))
        for gain in gains:
            if gain.is_contradicted:
                sentences.append(
                    f"{joint}: {gain.name} of the file, {gain.given:.3g} {gain.unit}, contradicts "
                    f"the recordings, which show {format_uncertainty(gain.found, gain.error)}; "
                    "check what the servo was set to"
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
    part_of_row = np.zeros(len(window), int)
    for number in np.unique(window):
        rows = np.flatnonzero(window == number)
        part_of_row[rows] = np.arange(len(rows)) * parts // len(rows)
    cluster = window * parts + part_of_row  # of each row
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
    scale = size[..., :, None] * size[..., None, :]
    fixed = np.eye(size.shape[-1]) * np.isinf(size)[..., None]  # so that nothing is divided by 0
    scaled = np.linalg.pinv(normal / scale + fixed, rcond=1e-10, hermitian=True)
    return np.asarray(scaled / scale)


class _Undetermined(NamedTuple):
    """Fields of a joint that the recordings do not determine, and a sentence about them."""

    fields: tuple[str, ...]
    sentence: str


def _undetermined(
    problem: FitProblem,
    values: Values,
    axes: Axes,
    std: Values,
    std_on_axes: Array,
) -> dict[str, _Undetermined]:
    """Return what the recordings do not determine, by joint: all fields of unexcited joints.

    Args:
        std: Standard errors in SI units, (n,) each.
        std_on_axes: Standard errors in large changes, (n, P); torques are there divided by kp.
    """
    bounds = problem.bounds
    unknown = {}
    for i, joint in enumerate(problem.robot.operated):
        if bounds.unexcited[i]:
            sentence = (
                f"{joint}: not determined by these logs: no command moves it by "
                f"{MIN_EXCITATION_RAD:g} rad; it keeps the file's values but for what others that "
                "move it show (kp, damping, friction, offset); record its motion"
            )
            unknown[joint] = _Undetermined(tuple(axes.names), sentence)
            continue
        wide, also_over_kp = _wide_fields(values, axes, std, std_on_axes, i)
        if not wide:
            continue
        texts = []
        for field in wide:
            texts.append(f"{field} {format_uncertainty(values[field][i], std[field][i])}")
        advice = ""
        if also_over_kp == ["kp"] and len(wide) > 1:
            advice = "; known as multiples of kp: take the values as a set"
        sentence = f"{joint}: not determined by these logs: {', '.join(texts)}{advice}"
        unknown[joint] = _Undetermined(tuple(wide), sentence)
    return unknown


def _wide_fields(
    values: Values,
    axes: Axes,
    std: Values,
    std_on_axes: Array,
    joint: int,
) -> tuple[list[str], list[str]]:
    """Return the fields of a joint that the recordings do not determine, and which of them not
    even over kp.

    Arguments as of `_undetermined`. A speed without its friction or line says nothing.
    """
    x = axes.normalize(values)
    after_large_change = axes.values(x + 1)
    wide = []
    also_over_kp = []
    for k, field in enumerate(axes.names):
        needed = NEEDED_BY_SPEED.get(field)
        if needed is not None and not values[needed][joint]:
            continue
        value = values[field][joint]
        scale = max(abs(value), after_large_change[field][joint] - value)
        if std[field][joint] <= MAX_RELATIVE_STD * scale:
            continue
        wide.append(field)
        is_over_kp = SERVO_FIELDS[field].axis == "over kp"
        scale_on_axis = max(abs(x[joint, k]), 1.0)
        if not is_over_kp or std_on_axes[joint, k] > MAX_RELATIVE_STD * scale_on_axis:
            also_over_kp.append(field)
    return wide, also_over_kp
