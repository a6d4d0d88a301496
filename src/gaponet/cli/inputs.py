"""What commands read from their arguments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.cli.out import Out
from gaponet.robot import RobotSpec, load_robot
from gaponet.robot_folder import keeps_robot, kept_robot

if TYPE_CHECKING:
    from gaponet.data.store import Dataset


def open_dataset(path: Path, robot: str | None, run: Path | None = None) -> tuple[Dataset, RobotSpec]:
    """A dataset and its robot: the one asked for, else the one that the dataset keeps.

    A dataset written before it kept any: the one that the run keeps, or else the package's of that name, and it is
    said.
    """
    from gaponet.data.store import Dataset

    data = Dataset(path)
    if robot is not None:
        return data, load_robot(robot)
    if not keeps_robot(path) and run is not None and keeps_robot(run):
        return data, kept_robot(run, data.robot_name)
    spec = kept_robot(path, data.robot_name)
    if not keeps_robot(path):
        note = f"{path} keeps no robot (written before November 2026): taking the package's {spec.name}"
        Out(as_json=True).say(note)  # on stderr
    return data, spec


def names(text: str) -> tuple[str, ...]:
    """ "a, b" → ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
