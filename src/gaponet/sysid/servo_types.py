"""Servos taken over from another identified robot; servo types measured on robots, and comparison with them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence as ListOf
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from gaponet import __version__
from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import PASSIVE_FIELDS, SERVO_FIELDS
from gaponet.robot.spec import RobotSpec, ServoType
from gaponet.robot.toml_file import MEASURED_FIELDS, Spread
from gaponet.sysid.axes import first_values, identified_joints
from gaponet.sysid.uncertainty import ParameterUncertainty, summarize

MAX_RATIO = 10.0  # to the interval of a servo type, or of it
MIN_CHANGE = 0.01  # relative; a value that differs less from the nominal one was not determined
NORMAL_QUANTILES = norm.ppf((np.arange(400) + 0.5) / 400)


def servos_like(robot: RobotSpec, like: RobotSpec) -> tuple[RobotSpec, dict[str, str]]:
    """Return the robot with the identified servos of another one, and joint → joint that its values come from.

    A joint takes the values of the identified joint of its name, else of its mirror image (left and right), else of
    the first joint with its type of servo. Zero offsets and what else belongs to a joint's mounting stay; kp keeps its
    ratio to the nominal kp. Of the same robot the payload's place is taken over too.

    Raises:
        UsageError: No joint corresponds.
    """
    before, changed = like.before_identification, identified_joints(like)
    sources: dict[str, str] = {}
    for i, joint in zip(robot.operated_index, robot.operated, strict=True):
        servo, types = robot.servos[i], dict(zip(like.joint_names, like.servos, strict=True))
        same_type = [
            j for j, other in types.items() if servo and other and other.name == servo.name
        ]
        source = next((j for j in (joint, mirrored(joint), *same_type) if j in changed), None)
        if source:
            sources[joint] = source
    if not sources:
        raise UsageError(
            f"{like.folder}: no identified joint of it has the name, the mirrored name or the type of servo of a joint "
            f"of {robot.name}"
        )
    taken = [
        f.name
        for f in SERVO_FIELDS.values()
        if (f.shared or f.name == "delay") and f.name != "effort_limit"
    ]
    servos: dict[str, dict[str, float]] = {}
    for joint, source in sources.items():
        i, k = robot.joint_names.index(joint), like.joint_names.index(source)
        servos[joint] = {f: float(getattr(like, f)[k]) for f in taken}
        for gain in ("kp", "kd"):
            own, theirs = (float(getattr(r, gain)[at]) for r, at in ((robot, i), (before, k)))
            servos[joint][gain] *= own / theirs if own > 0 and theirs > 0 else 1.0
    same = like if like.name == robot.name else robot
    return replace(
        robot.with_servos(servos), payload_mounts=same.payload_mounts, links=same.links
    ), sources


def mirrored(joint: str) -> str:
    """Return the joint's name with left and right exchanged; the name itself if it has no side."""
    sides = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "lf": "rf", "lh": "rh"}
    other = sides | {b: a for a, b in sides.items()}
    words = re.split(r"(_)", joint)
    return "".join(
        (other.get(w.lower(), w).upper() if w.isupper() else other.get(w, w)) for w in words
    )


def far_from_servo_type(robot: RobotSpec) -> list[str]:
    """Return a sentence for each value an order of magnitude outside the interval of a joint's servo type."""
    sentences = []
    for i in robot.operated_index:
        servo = robot.servos[i]
        for f in PASSIVE_FIELDS if servo else ():
            value, usual = float(getattr(robot, f)[i]), servo.measured.get(f) if servo else None
            nearest = float(np.clip(value, usual.low, usual.high)) if usual else 0.0
            if servo and nearest > 0 and max(value, nearest) > MAX_RATIO * min(value, nearest):
                sentences.append(
                    f"{robot.joint_names[i]}: {f} {value:.3g} is {value / nearest:.2g} times the {nearest:.3g} of the "
                    f"{servo.name} ({servo.source})"
                )
    return sentences


def measured_types(robots: ListOf[RobotSpec], source: str, licence: str) -> list[ServoType]:
    """Return the servo types of identified joints with their measured values.

    A value is the median of its joints. Its interval holds 5 to 95 % of the joints' estimates, each a normal
    distribution with its standard error; without uncertainty.json the estimates alone. A value that stayed at the
    nominal one is no estimate. Source and licence are those of the recordings.

    Raises:
        UsageError: No identified joint names a servo type.
    """
    joints: list[
        tuple[ServoType, set[tuple[int, str]], dict[str, tuple[float, float]]]
    ] = []  # type, robots, values
    for number, robot in enumerate(robots):
        nominal, known, op = (
            robot.before_identification,
            ParameterUncertainty.load(robot),
            robot.operated_index,
        )
        now, then, changed = first_values(robot), first_values(nominal), identified_joints(robot)
        now["damping"] = now["damping"] + robot.kd[op] - nominal.kd[op]
        units = {
            (number, u)
            for s in (known.sources if known else ({"unit": ""},))
            for u in s["unit"].split(", ")
        }
        for k, joint in enumerate(robot.operated):
            servo = robot.servos[op[k]]
            errors = summarize(known, joint).errors if known else {}
            moved = [
                f
                for f in MEASURED_FIELDS
                if abs(now[f][k] - then[f][k]) >= MIN_CHANGE * abs(then[f][k])
            ]
            if servo is not None and joint in changed:
                joints.append(
                    (servo, units, {f: (float(now[f][k]), errors.get(f, 0.0)) for f in moved})
                )
    if not joints:
        raise UsageError(
            "no identified joint names a servo type; write servo = into the [[joint]] of its robot.toml"
        )
    types = []
    for servo in {servo.name: servo for servo, *_ in joints}.values():
        same = [joint for joint in joints if joint[0].name == servo.name]
        estimates = {f: [values[f] for *_, values in same if f in values] for f in MEASURED_FIELDS}
        new: dict[str, Any] = {f: _spread(f, values) for f, values in estimates.items()}
        new |= {"source": source, "licence": licence, "gaponet": __version__, "joints": len(same)}
        types.append(
            replace(servo, **new, robots=len(set().union(*(units for _, units, _ in same))))
        )
    return types


def _spread(field: str, estimates: list[tuple[float, float]]) -> Spread | None:
    """Return the spread of values with standard errors, to 3 digits; None if no joint was fitted."""
    if not np.any(estimates):
        return None
    values, errors = np.array(estimates).T
    draws = values[:, None] + errors[:, None] * NORMAL_QUANTILES
    draws = draws if field == "damping" else np.maximum(draws, 0.0)
    return Spread(
        *(float(f"{x:.3g}") for x in (np.median(values), *np.quantile(draws, (0.05, 0.95))))
    )


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
