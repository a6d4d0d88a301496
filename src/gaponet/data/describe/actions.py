"""What the names of an action say: targets of joints, poses of the hand, steps, or speeds."""

from __future__ import annotations

import re
from collections.abc import Sequence

DELTA_WORDS = {
    "delta",
    "deltas",
    "rel",
    "relative",
    "diff",
    "dx",
    "dy",
    "dz",
    "droll",
    "dpitch",
    "dyaw",
}
HAND_WORDS = {"ee", "eef", "tcp", "cartesian", "effector", "pose"}
AXES = {
    "x",
    "y",
    "z",
    "wx",
    "wy",
    "wz",
    "rx",
    "ry",
    "rz",
    "qx",
    "qy",
    "qz",
    "qw",
    "roll",
    "pitch",
    "yaw",
}
SPEED_WORDS = {"vel", "velocity", "speed", "twist"}
NO_TARGETS = (
    "gaponet needs the joint positions that the servos were sent. If another feature or column "
    "holds them, say "
    'ctrl = "ITS NAME" in logs.toml; else record them'
)


def what_it_holds(names: Sequence[str]) -> str | None:
    """Return what an action holds by the names of its values; None if they may be joints.

    Args:
        names: Those that are no joints of the robot.
    """
    words = [words_of(name) for name in names]
    every = set().union(*words)
    if every & DELTA_WORDS:
        return "steps from the present position (deltas)"
    if every & HAND_WORDS or len(every & AXES) >= 3:
        return "poses of the end effector"
    if words and all(of_name & SPEED_WORDS for of_name in words):
        return "speeds"
    return None


def words_of(name: str) -> set[str]:
    """Return the words of a name: obs/robot0_eef_pos → obs, robot, eef, pos."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    return set(re.split(r"[^a-z]+", apart)) - {""}
