"""Write a copy of a user's URDF or SDF with identified damping, friction and effort limits; nothing else changes.

Neither format has a place for gains, armature, delay or offsets.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import lock_folder, write_text
from gaponet.export.mjcf_edit import Source, Tag, text_of
from gaponet.export.simulator_facts import Joints, ServoFacts
from gaponet.robot.spec import RobotSpec

MISSING_FIELDS = ("kp", "kd", "armature", "delay", "offset", "zero")  # of a joint, which these formats lack


def edit_urdf(path: Path, out: Path, joints: Joints, operated: tuple[str, ...], prefix: str = "") -> tuple[Path, str]:
    """Write a copy with the numbers of operated joints.

    Args:
        path: URDF or SDF; files that it names stay where they are.
        out: Folder for the copy.
        joints: Servos by joint (facts.json).
        operated: The joints to change.
        prefix: Text before each joint's name in the file.

    Returns:
        The copy, and the changes as a unified diff.

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
            names = ", ".join(t.attributes["name"] for t in source.tags if _joint(t, t.attributes.get("name", "")))
            raise RobotError(f"{path}: has no joint '{prefix + name}' (--prefix); it has {names}")
        (_urdf if root == "robot" else _sdf)(source, tag, joints[name])
    target = out / path.name
    with lock_folder(out, "engine"):
        write_text(target, source.edited()[source.main].decode("utf-8"))
    return target, source.difference()


def with_urdf_fields(plain: RobotSpec) -> RobotSpec:
    """Return the robot as such a file describes it: gains, armature, delays, offsets and stops are the nominal ones."""
    nominal = plain.before_identification
    missing = {f: getattr(nominal, f) for f in (*MISSING_FIELDS, "stop_low", "stop_high")}
    return replace(plain, **missing, nominal=nominal)


def _joint(tag: Tag, name: str) -> bool:
    return tag.name == "joint" and tag.parent in ("robot", "model", "world") and tag.attributes.get("name") == name


def _within(source: Source, parent: Tag, name: str) -> Tag | None:
    """Return the first element of a name inside another one."""
    return next((t for t in source.tags if t.name == name and parent.open_end <= t.start < parent.end), None)


def _urdf(source: Source, joint: Tag, servo: ServoFacts) -> None:
    values = {"damping": text_of(servo["damping"]), "friction": text_of(servo["frictionloss"])}
    dynamics, limit = (_within(source, joint, name) for name in ("dynamics", "limit"))
    if dynamics is not None:
        source.set(dynamics, **values)
    else:
        source.insert(joint, f'    <dynamics damping="{values["damping"]}" friction="{values["friction"]}"/>')
    if limit is not None and np.isfinite(servo["effort_limit"]):
        source.set(limit, effort=text_of(servo["effort_limit"]))


def _sdf(source: Source, joint: Tag, servo: ServoFacts) -> None:
    axis = _within(source, joint, "axis")
    if axis is None:
        raise RobotError(f"{joint.file}: joint '{joint.attributes['name']}' has no <axis>")
    dynamics, limit = _within(source, axis, "dynamics"), _within(source, axis, "limit")
    values = {"damping": servo["damping"], "friction": servo["frictionloss"]}
    missing = ""
    for name, value in values.items():
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
