"""Faults: what each one puts in doubt, what may still be used afterwards, and how the robot ends.

After a fault no joint is sent to a position, neither to a target nor to a measured one: a wrong reading would move the
joint. The robot damps. Damping needs no position. A measured speed may only lower a damping gain, and only as far as
safety.damping_gains allows. docs/deploy-safety.md has the same table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Ending(StrEnum):
    """What stops the robot after a fault. An SO-101 has no brake: it is lowered, or let go at once."""

    DAMP_OR_LOWER = "damp; lower an SO-101"
    DAMP_OR_LET_GO = "damp; let an SO-101 go at once"
    NOTHING = "none: nothing was commanded"


@dataclass(frozen=True)
class FaultRule:
    """What follows from one kind of fault."""

    doubted: str
    """What may be wrong."""
    usable: str
    """What may still be used to stop the robot."""
    ending: Ending
    """What is done."""
    is_data: bool = True
    """The recording until the fault can be trusted; False where a joint did not go where it was sent."""


LAST_COMMAND = "the last command, without stiffness; damping; torque limits"
NO_GOAL = "the last command, without stiffness; damping; torque off"

FAULTS: dict[str, FaultRule] = {
    "stale": FaultRule("all readings: they are old", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "checksum": FaultRule(
        "all readings: the bus damages messages", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "overrun": FaultRule(
        "the age of readings: this computer was late", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "suspend": FaultRule(
        "all readings from before the suspend", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "driver": FaultRule(
        "the bus, in both directions",
        "what needs no answer, sent until the bus takes it",
        Ending.DAMP_OR_LOWER,
    ),
    "target": FaultRule("the motion or the model", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "silence": FaultRule("the sender of targets", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "error": FaultRule("the policy, the model or this program", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "stop": FaultRule("nothing: somebody asked for it", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "obedience": FaultRule(
        "positions, and whether the robot holds its commands and settings",
        LAST_COMMAND,
        Ending.DAMP_OR_LOWER,
        is_data=False,
    ),
    "source": FaultRule(
        "which robot the states are from, or whose goals the servos hold",
        NO_GOAL,
        Ending.DAMP_OR_LET_GO,
        is_data=False,
    ),
    "frozen": FaultRule(
        "position and speed of a joint, or of all", NO_GOAL, Ending.DAMP_OR_LET_GO, is_data=False
    ),
    "nan": FaultRule("all readings of a joint", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "jump": FaultRule(
        "position and speed of a joint", NO_GOAL, Ending.DAMP_OR_LET_GO, is_data=False
    ),
    "temperature": FaultRule("a motor or its sensor", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "tracking": FaultRule(
        "the position of a joint, or that its way is free",
        NO_GOAL,
        Ending.DAMP_OR_LET_GO,
        is_data=False,
    ),
    "torque": FaultRule(
        "position and speed of a joint, or that its way is free", NO_GOAL, Ending.DAMP_OR_LET_GO
    ),
    "robot": FaultRule("a motor, its readings and its goal", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "tilt": FaultRule("the stand of the robot, or its IMU", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "plan": FaultRule("the way to the first target", "all readings", Ending.NOTHING),
}
FAULT_KINDS = tuple(FAULTS)


def lowers(kind: str) -> bool:
    """Return True if a robot without brakes is lowered; False if its torque goes off at once.

    The end of a run without fault has no rule, and lowers nothing.
    """
    return kind in FAULTS and FAULTS[kind].ending is Ending.DAMP_OR_LOWER


def spoils_data(kind: str) -> bool:
    """Return True if a recording with this fault is no data."""
    return kind in FAULTS and not FAULTS[kind].is_data
