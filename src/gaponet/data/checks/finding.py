"""Finding: one line of the doctor's report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gaponet.arrays import Array
from gaponet.robot import RobotSpec

# ok; note, a fact to know; warning, usable but look first; error, do not train on it before it is mended.
LEVELS = ("ok", "note", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """`message` is for people and says what to do; `values` are the numbers in it."""

    level: str
    check: str
    message: str
    joints: tuple[str, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)


def some(motions: list[str]) -> str:
    """Up to three names, each once, and how many more."""
    motions = list(dict.fromkeys(motions))
    return ", ".join(motions[:3]) + (f" and {len(motions) - 3} more" if len(motions) > 3 else "")


def names(robot: RobotSpec, mask: Array) -> tuple[str, ...]:
    """Joint names where mask (n) is true."""
    return tuple(name for name, yes in zip(robot.joint_names, mask, strict=True) if yes)
