"""Joints of a model fixed at a value."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from gaponet.base.errors import RobotError


def units_per_si(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
    """Return the specification's units per rad or m of a joint: an MJCF may use degrees."""
    return (
        math.degrees(1)
        if spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
        else 1.0
    )


def freeze(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, value: float) -> None:
    """Fix a hinge or slide joint at a value, rad or m; the body's orientation must be a quaternion.

    Raises:
        RobotError: Another joint of its body comes before it, and the value is not its reference.
    """
    body = joint.parent
    move = value - joint.ref / units_per_si(spec, joint)
    if move and body.joints[0].name != joint.name:
        raise RobotError(
            f"joint '{joint.name}' turns after '{body.joints[0].name}' in one body: keep or clamp "
            "both"
        )
    turn = np.zeros(4)
    quat = np.zeros(4)
    offset = np.zeros(3)
    slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    mujoco.mju_axisAngle2Quat(turn, axis, 0.0 if slides else move)
    mujoco.mju_rotVecQuat(offset, np.array(joint.pos), turn)
    mujoco.mju_rotVecQuat(
        offset, axis * move if slides else np.array(joint.pos) - offset, np.array(body.quat)
    )
    mujoco.mju_mulQuat(quat, np.array(body.quat), turn)
    body.pos = np.array(body.pos) + offset
    body.quat = quat
    spec.delete(joint)
