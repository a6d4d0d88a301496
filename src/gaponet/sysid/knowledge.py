"""What is known of a robot beside its values, kept as known.json in its folder: how sure they are, and from which logs.

A Gaussian around the values, on axes that do not depend on a motor's gain: logarithms of kp and stribeck_speed;
torques, damping and armature over kp; the others as they are. Beside it what recordings said there, so that later ones
can be told from them, and what the model leaves of motions that were never fitted, which no parameter explains.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.base.files import write_json
from gaponet.base.structure import read_json
from gaponet.robot.folder import KNOWN
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.axes import LOGARITHM, OVER_KP, first_values


class Source(TypedDict):
    """Recordings that numbers come from: the command, days that they name, unit, name → SHA-256, seconds; what the
    values were then, joint → axes, and their covariance."""

    made_by: str
    days: tuple[str, ...]
    unit: str
    logs: dict[str, str]
    seconds: float
    values: dict[str, tuple[float, ...]]
    covariance: dict[str, tuple[tuple[float, ...], ...]]


@dataclass(frozen=True)
class JointKnown:
    """One joint, P fields on their axes.

    Attributes:
        values: (P).
        covariance: (P, P).
        step, step_covariance: How far the recordings move fields and play, joints one by one; (P + 1), (P + 1, P + 1).
        scatter: How much farther windows pull apart than independent rows would, (P + 1).
        predicted: Standard deviation of a predicted position by the covariance alone, rad.
        left, band: RMS error of motions that were not fitted, and what 9 of 10 samples of others should be within, rad.
    """

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    step: tuple[float, ...]
    step_covariance: tuple[tuple[float, ...], ...]
    scatter: tuple[float, ...]
    predicted: float
    left: float
    band: float


@dataclass(frozen=True)
class Knowledge:
    """A robot's: fields, joints, sources from the first to the last; clusters: parts of recordings that the scatter is
    from; held: whether motions that were never fitted judged the model's error."""

    fields: tuple[str, ...]
    joints: dict[str, JointKnown]
    sources: tuple[Source, ...]
    clusters: int
    held: bool

    @classmethod
    def load(cls, robot: RobotSpec) -> Knowledge | None:
        """What the robot's folder keeps; None where it keeps nothing.

        Raises:
            RobotError: Damaged, or about other values than robot.toml's.
        """
        file = robot.folder / KNOWN
        if not file.is_file():
            return None
        hint = "identify or adapt again, or remove it: nothing is known then beside the values"
        found = read_json(cls, file, RobotError, hint)
        for joint, values in seen(robot, found.fields).items():
            kept = found.joints.get(joint)
            if kept is None or not np.allclose(values, kept.values, rtol=1e-4, atol=1e-5):
                raise RobotError(f"{file}: is about other values than robot.toml's, at {joint}; {hint}")
        return found

    def save(self, folder: Path) -> None:
        """Beside robot.toml."""
        write_json(folder / KNOWN, asdict(self))

    def array(self, joint: str, what: str) -> Array:
        """A joint's attribute as an array."""
        return np.array(getattr(self.joints[joint], what), float)

    def si(self, joint: str, covariance: Array | None = None) -> tuple[dict[str, float], Array]:
        """A joint's values by field, and their covariance (P, P), in SI units; or another one on the axes, in SI."""
        x, step = self.array(joint, "values"), 1e-6
        here = values_of(self.fields, x)
        ahead = values_of(self.fields, x + step * np.eye(len(x)))
        slope = np.stack([(ahead[f] - here[f]) / step for f in self.fields])  # (P, axes)
        about = self.array(joint, "covariance") if covariance is None else covariance
        return {f: float(v) for f, v in here.items()}, slope @ about @ slope.T


def seen(robot: RobotSpec, fields: ListOf[str]) -> dict[str, Array]:
    """A robot's own values on the axes, (P,) of each operated joint."""
    first = first_values(robot)
    kp = first["kp"]
    rows = [np.log(np.maximum(first[f], 1e-9)) if f in LOGARITHM else first[f] / kp ** (f in OVER_KP) for f in fields]
    return dict(zip(robot.operated, np.stack(rows, axis=-1), strict=True))


# Standard deviations on the axes before any log; of what is no logarithm at least the value itself.
BELIEVED = {
    "kp": 0.5, "stribeck_speed": 1.0, "damping": 0.05, "frictionloss": 0.02, "armature": 2e-4, "offset": 0.03,
    "delay": 0.02, "stribeck": 0.01, "friction_motor": 0.1, "friction_external": 0.1, "min_torque": 0.003,
}  # fmt: skip


def believed(fields: ListOf[str], x: Array) -> Array:
    """How far values (…, P) may be off before any log says so, standard deviations on the axes."""
    least = np.array([BELIEVED[f] for f in fields])
    return np.where(np.isin(fields, LOGARITHM), least, np.maximum(least, np.abs(x)))


def values_of(fields: ListOf[str], x: Array) -> dict[str, Array]:
    """From the axes (…, P) to field → (…) in SI."""
    found = {f: np.exp(x[..., i]) if f in LOGARITHM else x[..., i] for i, f in enumerate(fields)}
    return {f: v * found["kp"] if f in OVER_KP else v for f, v in found.items()}
