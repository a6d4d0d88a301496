"""Parameter uncertainty as a table and in sentences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.sysid.uncertainty import ParameterUncertainty

FIELD_UNITS = {  # field → heading, factor from SI
    "kp": ("kp, N·m/rad", 1.0), "kd": ("kd, N·m·s/rad", 1.0), "damping": ("damping, N·m·s/rad", 1.0),
    "frictionloss": ("friction, N·m", 1.0), "armature": ("armature, g·m²", 1e3), "offset": ("offset, mrad", 1e3),
    "delay": ("delay, ms", 1e3), "target_speed": ("ramp, rad/s", 1.0), "stribeck": ("more at rest, N·m", 1.0),
    "stribeck_speed": ("until, mrad/s", 1e3), "friction_motor": ("friction, % of motor", 1e2),
    "friction_external": ("friction, % of load", 1e2), "effort_limit": ("most torque, N·m", 1.0),
    "min_torque": ("least torque, N·m", 1.0), "encoder_step": ("encoder, mrad", 1e3), "zero": ("zero, mrad", 1e3),
    "stop_low": ("low stop, rad", 1.0), "stop_high": ("high stop, rad", 1.0),
}  # fmt: skip
LARGE_VALUE = {"offset": 0.02, "delay": 0.02}  # rad, s: scale of an error; of other fields the value itself
UNOBSERVED_RELATIVE_ERROR = 1.0  # a standard error as large says nothing about the value
MIN_SET_CORRELATION, MIN_SET_RELATIVE_ERROR = 0.9, 0.03  # from which parameters are known only as a set


@dataclass(frozen=True)
class JointSummary:
    """Values of a joint in SI units by field, their standard errors, and the sets that are only known together."""

    values: dict[str, float]
    errors: dict[str, float]
    sets: tuple[tuple[str, ...], ...] = ()

    def relative_error(self, field: str) -> float:
        """Return the standard error over the value, or over LARGE_VALUE."""
        return self.errors[field] / max(LARGE_VALUE.get(field, abs(self.values[field])), 1e-9)

    def cell(self, field: str) -> str:
        """Return the value with its uncertainty as text."""
        factor = FIELD_UNITS[field][1]
        if self.relative_error(field) > UNOBSERVED_RELATIVE_ERROR and self.values[field] == 0:
            return "none seen"
        return (
            format_uncertainty(self.values[field] * factor, self.errors[field] * factor)
            if self.errors[field] < 1e3
            else "?"
        )


def summarize(uncertainty: ParameterUncertainty, joint: str) -> JointSummary:
    """Summarize the uncertainty of one joint."""
    fields = uncertainty.fields
    values, covariance = uncertainty.si(joint)
    errors = np.sqrt(np.diag(covariance))
    summary = JointSummary(values, dict(zip(fields, errors.tolist(), strict=True)))
    size = np.where(errors > 0, errors, 1.0)
    correlated = (np.abs(covariance / np.outer(size, size)) > MIN_SET_CORRELATION) & (errors > 0)
    loose = np.array([summary.relative_error(f) > MIN_SET_RELATIVE_ERROR for f in fields])
    return JointSummary(values, summary.errors, _groups(correlated & loose[:, None] & loose[None, :], fields))


def _groups(connected: Array, fields: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Return the connected groups of two or more fields."""
    reach = np.linalg.matrix_power((connected | np.eye(len(fields), dtype=bool)).astype(float), len(fields)) > 0
    sets = dict.fromkeys(tuple(f for f, r in zip(fields, row, strict=True) if r) for row in reach)
    return tuple(s for s in sets if len(s) > 1)


def format_change(field: str, change: float, uncertainty: ParameterUncertainty, joint: str) -> str:
    """Return a change of a field on its axis, or of play, as text."""
    if field in ("offset", "play"):
        return f"{1e3 * change:+.1f} mrad"
    if field == "delay":
        return f"{1e3 * change:+.1f} ms"
    if field in ("friction_motor", "friction_external"):
        return f"{1e2 * change:+.1f} % of the load"
    if field in ("kp", "stribeck_speed"):
        return f"× {np.exp(change):.2f}"
    value = uncertainty.joints[joint].values[uncertainty.fields.index(field)]
    return f"{100 * change / value:+.0f} %" if value > 1e-9 else "from none"


def table_rows(uncertainty: ParameterUncertainty, fields: tuple[str, ...]) -> list[list[str]]:
    """Return a row for each joint: its name, then a cell for each field."""
    summaries = {joint: summarize(uncertainty, joint) for joint in uncertainty.joints}
    return [[joint, *(one.cell(f) for f in fields)] for joint, one in summaries.items()]


def sentences(uncertainty: ParameterUncertainty) -> list[str]:
    """Return the recordings, the parameters that are only known together, and the residual error, in sentences."""
    lines = []
    for s in uncertainty.sources:
        days = ", ".join(s["days"]) or "on a day that no log names"
        logs = f"{len(s['logs'])} log{'s' * (len(s['logs']) != 1)}"
        lines.append(f"{s['made_by']}: {logs} of {s['unit']}, {s['seconds']:.0f} s, {days}")
    for joint in uncertainty.joints:
        for group in summarize(uncertainty, joint).sets:
            lines.append(f"{joint}: {', '.join(group)} are known together; take them as a set")
    joints = uncertainty.joints
    worst = max(joints, key=lambda j: joints[j].residual_rms)
    judges = "were not fitted" if uncertainty.validated else "were fitted, since no others were there"
    lines.append(
        f"the RMS error of motions that {judges} is {_root_mean_square(j.residual_rms for j in joints.values()):.2f} "
        f"mrad ({worst} {1e3 * joints[worst].residual_rms:.2f}); the uncertainty of the values explains "
        f"{_root_mean_square(j.parameter_rms for j in joints.values()):.2f}, the servo model's limits the rest"
    )
    return lines


def _root_mean_square(errors: Iterable[float]) -> float:
    """Return the root mean square of errors in rad, in mrad."""
    return 1e3 * float(np.sqrt(np.mean([x**2 for x in errors])))
