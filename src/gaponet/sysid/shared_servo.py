"""One servo model for servos of one type, servos taken over from another robot, and comparison with published values.

The same motor has the same gain, damping, friction and armature in every joint. Mounting stays a joint's own: zero
offset, delay, and friction by load, which depends on how the joint is borne.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.axes import Values, identified_joints
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD, JointRollouts
from gaponet.sysid.least_squares import descend, soft_l1

# Fields of a joint's mounting, with the largest change from the joint's own value, and a large one.
MOUNTING = {f.name: f.bounds[1:] for f in SERVO_FIELDS.values() if f.bounds and not f.shared}
LARGE_LOG_CHANGE, MAX_LOG_CHANGE = 0.3, 2.5  # of shared fields
START_LOAD_FRICTION = 0.2  # friction by the motor's torque, in a second start
ARMATURE_PRICE = 2e-3  # of an armature e times the expected one, per row, in ERROR_SCALE_RAD squared
MIN_OVER_KP = 1e-6  # instead of a friction of zero
ITERATIONS = 25
MAX_RATIO = 10.0  # to a published value, or of it


def same_servos(robot: RobotSpec) -> dict[str, list[int]]:
    """Return type of servo → places among the operated joints, for types that two joints or more have."""
    places: dict[str, list[int]] = {}
    for place, joint in enumerate(robot.operated_index):
        if (servo := robot.servos[joint]) is not None:
            places.setdefault(servo.name, []).append(place)
    return {name: each for name, each in places.items() if len(each) > 1}


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


def share(rollouts: JointRollouts, values: Values, places: list[int], armature: float) -> Values:
    """Fit one servo model to the joints at `places`; other joints stay as they are.

    Least squares begin with the model of the joint that does best for all of them, or with the median: once with
    friction by load as it is, and once with some in every joint, which can stand for friction of its own.

    Args:
        rollouts: Windows of recordings.
        values: Every joint's own fit, (n,).
        places: Among the operated joints.
        armature: Expected armature, kg·m²; delay and damping can stand for much of it.
    """
    # Without friction by load the joints that carry the others would need a friction of their own.
    values = {f: np.zeros_like(values["kp"]) for f in MOUNTING if SERVO_FIELDS[f].in_servo_model} | values
    m, kp = len(places), values["kp"][places]
    # Over kp, because a motion shows torques over it: what grows together lies on one axis then.
    powers = {f: float(SERVO_FIELDS[f].axis == "over kp") for f in values if SERVO_FIELDS[f].shared}
    own = {f: MOUNTING[f] for f in MOUNTING if f in values}
    each = [np.log(np.maximum(values[f][places], MIN_OVER_KP * kp) / kp**r) for f, r in powers.items()]
    models = np.array(each).T / LARGE_LOG_CHANGE
    models = np.concatenate([models, np.median(models, axis=0, keepdims=True)])
    mounting = np.concatenate([values[f][places] / large for f, (_, large) in own.items()])
    loaded = mounting.copy()
    loaded[list(own).index("friction_motor") * m :][:m] = START_LOAD_FRICTION / own["friction_motor"][1]
    starts = [np.concatenate([models, np.tile(x, (m + 1, 1))], axis=1) for x in (mounting, loaded)]
    wide = np.concatenate([
        np.full(models.shape[1], MAX_LOG_CHANGE / LARGE_LOG_CHANGE),
        *(np.full(m, most / large) for most, large in own.values()),
    ])  # fmt: skip
    least = np.concatenate(
        [np.full(models.shape[1], -np.inf), *(np.full(m, -np.inf if SERVO_FIELDS[f].signed else 0) for f in own)]
    )

    def to_values(x: Array) -> Values:
        """Candidates (k, P) → values (k, n)."""
        every = {f: np.tile(v, (len(x), 1)) for f, v in values.items()}
        common = dict(zip(powers, np.exp(x[:, : len(powers)] * LARGE_LOG_CHANGE).T, strict=True))
        for f, r in powers.items():
            every[f][:, places] = (common[f] * common["kp"] ** r)[:, None]
        for f, part in zip(own, np.split(x[:, len(powers) :], len(own), axis=1), strict=True):
            every[f][:, places] = part * own[f][1]
        return every

    def errors(xs: Array) -> Array:
        """(k, 1, P) → (k, 1, rows) in ERROR_SCALE_RAD, and the price of the armature."""
        candidates = to_values(xs[:, 0])
        rows = rollouts.errors(candidates)[:, places].reshape(len(xs), -1) / np.float32(ERROR_SCALE_RAD)
        ratio = np.log(candidates["armature"][:, places[:1]] / armature)
        price = np.sqrt(2 * ARMATURE_PRICE * m * rollouts.rows.max()) * ratio
        return np.concatenate([rows, price], axis=1, dtype=np.float32)[:, None]

    first = np.stack([x[soft_l1(errors(x[:, None])).argmin()] for x in starts])[:, None]
    low, high = np.maximum(first.min(axis=0) - wide, least), first.max(axis=0) + wide
    x, cost = descend(first, low, high, errors, ITERATIONS)
    return {f: v[0] for f, v in to_values(x[cost[:, 0].argmin()]).items()}
