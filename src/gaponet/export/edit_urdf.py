"""Someone's URDF or SDF with identified damping, friction and effort limits: a copy in which these tags change alone.

Neither format has a place for gains, armature, delay, or offsets; `tags_alone` is the robot without them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import lock_folder, write_text
from gaponet.export.edit import Source, Tag, difference, text_of
from gaponet.export.facts import Joints
from gaponet.robot.spec import RobotSpec

LOST = ("kp", "kd", "armature", "delay", "offset", "zero")  # of a joint


def edit_urdf(path: Path, out: Path, joints: Joints, operated: tuple[str, ...], prefix: str = "") -> tuple[Path, str]:
    """Write a copy with the numbers of operated joints.

    Args:
        path: URDF or SDF; files that it names stay where they are.
        out: Folder for the copy.
        joints: Name → numbers of its servo (facts.json).
        operated: The joints to change.
        prefix: What the file has before each joint's name.

    Returns:
        The copy, and what was changed as a unified diff.

    Raises:
        RobotError: A joint is not in the file, or it is no URDF or SDF.
    """
    source = Source(path.resolve())
    root = source.tags[0].name
    if root not in ("robot", "sdf"):
        raise RobotError(f"{path}: begins with <{root}>, so it is no URDF or SDF")
    for name in operated:
        tag = source.one(f"joints '{prefix + name}'", lambda t, n=prefix + name: _joint(t, n))  # type: ignore[misc]
        if tag is None:
            known = ", ".join(t.attributes["name"] for t in source.tags if _joint(t, t.attributes.get("name", "")))
            raise RobotError(f"{path}: has no joint '{prefix + name}' (--prefix); it has {known}")
        (_urdf if root == "robot" else _sdf)(source, tag, joints[name])
    target = out / path.name
    with lock_folder(out, "engine"):
        write_text(target, source.edited()[source.main].decode("utf-8"))
    return target, difference(source)


def tags_alone(plain: RobotSpec) -> RobotSpec:
    """The robot of which these tags are all that leaves: gains, armature, delays and offsets are as before."""
    given = plain.nominal or plain
    nothing = {f: getattr(given, f) for f in (*LOST, "stop_low", "stop_high")}
    return replace(plain, **nothing, nominal=given)


def _joint(tag: Tag, name: str) -> bool:
    return tag.name == "joint" and tag.inside in ("robot", "model", "world") and tag.attributes.get("name") == name


def _within(source: Source, parent: Tag, name: str) -> Tag | None:
    """A direct child, or a child's child, by name."""
    inside = (t for t in source.tags if t.name == name and parent.open_end <= t.start < parent.end)
    return next(inside, None)


def _urdf(source: Source, joint: Tag, servo: dict[str, float]) -> None:
    told = {"damping": text_of(servo["damping"]), "friction": text_of(servo["frictionloss"])}
    dynamics, limit = (_within(source, joint, name) for name in ("dynamics", "limit"))
    if dynamics is not None:
        source.set(dynamics, **told)
    else:
        source.insert(joint, f'    <dynamics damping="{told["damping"]}" friction="{told["friction"]}"/>')
    if limit is not None and np.isfinite(servo["effort_limit"]):
        source.set(limit, effort=text_of(servo["effort_limit"]))


def _sdf(source: Source, joint: Tag, servo: dict[str, float]) -> None:
    axis = _within(source, joint, "axis")
    if axis is None:
        raise RobotError(f"{joint.file}: joint '{joint.attributes['name']}' has no <axis>")
    dynamics, limit = _within(source, axis, "dynamics"), _within(source, axis, "limit")
    told = {"damping": servo["damping"], "friction": servo["frictionloss"]}
    missing = ""
    for name, value in told.items():
        element = None if dynamics is None else _within(source, dynamics, name)
        if element is None:
            missing += f"<{name}>{text_of(value)}</{name}>"
        else:
            source.replace(element, f"<{name}>{text_of(value)}</{name}>")
    if missing:
        source.insert(dynamics or axis, missing if dynamics else f"<dynamics>{missing}</dynamics>")
    effort = None if limit is None else _within(source, limit, "effort")
    if effort is not None and np.isfinite(servo["effort_limit"]):
        source.replace(effort, f"<effort>{text_of(servo['effort_limit'])}</effort>")
