"""Evidence of recordings about a robot's parameters: gradients and information near its values."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.repeatability import repetition_difference
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import confidence_factor, standard_error
from gaponet.sim.replay import replay
from gaponet.sysid.acceptance import HeldOut
from gaponet.sysid.axes import CLASSIC, Axes, Bounds, first_values
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, JointRollouts
from gaponet.sysid.least_squares import slopes, soft_l1_weight
from gaponet.sysid.problem import PRIOR_LOG_STD
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.standard_errors import cluster_sums
from gaponet.sysid.table_contact import contact_height, tip_heights
from gaponet.sysid.uncertainty import (
    JointUncertainty,
    ParameterUncertainty,
    Provenance,
    prior_std,
    to_axes,
)

WINDOWS = 40  # of 8 s
PLAY_TURN_RAD = 0.002  # servo error at which play has changed sides
MIN_RELATIVE_INFORMATION = 1e-6  # of a parameter; less counts as none
BOUND_QUANTILE = 0.9  # of all samples
# Fewer recordings are divided into more clusters.
MIN_RECORDINGS_AS_CLUSTERS = 6
# Standard deviation over that of the prior, of a field that neither the fit's prior nor the
# recordings hold.
WITHOUT_PRIOR = 10.0
WITHOUT_PLAY = slice(-1)  # of the Q numbers of an `Evidence`, the last of which is play


@dataclass(frozen=True)
class Evidence:
    """Evidence of recordings of n joints about Q numbers: the fields of the axes, then play."""

    gradients: Array  # gradient of the cost in each of C clusters, (n, C, Q)
    information: Array  # Gauss-Newton information in each cluster, (n, C, Q, Q)
    rows: Array  # number of rows that count, (n,)
    recording: Array  # recording of each cluster, (C,)
    names: tuple[str, ...]  # names of the recordings
    window_rms: Array  # RMS error of each of W windows, (n, W) rad

    def by_recording(self) -> Evidence:
        """Return the evidence with one cluster of each recording."""
        numbers = np.arange(len(self.names))
        is_of_recording = (self.recording == numbers[:, None]).astype(float)  # (recordings, C)
        gradients = np.einsum("rc,ncq->nrq", is_of_recording, self.gradients)
        information = np.einsum("rc,ncqp->nrqp", is_of_recording, self.information)
        return replace(self, gradients=gradients, information=information, recording=numbers)

    def without(self, names: Collection[str]) -> Evidence:
        """Return the evidence without these recordings."""
        if not names:
            return self
        keep = np.array([self.names[number] not in names for number in self.recording])  # (C,)
        rest = tuple(name for name in self.names if name not in names)
        recording = [rest.index(self.names[number]) for number in self.recording[keep]]
        return replace(
            self,
            gradients=self.gradients[:, keep],
            information=self.information[:, keep],
            rows=self.rows * keep.mean(),  # windows are as long as each other
            recording=np.array(recording),
            names=rest,
        )


def widened(information: Array, overdispersion: Array) -> Array:
    """Return the covariance of summed gradients with this overdispersion, (…, Q, Q)."""
    root = np.sqrt(overdispersion)
    return np.asarray(root[..., :, None] * information * root[..., None, :])


def gradient_covariance(gradients: Array) -> Array:
    """Return the covariance of the sum of gradients (n, C, Q) from their scatter over clusters,
    (n, Q, Q).
    """
    clusters = gradients.shape[1]
    deviation = gradients - gradients.mean(axis=1, keepdims=True)  # (n, C, Q)
    scatter = np.swapaxes(deviation, -1, -2) @ deviation
    return np.asarray(scatter * (clusters / max(clusters - 1, 1)))


def inverted(information: Array) -> Array:
    """Return inverses of (n, Q, Q); directions without information get a little."""
    size = np.sqrt(np.maximum(np.einsum("...kk->...k", information), 1e-12))
    scale = size[..., :, None] * size[..., None, :]
    least = MIN_RELATIVE_INFORMATION * np.eye(information.shape[-1])
    return np.asarray(np.linalg.inv(information / scale + least) / scale)


def evidence(
    robot: RobotSpec,
    sequences: ListOf[Sequence],
    fields: ListOf[str],
    windows: int = WINDOWS,
    nthread: int = 0,
) -> Evidence:
    """Compute the evidence of recordings by rollouts of every joint by itself, at the robot's own
    values.

    Args:
        fields: The P fields; play is the next one, so that Q = P + 1.
        windows: Number of windows of the recordings that are used.
    """
    contact = contact_height(robot, tip_heights(sequences, robot))
    parts = cut(sequences, windows)
    rollouts = JointRollouts(parts, robot, contact, nthread)
    errors, jac = _slopes_of_joints(rollouts, Bounds(robot, sequences), fields)
    weight = soft_l1_weight(errors)  # (n, rows)
    gradient_of_rows = jac * (weight * errors)[..., None]  # (n, rows, Q)
    gradients, window_of_cluster = cluster_sums(gradient_of_rows, rollouts.window)
    several = _are_of_several_units(sequences)
    name_of_window = [_window_name(part, several) for part in parts]
    names = list(dict.fromkeys(name_of_window))
    recording_of_window = np.array([names.index(name) for name in name_of_window])
    return Evidence(
        gradients=gradients,
        information=_information(jac, weight, rollouts.window),
        rows=rollouts.rows,
        recording=recording_of_window[window_of_cluster],
        names=tuple(names),
        window_rms=_window_rms(rollouts, errors),
    )


def _slopes_of_joints(
    rollouts: JointRollouts,
    bounds: Bounds,
    fields: ListOf[str],
) -> tuple[Array, Array]:
    """Return the errors at the robot's own values, (n, rows) in ERROR_SCALE_RAD, and their slopes
    over the fields on their axes and over play, (n, rows, Q).
    """
    axes = Axes(bounds, fields, bounds.first)

    def scaled_errors(x: Array) -> Array:
        return rollouts.flat_errors(axes.values(x)) / np.float32(ERROR_SCALE_RAD)

    start = axes.normalize(bounds.first)  # (n, P)
    errors, by_large_change = slopes(start[None], axes.high, scaled_errors)
    is_free = axes.low < axes.high  # (n, P)
    by_field = by_large_change[0] / axes.unit[:, None] * is_free[:, None]  # (n, rows, P)
    by_play = _slopes_over_play(rollouts, bounds).reshape(bounds.n, -1, 1)
    return errors[0], np.concatenate([by_field, by_play], axis=-1)


def _information(jac: Array, weight: Array, window: Array) -> Array:
    """Return the Gauss-Newton information in each cluster, (n, C, Q, Q).

    Args:
        jac: Slopes of errors, (n, rows, Q).
        weight: Weight of each error, (n, rows).
        window: Window of each row, (rows,).
    """
    information = []
    for of_joint, weights in zip(jac, weight, strict=True):  # a joint at a time, for memory
        weighted = weights[:, None] * of_joint
        of_rows = of_joint[:, :, None] * weighted[:, None, :]  # (rows, Q, Q)
        of_clusters, _ = cluster_sums(of_rows[None], window)
        information.append(of_clusters)
    return np.concatenate(information)


def _window_rms(rollouts: JointRollouts, errors: Array) -> Array:
    """Return the RMS error of each window, (n, W) rad; errors (n, rows) in ERROR_SCALE_RAD."""
    in_windows = ERROR_SCALE_RAD * errors.reshape(len(errors), *rollouts.counted.shape)
    squares = np.square(in_windows).sum(axis=-1)
    return np.asarray(np.sqrt(squares / np.maximum(rollouts.counted.sum(axis=-1), 1)))


def _slopes_over_play(rollouts: JointRollouts, bounds: Bounds) -> Array:
    """Return the slopes of errors over the width of a gap, (n, windows, rows) in ERROR_SCALE_RAD
    per rad.

    The link is half the width behind the motor, on the side on which the servo's error presses it.
    """
    windows = rollouts.windows
    delay = bounds.first["delay"][:, None]  # (n, 1) s
    delay_rows = np.round(delay / windows.periods).astype(int)  # (n, windows)
    row = np.arange(windows.ctrl.shape[-1])
    sent = np.maximum(row - delay_rows[..., None], 0)  # row of the command that acts
    command = np.take_along_axis(windows.ctrl, sent, axis=-1)  # (n, windows, rows) rad
    offset = bounds.first["offset"][:, None, None].astype(np.float32)
    servo_error = command + offset - windows.qpos
    side = np.tanh(servo_error / PLAY_TURN_RAD)  # −1 to 1
    is_counted = rollouts.counted & rollouts.recorded[..., None]
    return np.asarray(0.5 / ERROR_SCALE_RAD * side[..., :: windows.thin] * is_counted)


def _are_of_several_units(sequences: ListOf[Sequence]) -> bool:
    return len({sequence.meta.unit_id for sequence in sequences}) > 1


def _window_name(part: Sequence, with_unit: bool) -> str:
    """Return the name of a window's recording: its motion, its unit if asked, its payload, and its
    repetition unless it is the first one.
    """
    name = _take_name(part, with_unit)
    if not part.meta.repetition:
        return name
    return f"{name} ({part.meta.repetition})"


def _take_name(sequence: Sequence, with_unit: bool) -> str:
    """Return motion, unit if asked, and payload of a recording; of an empty hand nothing is
    said.
    """
    name = sequence.meta.motion
    if with_unit:
        name += f", {sequence.meta.unit_id}"
    if sequence.meta.payload_mass:
        side = sequence.meta.payload_side
        of_side = "" if side == "both" else f" {side}"
        name += f", {sequence.meta.payload_mass:g} kg{of_side}"
    return name


def estimate_uncertainty(
    robot: RobotSpec,
    sequences: ListOf[Sequence],
    judges: ListOf[Sequence],
    covariances: Mapping[str, tuple[list[str], Array]] = {},
    before: ParameterUncertainty | None = None,
    held_out: ListOf[HeldOut] = (),
    nthread: int = 0,
) -> ParameterUncertainty:
    """Estimate the parameter uncertainty of a robot with the values that were fitted to recordings
    of one robot.

    Args:
        judges: Recordings that were not fitted, for the residual; without any, the fitted ones.
        covariances: Joint → fields and their covariance on the axes; of other joints it follows
            from the recordings and from `before`.
        before: Uncertainty of the robot that the fit began from. Its variance grows by how far the
            values moved beyond what both uncertainties explain.
        held_out: Recordings and the robots that were fitted without them, instead of `judges`, if
            `robot` was fitted to them as well.
    """
    fields = before.fields if before else _fitted_fields(robot)
    seen = evidence(robot, sequences, fields, nthread=nthread)
    clusters, overdispersion = _overdispersion(seen, before, robot.operated)
    step = _gauss_newton_step(seen, overdispersion)
    values = to_axes(robot, fields)
    repeatability = repetition_difference(sequences, robot.operated)
    folds = held_out or [HeldOut(list(judges or sequences), robot)]
    errors = _errors_by_joint(folds, nthread)
    is_validated = bool(judges or held_out)
    joints = {}
    for i, joint in enumerate(robot.operated):
        from_rows = step.covariance[i, WITHOUT_PLAY, WITHOUT_PLAY]
        information = step.information[i, WITHOUT_PLAY, WITHOUT_PLAY]
        covariance = _covariance(joint, fields, values[joint], from_rows, covariances, before)
        uncertainty = JointUncertainty(
            values=_nested(values[joint]),
            covariance=_nested(covariance),
            gauss_newton_step=_nested(step.change[i]),
            gauss_newton_covariance=_nested(step.covariance[i]),
            overdispersion=_nested(overdispersion[i]),
            parameter_rms=_predicted_rms(covariance, information, seen.rows[i]),
            residual_rms=_root_mean_square(errors[joint]),
            residual_p90=_error_bound(errors[joint]),
            repeatability=float(repeatability[i]),
        )
        if before:
            old = before.joints[joint]
            uncertainty = no_better_than(uncertainty, old, errors_are_of_fit=not is_validated)
        joints[joint] = uncertainty
    # Only `adapt` gives neither motions that judge nor covariances of its own.
    made_by = "identify" if judges or covariances else "adapt"
    sources = [_provenance(sequences, joints, made_by)]
    if before:
        sources = [*before.sources, *sources]
    return ParameterUncertainty(fields, joints, tuple(sources), clusters, is_validated)


class _GaussNewtonStep(NamedTuple):
    """Gauss-Newton step that recordings ask for, of n joints and Q numbers."""

    change: Array  # (n, Q)
    covariance: Array  # of the change, (n, Q, Q)
    information: Array  # of all clusters, (n, Q, Q)


def _gauss_newton_step(seen: Evidence, overdispersion: Array) -> _GaussNewtonStep:
    """Return the step that evidence asks for; overdispersion (n, Q) makes it less sure."""
    information = seen.information.sum(axis=1)
    gradient = seen.gradients.sum(axis=1)
    inverse = inverted(information)
    change = -(inverse @ gradient[..., None])[..., 0]
    scatter = widened(information, np.maximum(overdispersion, 1.0))
    return _GaussNewtonStep(change, inverse @ scatter @ inverse, information)


def _predicted_rms(covariance: Array, information: Array, rows: float) -> float:
    """Return the RMS position error that a covariance alone predicts, rad, from the information of
    so many rows; (P, P) both.
    """
    squared_errors = max(np.trace(covariance @ information), 0.0)
    return ERROR_SCALE_RAD * float(np.sqrt(squared_errors / max(rows, 1)))


def _fitted_fields(robot: RobotSpec) -> tuple[str, ...]:
    """Return the fields that a robot's fit has: the classic ones, and those of its terms."""
    first = first_values(robot)
    fields = [*CLASSIC]
    for field in SERVO_TERMS:
        has_prior = bool(SERVO_FIELDS[field].prior_std)
        if has_prior and first[field].any():
            fields.append(field)
    return tuple(fields)


def no_better_than(
    today: JointUncertainty,
    old: JointUncertainty,
    *,
    errors_are_of_fit: bool,
) -> JointUncertainty:
    """Return a joint's uncertainty of today with repetitions that differ no less than before.

    Errors of recordings that were fitted are too small, so they are no less than those of motions
    that were not.
    """
    repeatability = max(today.repeatability, old.repeatability)
    if not errors_are_of_fit:
        return replace(today, repeatability=repeatability)
    return replace(
        today,
        repeatability=repeatability,
        residual_rms=max(today.residual_rms, old.residual_rms),
        residual_p90=max(today.residual_p90, old.residual_p90),
    )


def _provenance(
    sequences: ListOf[Sequence],
    joints: Mapping[str, JointUncertainty],
    made_by: str,
) -> Provenance:
    """Return where values and covariances come from."""
    several = _are_of_several_units(sequences)
    return {
        "made_by": made_by,
        "days": tuple(sorted({s.meta.recorded_at[:10] for s in sequences} - {""})),
        "unit": ", ".join(sorted({s.meta.unit_id for s in sequences})),
        "logs": {_log_name(s, several): s.content_hash() for s in sequences},
        "seconds": float(sum(s.duration for s in sequences)),
        "values": {name: joint.values for name, joint in joints.items()},
        "covariance": {name: joint.covariance for name, joint in joints.items()},
    }


def _overdispersion(
    seen: Evidence,
    before: ParameterUncertainty | None,
    joints: ListOf[str],
) -> tuple[int, Array]:
    """Return the number of clusters, and the variance of their gradients over that of independent
    rows, (n, Q).

    It is averaged with that of `before`, in proportion to the clusters of both.
    """
    if len(seen.names) >= MIN_RECORDINGS_AS_CLUSTERS:
        seen = seen.by_recording()
    clusters = seen.gradients.shape[1]
    independent = np.einsum("nckk->nk", seen.information)
    scatter = np.einsum("nkk->nk", gradient_covariance(seen.gradients))
    none = np.zeros_like(independent)
    of_these = np.divide(scatter, independent, out=none, where=independent > 0)
    if before is None:
        return clusters, of_these
    old = np.stack([before.array(joint, "overdispersion") for joint in joints])
    total = before.clusters * old + clusters * of_these
    return clusters, total / (before.clusters + clusters)


def _covariance(
    joint: str,
    fields: tuple[str, ...],
    values: Array,
    from_rows: Array,
    fitted: Mapping[str, tuple[list[str], Array]],
    before: ParameterUncertainty | None,
) -> Array:
    """Return the covariance of a joint's values (P,) on the axes, (P, P).

    Args:
        from_rows: What the recordings' rows say alone, (P, P).
        fitted, before: As `covariances` and `before` of `estimate_uncertainty`. A fit has counted
            its own prior of kp, damping and armature.
    """
    covariance = from_rows
    if joint in fitted:
        names, of_names = fitted[joint]
        order = np.array([names.index(field) for field in fields])
        covariance = of_names[np.ix_(order, order)]
    elif before:
        covariance = _beside_earlier(joint, values, from_rows, before)
    if before:
        return covariance
    prior = prior_std(fields, values)
    information = prior**-2
    if joint in fitted:
        has_prior = np.isin(fields, list(PRIOR_LOG_STD))
        has_prior &= np.sqrt(np.diag(covariance)) < WITHOUT_PRIOR * prior
        information = np.where(has_prior, 0.0, information)  # the fit has counted it
    return inverted(inverted(covariance) + np.diag(information))


def _beside_earlier(
    joint: str,
    values: Array,
    from_rows: Array,
    before: ParameterUncertainty,
) -> Array:
    """Return the covariance of a joint's values (P,) by new recordings and by those before, whose
    variance grows by how far the values moved beyond both; (P, P).
    """
    earlier = before.array(joint, "covariance")
    squared_move = np.square(values - before.array(joint, "values"))
    unexplained = squared_move - np.diag(from_rows) - np.diag(earlier)
    wider = earlier + np.diag(np.maximum(unexplained, 0.0))
    return inverted(inverted(wider) + inverted(from_rows))


def _log_name(sequence: Sequence, with_unit: bool) -> str:
    """Return motion, unit if asked, payload and repetition of a recording; the first repetition has
    no number.
    """
    name = _take_name(sequence, with_unit)
    return f"{name} {sequence.meta.repetition}".removesuffix(" 0")


def _errors_by_joint(folds: ListOf[HeldOut], nthread: int) -> dict[str, list[Array]]:
    """Return joint → |error| of each rollout that holds it, rad; the worst joint's for joints that
    none holds.
    """
    robot = folds[0].robot
    errors: dict[str, list[Array]] = {}
    for sequences, judged in folds:
        replays = replay(sequences, judged, nthread=nthread, lock_idle=True)
        for s, simulated in zip(sequences, replays, strict=True):
            error = np.abs(simulated.qpos - s.qpos)[1:]  # (T − 1, joints); both start as recorded
            for joint, i in zip(robot.operated, robot.operated_index, strict=True):
                if joint not in s.meta.unrecorded:
                    errors.setdefault(joint, []).append(error[:, i])
    worst = max(errors.values(), key=_root_mean_square, default=[np.zeros(1)])
    return {joint: errors.get(joint, worst) for joint in robot.operated}


def _root_mean_square(errors: ListOf[Array]) -> float:
    """Return the root mean square of the samples of all arrays, rad."""
    return float(np.sqrt(np.square(np.concatenate(errors)).mean()))


def _error_bound(motions: ListOf[Array]) -> float:
    """Return the bound of 90 % of other motions' samples, from |error| of some, rad.

    It is wider than the bound of these by one standard error (Student's t) of the mean of their RMS
    errors.
    """
    bound = float(np.quantile(np.concatenate(motions), BOUND_QUANTILE))
    freedom = len(motions) - 1
    if not freedom:
        return bound
    rms = np.array([np.sqrt(np.square(error).mean()) for error in motions])
    margin = confidence_factor(freedom) * standard_error(rms)
    relative_margin = margin / max(float(rms.mean()), 1e-12)
    return bound * (1 + relative_margin)


def _nested(x: Array) -> Any:
    """Return an array as nested tuples, or a number if it has no dimension."""
    if x.ndim == 0:
        return float(x)
    return tuple(_nested(row) for row in x)
