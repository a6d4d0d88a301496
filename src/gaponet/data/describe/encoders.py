"""Encoders of an arm as LeRobot calibrates them: a JSON file that turns ticks and percent into
angles.

    {"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1365, "range_min": 746,
    "range_max": 3477}, …}

An angle is (reading − middle of the range) · 2π / 4095, as LeRobot's degrees are. homing_offset
lies in the servo, whose readings have it already. Percent are −100..100 of the range, of a gripper
0..100.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NotRequired

import numpy as np
from annotated_types import Interval
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import JointMismatchError, UsageError
from gaponet.base.structure import read_json
from gaponet.robot.spec import RobotSpec

MAX_TICKS = 1 << 16
Ticks = Annotated[int, Interval(ge=-MAX_TICKS, le=MAX_TICKS)]


class _Motor(TypedDict):
    range_min: Ticks
    range_max: Ticks
    drive_mode: NotRequired[Annotated[int, Interval(ge=0, le=1)]]


@dataclass(frozen=True)
class Encoder:
    """One motor of a calibration file.

    Attributes:
        low, high: Readings at the ends of its range, ticks.
        inverted: True if percent count the other way round (drive_mode).
        per_turn: Steps a turn, less one, as LeRobot counts them.
    """

    low: int
    high: int
    inverted: bool = False
    per_turn: int = 4095

    def angles(self, values: Array, unit: str, speed: bool = False) -> Array:
        """Return angles, rad (or rad/s): zero is the middle of the range.

        Args:
            values: Readings, (k,), in ticks or signed_percent.
            speed: Values are per second, so that no zero is taken off.
        """
        per_tick = 2 * np.pi / self.per_turn
        if unit == "signed_percent":
            sign = -1.0 if self.inverted else 1.0
            return sign * values * (self.high - self.low) / 200 * per_tick
        if speed:
            return values * per_tick
        middle = (self.low + self.high) / 2
        return (values - middle) * per_tick

    def fractions(self, values: Array, speed: bool = False) -> Array:
        """Return ticks (k,) as shares of the range, 0..1."""
        span = self.high - self.low
        if speed:
            return (-values if self.inverted else values) / span
        shares = (values - self.low) / span
        return 1 - shares if self.inverted else shares


def read_encoders(
    file: Path, robot: RobotSpec, joint_map: dict[str, str] | None
) -> dict[str, Encoder]:
    """Return the robot's joint → its encoder; motors that are no joints of the robot are left out.

    Raises:
        UsageError: The file is missing, or is no calibration of LeRobot.
    """
    hint = (
        "give the calibration file of the follower arm "
        "(~/.cache/huggingface/lerobot/calibration/robots/…)"
    )
    motors = read_json(dict[str, _Motor], file, UsageError, hint, allow_extra=True)
    encoders = {}
    for name, motor in motors.items():
        if motor["range_min"] >= motor["range_max"]:
            raise UsageError(f"{file}: {name} has range_min ≥ range_max; calibrate the arm again")
        try:
            joint = robot.resolve(name, str(file), joint_map)
        except JointMismatchError:
            continue
        inverted = bool(motor.get("drive_mode", 0))
        encoders[joint] = Encoder(motor["range_min"], motor["range_max"], inverted)
    if not encoders:
        raise UsageError(
            f"{file}: none of its motors ({', '.join(motors)}) is a joint of {robot.name}"
        )
    return encoders
