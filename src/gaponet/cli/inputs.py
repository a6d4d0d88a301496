"""What commands read from their arguments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.robot import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.data.store import Dataset


def open_dataset(path: Path, robot: str | None) -> tuple[Dataset, RobotSpec]:
    """A dataset and its robot: the package's of that name, or the one named or pointed at by `robot`."""
    from gaponet.data.store import Dataset

    data = Dataset(path)
    return data, load_robot(robot or data.robot_name)


def names(text: str) -> tuple[str, ...]:
    """ "a, b" → ("a", "b")."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
