"""LeRobot's calibration of an SO-101, from its JSON file or from the servos themselves."""

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

STEPS_PER_TURN = 4096  # of an encoder
STEP_RAD = 2 * np.pi / STEPS_PER_TURN
# Joints of servo 1 to 6.
JOINTS = (
    "shoulder_pan",
    "shoulder_lift",
    "elbow_flex",
    "wrist_flex",
    "wrist_roll",
    "gripper",
)
CONTINUOUS_JOINT = "wrist_roll"  # it has no stops
GRIPPER = "gripper"  # its zero is at a stop
USUAL_FILE = "~/.cache/huggingface/lerobot/calibration/robots/so_follower/ID.json"

Position = Annotated[int, at.Interval(ge=0, le=STEPS_PER_TURN - 1)]


@dataclass(frozen=True)
class ServoRow:
    """Calibration of one joint: row of the file.

    All but id and drive_mode are also registers of the servo.
    """

    id: Annotated[int, at.Interval(ge=1, le=253)]
    drive_mode: Annotated[int, at.Interval(ge=0, le=1)]
    homing_offset: Annotated[int, at.Interval(ge=-2047, le=2047)]
    range_min: Position
    range_max: Position


class ArmCalibration:
    """Converts encoder steps to rad and back, for every joint in the robot's order.

    0 rad is the middle of a joint's calibrated range, as in LeRobot. For the gripper it is the zero
    of the MJCF, whose lower limit is the end of the calibrated range at which the jaw is closed.

    Attributes:
        rows: Calibration of each joint, by its name.
        servos: Their ids.
        low, high: Ends of the calibrated range, steps.
        sign: 1 or −1: direction of the joint.
        zero: Step at 0 rad.
    """

    def __init__(self, rows: dict[str, ServoRow], robot: RobotSpec) -> None:
        """Take the order of the joints and the gripper's lower limit from the robot."""
        ordered = [rows[joint] for joint in robot.joint_names]
        self.rows = rows
        self.servos = [row.id for row in ordered]
        self.low = np.array([row.range_min for row in ordered])
        self.high = np.array([row.range_max for row in ordered])
        self.sign = np.array([-1.0 if row.drive_mode else 1.0 for row in ordered])
        self.zero = (self.low + self.high) / 2
        jaw = robot.index([GRIPPER])[0]
        closed = self.low[jaw] if self.sign[jaw] > 0 else self.high[jaw]
        self.zero[jaw] = closed - self.sign[jaw] * robot.qpos_range[jaw, 0] / STEP_RAD

    @property
    def qpos_range(self) -> Array:
        """Calibrated range, (n, 2) rad."""
        return np.sort(np.stack([self.qpos(self.low), self.qpos(self.high)], axis=1), axis=1)

    def qpos(self, steps: Array) -> Array:
        """Return rad (n) of steps (n)."""
        result: Array = (steps - self.zero) * STEP_RAD * self.sign
        return result

    def steps(self, qpos: Array) -> Array:
        """Return the nearest whole steps (n) within the calibrated range, of rad (n)."""
        nearest = np.rint(qpos / (STEP_RAD * self.sign) + self.zero)
        result: Array = np.clip(nearest, self.low, self.high).astype(int)
        return result


def read_calibration(path: str | Path, robot: RobotSpec) -> ArmCalibration:
    """Return the calibration of a file that lerobot-calibrate wrote.

    Raises:
        UsageError: The file is no calibration, or lacks a joint.
    """
    hint = f"give the file that lerobot-calibrate wrote for this arm ({USUAL_FILE})"
    rows = read_json(dict[str, ServoRow], Path(path), UsageError, hint)
    for joint in JOINTS:
        if joint not in rows:
            raise UsageError(
                f"{path}: no joint '{joint}', only {', '.join(rows) or 'none'}; {hint}"
            )
        if rows[joint].range_min >= rows[joint].range_max:
            raise UsageError(f"{path}: {joint}: range_min is not below range_max; calibrate again")
    if len({rows[joint].id for joint in JOINTS}) < len(JOINTS):
        raise UsageError(f"{path}: two joints have the same id; {hint}")
    return ArmCalibration({joint: rows[joint] for joint in JOINTS}, robot)


def uncalibrated(robot: RobotSpec) -> ArmCalibration:
    """Return a calibration with the whole range of each encoder, for servos with the ids 1 to 6."""
    rows = {}
    for servo, joint in enumerate(JOINTS, 1):
        rows[joint] = ServoRow(
            id=servo, drive_mode=0, homing_offset=0, range_min=0, range_max=STEPS_PER_TURN - 1
        )
    return ArmCalibration(rows, robot)


def resolve_calibration(
    file: ArmCalibration | None, stored: dict[str, ServoRow], robot: RobotSpec, port: str
) -> ArmCalibration:
    """Return the calibration of the file if the servos store the same, by joint, or the servos'
    own without a file.

    Raises:
        DriverError: The two differ, or neither has the ends of the joints.
    """
    if file is None:
        blank = []
        for joint in JOINTS:
            row = stored[joint]
            is_whole_turn = row.range_max - row.range_min >= STEPS_PER_TURN - 1
            if is_whole_turn and joint != CONTINUOUS_JOINT:
                blank.append(joint)
        if blank:
            raise DriverError(
                f"{port}: the servos hold no calibration (no limits in {', '.join(blank)}); run "
                "lerobot-calibrate, which writes it into them, and say --calibration FILE "
                f"({USUAL_FILE})"
            )
        return ArmCalibration(stored, robot)
    for joint in JOINTS:
        for field in ("homing_offset", "range_min", "range_max"):
            in_file = getattr(file.rows[joint], field)
            in_servo = getattr(stored[joint], field)
            if in_file != in_servo:
                raise DriverError(
                    f"{port}: {field} of {joint} is {in_file} in the calibration file and "
                    f"{in_servo} in servo {file.rows[joint].id}: the file of another arm, or an "
                    "older one. Calibrate again, or let LeRobot write the file into the servos"
                )
    return file
