"""Closed loops of a vendor's model: connects and welds between bodies, beside its tree of joints."""

from __future__ import annotations

from pathlib import Path

import mujoco

from gaponet.base.errors import RobotError
from gaponet.robot.finding import abbreviate

BETWEEN_BODIES = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


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

    A loop of logged joints alone moves; one of fixed joints alone stands still and harms nothing.

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
