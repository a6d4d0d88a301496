"""How logs name and measure the joints of a robot."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

LOG_UNITS = ("rad", "deg", "fraction", "percent", "signed_percent", "ticks", "turns")
MAX_SUGGESTIONS = 3  # similar names in an error


class Follower(NamedTuple):
    """A mimic joint: its angle is ratio · (angle of the joint that it follows) + at_zero, rad."""

    joint: str
    ratio: float
    at_zero: float


@dataclass(frozen=True)
class LogJoints:
    """How logs name and measure the joints of a robot.

    Attributes:
        units: Unit of each joint in public logs, (n), one of LOG_UNITS; a fraction is 0..1 of the
            MJCF range.
        aliases: Other names of a joint in logs → its name in robot.toml.
        followers: Mimic joints, which a log may lack: they move with another joint, and have no
            motor.
    """

    units: tuple[str, ...]
    aliases: dict[str, str] = field(default_factory=dict)
    followers: dict[str, Follower] = field(default_factory=dict)

    def find(
        self, name: str, joint_names: tuple[str, ...], joint_map: Mapping[str, str]
    ) -> tuple[str, list[str]]:
        """Return a log's name of a joint after aliases, and the joints that it can mean.

        Args:
            name: left/waist matches left_waist or else waist; kLeftElbow and left_elbow match
                left_elbow_joint.
            joint_names: Of the robot, (n).
            joint_map: The user's --map, which has priority over the aliases.
        """
        full = name.strip()
        short = full.split("/")[-1]
        for table in (joint_map, self.aliases):
            mapped = table.get(full, table.get(short))
            if mapped is not None:
                full = mapped
                short = mapped
        for candidate in (full.replace("/", "_"), short):
            if candidate in joint_names:
                return short, [candidate]
        letters = _letters(short)
        return short, [joint for joint in joint_names if _letters(joint) == letters]


def nearest(name: str, names: Iterable[str]) -> list[str]:
    """Return the most similar names, the nearest first."""
    return difflib.get_close_matches(name, names, n=MAX_SUGGESTIONS, cutoff=0.0)


def _letters(joint: str) -> str:
    """Return the letters that a joint name shares between the styles of C, ROS and Python."""
    return re.sub(r"[^a-z0-9]|joint", "", re.sub(r"^k(?=[A-Z])", "", joint).lower())
