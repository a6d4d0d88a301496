"""Servos taken over from another identified robot, and comparison with published values."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.axes import identified_joints

MAX_RATIO = 10.0  # to a published value, or of it


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
        type_of = robot.servos[i]
        same_type = [j for j in like.joint_names if type_of and like.servos[like.joint_names.index(j)] == type_of]
        source = next((j for j in (joint, mirrored(joint), *same_type) if j in changed), None)
        if source:
            sources[joint] = source
    if not sources:
        raise UsageError(
            f"{like.folder}: no identified joint of it has the name, the mirrored name or the type of servo of a joint "
            f"of {robot.name}"
        )
    taken = [f.name for f in SERVO_FIELDS.values() if (f.shared or f.name == "delay") and f.name != "effort_limit"]
    servos: dict[str, dict[str, float]] = {}
    for joint, source in sources.items():
        i, k = robot.joint_names.index(joint), like.joint_names.index(source)
        servos[joint] = {f: float(getattr(like, f)[k]) for f in taken}
        for gain in ("kp", "kd"):
            own, theirs = (float(getattr(r, gain)[at]) for r, at in ((robot, i), (before, k)))
            servos[joint][gain] *= own / theirs if own > 0 and theirs > 0 else 1.0
    mounts = like.payload_mounts if like.name == robot.name else robot.payload_mounts
    return replace(robot.with_servos(servos), payload_mounts=mounts), sources


def mirrored(joint: str) -> str:
    """Return the joint's name with left and right exchanged; the name itself if it has no side."""
    sides = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "lf": "rf", "lh": "rh"}
    other = sides | {b: a for a, b in sides.items()}
    words = re.split(r"(_)", joint)
    return "".join((other.get(w.lower(), w).upper() if w.isupper() else other.get(w, w)) for w in words)


def far_from_published(robot: RobotSpec) -> list[str]:
    """Return a sentence for each value an order of magnitude off the published one of a joint's servo."""
    sentences = []
    for i in robot.operated_index:
        servo = robot.servos[i]
        for f, usual in servo.published.items() if servo else ():
            value = float(getattr(robot, f)[i])
            if servo and np.isfinite(value) and not usual / MAX_RATIO < value < usual * MAX_RATIO:
                sentences.append(
                    f"{robot.joint_names[i]}: {f} {value:.3g} is {value / usual:.2g} times the {usual:.3g} published "
                    f"for the {servo.name} ({servo.source})"
                )
    return sentences
