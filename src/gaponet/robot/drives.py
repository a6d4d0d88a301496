"""Gains, torque limit and home of each joint, from the model's actuators or from the user, with their sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from gaponet.base.errors import UsageError
from gaponet.robot.finding import abbreviate
from gaponet.robot.servo_fields import PASSIVE_FIELDS
from gaponet.robot.spec import ServoType, servo_type

NO_LIMIT = 1e6  # N·m
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
        values = ", ".join(self.passive) or "no values"
        return (
            f"servo {self.servo.name} ({values}: {self.servo.source})"
            if self.servo
            else "the model"
        )


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
    words = {name: _by_joint(name, given[name], joints) for name in given}
    servos = {
        j: servo_type(word.rpartition("=")[2], f"--servo {word}")
        for j, word in words.pop("servo").items()
    }
    options = {
        name: {j: _number(name, word) for j, word in by.items()} for name, by in words.items()
    }
    result, without_gain = [], []
    for name in joints:
        j = model.joint(name).id
        actuators = np.flatnonzero(
            np.isin(model.actuator_trntype, ON_JOINT) & (model.actuator_trnid[:, 0] == j)
        ).tolist()
        kp, kd = _gains(model, actuators)
        sources = dict.fromkeys(("kp", "kd"), f"its actuator in {file}")
        if not kp and name not in options["kp"]:
            without_gain.append(name)
        if not kd:
            sources["kd"] = f"its actuator in {file} has none" if actuators else f"{file} has none"
        if name in options["kp"]:
            kp, kd, sources["kp"], sources["kd"] = (
                options["kp"][name],
                0.0,
                "--kp",
                "--kp was given without --kd",
            )
        if name in options["kd"]:
            kd, sources["kd"] = options["kd"][name], "--kd"
        limits = [
            *_limits(model, j, actuators, file),
            (NO_LIMIT, f"{file} has none: write the motor's"),
        ]
        limit, why = min(limits, key=lambda x: x[0])
        servo = servos.get(name)
        if servo is not None and servo.effort_limit is not None:
            limit, why = servo.effort_limit, f"servo {servo.name}"
        if name in options["effort_limit"]:
            limit, why = options["effort_limit"][name], "--effort-limit"
        actuator = model.actuator(actuators[0]).name if len(actuators) == 1 else ""
        home = float(pose[model.jnt_qposadr[j]])
        result.append(
            Drive(name, actuator, kp, sources["kp"], kd, sources["kd"], limit, why, home, servo)
        )
    if without_gain:
        raise UsageError(
            f"{file} has no position gain for {abbreviate(without_gain)}: give those of the controller that recorded "
            "the logs, --kp 100 '*wrist*=20' and --kd likewise (N·m/rad, N·m·s/rad); if they are unknown, a guess is "
            "enough, gaponet identify corrects it within a factor of 50"
        )
    return tuple(result)


def _gains(model: mujoco.MjModel, actuators: list[int]) -> tuple[float, float]:
    """Return kp and kd at the joint, summed over its position and damping actuators."""
    kp = kd = 0.0
    for a in actuators:
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
            gear = float(model.actuator_gear[a, 0]) ** 2
            kp -= gear * float(model.actuator_biasprm[a, 1])
            kd -= gear * float(model.actuator_biasprm[a, 2])
    return round(max(kp, 0.0), 9), round(max(kd, 0.0), 9)


def _limits(
    model: mujoco.MjModel, j: int, actuators: list[int], file: str
) -> Iterator[tuple[float, str]]:
    """Yield the torque limits that the model states for a joint, with sources; of both directions, the smaller."""
    if model.jnt_actfrclimited[j]:
        yield (
            float(np.abs(model.jnt_actfrcrange[j]).min()),
            f"actuatorfrcrange (in a URDF, effort) in {file}",
        )
    for a in actuators:
        gear = abs(model.actuator_gear[a, 0])
        if model.actuator_forcelimited[a]:
            yield float(gear * np.abs(model.actuator_forcerange[a]).min()), f"forcerange in {file}"
        if (
            model.actuator_ctrllimited[a]
            and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        ):
            most = np.abs(model.actuator_ctrlrange[a] * model.actuator_gainprm[a, 0]).min()
            yield float(gear * most), f"ctrlrange of its motor in {file}"


def _by_joint(name: str, words: tuple[str, ...], joints: list[str]) -> dict[str, str]:
    """Return joint → its last word among ("100", "*wrist*=20")."""
    by, option = dict[str, str](), f"--{name.replace('_', '-')}"
    if any("=" not in word for word in words[1:]):
        raise UsageError(
            f"{option} {' '.join(words)}: give one value for all joints first, then {joints[0]}=NUMBER"
        )
    for word in words:
        matches = [j for j in joints if fnmatchcase(j, word.rpartition("=")[0] or "*")]
        if not matches:
            raise UsageError(f"{option} {word}: no such joint; there are: {', '.join(joints)}")
        by |= dict.fromkeys(matches, word)
    return by


def _number(name: str, word: str) -> float:
    try:
        value = float(word.rpartition("=")[2])
    except ValueError:
        value = np.nan
    if not 0 <= value <= NO_LIMIT:
        raise UsageError(
            f"--{name.replace('_', '-')} {word}: give a number from 0 to {NO_LIMIT:g}, or PATTERN=NUMBER"
        )
    return value
