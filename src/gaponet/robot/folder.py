"""The robot folder that a run or a dataset keeps: complete, wherever it lies and whatever lies around it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import lock_folder, write_text
from gaponet.robot.spec import PACKAGE_FOLDER, SERVO_FIELDS, SERVO_TERMS, RobotSpec, load_robot, packaged_robots

STORED_ROBOT = "robot"  # folder of a run or a dataset
MOVE_STORED_ROBOT = "move that folder away to keep the other robot from now on"
PROVENANCE_FILE = "identified.json"  # what a robot was identified from (report/candidate.py)
UNCERTAINTY_FILE = "uncertainty.json"  # of its values (sysid/uncertainty.py)
OLD_UNCERTAINTY_FILE = "known.json"  # the same in folders that older versions wrote
BESIDE = ("collision.toml", "look.toml", PROVENANCE_FILE, UNCERTAINTY_FILE, OLD_UNCERTAINTY_FILE)
IDENTIFIED_MARK = "# Identified from logs by gaponet identify; remove what follows for the nominal robot."
IDENTIFIED_TABLES = re.compile(r"^\[identified[._].*?(?=^\[(?!identified[._])|\Z)", re.MULTILINE | re.DOTALL)
FILES = re.compile(r"<include\b|\bfile\s*=|\b(mesh|texture|asset)dir\s*=")


def save_robot(robot: RobotSpec, folder: Path) -> None:
    """Write the nominal robot's folder again, and [identified.JOINT] tables where parameters were identified.

    The copy needs nothing outside it: an MJCF that includes or names files is written anew without them
    (gaponet.robot.self_contained).

    Args:
        robot: Loaded by load_robot, or made from such a one by with_servos.
        folder: Where to; one that gaponet has not made is refused.

    Raises:
        RobotError: A copy in one file would not move as the robot does.
    """
    from gaponet.robot.self_contained import self_contained_mjcf

    if folder.resolve() == robot.folder.resolve():
        raise UsageError(f"{folder}: is the robot's own folder; choose another")
    text = (robot.folder / "robot.toml").read_text(encoding="utf-8").split(IDENTIFIED_MARK)[0]
    text = IDENTIFIED_TABLES.sub("", re.sub(r"(?m)^mjcf\s*=.*\n", "", text)).rstrip() + "\n"
    for name, usual in (("carries_payload", True), ("gain_scale", 1.0)):
        value, text = getattr(robot, name), re.sub(rf"(?m)^{name}\s*=.*\n", "", text)
        text = text if value == usual else f"{name} = {str(value).lower()}\n{text}"
    if robot.nominal is not None:
        text += f"\n{IDENTIFIED_MARK}\n" + "".join(_servo(robot, joint) for joint in robot.operated)
        if robot.table is not None and robot.table != robot.nominal.table:
            lines = [f"{name} = {value!r}\n" for name, value in vars(robot.table).items()]
            text += "[identified_table]\n" + "".join(lines)
        if robot.payload_mounts != robot.nominal.payload_mounts:
            text += "".join(
                f'[identified_mount."{m.side}"]\npos = {list(m.pos)}\nmass = {m.mass!r}\n' for m in robot.payload_mounts
            )
    xml = robot.mjcf.read_text(encoding="utf-8")
    xml = self_contained_mjcf(robot.mjcf) if FILES.search(xml) else xml
    beside = {name: robot.folder / name for name in BESIDE if (robot.folder / name).is_file()}
    with lock_folder(folder, "robot"):
        (folder / "robot.toml").unlink(missing_ok=True)  # without it, nothing is kept: it comes last
        write_text(folder / "robot.xml", xml)
        for name, file in beside.items():
            write_text(folder / name, file.read_text(encoding="utf-8"))
        write_text(folder / "robot.toml", text)
    load_robot(folder)


def require_self_contained(folder: Path) -> None:
    """Refuse a folder whose MJCF names other files: a stranger's could name anybody's."""
    file = folder / "robot.xml"
    if not file.is_file() or FILES.search(file.read_text(encoding="utf-8", errors="replace")):
        raise RobotError(f"{file}: is missing, or names other files; a robot that was kept needs none")


def load_stored_robot(holder: Path, name: str) -> RobotSpec:
    """The robot that a run or a dataset keeps, or in one written before they kept any, the package's of that name.

    Never a folder of that name elsewhere.
    """
    if has_stored_robot(holder):
        return load_robot(holder / STORED_ROBOT)
    if name in packaged_robots():
        return load_robot(PACKAGE_FOLDER / name)
    raise RobotError(
        f"{holder}: keeps no robot, and the package has no '{name}'; say which robot it is with --robot ./FOLDER"
    )


def has_stored_robot(holder: Path) -> bool:
    """Whether there is a robot folder in a run or a dataset."""
    return (holder / STORED_ROBOT / "robot.toml").is_file()


def stored_robot_holder(artifact: Path) -> Path:
    """Where the simulator of a model lies: in its folder where that was exported, else in its run."""
    return artifact if has_stored_robot(artifact) else artifact.parent


def _servo(robot: RobotSpec, joint: str) -> str:
    i = robot.joint_names.index(joint)
    values = {name: float(getattr(robot, name)[i]) for name in SERVO_FIELDS}
    none = (*SERVO_TERMS, "target_speed")  # where they are 0
    told = {name: value for name, value in values.items() if np.isfinite(value) and (value or name not in none)}
    lines = [f"{name} = {value!r}\n" for name, value in told.items()]
    return f'[identified."{joint}"]\n' + "".join(lines)
