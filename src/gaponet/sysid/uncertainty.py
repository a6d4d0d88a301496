"""Uncertainty of a robot's fitted parameters, stored as uncertainty.json in its folder.

The parameters are Gaussian on axes that do not depend on a motor's gain: the logarithms of kp and
stribeck_speed; torques, damping and armature divided by kp; 1 / no_load_speed; other fields in SI
units. The file also holds what the recordings showed by themselves, for comparison with later ones,
and the error of motions that were not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse.csgraph import connected_components
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import write_json
from gaponet.base.structure import read_json, validated
from gaponet.base.text import format_uncertainty
from gaponet.robot.folder import OLD_UNCERTAINTY_FILE, UNCERTAINTY_FILE
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.links import LinkAxes, LinkResult
from gaponet.sysid.axes import Values, first_values, from_axis, to_axis

# Of gear or motor, rad: no parameter of the simulator, but a change that later recordings may show.
PLAY = "play"
# Relative standard errors from which a parameter had no visible effect.
UNSEEN_ERROR_OF_ZERO = 1.0
UNSEEN_ERROR = 3.0  # of another value
# Standard errors: a value nearer to zero has ended at this bound.
MAX_STDS_AT_BOUND = 0.05
DERIVATIVE_STEP = 1e-6  # on an axis, of the delta method
# Parameters that correlate so much, and have at least this relative error, are known only as a set.
MIN_SET_CORRELATION = 0.9
MIN_SET_RELATIVE_ERROR = 0.03
REPAIR_HINT = (
    "identify or adapt again, or remove the file: the robot then has values without uncertainty"
)
# Keys of known.json → of uncertainty.json.
OLD_KEYS = {
    "step": "gauss_newton_step",
    "step_covariance": "gauss_newton_covariance",
    "scatter": "overdispersion",
    "predicted": "parameter_rms",
    "left": "residual_rms",
    "band": "residual_p90",
    "held": "validated",
}


class Provenance(TypedDict):
    """Origin of numbers."""

    made_by: str  # command
    days: tuple[str, ...]  # of recording
    unit: str  # ids of the robots
    logs: dict[str, str]  # name → SHA-256
    seconds: float  # of all logs
    values: dict[str, tuple[float, ...]]  # joint → values on the axes that were fitted then, (P,)
    covariance: dict[str, tuple[tuple[float, ...], ...]]  # joint → (P, P)


@dataclass(frozen=True)
class JointUncertainty:
    """Uncertainty of one joint's P fields on their axes.

    Attributes:
        values: Fitted values, (P,).
        covariance: (P, P).
        gauss_newton_step: Gauss-Newton step of fields and play that the recordings ask for by
            themselves, (P + 1,).
        gauss_newton_covariance: Its covariance, (P + 1, P + 1).
        overdispersion: Variance of the recordings' gradients over that of independent rows, (P +
            1,).
        parameter_rms: RMS position error that the covariance alone predicts, rad.
        residual_rms: RMS position error of motions that were not fitted, rad.
        residual_p90: Bound of 90 % of the position errors of other motions, rad.
        repeatability: RMS difference between the tracking errors of two recordings of one command,
            rad; 0 if unknown.
    """

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    gauss_newton_step: tuple[float, ...]
    gauss_newton_covariance: tuple[tuple[float, ...], ...]
    overdispersion: tuple[float, ...]
    parameter_rms: float
    residual_rms: float
    residual_p90: float
    repeatability: float = 0.0


@dataclass(frozen=True)
class LinkUncertainty:
    """Uncertainty of fitted links in Q coordinates (sim/links.py).

    The covariances of the joints are for the links as fitted.

    Attributes:
        values: Fitted coordinates, (Q,).
        covariance: (Q, Q).
        servo_slopes: Joint → slopes of its values over the coordinates, (P, Q).
    """

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    servo_slopes: dict[str, tuple[tuple[float, ...], ...]]

    @classmethod
    def of(
        cls,
        result: LinkResult | None,
        robot: RobotSpec,
        fields: ListOf[str],
    ) -> LinkUncertainty | None:
        """Return the uncertainty of a fit that began with the file's links, if the robot has the
        fitted ones.
        """
        if result is None:
            return None
        began_with_others = bool(result.axes.links(0 * result.x))
        if began_with_others or robot.links != result.axes.links(result.x):
            return None
        no_slope = np.zeros((len(robot.operated), len(result.x)))
        by_field = [result.servo_slopes.get(field, no_slope) for field in fields]
        slopes = np.stack(by_field, axis=1)  # (n, P, Q)
        return cls(
            values=tuple(result.x.tolist()),
            covariance=result.covariance.tolist(),
            servo_slopes=dict(zip(robot.operated, slopes.tolist(), strict=True)),
        )

    def are_of(self, robot: RobotSpec) -> bool:
        """Return True if the robot's links have the masses of these values."""
        axes = LinkAxes(robot.before_identification)
        for body, link in axes.links(np.array(self.values)).items():
            if body not in robot.links:
                return False
            if not np.isclose(link.mass, robot.links[body].mass, rtol=1e-4):
                return False
        return True


ArrayName = Literal[
    "values", "covariance", "gauss_newton_step", "gauss_newton_covariance", "overdispersion"
]


@dataclass(frozen=True)
class ParameterUncertainty:
    """Uncertainty of a robot's parameters."""

    fields: tuple[str, ...]  # the P fields of the axes
    joints: dict[str, JointUncertainty]  # joint name → its uncertainty
    sources: tuple[Provenance, ...]  # recordings, from the first to the last
    clusters: int  # number of parts of the recordings from which the overdispersion was estimated
    validated: bool  # whether the residuals are of motions that were not fitted
    links: LinkUncertainty | None = None  # of the links, if they were fitted

    @classmethod
    def load(cls, robot: RobotSpec) -> ParameterUncertainty | None:
        """Read uncertainty.json, or known.json of older versions, of the robot's folder; None if
        there is neither.

        Raises:
            RobotError: The file is damaged, or its values are not those of robot.toml.
        """
        file = robot.folder / UNCERTAINTY_FILE
        if not file.is_file():
            file = robot.folder / OLD_UNCERTAINTY_FILE
        if not file.is_file():
            return None
        table = _with_new_keys(read_json(dict[str, Any], file, RobotError, REPAIR_HINT))
        uncertainty = validated(cls, table, file, RobotError, REPAIR_HINT)
        uncertainty._require_values_of(robot, file)
        return uncertainty

    def _require_values_of(self, robot: RobotSpec, file: Path) -> None:
        """Raise RobotError if the values are not those of robot.toml."""
        for joint, values in to_axes(robot, self.fields).items():
            stored = self.joints.get(joint)
            if stored is None or not np.allclose(values, stored.values, rtol=1e-4, atol=1e-5):
                what = f"its values are other values than robot.toml's, at {joint}"
                raise RobotError(f"{file}: {what}; {REPAIR_HINT}")
        if self.links and not self.links.are_of(robot):
            raise RobotError(f"{file}: its links are other links than robot.toml's; {REPAIR_HINT}")

    @classmethod
    def require(cls, robot: RobotSpec) -> ParameterUncertainty:
        """Return `load`; refuse a robot whose folder has no uncertainty."""
        uncertainty = cls.load(robot)
        if uncertainty is None:
            raise UsageError(
                f"{robot.folder}: keeps only values (no {UNCERTAINTY_FILE}); identify or adapt it "
                "again"
            )
        return uncertainty

    def save(self, folder: Path) -> None:
        """Write uncertainty.json into a robot folder."""
        table = {name: value for name, value in asdict(self).items() if value is not None}
        write_json(folder / UNCERTAINTY_FILE, table)

    def array(self, joint: str, name: ArrayName) -> Array:
        """Return an attribute of a joint as an array."""
        return np.array(getattr(self.joints[joint], name), float)

    def si(self, joint: str, covariance: Array | None = None) -> tuple[dict[str, float], Array]:
        """Return a joint's values by field and their covariance (P, P), in SI units.

        `covariance` (P, P) on the axes replaces the joint's own.
        """
        if covariance is None:
            covariance = self.array(joint, "covariance")
        x = self.array(joint, "values")
        values = from_axes(self.fields, x)
        moved = from_axes(self.fields, x + DERIVATIVE_STEP * np.eye(len(x)))
        slopes = [(moved[field] - values[field]) / DERIVATIVE_STEP for field in self.fields]
        jac = np.stack(slopes)  # of fields over axes, (P, P)
        return {field: float(value) for field, value in values.items()}, jac @ covariance @ jac.T


def _with_new_keys(table: dict[str, Any]) -> dict[str, Any]:
    """Rename the keys of a known.json; those of an uncertainty.json stay."""
    renamed = {OLD_KEYS.get(key, key): value for key, value in table.items()}
    joints = renamed.get("joints")
    if not isinstance(joints, dict):
        return renamed
    renamed["joints"] = joints.copy()
    for joint, values in joints.items():
        if isinstance(values, dict):
            renamed["joints"][joint] = _with_new_keys(values)
    return renamed


def to_axes(robot: RobotSpec, fields: ListOf[str]) -> dict[str, Array]:
    """Return a robot's own values on the axes, (P,) of each operated joint."""
    first = first_values(robot)
    by_field = [to_axis(field, first[field], first["kp"]) for field in fields]
    by_joint = np.stack(by_field, axis=-1)  # (n, P)
    return dict(zip(robot.operated, by_joint, strict=True))


def from_axes(fields: ListOf[str], x: Array) -> Values:
    """Return values on the axes, (…, P), as field → (…) in SI units."""
    return from_axis({field: x[..., i] for i, field in enumerate(fields)})


def prior_std(fields: ListOf[str], x: Array) -> Array:
    """Return the prior standard deviations of values (…, P) on the axes, before any log."""
    records = [SERVO_FIELDS[field] for field in fields]
    own = np.array([record.prior_std for record in records], float)
    is_log = np.array([record.axis == "log" for record in records])
    return np.where(is_log, own, np.maximum(own, np.abs(x)))


@dataclass(frozen=True)
class JointSummary:
    """Values of a joint in SI units by field, their standard errors, and the sets that are only
    known together.
    """

    values: dict[str, float]
    errors: dict[str, float]
    sets: tuple[tuple[str, ...], ...] = ()

    def relative_error(self, field: str) -> float:
        """Return the standard error over the value, or over the field's large value."""
        scale = SERVO_FIELDS[field].large_value or abs(self.values[field])
        return self.errors[field] / max(scale, 1e-9)

    def cell(self, field: str) -> str:
        """Return the value with its uncertainty as text; no uncertainty where the logs say
        nothing.
        """
        record = SERVO_FIELDS[field]
        value = self.values[field] * record.factor
        error = self.errors[field] * record.factor
        relative = self.relative_error(field)
        if value == 0 and relative > UNSEEN_ERROR_OF_ZERO:
            return "none seen"
        if value != 0 and relative > UNSEEN_ERROR:
            return f"{value:.3g} (no log shows it)"
        ended_at_zero = not record.signed and value < MAX_STDS_AT_BOUND * error
        if ended_at_zero:  # a delay below zero does not exist
            return f"at most {value + 2 * error:.2g}"
        return format_uncertainty(value, error)


def summarize(uncertainty: ParameterUncertainty, joint: str) -> JointSummary:
    """Summarize the uncertainty of one joint."""
    fields = uncertainty.fields
    values, covariance = uncertainty.si(joint)
    errors = np.sqrt(np.diag(covariance))
    summary = JointSummary(values, dict(zip(fields, errors.tolist(), strict=True)))
    size = np.where(errors > 0, errors, 1.0)
    correlation = np.abs(covariance / np.outer(size, size))  # (P, P)
    is_correlated = (correlation > MIN_SET_CORRELATION) & (errors > 0)
    is_loose = np.array(
        [summary.relative_error(field) > MIN_SET_RELATIVE_ERROR for field in fields]
    )
    both_are_loose = is_loose[:, None] & is_loose[None, :]
    _, set_of_field = connected_components(is_correlated & both_are_loose)  # numbers, (P,)
    sets: dict[int, list[str]] = {}
    for field, number in zip(fields, set_of_field.tolist(), strict=True):
        sets.setdefault(number, []).append(field)
    of_several = [tuple(members) for members in sets.values() if len(members) > 1]
    return replace(summary, sets=tuple(of_several))


def format_change(
    field: str,
    change: float,
    uncertainty: ParameterUncertainty,
    joint: str,
) -> str:
    """Return a change of a field on its axis, or of play, as text."""
    if field == PLAY:
        return f"{1e3 * change:+.1f} mrad"
    record = SERVO_FIELDS[field]
    if record.axis == "value":
        return f"{record.factor * change:+.1f} {record.shown_unit}"
    if record.axis == "log":
        return f"× {np.exp(change):.2f}"
    before = uncertainty.joints[joint].values[uncertainty.fields.index(field)]
    after = before + change
    if record.axis == "inverse" and min(before, after) > 0:
        return f"× {before / after:.2f}"
    if before <= 1e-9:
        return "from none"
    return f"{max(100 * change / before, -100):+.0f} %"


def table_rows(uncertainty: ParameterUncertainty, fields: tuple[str, ...]) -> list[list[str]]:
    """Return a row for each joint: its name, then a cell for each field."""
    rows = []
    for joint in uncertainty.joints:
        summary = summarize(uncertainty, joint)
        rows.append([joint, *map(summary.cell, fields)])
    return rows


def sentences(uncertainty: ParameterUncertainty) -> list[str]:
    """Return the recordings, the parameters that are only known together, and the residual error,
    in sentences.
    """
    return [
        *_recordings(uncertainty.sources),
        *_values_in_sets(uncertainty),
        _residual_error(uncertainty),
    ]


def _recordings(sources: ListOf[Provenance]) -> list[str]:
    """Return which recordings were used, a sentence for each command that used some."""
    lines = []
    for source in sources:
        count = len(source["logs"])
        logs = "1 log" if count == 1 else f"{count} logs"
        days = ", ".join(source["days"]) or "date unknown"
        what = f"{logs} of {source['unit']}, {source['seconds']:.0f} s, {days}"
        lines.append(f"{source['made_by']}: {what}")
    return lines


def _values_in_sets(uncertainty: ParameterUncertainty) -> list[str]:
    """Return a sentence for each set of values that are only known together."""
    lines = []
    for joint in uncertainty.joints:
        for *some, last in summarize(uncertainty, joint).sets:
            lines.append(
                f"{joint}: the logs determine only {', '.join(some)} and {last} together; change "
                "none alone"
            )
    return lines


def _residual_error(uncertainty: ParameterUncertainty) -> str:
    """Return the error of motions that judge, and what of it the standard errors explain."""
    joints = uncertainty.joints
    judges = "were fitted, since no others were there"
    if uncertainty.validated:
        judges = "were not fitted"
    error = _root_mean_square([joint.residual_rms for joint in joints.values()])
    predicted = _root_mean_square([joint.parameter_rms for joint in joints.values()])
    worst = max(joints, key=lambda name: joints[name].residual_rms)
    return (
        f"the RMS error of motions that {judges} is {error:.2f} mrad "
        f"({worst} {1e3 * joints[worst].residual_rms:.2f}). The standard errors predict "
        f"{predicted:.2f}; more than that is due to the servo model"
    )


def _root_mean_square(errors: ListOf[float]) -> float:
    """Return the root mean square of errors in rad, in mrad."""
    return 1e3 * float(np.sqrt(np.mean([x**2 for x in errors])))
