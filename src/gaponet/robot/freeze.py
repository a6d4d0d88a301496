"""Joints of a model fixed at a value."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError


def units_per_si(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
    """Return the specification's units per rad or m of a joint: an MJCF may use degrees."""
    if compiler_of(spec, joint).degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        return math.degrees(1)
    return 1.0


def compiler_of(spec: mujoco.MjSpec, element: Any) -> Any:
    """Return the settings of the file that an element comes from: an attached model has its own."""
    return getattr(element, "compiler", spec.compiler)


def _quat(spec: mujoco.MjSpec, element: mujoco.MjsBody | mujoco.MjsFrame) -> Array:
    """Return the orientation of a body or frame in what holds it, in whatever form it is given."""
    if element.alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
        return np.array(element.quat)
    compiler = compiler_of(spec, element)
    return np.array(
        spec.resolve_orientation(
            degree=compiler.degree, sequence=compiler.eulerseq, orientation=element.alt
        )
    )


def _axis_and_anchor(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> tuple[Array, Array]:
    """Return a joint's axis, of length 1, and its place, m, in its body; frames may lie between."""
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    anchor = np.array(joint.pos)
    frame = joint.frame
    while frame is not None:
        quat = _quat(spec, frame)
        turned_axis = np.zeros(3)
        turned_anchor = np.zeros(3)
        mujoco.mju_rotVecQuat(turned_axis, axis, quat)
        mujoco.mju_rotVecQuat(turned_anchor, anchor, quat)
        axis = turned_axis
        anchor = turned_anchor + np.array(frame.pos)
        frame = frame.frame
    return axis, anchor


def freeze(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, value: float) -> None:
    """Fix a hinge or slide joint at a value, rad or m.

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
    body.quat = _quat(spec, body)
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    axis, anchor = _axis_and_anchor(spec, joint)
    turn = np.array([1.0, 0.0, 0.0, 0.0])  # of the body, in its own frame
    shift = axis * move  # of the body's origin, in its own frame, m
    if joint.type != mujoco.mjtJoint.mjJNT_SLIDE:
        mujoco.mju_axisAngle2Quat(turn, axis, move)
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


def delete_references(spec: mujoco.MjSpec, removed: set[str]) -> None:
    """Delete actuators, sensors and keyframes, and what refers to joints that will be removed."""
    tendons = _tendons_of(spec, removed)
    for kind in (spec.actuators, spec.sensors, spec.keys):
        for element in list(kind):
            spec.delete(element)
    coupled = {mujoco.mjtEq.mjEQ_JOINT: removed, mujoco.mjtEq.mjEQ_TENDON: tendons}
    for equality in list(spec.equalities):
        if {equality.name1, equality.name2} & coupled.get(equality.type, set()):
            spec.delete(equality)
    for tendon in list(spec.tendons):
        if tendon.name in tendons:
            spec.delete(tendon)


def _tendons_of(spec: mujoco.MjSpec, joints: set[str]) -> set[str]:
    """Return the names of the tendons that run along joints."""
    if not joints or not len(spec.tendons):
        return set()
    model = spec.copy().compile()
    tendons = set()
    for t in range(model.ntendon):
        part = slice(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
        on_joint = model.wrap_type[part] == mujoco.mjtWrap.mjWRAP_JOINT
        if {model.joint(j).name for j in model.wrap_objid[part][on_joint]} & joints:
            tendons.add(model.tendon(t).name)
    return tendons
