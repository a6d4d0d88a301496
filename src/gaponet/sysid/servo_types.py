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

MAX_RATIO = 10.0  # of a value to the nearest end of its servo type's interval, or the reverse
MIN_CHANGE = 0.01  # relative; a value that differs less from the nominal one was not determined
NORMAL_QUANTILES = norm.ppf((np.arange(400) + 0.5) / 400)  # a normal distribution as 400 numbers
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
    before = like.before_identification
    taken = [f.name for f in SERVO_FIELDS.values() if f.shared or f.name == "delay"]
    taken.remove("effort_limit")
    servos: dict[str, dict[str, float]] = {}
    for joint, source in sources.items():
        i = robot.joint_names.index(joint)
        k = like.joint_names.index(source)
        servos[joint] = like.servo.of_joint(k, taken)
        for gain in ("kp", "kd"):
            own = float(robot.servo[gain][i])
            theirs = float(before.servo[gain][k])
            if own > 0 and theirs > 0:
                servos[joint][gain] *= own / theirs
    same = like if like.name == robot.name else robot
    taken_over = replace(
        robot.with_identified(servos), payload_mounts=same.payload_mounts, links=same.links
    )
    return taken_over, sources


def _sources(robot: RobotSpec, like: RobotSpec) -> dict[str, str]:
    """Return joint of `robot` → identified joint of `like` that its values come from."""
    identified = identified_joints(like)
    types = dict(zip(like.joint_names, like.servo.types, strict=True))
    sources: dict[str, str] = {}
    for i, joint in zip(robot.operated_index, robot.operated, strict=True):
        candidates = [joint, mirrored(joint)]
        servo = robot.servo.types[i]
        if servo is not None:
            candidates += [j for j, other in types.items() if other and other.name == servo.name]
        found = [j for j in candidates if j in identified]
        if found:
            sources[joint] = found[0]
    return sources


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
            is_far = max(value, nearest) > MAX_RATIO * min(value, nearest)
            if nearest > 0 and is_far:
                sentences.append(
                    f"{robot.joint_names[i]}: {field} {value:.3g} is {value / nearest:.2g} times "
                    f"the {nearest:.3g} of the {servo.name} ({servo.source})"
                )
    return sentences


def measured_types(robots: ListOf[RobotSpec], source: str, licence: str) -> list[ServoType]:
    """Return the servo types of identified joints with their measured values.

    A value is the median of its joints. Its interval holds 5 to 95 % of the joints' estimates, each
    a normal distribution with its standard error; without uncertainty.json the estimates alone. A
    value that stayed at the nominal one is no estimate. Source and licence are those of the
    recordings.

    Raises:
        UsageError: No identified joint names a servo type.
    """
    joints: list[_MeasuredServo] = []
    for number, robot in enumerate(robots):
        joints += _measured_servos(number, robot)
    if not joints:
        raise UsageError(
            "no identified joint names a servo type; write servo = into the [[joint]] of its "
            "robot.toml"
        )
    types = []
    for servo in {joint.servo.name: joint.servo for joint in joints}.values():
        same = [joint for joint in joints if joint.servo.name == servo.name]
        units = set[tuple[int, str]]().union(*(joint.units for joint in same))
        measured: dict[str, Any] = {}
        for f in MEASURED_FIELDS:
            measured[f] = _spread(f, [joint.estimates[f] for joint in same if f in joint.estimates])
        measured |= {"source": source, "licence": licence, "gaponet": __version__}
        types.append(replace(servo, **measured, joints=len(same), robots=len(units)))
    return types


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
    nominal = robot.before_identification
    known = ParameterUncertainty.load(robot)
    op = robot.operated_index
    now = first_values(robot)
    then = first_values(nominal)
    now["damping"] = now["damping"] + robot.servo.kd[op] - nominal.servo.kd[op]
    sources = known.sources if known else ({"unit": ""},)
    units = set[tuple[int, str]]()
    for source in sources:
        units.update((number, unit) for unit in source["unit"].split(", "))
    identified = identified_joints(robot)
    servos = []
    for k, joint in enumerate(robot.operated):
        servo = robot.servo.types[op[k]]
        if servo is None or joint not in identified:
            continue
        errors = summarize(known, joint).errors if known else {}
        estimates = {}
        for f in MEASURED_FIELDS:
            if abs(now[f][k] - then[f][k]) >= MIN_CHANGE * abs(then[f][k]):
                estimates[f] = (float(now[f][k]), errors.get(f, 0.0))
        servos.append(_MeasuredServo(servo, units, estimates))
    return servos


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
    return Spread(*(float(f"{x:.3g}") for x in (np.median(values), low, high)))


def toml_entry(servo: ServoType) -> str:
    """Return a servo type as a [[servo]] table."""
    lines = ["[[servo]]"]
    for f in fields(servo):
        value = getattr(servo, f.name)
        if isinstance(value, Spread):
            value = ", ".join(f"{name} = {x!r}" for name, x in vars(value).items())
            lines.append(f"{f.name} = {{ {value} }}  # {SERVO_FIELDS[f.name].unit}")
        elif value != f.default:
            lines.append(f"{f.name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join([*lines, ""])
