"""A dataset opened for reading, with its robot and the gains of its recordings."""

from __future__ import annotations

import logging
from pathlib import Path

from gaponet.data.store import Dataset
from gaponet.robot.folder import has_stored_robot, load_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot


def dataset_robot(data: Dataset, run: Path | None = None) -> RobotSpec:
    """Return a dataset's robot with the gains that all its recordings state.

    Args:
        run: Run or robot folder that is used with the dataset. Its robot is used if the dataset
            stores none, and the gains of the dataset's robot.toml if it was fitted with them.
    """
    own: RobotSpec | None = None
    if run is not None and (run / "robot.toml").is_file():
        own = load_robot(run)
    elif run is not None and has_stored_robot(run):
        own = load_stored_robot(run, data.robot_name)
        if not has_stored_robot(data.path):
            return own
    robot = load_stored_robot(data.path, data.robot_name)
    gains = {e.meta.recorded_gains for e in data.entries}
    recorded = robot.with_gains(*gains.pop()) if len(gains) == 1 else robot
    if recorded is robot or own is None:
        return recorded
    # With mujoco, before which view and report choose OpenGL.
    from gaponet.sim.model import model_hash

    fitted_with_stated_gains = model_hash(own.before_identification) == model_hash(
        robot.before_identification
    )
    return robot if fitted_with_stated_gains else recorded


def open_dataset(
    dataset: Dataset | str | Path,
    robot: RobotSpec | str | Path | None = None,
    run: str | Path | None = None,
) -> tuple[Dataset, RobotSpec]:
    """Open a dataset for reading; return it and its robot, with the gains that all recordings
    state.

    Args:
        dataset: Folder.
        robot: Robot to use instead of the one in the dataset folder.
        run: Run or robot folder that is used with the dataset (dataset_robot).

    Raises:
        DatasetError: There is no dataset, or it is damaged.

    Datasets written before November 2026 have no robot folder. For those the run's robot is used,
    or else the robot of that name in the package, with a warning in the log.
    """
    data = dataset if isinstance(dataset, Dataset) else Dataset(dataset)
    if robot is not None:
        return data, robot if isinstance(robot, RobotSpec) else load_robot(robot)
    spec = dataset_robot(data, None if run is None else Path(run))
    if not has_stored_robot(data.path) and (run is None or not has_stored_robot(Path(run))):
        logging.getLogger("gaponet").warning(
            "%s holds no robot (written before November 2026): the package's %s is used",
            data.path,
            spec.name,
        )
    return data, spec
