"""Write a copy of a user's URDF with identified damping, friction, effort limits and inertias.

Nothing else changes, and URDF has no place for gains, armature, delay or offsets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import RobotError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.export.mjcf_edit import Source, text_of
from gaponet.robot.servo_fields import STOP_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model

# of a joint, which a URDF lacks
MISSING_FIELDS = (
    "kp",
    "kd",
    "armature",
    "delay",
    "offset",
    "zero",
)
INERTIA_AXES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")  # in the order of robot.toml


@dataclass(frozen=True)
class EditedUrdf:
    """A copy of a URDF, and what could not be written into it.

    Attributes:
        other_links: Links that stay: their mass in the file is not the nominal one, so their frame
            may differ too.
        without_limit: Joints without a <limit>, which would hold their torque limit.
    """

    file: Path
    other_links: tuple[str, ...]
    without_limit: tuple[str, ...]


def edit_urdf(path: Path, out: Path, facts: dict[str, Any], robot: RobotSpec) -> EditedUrdf:
    """Write a copy with the numbers of operated joints and of identified links.

    Args:
        path: URDF; files that it names stay where they are.
        out: Folder for the copy and changes.diff.
        facts: facts.json, with the prefix of joint names in the file.
        robot: Robot with the joints and links to change.

    Raises:
        RobotError: A joint is not in the file, or it is no URDF, or it lies in `out`.
    """
    source = Source(path.resolve())
    source.require_outside(out)
    prefix = facts["prefix"]
    if source.tags[0].name != "robot":
        raise RobotError(f"{path}: begins with <{source.tags[0].name}>, so it is no URDF")
    joints = [tag for tag in source.tags if tag.name == "joint" and tag.parent == "robot"]
    tags = {tag.attributes.get("name", ""): tag for tag in joints}
    without_limit = []
    for name in robot.operated:
        tag = tags.get(prefix + name)
        if tag is None:
            raise RobotError(
                f"{path}: has no joint '{prefix + name}' (--prefix); it has {', '.join(tags)}"
            )
        servo = facts["plain"][name]
        damping = text_of(servo["damping"])
        friction = text_of(servo["frictionloss"])
        dynamics = source.child(tag, "dynamics")
        limit = source.child(tag, "limit")
        if dynamics is not None:
            source.set(dynamics, damping=damping, friction=friction)
        else:
            source.insert(tag, f'    <dynamics damping="{damping}" friction="{friction}"/>')
        if not np.isfinite(servo["effort_limit"]):
            continue
        if limit is None:
            without_limit.append(name)
        else:
            source.set(limit, effort=text_of(servo["effort_limit"]))
    other = _set_links(source, robot, prefix)
    target = out / path.name
    edited = source.edited()[source.main]
    changes = source.changes()
    with lock_folder(out, "engine"):
        with atomic_write(target) as temporary:
            temporary.write_bytes(edited)
        write_text(out / "changes.diff", changes)
    return EditedUrdf(target, tuple(other), tuple(without_limit))


def _set_links(source: Source, robot: RobotSpec, prefix: str) -> list[str]:
    """Write the inertias of identified links whose mass is as before.

    Return the names of others.
    """
    before = build_model(robot.before_identification)
    other = list[str]()
    tags = {t.attributes.get("name", ""): t for t in source.tags if t.name == "link"}
    for name, link in robot.links.items():
        tag = tags.get(prefix + name)
        inertial = source.child(tag, "inertial") if tag else None
        mass = source.child(inertial, "mass") if inertial else None
        own = float(mass.attributes["value"]) if mass else np.nan
        if inertial is None or not np.isclose(own, before.body(name).mass[0], rtol=1e-2):
            other.append(name)
            continue
        numbers = ""
        for axes, value in zip(INERTIA_AXES, link.inertia, strict=True):
            numbers += f' {axes}="{text_of(value)}"'
        origin = f'<origin xyz="{text_of(*link.pos)}"/>'
        weight = f'<mass value="{text_of(link.mass)}"/>'
        source.replace(inertial, f"<inertial>{origin}{weight}<inertia{numbers}/></inertial>")
    return other


def with_urdf_fields(plain: RobotSpec, edited: EditedUrdf) -> RobotSpec:
    """Return the robot as such a file describes it.

    Gains, armature, delays, offsets, stops, what the hands carry, and the table are the nominal
    ones, and so is what could not be written.
    """
    nominal = plain.before_identification
    missing = {name: nominal.servo[name] for name in (*MISSING_FIELDS, *STOP_FIELDS)}
    limits = plain.servo.effort_limit.copy()
    for name in edited.without_limit:
        i = plain.joint_names.index(name)
        limits[i] = nominal.servo.effort_limit[i]
    links = dict(plain.links)
    for name in edited.other_links:
        links.pop(name, None)
    described = plain.with_servo(**missing, effort_limit=limits).with_table(nominal.scene.table)
    return replace(described, nominal=nominal, links=links, payload_mounts=nominal.payload_mounts)
