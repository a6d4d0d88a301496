"""Write a robot's folder again: into a run that must stay readable, or with identified servo parameters."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np

from gaponet.errors import UsageError
from gaponet.files import whole, write_text, writing
from gaponet.robot import IDENTIFIED, RobotSpec, load_robot

MARK = "# Identified from logs by gaponet identify; remove what follows for the nominal robot."


def save_robot(robot: RobotSpec, folder: Path) -> None:
    """robot.toml and robot.xml of the nominal robot, and [identified.JOINT] tables where parameters were identified.

    Args:
        robot: Loaded by load_robot, or made from such a one by with_servos.
        folder: Written anew; one that gaponet has not made is refused.
    """
    with writing(folder, "robot"):
        _save(robot, folder)


def _save(robot: RobotSpec, folder: Path) -> None:
    source = robot.mjcf.parent
    if folder.resolve() == source.resolve():
        raise UsageError(f"{folder}: is the robot's own folder; choose another")
    text = (source / "robot.toml").read_text(encoding="utf-8").split(MARK)[0].rstrip() + "\n"
    xml = robot.mjcf.read_text(encoding="utf-8")
    # An MJCF that refers to files beside it stays where it is.
    if re.search(r"<include\b|\bfile=|\b(mesh|texture|asset)dir=", xml):
        text = re.sub(r"(?m)^mjcf *=.*\n", "", text)
        text = f"mjcf = '{robot.mjcf.resolve()}'\n" + text
    else:
        with whole(folder / robot.mjcf.name) as temporary:
            shutil.copyfile(robot.mjcf, temporary)
    if robot.nominal is not None:
        text += f"\n{MARK}\n" + "".join(_table(robot, joint) for joint in robot.operated)
    write_text(folder / "robot.toml", text)
    load_robot(folder)


def _table(robot: RobotSpec, joint: str) -> str:
    i = robot.joint_names.index(joint)
    values = {name: float(getattr(robot, name)[i]) for name in ("kp", *IDENTIFIED)}
    lines = [f"{name} = {value!r}\n" for name, value in values.items() if np.isfinite(value)]
    return f'[identified."{joint}"]\n' + "".join(lines)
