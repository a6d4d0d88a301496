"""Joints of a model fixed at a value."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from gaponet.base.errors import RobotError


def units_per_si(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
    """Return the specification's units per rad or m of a joint: an MJCF may use degrees."""
    if spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        return math.degrees(1)
    return 1.0


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
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    turn = np.array([1.0, 0.0, 0.0, 0.0])  # of the body, in its own frame
    shift = axis * move  # of the body's origin, in its own frame, m
    if joint.type != mujoco.mjtJoint.mjJNT_SLIDE:
        mujoco.mju_axisAngle2Quat(turn, axis, move)
        anchor = np.array(joint.pos)
        turned_anchor = np.zeros(3)
        mujoco.mju_rotVecQuat(turned_anchor, anchor, turn)
        shift = anchor - turned_anchor
    offset = np.zeros(3)  # the same in the frame of the parent
    mujoco.mju_rotVecQuat(offset, shift, np.array(body.quat))
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, np.array(body.quat), turn)
    body.pos = np.array(body.pos) + offset
    body.quat = quat
    spec.delete(joint)
