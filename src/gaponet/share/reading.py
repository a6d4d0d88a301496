"""Datasets to read: a folder, or what was pushed to a bucket, read where it lies."""

from __future__ import annotations

import sys
from pathlib import Path

from gaponet.data.store import Dataset
from gaponet.robot.folder import keeps_robot, kept_robot
from gaponet.robot.spec import RobotSpec, load_robot


def opened(place: str | Path) -> Dataset:
    """A dataset folder, or one behind an address.

    Raises:
        DatasetError: As open_dataset.
    """
    if "://" not in str(place):
        return Dataset(place)
    from gaponet.share.stream import open_pushed

    return open_pushed(str(place))


def open_dataset(
    dataset: Dataset | str | Path, robot: RobotSpec | str | Path | None = None, run: str | Path | None = None
) -> tuple[Dataset, RobotSpec]:
    """A dataset, to be read, and its robot: the one asked for, else the one that the dataset keeps.

    Args:
        dataset: Folder; or the address (s3://, gs://, file://, hf://) of one that was pushed, which is read where it
            lies.
        robot: Another robot than the one that the dataset keeps.
        run: The run whose robot is taken where the dataset keeps none.

    Raises:
        DatasetError: There is no dataset, it is damaged, or it cannot be reached.

    A dataset written before it kept any takes the one that the run keeps, or else the package's of that name, and that
    is said on stderr.
    """
    data = dataset if isinstance(dataset, Dataset) else opened(dataset)
    if robot is not None:
        return data, robot if isinstance(robot, RobotSpec) else load_robot(robot)
    if not keeps_robot(data.path) and run is not None and keeps_robot(Path(run)):
        return data, kept_robot(Path(run), data.robot_name)
    spec = kept_robot(data.path, data.robot_name)
    if not keeps_robot(data.path):
        note = f"{data.path} keeps no robot (written before November 2026): taking the package's {spec.name}"
        print(note, file=sys.stderr)
    return data, spec
