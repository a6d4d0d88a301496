"""What a LeRobot calibration says of an SO-101: in a JSON file, and in the servos themselves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import annotated_types as at
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.structure import read_json
from gaponet.hw.control.driver import DriverError
from gaponet.robot.spec import RobotSpec

STEPS = 4096  # of an encoder, a turn
STEP = 2 * np.pi / STEPS  # rad
SPEAK = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")  # servo 1 to 6
TURNS, GRIPPER = "wrist_roll", "gripper"  # has no stops; has its zero at one
WHERE = "~/.cache/huggingface/lerobot/calibration/robots/so_follower/ID.json"

Position = Annotated[int, at.Interval(ge=0, le=STEPS - 1)]


@dataclass(frozen=True)
class ServoRow:
    """One joint's row of the file; the register of that name holds the same, drive_mode and id aside."""

    id: Annotated[int, at.Interval(ge=1, le=253)]
    drive_mode: Annotated[int, at.Interval(ge=0, le=1)]
    homing_offset: Annotated[int, at.Interval(ge=-2047, le=2047)]
    range_min: Position
    range_max: Position


class ArmCalibration:
    """Encoder steps ↔ rad of every joint, in the robot's order.

    0 rad is the middle of a joint's calibrated range, as in LeRobot. The gripper's is where it is in the MJCF: its
    lower limit is the end of the range at which the jaw is closed.
    """

    def __init__(self, rows: dict[str, ServoRow], robot: RobotSpec) -> None:
        """
        Args:
            robot: Order of the joints, and the gripper's lower limit.
        """
        ordered = [rows[joint] for joint in robot.joint_names]
        self.rows, self.servos = rows, [row.id for row in ordered]
        self.low, self.high = (np.array([getattr(row, end) for row in ordered]) for end in ("range_min", "range_max"))
        self.sign = np.array([-1.0 if row.drive_mode else 1.0 for row in ordered])
        self.zero = (self.low + self.high) / 2  # step at 0 rad
        jaw = robot.index([GRIPPER])[0]
        closed = self.low[jaw] if self.sign[jaw] > 0 else self.high[jaw]
        self.zero[jaw] = closed - self.sign[jaw] * robot.qpos_range[jaw, 0] / STEP

    @property
    def qpos_range(self) -> Array:
        """Where the calibrated range ends, (n, 2) rad."""
        return np.sort(np.stack([self.qpos(self.low), self.qpos(self.high)], axis=1), axis=1)

    def qpos(self, steps: Array) -> Array:
        """Steps (n) → rad (n)."""
        return (steps - self.zero) * STEP * self.sign

    def steps(self, qpos: Array) -> Array:
        """Rad (n) → the nearest whole steps (n) within the calibrated range."""
        return np.clip(np.rint(qpos / (STEP * self.sign) + self.zero), self.low, self.high).astype(int)


def read_calibration(path: str | Path, robot: RobotSpec) -> ArmCalibration:
    """The calibration of a file that lerobot-calibrate wrote.

    Raises:
        UsageError: The file is not one, or lacks a joint.
    """
    hint = f"give the file that lerobot-calibrate wrote for this arm ({WHERE})"
    rows = read_json(dict[str, ServoRow], Path(path), UsageError, hint)
    for joint in SPEAK:
        if joint not in rows:
            raise UsageError(f"{path}: no joint '{joint}', only {', '.join(rows) or 'none'}; {hint}")
        if rows[joint].range_min >= rows[joint].range_max:
            raise UsageError(f"{path}: {joint}: range_min is not below range_max; calibrate again")
    if len({rows[joint].id for joint in SPEAK}) < len(SPEAK):
        raise UsageError(f"{path}: two joints have the same id; {hint}")
    return ArmCalibration({joint: rows[joint] for joint in SPEAK}, robot)


def numbered(robot: RobotSpec) -> ArmCalibration:
    """Calibration of an arm of which only the servos' numbers are known, 1 to 6."""
    whole = {joint: ServoRow(id=i + 1, drive_mode=0, homing_offset=0, range_min=0, range_max=STEPS - 1)
             for i, joint in enumerate(SPEAK)}  # fmt: skip
    return ArmCalibration(whole, robot)


def settle(given: ArmCalibration | None, held: dict[str, ServoRow], robot: RobotSpec, port: str) -> ArmCalibration:
    """The calibration that holds: the file's if the servos hold the same, or the servos' own without a file.

    Raises:
        DriverError: The two differ, or neither says where the joints end.
    """
    if given is None:
        blank = [j for j in SPEAK if j != TURNS and held[j].range_max - held[j].range_min >= STEPS - 1]
        if blank:
            raise DriverError(
                f"{port}: the servos hold no calibration (no limits in {', '.join(blank)}); run lerobot-calibrate, "
                f"which writes it into them, and say --calibration FILE ({WHERE})"
            )
        return ArmCalibration(held, robot)
    for joint in SPEAK:
        for field in ("homing_offset", "range_min", "range_max"):
            said, found = getattr(given.rows[joint], field), getattr(held[joint], field)
            if said != found:
                raise DriverError(
                    f"{port}: {field} of {joint} is {said} in the calibration file and {found} in servo "
                    f"{given.rows[joint].id}: the file of another arm, or an older one. Calibrate again, or let "
                    "LeRobot write the file into the servos"
                )
    return given
