"""Datasets, robots and runs as arguments: a path or an object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset, Entry
from gaponet.nn.packaged_networks import named_folder
from gaponet.robot.spec import RobotSpec
from gaponet.robot.spec import as_robot as as_robot
from gaponet.sim.dataset_robot import open_dataset as open_dataset

if TYPE_CHECKING:
    from gaponet.data.sequence import Sequence
    from gaponet.nn.artifact import GapModel

Place = str | Path
MOVING_RAD = 0.05  # range of a joint that moves


def as_identified(robot: RobotSpec | Place) -> RobotSpec:
    """Return an identified robot; text is its folder even without a slash, where `as_robot` takes
    it for the name of a robot as its maker states it.
    """
    if isinstance(robot, str):
        robot = Path(robot)
    return as_robot(robot)


def as_run(run: GapModel | Place) -> Path:
    """Return the folder of a run, or of a network of the package by name; a trained model lies in
    it.
    """
    if isinstance(run, (str, Path)):
        return named_folder(run)
    return run.path.parent if run.path.name == "model" else run.path


def entries_of_unit(data: Dataset, unit: str, motions: tuple[str, ...]) -> tuple[str, list[Entry]]:
    """Return the id and the recordings of a unit, or of the only one; motions: only these.

    Raises:
        UsageError: The unit is not there, or there are several and none is named.
    """
    units = sorted({e.meta.unit_id for e in data.entries})
    if not unit and len(units) == 1:
        unit = units[0]
    if unit not in units:
        raise UsageError(
            f"--unit {unit or '(none)'}: {data.path} holds units {', '.join(units)}; name one"
        )
    return unit, [e for e in data.select(motions) if e.meta.unit_id == unit]


def test_motions(data: Dataset) -> tuple[str, ...]:
    """Return the names of the motions that no fit to a dataset sees."""
    from gaponet.data.split import split_entries

    return tuple(sorted({entry.meta.motion for entry in split_entries(data)["test"]}))


def driven_by_torque(data: Dataset) -> bool:
    """True if torque was recorded and no position commanded: the commands of the first recording
    are its positions.
    """
    first = data.read(data.entries[0]) if data.entries else None
    return first is not None and first.tau is not None and set(_copies(first)) == {0}


def require_torque_for_current(data: Dataset) -> None:
    """Refuse --current for recordings that hold position commands, or no torque.

    Raises:
        UsageError: The commands are no copies of the positions, or no torque was recorded.
    """
    if driven_by_torque(data) or copies_with_torque(data):
        return
    raise UsageError(
        f"--current is for a robot that is driven by torque or current, and {data.path} holds "
        "position commands beside the positions, or no torque. Leave --current out. If no "
        "position was commanded, name the position's column for ctrl too, and the torque's or "
        "current's for tau (docs/logs.md, 'Driven by torque or current')"
    )


def copies_with_torque(data: Dataset) -> bool:
    """True if torque was recorded, and the commands of the first recording are its positions, of
    the same row or some rows later.
    """
    first = data.read(data.entries[0]) if data.entries else None
    return first is not None and first.tau is not None and None not in _copies(first)


def _copies(sequence: Sequence) -> list[int | None]:
    """Return, for each moving joint, by how many rows its positions repeat its commands; None for
    one whose positions do not. [None] if no joint moves.
    """
    copies: list[int | None] = []
    for j in np.flatnonzero(np.ptp(sequence.qpos, axis=0) > MOVING_RAD):
        if np.array_equal(sequence.ctrl[:, j], sequence.qpos[:, j]):
            copies.append(0)
        else:
            copies.append(sequence.copied.get(sequence.joint_names[j]))
    return copies or [None]


def _what_torque_tells(data: Dataset, first: Sequence) -> str:
    if first.tau is None:
        return (
            "Log what the servos were sent. This log also has no torque of every operated joint, "
            "as of a robot that is driven by torque; if it was recorded, say its column as tau in "
            "logs.toml"
        )
    return (
        f"If the robot is driven by torque, gaponet identify {data.path} --out ROBOT fits its "
        "friction, inertia and delay, and says how far it is"
    )


def require_commands(data: Dataset) -> None:
    """Refuse recordings without commanded positions."""
    first = data.read(data.entries[0]) if data.entries else None
    if first is not None and set(_copies(first)) == {0}:
        raise UsageError(
            f"{data.path}: no position was commanded, so there is nothing to follow: command and "
            f"state are the same numbers. {_what_torque_tells(data, first)}"
        )
