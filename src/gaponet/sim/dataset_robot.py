"""The robot of a dataset, with the gains of its recordings."""

from __future__ import annotations

from pathlib import Path

from gaponet.data.store import Dataset
from gaponet.robot.folder import has_stored_robot, load_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import model_hash


def dataset_robot(data: Dataset, run: Path | None = None) -> RobotSpec:
    """Return a dataset's robot with the gains that all its recordings state.

    Args:
        run: Run or robot folder that is used with the dataset. Its robot is used if the dataset stores none, and the
            gains of the dataset's robot.toml if it was fitted with them.
    """
    own: RobotSpec | None = None
    if run is not None and (run / "robot.toml").is_file():
        own = load_robot(run)
    elif run is not None and has_stored_robot(run):
        own = load_stored_robot(run, data.robot_name)
        if not has_stored_robot(data.path):
            return own
    robot, gains = (
        load_stored_robot(data.path, data.robot_name),
        {e.meta.recorded_gains for e in data.entries},
    )
    recorded = robot.with_gains(*gains.pop()) if len(gains) == 1 else robot
    if recorded is robot or own is None:
        return recorded
    return (
        robot
        if model_hash(own.before_identification) == model_hash(robot.before_identification)
        else recorded
    )
