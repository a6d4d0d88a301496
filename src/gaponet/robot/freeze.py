"""Joints of a model fixed at a value, and the closed loops that this would lock."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.robot.finding import abbreviate

BETWEEN_BODIES = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


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
    move = value - joint.ref / units_per_si(spec, joint)
    if move:
        _require_first(joint)
    axis, anchor = _axis_and_anchor(spec, joint)
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    shift = axis * move
    if joint.type != mujoco.mjtJoint.mjJNT_SLIDE:
        mujoco.mju_axisAngle2Quat(turn, axis, move)
        shift = _shift_about(anchor, turn)
    _move(spec, joint.parent, turn, shift)
    spec.delete(joint)


def freeze_free(
    spec: mujoco.MjSpec, joint: mujoco.MjsJoint, reference: Array, value: Array
) -> None:
    """Fix a free or ball joint at a value.

    Args:
        reference: Its coordinates in the model's zero: position, m, and quaternion (7), or of a
            ball joint the quaternion (4).
        value: Its coordinates where it becomes fixed.

    Raises:
        RobotError: Another joint of its body comes before it, and the value is not its reference.
    """
    if not np.array_equal(reference, value):
        _require_first(joint)
        back = np.zeros(4)  # from the reference
        mujoco.mju_negQuat(back, reference[-4:])
        turn = np.zeros(4)
        mujoco.mju_mulQuat(turn, back, value[-4:])
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            shift = np.zeros(3)
            mujoco.mju_rotVecQuat(shift, value[:3] - reference[:3], back)
        else:
            _, anchor = _axis_and_anchor(spec, joint)
            shift = _shift_about(anchor, turn)
        _move(spec, joint.parent, turn, shift)
    spec.delete(joint)


def _require_first(joint: mujoco.MjsJoint) -> None:
    """Refuse a joint of a body that another joint comes before."""
    first = joint.parent.joints[0]
    if first.name != joint.name:
        raise RobotError(
            f"joint '{joint.name}' turns after '{first.name}' in one body: keep or clamp both"
        )


def _shift_about(anchor: Array, turn: Array) -> Array:
    """Return how far a body's origin moves when the body turns about an anchor, m, in the body's
    frame.
    """
    turned_anchor = np.zeros(3)
    mujoco.mju_rotVecQuat(turned_anchor, anchor, turn)
    return anchor - turned_anchor


def _move(spec: mujoco.MjSpec, body: mujoco.MjsBody, turn: Array, shift: Array) -> None:
    """Turn a body by a quaternion and shift its origin, m, both in the body's own frame."""
    old = _quat(spec, body)
    offset = np.zeros(3)  # of the origin, in the frame that holds the body
    mujoco.mju_rotVecQuat(offset, shift, old)
    quat = np.zeros(4)
    mujoco.mju_mulQuat(quat, old, turn)
    body.pos = np.array(body.pos) + offset
    body.quat = quat
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


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


def delete_mocap_welds(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Delete connects and welds to mocap bodies, which move a robot by hand; return notes.

    Args:
        model: The compiled specification.
    """
    notes = []
    for equality in _between_bodies(spec):
        ends = _ends(model, equality)
        mocap = [body for body in ends if model.body_mocapid[body] >= 0]
        if not mocap:
            continue
        held = [body for body in ends if body not in mocap]
        robot = model.body((held or mocap)[0]).name
        notes.append(
            f"left out: what fastens {robot} to the mocap body {model.body(mocap[0]).name}; it "
            "would hold the robot"
        )
        spec.delete(equality)
    return notes


def require_open(spec: mujoco.MjSpec, model: mujoco.MjModel, logged: list[str], path: Path) -> None:
    """Refuse a closed loop in which logged joints would be locked by one that becomes fixed.

    A connect or weld closes a loop beside the tree of joints. A loop of logged joints alone moves.
    One of fixed joints alone stands still and harms nothing.

    Args:
        model: The compiled specification.
        logged: Names of the joints that stay.

    Raises:
        RobotError: There is such a loop.
    """
    for equality in _between_bodies(spec):
        if not equality.active:
            continue
        moving = []
        fixed = []
        for joint in _joints_between(model, *_ends(model, equality)):
            name = model.joint(joint).name
            if name in logged:
                moving.append(name)
            else:
                fixed.append(name or f"the joint of {model.body(model.jnt_bodyid[joint]).name}")
        if moving and fixed:
            kind = equality.type.name.removeprefix("mjEQ_").lower()
            raise RobotError(
                f"{path}: closed loop through {abbreviate(fixed)}: gaponet cannot simulate it, "
                f"because a joint that is not logged is frozen and would lock {abbreviate(moving)}."
                f" Name with --joints only joints outside the loop, or delete the <{kind}> of "
                f"{equality.name1} and {equality.name2 or 'the world'} from the model to open the "
                "loop"
            )


def _between_bodies(spec: mujoco.MjSpec) -> list[mujoco.MjsEquality]:
    """Return the connects and welds."""
    return [equality for equality in spec.equalities if equality.type in BETWEEN_BODIES]


def _ends(model: mujoco.MjModel, equality: mujoco.MjsEquality) -> list[int]:
    """Return the numbers of the two bodies that a connect or weld holds together."""
    ends = []
    for name in (equality.name1, equality.name2):
        if not name:
            ends.append(0)  # the world
        elif equality.objtype == mujoco.mjtObj.mjOBJ_SITE:
            ends.append(int(model.site(name).bodyid[0]))
        else:
            ends.append(model.body(name).id)
    return ends


def _joints_between(model: mujoco.MjModel, first: int, second: int) -> list[int]:
    """Return the numbers of the joints that move one of two bodies relative to the other."""
    between = set(chain(model, first)) ^ set(chain(model, second))
    return [joint for joint in range(model.njnt) if int(model.jnt_bodyid[joint]) in between]


def chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and its ancestors up to the world."""
    bodies = [body]
    while bodies[-1]:
        bodies.append(int(model.body_parentid[bodies[-1]]))
    return bodies
