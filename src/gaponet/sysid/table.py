"""What is known of a robot, as a table and in sentences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.sysid.knowledge import Knowledge

SHOWN = {  # field → heading, factor from SI
    "kp": ("kp, N·m/rad", 1.0), "damping": ("damping, N·m·s/rad", 1.0), "frictionloss": ("friction, N·m", 1.0),
    "armature": ("armature, g·m²", 1e3), "offset": ("offset, mrad", 1e3), "delay": ("delay, ms", 1e3),
    "stribeck": ("more at rest, N·m", 1.0), "stribeck_speed": ("until, mrad/s", 1e3),
    "friction_motor": ("friction, % of motor", 1e2), "friction_external": ("friction, % of load", 1e2),
    "min_torque": ("least torque, N·m", 1.0),
}  # fmt: skip
LARGE = {"offset": 0.02, "delay": 0.02}  # rad, s: against which an error is small; of other fields their value
UNKNOWN = 1.0  # of a value: an error as large says nothing of it
TOGETHER, LOOSE = 0.9, 0.03  # correlation, and share of a value: numbers as loose that go together are one set


@dataclass(frozen=True)
class Certainty:
    """A joint's values in SI by field, their standard errors, and which fields are only known together."""

    values: dict[str, float]
    errors: dict[str, float]
    sets: tuple[tuple[str, ...], ...]

    def share(self, field: str) -> float:
        """Standard error over the value, or over what is a large one."""
        return self.errors[field] / max(LARGE.get(field, abs(self.values[field])), 1e-9)

    def cell(self, field: str) -> str:
        """The value as people read it."""
        factor = SHOWN[field][1]
        if self.share(field) > UNKNOWN and self.values[field] == 0:
            return "none seen"
        return (
            format_uncertainty(self.values[field] * factor, self.errors[field] * factor)
            if self.errors[field] < 1e3
            else "?"
        )


def certainty(known: Knowledge, joint: str) -> Certainty:
    """How sure a joint's values are."""
    values, covariance = known.si(joint)
    errors = np.sqrt(np.diag(covariance))
    found = Certainty(values, dict(zip(known.fields, errors.tolist(), strict=True)), ())
    size = np.where(errors > 0, errors, 1.0)
    tied = (np.abs(covariance / np.outer(size, size)) > TOGETHER) & (errors > 0)
    loose = np.array([found.share(f) > LOOSE for f in known.fields])
    tied &= loose[:, None] & loose[None, :]
    return Certainty(found.values, found.errors, _groups(tied, known.fields))


def change(field: str, by: float, known: Knowledge, joint: str) -> str:
    """How far a number moved on its axis, or play, as people say it."""
    if field in ("offset", "play"):
        return f"{1e3 * by:+.1f} mrad"
    if field == "delay":
        return f"{1e3 * by:+.1f} ms"
    if field in ("friction_motor", "friction_external"):
        return f"{1e2 * by:+.1f} % of the load"
    if field in ("kp", "stribeck_speed"):
        return f"× {np.exp(by):.2f}"
    value = known.joints[joint].values[known.fields.index(field)]
    return f"{100 * by / value:+.0f} %" if value > 1e-9 else "from none"


def _groups(tied: Array, fields: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Fields that hang together, two or more."""
    reach = np.linalg.matrix_power((tied | np.eye(len(fields), dtype=bool)).astype(float), len(fields)) > 0
    sets = dict.fromkeys(tuple(f for f, r in zip(fields, row, strict=True) if r) for row in reach)
    return tuple(s for s in sets if len(s) > 1)


def rows(known: Knowledge, fields: tuple[str, ...]) -> list[list[str]]:
    """A line for each joint: its cells, and what is left that no value explains."""
    found = []
    for joint in known.joints:
        one = certainty(known, joint)
        found.append([joint, *(one.cell(f) for f in fields)])
    return found


def sentences(known: Knowledge) -> list[str]:
    """Where the numbers come from, what is known only together, and what the model leaves."""
    told = []
    for s in known.sources:
        days = ", ".join(s["days"]) or "on a day that no log names"
        logs = f"{len(s['logs'])} log{'s' * (len(s['logs']) != 1)}"
        told.append(f"{s['made_by']}: {logs} of {s['unit']}, {s['seconds']:.0f} s, {days}")
    for joint in known.joints:
        for group in certainty(known, joint).sets:
            told.append(f"{joint}: {', '.join(group)} are known together; take them as a set")
    far = max(known.joints, key=lambda j: known.joints[j].left)
    left, said = (np.sqrt(np.mean([x**2 for x in of])) for of in (
        [one.left for one in known.joints.values()], [one.predicted for one in known.joints.values()]))  # fmt: skip
    on = "motions that were not fitted" if known.held else "the motions that were fitted, since no others were there"
    told.append(
        f"on {on}: {1e3 * left:.2f} mrad RMS are left, {far} {1e3 * known.joints[far].left:.2f}; the errors of the "
        f"values explain {1e3 * said:.2f}, the rest is what this form of servo cannot do"
    )
    return told
