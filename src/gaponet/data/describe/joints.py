"""Names of joints in a log → the robot's own."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from fnmatch import fnmatchcase

from gaponet.base.errors import JointMismatchError
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots


def resolve_all(
    names: Sequence[str], robot: RobotSpec, where: str, joint_map: dict[str, str] | None
) -> list[str]:
    """The robot's joint of each name in a log, in the same order; one error for all that it does
    not have.

    Args:
        names: Joint names as the log writes them; /robot/link/joint is reduced to its last part.
        where: File, for the error.
        joint_map: The log's name → the robot's, tried first.

    Raises:
        JointMismatchError: A name is no joint of this robot, or two names are one joint.
    """
    matched = []
    errors: dict[str, JointMismatchError] = {}
    for name in names:
        try:
            matched.append(robot.resolve(name, where, joint_map))
        except JointMismatchError as error:
            errors[name] = error
    strange = [name for name in names if name in errors]
    if len(strange) == 1:
        raise errors[strange[0]]
    if strange:
        if not matched and not joint_map:
            _refuse_joints_of_another_robot(names, robot, where)
        free = [j for j in robot.joint_names if j not in matched]
        raise _unknown_joints(strange, free, robot, where)
    if len(set(matched)) != len(matched):
        raise JointMismatchError(
            f"{where}: two names map to one joint: {', '.join(matched)}; mend --map or [names]"
        )
    return matched


def _refuse_joints_of_another_robot(names: Sequence[str], robot: RobotSpec, where: str) -> None:
    for other in packaged_robots():
        if _all_of(other, names):
            raise JointMismatchError(
                f"{where} names joints {', '.join(names)}: no joint of robot '{robot.name}', all "
                f"of robot '{other}': give that one (import --robot {other}; start {other} LOGS)"
            )


def _unknown_joints(
    strange: list[str], free: list[str], robot: RobotSpec, where: str
) -> JointMismatchError:
    """Return the error that names are no joints of the robot, with a proposal for each.

    Args:
        free: Joints that no name means.
    """
    maps = []
    for name in strange:
        close = difflib.get_close_matches(name.split("/")[-1], free, n=1, cutoff=0.5)
        maps.append(f"--map {name}={close[0] if close else '…'}")
        free = [j for j in free if j not in close]
    left = ""
    if free and any(one.endswith("=…") for one in maps):
        left = f" (… is one of {', '.join(free)})"
    return JointMismatchError(
        f"{where} names joints {', '.join(strange)}, which robot '{robot.name}' "
        f"does not have. Map them with {' '.join(maps)}{left}, or under [names] in logs.toml; "
        'what is no joint of this robot is left out by ignore = ["NAME", …] there'
    )


def _all_of(name: str, joints: Sequence[str]) -> bool:
    """Return True if these are all joints of a robot of the package."""
    try:
        return bool([load_robot(name).resolve(joint, "") for joint in joints])
    except JointMismatchError:
        return False


def ignored(name: str, patterns: Sequence[str]) -> bool:
    """Return True if logs.toml says that a name in the log is no joint of this robot."""
    return not name or any(fnmatchcase(name, pattern) for pattern in patterns)
