"""Evidence of recordings about a robot's parameters: gradients and information near its values."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import Any

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
from gaponet.sysid.least_squares import slopes
from gaponet.sysid.problem import MIN_CLUSTERS, cluster_sums
from gaponet.sysid.robot_rollouts import cut
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
        order = np.arange(len(self.names))
        pick = (self.recording == order[:, None]).astype(float)
        gradients = np.einsum("rc,ncq->nrq", pick, self.gradients)
        information = np.einsum("rc,ncqp->nrqp", pick, self.information)
        return Evidence(gradients, information, self.rows, order, self.names, self.window_rms)

    def without(self, names: Collection[str]) -> Evidence:
        """Return the evidence without these recordings."""
        if not names:
            return self
        keep = np.array([self.names[r] not in names for r in self.recording])
        rest = tuple(name for name in self.names if name not in names)
        order = np.array([rest.index(self.names[r]) for r in self.recording[keep]])
        rows = self.rows * keep.mean()  # windows are as long as each other
        return Evidence(
            self.gradients[:, keep], self.information[:, keep], rows, order, rest, self.window_rms
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
    each = gradients - gradients.mean(axis=1, keepdims=True)
    return np.asarray(np.swapaxes(each, -1, -2) @ each * (clusters / max(clusters - 1, 1)))


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
    weight = 1 / np.sqrt(1 + errors**2)  # of soft L1
    gradients, window = cluster_sums(jac * (weight * errors)[..., None], rollouts.window)
    names = [_window_name(part) for part in parts]
    recordings = list(dict.fromkeys(names))
    recording_of_window = np.array([recordings.index(name) for name in names])
    return Evidence(
        gradients=gradients,
        information=_information(jac, weight, rollouts.window),
        rows=rollouts.rows,
        recording=recording_of_window[window],
        names=tuple(recordings),
        window_rms=_window_rms(rollouts, errors),
    )


def _slopes_of_joints(
    rollouts: JointRollouts, bounds: Bounds, fields: ListOf[str]
) -> tuple[Array, Array]:
    """Return the errors at the robot's own values, (n, rows) in ERROR_SCALE_RAD, and their slopes
    over the fields on their axes and over play, (n, rows, Q).
    """
    axes = Axes(bounds, fields, bounds.first)

    def scaled_errors(x: Array) -> Array:
        return rollouts.flat_errors(axes.values(x)) / np.float32(ERROR_SCALE_RAD)

    start = axes.normalize(bounds.first)[None]
    errors, by_change = slopes(start, axes.high, scaled_errors)  # (1, n, rows) and (1, n, rows, P)
    is_free = axes.low < axes.high
    by_field = by_change[0] / axes.unit[:, None] * is_free[:, None]
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
        products = of_joint[None, :, :, None] * weighted[None, :, None, :]  # (1, rows, Q, Q)
        of_clusters, _ = cluster_sums(products, window)
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
    late = np.round(bounds.first["delay"][:, None] / windows.periods).astype(int)  # (n, windows)
    command = np.empty_like(windows.ctrl)
    for j, of_joint in enumerate(windows.ctrl):
        for window, ctrl in enumerate(of_joint):
            command[j, window] = np.roll(ctrl, late[j, window])
    offset = bounds.first["offset"][:, None, None].astype(np.float32)
    servo_error = command + offset - windows.qpos
    side = np.tanh(servo_error / PLAY_TURN_RAD)[..., :: windows.thin]
    is_counted = rollouts.counted & rollouts.recorded[..., None]
    return np.asarray(0.5 / ERROR_SCALE_RAD * side * is_counted)


def _window_name(part: Sequence) -> str:
    """Return the name of a window's recording: its motion, and its repetition unless it is the
    first one.
    """
    if not part.meta.repetition:
        return part.meta.motion
    return f"{part.meta.motion} ({part.meta.repetition})"


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
    own = evidence(robot, sequences, fields, nthread=nthread)
    values = to_axes(robot, fields)
    clusters, overdispersion = _overdispersion(own, before, robot.operated)
    information = own.information.sum(axis=1)
    inverse = inverted(information)
    step = -(inverse @ own.gradients.sum(axis=1)[..., None])[..., 0]
    step_covariance = inverse @ widened(information, np.maximum(overdispersion, 1.0)) @ inverse
    repeatability = repetition_difference(sequences, robot.operated)
    errors = _errors_by_joint(held_out or [HeldOut(list(judges or sequences), robot)], nthread)
    joints = {}
    for i, joint in enumerate(robot.operated):
        covariance = _covariance(
            joint, fields, values[joint], step_covariance[i, :-1, :-1], covariances, before
        )
        variance = max(np.trace(covariance @ information[i, :-1, :-1]), 0.0) / max(own.rows[i], 1)
        today = JointUncertainty(
            values=_nested(values[joint]),
            covariance=_nested(covariance),
            gauss_newton_step=_nested(step[i]),
            gauss_newton_covariance=_nested(step_covariance[i]),
            overdispersion=_nested(overdispersion[i]),
            parameter_rms=ERROR_SCALE_RAD * float(np.sqrt(variance)),
            residual_rms=float(np.sqrt(np.mean(np.concatenate(errors[joint]) ** 2))),
            residual_p90=_error_bound(errors[joint]),
            repeatability=float(repeatability[i]),
        )
        joints[joint] = today
        if before:
            old = before.joints[joint]
            joints[joint] = _no_better(today, old, errors_are_of_fit=not (judges or held_out))
    source = _provenance(sequences, joints, "identify" if judges or covariances else "adapt")
    sources = (*before.sources, source) if before else (source,)
    return ParameterUncertainty(fields, joints, sources, clusters, bool(judges or held_out))


def _fitted_fields(robot: RobotSpec) -> tuple[str, ...]:
    """Return the fields that a robot's fit has: the classic ones, and those of its terms."""
    first = first_values(robot)
    present = [f for f in SERVO_TERMS if SERVO_FIELDS[f].prior_std and first[f].any()]
    return (*CLASSIC, *present)


def _no_better(
    today: JointUncertainty, old: JointUncertainty, *, errors_are_of_fit: bool
) -> JointUncertainty:
    """Return a joint's uncertainty with repetitions that differ no less than before.

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
    sequences: ListOf[Sequence], joints: Mapping[str, JointUncertainty], made_by: str
) -> Provenance:
    """Return where values and covariances come from."""
    return {
        "made_by": made_by,
        "days": tuple(sorted({s.meta.recorded_at[:10] for s in sequences} - {""})),
        "unit": ", ".join(sorted({s.meta.unit_id for s in sequences})),
        "logs": {_log_name(s): s.content_hash() for s in sequences},
        "seconds": float(sum(s.duration for s in sequences)),
        "values": {name: joint.values for name, joint in joints.items()},
        "covariance": {name: joint.covariance for name, joint in joints.items()},
    }


def _overdispersion(
    own: Evidence, before: ParameterUncertainty | None, joints: ListOf[str]
) -> tuple[int, Array]:
    """Return the number of clusters, and the variance of their gradients over that of independent
    rows, (n, Q).

    It is averaged with that of `before`, in proportion to the clusters of both.
    """
    grouped = own.by_recording() if len(own.names) >= MIN_CLUSTERS // 4 else own
    clusters = grouped.gradients.shape[1]
    independent = np.einsum("nckk->nk", grouped.information)
    scatter = np.einsum("nkk->nk", gradient_covariance(grouped.gradients))
    seen = np.divide(scatter, independent, out=np.zeros_like(independent), where=independent > 0)
    if before is None:
        return clusters, seen
    old = np.stack([before.array(j, "overdispersion") for j in joints])
    return clusters, (before.clusters * old + clusters * seen) / (before.clusters + clusters)


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
        fitted, before: As `covariances` and `before` of `estimate_uncertainty`.
    """
    covariance = from_rows
    if before:
        was = before.array(joint, "covariance")
        at = before.array(joint, "values")
        moved = np.square(values - at) - np.diag(covariance) - np.diag(was)
        wider = was + np.diag(np.maximum(moved, 0.0))
        covariance = inverted(inverted(wider) + inverted(covariance))
    if joint in fitted:
        names, whole = fitted[joint]
        order = np.array([names.index(f) for f in fields])
        covariance = whole[np.ix_(order, order)]
    if not before:
        prior = np.diag(prior_std(fields, values) ** -2)
        covariance = inverted(inverted(covariance) + prior)
    return covariance


def _log_name(sequence: Sequence) -> str:
    """Return motion and repetition of a recording; the first repetition has no number."""
    return f"{sequence.meta.motion} {sequence.meta.repetition}".removesuffix(" 0")


def _errors_by_joint(folds: ListOf[HeldOut], nthread: int) -> dict[str, list[Array]]:
    """Return joint → |error| of each rollout that holds it, rad; the worst joint's for joints that
    none holds.
    """
    robot = folds[0].robot
    errors: dict[str, list[Array]] = {}
    for sequences, judged in folds:
        replays = replay(sequences, judged, nthread=nthread, lock_idle=True)
        for s, simulated in zip(sequences, replays, strict=True):
            error = np.abs(simulated.qpos - s.qpos)[1:]
            for joint, i in zip(robot.operated, robot.operated_index, strict=True):
                if joint not in s.meta.unrecorded:
                    errors.setdefault(joint, []).append(error[:, i])
    worst = max(errors.values(), key=_mean_square, default=[np.zeros(1)])
    return {joint: errors.get(joint, worst) for joint in robot.operated}


def _mean_square(errors: ListOf[Array]) -> float:
    return float(np.square(np.concatenate(errors)).mean())


def _error_bound(motions: ListOf[Array]) -> float:
    """Return the bound of 90 % of other motions' samples, from |error| of some, rad.

    It is wider than the bound of these by one standard error (Student's t) of the mean of their RMS
    errors.
    """
    rms = np.array([np.sqrt(np.square(error).mean()) for error in motions])
    freedom = len(motions) - 1
    wider = 0.0
    if freedom:
        wider = confidence_factor(freedom) * standard_error(rms) / max(float(rms.mean()), 1e-12)
    return float(np.quantile(np.concatenate(motions), BOUND_QUANTILE)) * (1 + wider)


def _nested(x: Array) -> Any:
    """Return an array as nested tuples."""
    return tuple(_nested(y) for y in x) if x.ndim else float(x)
