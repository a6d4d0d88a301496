"""Gains, torque limit and home of each joint, from the model's actuators or from the user, with
their sources.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import NamedTuple

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.finding import abbreviate
from gaponet.robot.servo_fields import PASSIVE_FIELDS
from gaponet.robot.servo_parameters import NO_LIMIT
from gaponet.robot.spec import ServoType, servo_type

ON_JOINT = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]


@dataclass(frozen=True)
class Drive:
    """Drive of one joint, with the sources of its numbers.

    Attributes:
        actuator: Name of the joint's only actuator, else "".
        kp, kd, limit, home: N·m/rad, N·m·s/rad, N·m, rad.
        servo: Servo type that the user named.
    """

    name: str
    actuator: str
    kp: float
    kp_source: str
    kd: float
    kd_source: str
    limit: float
    limit_source: str
    home: float
    servo: ServoType | None

    @property
    def passive(self) -> dict[str, float]:
        """Damping, dry friction and armature of the servo type, where it has them."""
        measured = self.servo.measured if self.servo else {}
        return {f: max(measured[f].value, 0.0) for f in PASSIVE_FIELDS if f in measured}

    @property
    def passive_source(self) -> str:
        """Source of these values."""
        if self.servo is None:
            return "the model"
        values = ", ".join(self.passive) or "no values"
        return f"servo {self.servo.name} ({values}: {self.servo.source})"


def drives(
    model: mujoco.MjModel,
    joints: list[str],
    pose: np.ndarray,
    given: dict[str, tuple[str, ...]],
    file: str,
) -> tuple[Drive, ...]:
    """Determine the drives of hinge joints.

    Args:
        pose: Home pose, (nq).
        given: The user's options kp, kd, effort_limit and servo, such as ("100", "*wrist*=20").
        file: Name of the model, for sources and messages.

    Raises:
        UsageError: An option is no number or names no joint, or a joint has no kp.
    """
    servos = {}
    for joint, word in _by_joint("servo", given["servo"], joints).items():
        servos[joint] = servo_type(word.rpartition("=")[2], f"--servo {word}")
    stated: dict[str, dict[str, float]] = {}
    for name in ("kp", "kd", "effort_limit"):
        words = _by_joint(name, given[name], joints)
        stated[name] = {joint: _number(name, word) for joint, word in words.items()}
    found = []
    without_gain = []
    for name in joints:
        j = model.joint(name).id
        is_own = np.isin(model.actuator_trntype, ON_JOINT) & (model.actuator_trnid[:, 0] == j)
        actuators: list[int] = np.flatnonzero(is_own).tolist()
        kp, kd = _gains_and_sources(model, name, actuators, stated, file)
        if not kp.value and name not in stated["kp"]:
            without_gain.append(name)
        limit = _limit_and_source(model, name, actuators, stated, servos.get(name), file)
        actuator = model.actuator(actuators[0]).name if len(actuators) == 1 else ""
        home = float(pose[model.jnt_qposadr[j]])
        drive = Drive(
            name=name,
            actuator=actuator,
            kp=kp.value,
            kp_source=kp.source,
            kd=kd.value,
            kd_source=kd.source,
            limit=limit.value,
            limit_source=limit.source,
            home=home,
            servo=servos.get(name),
        )
        found.append(drive)
    if without_gain:
        raise UsageError(
            f"{file} has no position gain for {abbreviate(without_gain)}: give those of the "
            "controller that recorded the logs, --kp 100 '*wrist*=20' and --kd likewise (N·m/rad, "
            "N·m·s/rad), and leave out joints without position control, such as wheels, with "
            "--joints. If the gains are unknown, a guess is enough, gaponet identify corrects it "
            "within a factor of 50"
        )
    return tuple(found)


class _Sourced(NamedTuple):
    """A number and where it comes from."""

    value: float
    source: str


def _gains_and_sources(
    model: mujoco.MjModel,
    joint: str,
    actuators: list[int],
    stated: dict[str, dict[str, float]],
    file: str,
) -> tuple[_Sourced, _Sourced]:
    """Return kp, N·m/rad, and kd, N·m·s/rad: the user's, else those of the actuators."""
    own_kp, own_kd = _gains(model, actuators)
    kp = _Sourced(own_kp, f"its actuator in {file}")
    kd = _Sourced(own_kd, f"its actuator in {file}")
    if not own_kd:
        why = f"its actuator in {file} has none" if actuators else f"{file} has none"
        kd = _Sourced(0.0, why)
    if joint in stated["kp"]:
        kp = _Sourced(stated["kp"][joint], "--kp")
        kd = _Sourced(0.0, "--kp was given without --kd")
    if joint in stated["kd"]:
        kd = _Sourced(stated["kd"][joint], "--kd")
    return kp, kd


def _limit_and_source(
    model: mujoco.MjModel,
    joint: str,
    actuators: list[int],
    stated: dict[str, dict[str, float]],
    servo: ServoType | None,
    file: str,
) -> _Sourced:
    """Return the torque limit, N·m: the user's, else the servo type's, else the model's least."""
    if joint in stated["effort_limit"]:
        return _Sourced(stated["effort_limit"][joint], "--effort-limit")
    if servo is not None and servo.effort_limit is not None:
        return _Sourced(servo.effort_limit, f"servo {servo.name}")
    limits = list(_limits(model, model.joint(joint).id, actuators, file))
    limits.append((NO_LIMIT, f"{file} has none: write the motor's"))
    value, source = min(limits, key=lambda limit: limit[0])
    return _Sourced(value, source)


def _gains(model: mujoco.MjModel, actuators: list[int]) -> tuple[float, float]:
    """Return kp and kd at the joint, summed over its position and damping actuators."""
    kp = 0.0
    kd = 0.0
    for a in actuators:
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
            gear = float(model.actuator_gear[a, 0]) ** 2
            kp -= gear * float(model.actuator_biasprm[a, 1])
            kd -= gear * float(model.actuator_biasprm[a, 2])
    return round(max(kp, 0.0), 9), round(max(kd, 0.0), 9)


def _smaller_side(both: Array) -> float:
    """Return the smaller size of two ends, (2,), that is not 0; 0 if both are."""
    sizes = np.abs(both)
    return float(min(sizes[sizes > 0], default=0.0))


def _limits(
    model: mujoco.MjModel, j: int, actuators: list[int], file: str
) -> Iterator[tuple[float, str]]:
    """Yield the torque limits that the model states for a joint, with sources; of both directions,
    the smaller that is not 0, since a motor may pull one way only.
    """
    if model.jnt_actfrclimited[j]:
        yield (
            _smaller_side(model.jnt_actfrcrange[j]),
            f"actuatorfrcrange (in a URDF, effort) in {file}",
        )
    for a in actuators:
        gear = abs(float(model.actuator_gear[a, 0]))
        if model.actuator_forcelimited[a]:
            yield gear * _smaller_side(model.actuator_forcerange[a]), f"forcerange in {file}"
        if (
            model.actuator_ctrllimited[a]
            and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        ):
            most = _smaller_side(model.actuator_ctrlrange[a] * model.actuator_gainprm[a, 0])
            yield gear * most, f"ctrlrange of its motor in {file}"


def _by_joint(name: str, words: tuple[str, ...], joints: list[str]) -> dict[str, str]:
    """Return joint → its last word among ("100", "*wrist*=20")."""
    word_of_joint: dict[str, str] = {}
    option = f"--{name.replace('_', '-')}"
    if any("=" not in word for word in words[1:]):
        raise UsageError(
            f"{option} {' '.join(words)}: give one value for all joints first, then "
            f"{joints[0]}=NUMBER"
        )
    for word in words:
        matches = [j for j in joints if fnmatchcase(j, word.rpartition("=")[0] or "*")]
        if not matches:
            raise UsageError(f"{option} {word}: no such joint; there are: {', '.join(joints)}")
        word_of_joint |= dict.fromkeys(matches, word)
    return word_of_joint


def _number(name: str, word: str) -> float:
    """Return the number of a word such as "100" or "*wrist*=20" of an option."""
    try:
        value = float(word.rpartition("=")[2])
    except ValueError:
        value = np.nan
    if not 0 <= value <= NO_LIMIT:
        raise UsageError(
            f"--{name.replace('_', '-')} {word}: give a number from 0 to {NO_LIMIT:g}, or "
            "PATTERN=NUMBER"
        )
    return value
