"""Open a dataset for reading: a folder, or a pushed one at an address."""

from __future__ import annotations

import logging
from pathlib import Path

from gaponet.data.store import Dataset
from gaponet.robot.folder import has_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot


def load_dataset(place: str | Path) -> Dataset:
    """Open a dataset folder, or a pushed dataset at an address.

    Raises:
        DatasetError: There is no dataset, it is damaged, or it cannot be reached.
    """
    if "://" not in str(place):
        return Dataset(place)
    from gaponet.share.stream import open_remote_dataset

    return open_remote_dataset(str(place))


def open_dataset(
    dataset: Dataset | str | Path,
    robot: RobotSpec | str | Path | None = None,
    run: str | Path | None = None,
) -> tuple[Dataset, RobotSpec]:
    """Open a dataset for reading; return it and its robot, with the gains that all recordings state.

    Args:
        dataset: Folder; or the address (s3://, gs://, file://, hf://) of a pushed dataset, which is read without a
            pull.
        robot: Robot to use instead of the one in the dataset folder.
        run: Run or robot folder that is used with the dataset (sim.dataset_robot).

    Raises:
        DatasetError: There is no dataset, it is damaged, or it cannot be reached.

    Datasets written before November 2026 have no robot folder. For those the run's robot is used, or else the robot of
    that name in the package, with a warning in the log.
    """
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    if robot is not None:
        return data, robot if isinstance(robot, RobotSpec) else load_robot(robot)
    from gaponet.sim.dataset_robot import (
        dataset_robot,
    )  # imports mujoco, before which view and report choose OpenGL

    spec = dataset_robot(data, None if run is None else Path(run))
    if not has_stored_robot(data.path) and (run is None or not has_stored_robot(Path(run))):
        logging.getLogger("gaponet").warning(
            "%s holds no robot (written before November 2026): the package's %s is used",
            data.path,
            spec.name,
        )
    return data, spec
