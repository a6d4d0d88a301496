"""Write a copy of a user's URDF with identified damping, friction and effort limits; nothing else changes.

URDF has no place for gains, armature, delay or offsets.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import lock_folder, write_text
from gaponet.export.mjcf_edit import Source, Tag, text_of
from gaponet.robot.spec import RobotSpec

MISSING_FIELDS = ("kp", "kd", "armature", "delay", "offset", "zero")  # of a joint, which a URDF lacks


def edit_urdf(path: Path, out: Path, facts: dict[str, Any], operated: tuple[str, ...]) -> Path:
    """Write a copy with the numbers of operated joints.

    Args:
        path: URDF; files that it names stay where they are.
        out: Folder for the copy and changes.diff.
        facts: facts.json, with the prefix of joint names in the file.
        operated: The joints to change.

    Returns:
        The copy.

    Raises:
        RobotError: A joint is not in the file, or it is no URDF.
    """
    source, prefix = Source(path.resolve()), facts["prefix"]
    if source.tags[0].name != "robot":
        raise RobotError(f"{path}: begins with <{source.tags[0].name}>, so it is no URDF")
    tags = {t.attributes.get("name", ""): t for t in source.tags if t.name == "joint" and t.parent == "robot"}
    for name in operated:
        if (tag := tags.get(prefix + name)) is None:
            raise RobotError(f"{path}: has no joint '{prefix + name}' (--prefix); it has {', '.join(tags)}")
        servo = facts["plain"][name]
        values = {"damping": text_of(servo["damping"]), "friction": text_of(servo["frictionloss"])}
        dynamics, limit = (_within(source, tag, element) for element in ("dynamics", "limit"))
        if dynamics is not None:
            source.set(dynamics, **values)
        else:
            source.insert(tag, f'    <dynamics damping="{values["damping"]}" friction="{values["friction"]}"/>')
        if limit is not None and np.isfinite(servo["effort_limit"]):
            source.set(limit, effort=text_of(servo["effort_limit"]))
    target = out / path.name
    with lock_folder(out, "engine"):
        write_text(target, source.edited()[source.main].decode("utf-8"))
    source.write_changes(out)
    return target


def with_urdf_fields(plain: RobotSpec) -> RobotSpec:
    """Return the robot as such a file describes it: gains, armature, delays, offsets and stops are the nominal ones."""
    nominal = plain.before_identification
    missing = {f: getattr(nominal, f) for f in (*MISSING_FIELDS, "stop_low", "stop_high")}
    return replace(plain, **missing, nominal=nominal)


def _within(source: Source, parent: Tag, name: str) -> Tag | None:
    """Return the first element of a name inside another one."""
    return next((t for t in source.tags if t.name == name and parent.open_end <= t.start < parent.end), None)
