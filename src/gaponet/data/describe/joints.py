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
    strange = []
    for name in names:
        try:
            matched.append(robot.resolve(name, where, joint_map))
        except JointMismatchError as error:
            strange.append((name, error))
    if len(strange) == 1:
        raise strange[0][1]
    kin = (
        [] if matched or joint_map else [name for name in packaged_robots() if _all_of(name, names)]
    )
    if strange and kin:
        raise JointMismatchError(
            f"{where} names joints {', '.join(names)}: no joint of robot '{robot.name}', all of "
            f"robot '{kin[0]}': give that one (import --robot {kin[0]}; start {kin[0]} LOGS)"
        )
    if strange:
        free = [j for j in robot.joint_names if j not in matched]
        maps = []
        for name, _ in strange:
            close = difflib.get_close_matches(name.split("/")[-1], free, n=1, cutoff=0.5)
            maps.append(f"--map {name}={close[0] if close else '…'}")
            free = [j for j in free if j not in close]
        left = (
            f" (… is one of {', '.join(free)})"
            if free and any(m.endswith("=…") for m in maps)
            else ""
        )
        raise JointMismatchError(
            f"{where} names joints {', '.join(n for n, _ in strange)}, which robot '{robot.name}' "
            f"does not have. Map them with {' '.join(maps)}{left}, or under [names] in logs.toml; "
            'what is no joint of this robot is left out by ignore = ["NAME", …] there'
        )
    if len(set(matched)) != len(matched):
        raise JointMismatchError(
            f"{where}: two names map to one joint: {', '.join(matched)}; mend --map or [names]"
        )
    return matched


def _all_of(name: str, joints: Sequence[str]) -> bool:
    """Return True if these are all joints of a robot of the package."""
    try:
        return bool([load_robot(name).resolve(joint, "") for joint in joints])
    except JointMismatchError:
        return False


def ignored(name: str, patterns: Sequence[str]) -> bool:
    """Return True if logs.toml says that a name in the log is no joint of this robot."""
    return not name or any(fnmatchcase(name, pattern) for pattern in patterns)
