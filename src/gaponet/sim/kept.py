"""Whether a robot is the one that a run or a dataset keeps."""

from __future__ import annotations

from pathlib import Path

from gaponet.base.errors import GAPONetError
from gaponet.robot.folder import KEPT, keeps_robot, kept_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash


def require_kept(holder: Path, robot: RobotSpec, error: type[GAPONetError], hint: str) -> RobotSpec:
    """Refuse a robot whose nominal simulator is not that of the robot kept, whatever their names.

    Args:
        holder: Run or dataset; one written before they kept a robot takes the given one.
        robot: Asked for, or of other data.
        error: What is raised.
        hint: What to do about it.

    Returns:
        The robot kept: nominal, or identified.

    Raises:
        error: They move differently before identification.
    """
    if not keeps_robot(holder):
        return robot
    kept = kept_robot(holder, robot.name)
    return require_same(kept, robot, holder, error, f"--robot {holder / KEPT} where that is the right one, or {hint}")


def require_same(own: RobotSpec, robot: RobotSpec, folder: Path, error: type[GAPONetError], use: str) -> RobotSpec:
    """Own, the robot in a folder; refused where it and the other one differ before identification."""
    ours, theirs = model_hash(own.before_identification), model_hash(robot.before_identification)
    if ours != theirs:
        raise error(
            f"{folder}: its nominal simulator is {ours}, that of {robot.folder} is {theirs}: another robot, or other "
            f"gains or inertias. Use {use}"
        )
    return own
