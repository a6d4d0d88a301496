"""Servos taken over from another identified robot; servo types measured on robots, and comparison
with them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence as ListOf
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from gaponet import __version__
from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS
from gaponet.robot.spec import RobotSpec, ServoType
from gaponet.robot.toml_file import MEASURED_FIELDS, Spread
from gaponet.sysid.axes import first_values, identified_joints
from gaponet.sysid.uncertainty import ParameterUncertainty, summarize

# Of a value to the nearest end of its servo type's interval, or the reverse.
MAX_RATIO_TO_TYPE = 10.0
# A value that differs less from the nominal one was not determined.
MIN_RELATIVE_CHANGE = 0.01
# A normal distribution as 400 numbers.
NORMAL_QUANTILES = norm.ppf((np.arange(400) + 0.5) / 400)
# Parts of a joint's name, separated by _, that are exchanged for its mirror image.
SIDES = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "lf": "rf", "lh": "rh"}
OTHER_SIDE = SIDES | {right: left for left, right in SIDES.items()}


def servos_like(robot: RobotSpec, like: RobotSpec) -> tuple[RobotSpec, dict[str, str]]:
    """Return the robot with the identified servos of another one, and joint → joint that its
    values come from.

    A joint takes the values of the identified joint of its name, else of its mirror image (left and
    right), else of the first joint with its type of servo. Zero offsets and what else belongs to a
    joint's mounting stay; kp keeps its ratio to the nominal kp. Of the same robot the payload's
    place is taken over too.

    Raises:
        UsageError: No joint corresponds.
    """
    sources = _sources(robot, like)
    if not sources:
        raise UsageError(
            f"{like.folder}: no identified joint of it has the name, the mirrored name or the "
            f"type of servo of a joint of {robot.name}"
        )
    servos = {}
    for joint, source in sources.items():
        servos[joint] = _servo_like(robot, joint, like, source)
    started = robot.with_identified(servos)
    if like.name == robot.name:
        started = replace(started, payload_mounts=like.payload_mounts, links=like.links)
    return started, sources


def _servo_like(
    robot: RobotSpec,
    joint: str,
    like: RobotSpec,
    source: str,
) -> dict[str, float]:
    """Return the identified servo of a joint of `like` for a joint of `robot`: field → value."""
    i = robot.joint_names.index(joint)
    k = like.joint_names.index(source)
    servo = like.servo.of_joint(k, _fields_taken_over())
    before = like.before_identification
    for gain in ("kp", "kd"):
        own = float(robot.servo[gain][i])
        theirs = float(before.servo[gain][k])
        if own > 0 and theirs > 0:
            servo[gain] *= own / theirs
    return servo


def _fields_taken_over() -> list[str]:
    """Return the fields that a servo has wherever it is mounted, without the given torque limit."""
    fields = []
    for field in SERVO_FIELDS.values():
        is_of_servo = field.shared or field.name == "delay"
        if is_of_servo and field.name != "effort_limit":
            fields.append(field.name)
    return fields


def _sources(robot: RobotSpec, like: RobotSpec) -> dict[str, str]:
    """Return joint of `robot` → identified joint of `like` that its values come from."""
    identified = identified_joints(like)
    sources: dict[str, str] = {}
    for i, joint in zip(robot.operated_index, robot.operated, strict=True):
        candidates = [joint, mirrored(joint), *_joints_with(like, robot.servo.types[i])]
        for candidate in candidates:
            if candidate in identified:
                sources[joint] = candidate
                break
    return sources


def _joints_with(robot: RobotSpec, servo: ServoType | None) -> list[str]:
    """Return the joints of a robot with a type of servo; none if the type is unknown."""
    if servo is None:
        return []
    joints = []
    for joint, own in zip(robot.joint_names, robot.servo.types, strict=True):
        if own is not None and own.name == servo.name:
            joints.append(joint)
    return joints


def mirrored(joint: str) -> str:
    """Return the joint's name with left and right exchanged; the name itself if it has no side."""
    words = []
    for word in joint.split("_"):
        if word.isupper():
            words.append(OTHER_SIDE.get(word.lower(), word).upper())
        else:
            words.append(OTHER_SIDE.get(word, word))
    return "_".join(words)


def far_from_servo_type(robot: RobotSpec) -> list[str]:
    """Return a sentence for each value an order of magnitude outside the interval of a joint's
    servo type.
    """
    sentences = []
    for i in robot.operated_index:
        servo = robot.servo.types[i]
        if servo is None:
            continue
        for field in PASSIVE_FIELDS:
            usual = servo.measured.get(field)
            if usual is None:
                continue
            value = float(robot.servo[field][i])
            nearest = float(np.clip(value, usual.low, usual.high))
            is_far = max(value, nearest) > MAX_RATIO_TO_TYPE * min(value, nearest)
            if nearest > 0 and is_far:
                sentences.append(
                    f"{robot.joint_names[i]}: {field} {value:.3g} is {value / nearest:.2g} times "
                    f"the {nearest:.3g} of the {servo.name} ({servo.source})"
                )
    return sentences


def measured_types(
    robots: ListOf[RobotSpec],
    source: str,
    licence: str,
) -> list[ServoType]:
    """Return the servo types of identified joints with their measured values.

    A value is the median of its joints. Its interval holds 5 to 95 % of the joints' estimates, each
    a normal distribution with its standard error; without uncertainty.json the estimates alone. A
    value that stayed at the nominal one is no estimate. Source and licence are those of the
    recordings.

    Raises:
        UsageError: No identified joint names a servo type.
    """
    by_type: dict[str, list[_MeasuredServo]] = {}
    for number, robot in enumerate(robots):
        for measured in _measured_servos(number, robot):
            by_type.setdefault(measured.servo.name, []).append(measured)
    if not by_type:
        raise UsageError(
            "no identified joint names a servo type; write servo = into the [[joint]] of its "
            "robot.toml"
        )
    return [_measured_type(joints, source, licence) for joints in by_type.values()]


def _measured_type(
    joints: list[_MeasuredServo],
    source: str,
    licence: str,
) -> ServoType:
    """Return the type that joints have, with their measured values."""
    units: set[tuple[int, str]] = set()
    for joint in joints:
        units |= joint.units
    values: dict[str, Any] = {"source": source, "licence": licence, "gaponet": __version__}
    for field in MEASURED_FIELDS:
        estimates = [joint.estimates[field] for joint in joints if field in joint.estimates]
        values[field] = _spread(field, estimates)
    return replace(joints[-1].servo, **values, joints=len(joints), robots=len(units))


class _MeasuredServo(NamedTuple):
    """The servo of an identified joint: its type, the units recorded, and field → value and its
    standard error.
    """

    servo: ServoType
    units: set[tuple[int, str]]
    estimates: dict[str, tuple[float, float]]


def _measured_servos(number: int, robot: RobotSpec) -> list[_MeasuredServo]:
    """Return the servos of a robot's identified joints whose type is known; `number` tells robots
    apart.
    """
    op = robot.operated_index
    nominal = robot.before_identification
    now = first_values(robot)
    then = first_values(nominal)
    now["damping"] = now["damping"] + robot.servo.kd[op] - nominal.servo.kd[op]
    uncertainty = ParameterUncertainty.load(robot)
    units = {(number, unit) for unit in _units(uncertainty)}
    identified = identified_joints(robot)
    servos = []
    for k, joint in enumerate(robot.operated):
        servo = robot.servo.types[op[k]]
        if servo is None or joint not in identified:
            continue
        errors = summarize(uncertainty, joint).errors if uncertainty else {}
        estimates = {}
        for field in MEASURED_FIELDS:
            change = abs(now[field][k] - then[field][k])
            if change >= MIN_RELATIVE_CHANGE * abs(then[field][k]):
                estimates[field] = (float(now[field][k]), errors.get(field, 0.0))
        servos.append(_MeasuredServo(servo, units, estimates))
    return servos


def _units(uncertainty: ParameterUncertainty | None) -> set[str]:
    """Return the ids of the units that were recorded; one without a name if nothing is known."""
    if uncertainty is None:
        return {""}
    units: set[str] = set()
    for source in uncertainty.sources:
        units.update(source["unit"].split(", "))
    return units


def _spread(field: str, estimates: list[tuple[float, float]]) -> Spread | None:
    """Return the spread of values with standard errors, to 3 digits; None if no joint was
    fitted.
    """
    if not np.any(estimates):
        return None
    values, errors = np.array(estimates).T
    draws = values[:, None] + errors[:, None] * NORMAL_QUANTILES
    if field != "damping":  # which is negative where it takes from the servo's kd
        draws = np.maximum(draws, 0.0)
    low, high = np.quantile(draws, (0.05, 0.95))
    return Spread(
        value=_three_digits(np.median(values)), low=_three_digits(low), high=_three_digits(high)
    )


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def toml_entry(servo: ServoType) -> str:
    """Return a servo type as a [[servo]] table."""
    lines = ["[[servo]]"]
    for field in fields(servo):
        value = getattr(servo, field.name)
        if isinstance(value, Spread):
            numbers = ", ".join(f"{name} = {number!r}" for name, number in vars(value).items())
            lines.append(f"{field.name} = {{ {numbers} }}  # {SERVO_FIELDS[field.name].unit}")
        elif value != field.default:
            lines.append(f"{field.name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join([*lines, ""])
