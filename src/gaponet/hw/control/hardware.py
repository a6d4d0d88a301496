"""Limits of real robots: they come from the package's own robot, or from a folder that the user names.

A run or an identified folder may come from a stranger. On hardware it supplies identified values only. Its nominal
gains, joint ranges, effort limits, inertias and collision shapes must equal those of the reference robot.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError, UsageError
from gaponet.robot.collision import read_shapes
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import PACKAGE_FOLDER, RobotSpec, load_robot
from gaponet.sim.model import model_hash

ROBOT_OF_DRIVER = {"unitree": "h1_2", "so101": "so101"}
MAX_OFFSET_RAD = 0.1  # of an identified command offset; a larger one is a wrong zero, which calibration removes
KP_RATIO_BOUNDS = (0.25, 4.0)  # of identified kp to nominal kp
RELATIVE_TOLERANCE = 1e-6  # between values of two files
MAX_KP = 300.0  # N·m/rad of any joint; the H1-2's legs have 200
MAX_KD = 10.0  # N·m·s/rad
MAX_BEYOND_RANGE_RAD = 0.051  # of a command: a joint may start 0.05 rad outside its range, and is commanded there


def reference_robot(driver: str, limits_from: str | None) -> RobotSpec:
    """Return the robot whose limits hold for a driver: the package's own, or the folder that the user names.

    Raises:
        UsageError: The driver is an extension's, and no folder is named.
    """
    if limits_from is None and driver not in ROBOT_OF_DRIVER:
        raise UsageError(
            f"driver '{driver}' is an extension, whose robot this package does not have; give --limits-from FOLDER, a "
            "robot folder whose gains, joint ranges, effort limits and collision shapes you have read"
        )
    return load_robot(limits_from or PACKAGE_FOLDER / ROBOT_OF_DRIVER[driver]).before_identification


def hardware_robot(robot: RobotSpec, reference: RobotSpec) -> RobotSpec:
    """Return the reference robot with the identified values of another one.

    Args:
        robot: From a run or a robot folder, identified or not.
        reference: Supplies gains, ranges, effort limits and collision shapes.

    Raises:
        RobotError: A nominal value of `robot` differs from the reference, or an identified value is implausible.
    """
    if robot.folder.resolve() != reference.folder.resolve():
        _require_equal(robot.before_identification, reference)
    require_plausible(robot)
    if robot.nominal is None:
        return reference
    return replace(reference, **{name: getattr(robot, name) for name in SERVO_FIELDS}, nominal=reference)


def robot_hash(robot: RobotSpec) -> str:
    """Return 12 hex digits of all values that determine motion and limits: simulator, gains, ranges, shapes."""
    text = f"{model_hash(robot.before_identification)} {read_shapes(robot.folder)}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _require_equal(robot: RobotSpec, reference: RobotSpec) -> None:
    use = f"Use a folder made from {reference.folder}, or --limits-from FOLDER with a folder whose values you have read"
    if robot.joint_names != reference.joint_names:
        raise RobotError(f"{robot.folder}: its joints are not those of {reference.folder}. {use}")
    for name, unit in (("kp", "N·m/rad"), ("kd", "N·m·s/rad"), ("effort_limit", "N·m"), ("qpos_range", "rad")):
        theirs, ours = getattr(robot, name), getattr(reference, name)
        differ = ~np.isclose(theirs, ours, rtol=RELATIVE_TOLERANCE, atol=1e-9).reshape(len(ours), -1).all(axis=1)
        if differ.any():
            i = int(differ.argmax())
            raise RobotError(
                f"{robot.folder}: {name} of {reference.joint_names[i]} is {_text(theirs[i])} {unit}, the known robot "
                f"has {_text(ours[i])} ({reference.folder}). {use}"
            )
    if read_shapes(robot.folder) != read_shapes(reference.folder):
        raise RobotError(f"{robot.folder}: collision.toml differs from that of {reference.folder}. {use}")
    if model_hash(robot) != model_hash(reference):
        raise RobotError(f"{robot.folder}: inertias or geometry of robot.xml differ from {reference.folder}. {use}")


def _text(value: Array | float) -> str:
    return " to ".join(f"{x:g}" for x in np.atleast_1d(value))


def require_plausible(robot: RobotSpec) -> None:
    """Refuse identified values that would move commands of a real robot far from their targets.

    Raises:
        RobotError: With the folder, the joint and the bound.
    """
    nominal = robot.before_identification
    low, high = KP_RATIO_BOUNDS
    for i, joint in enumerate(robot.joint_names):
        if not abs(robot.offset[i]) <= MAX_OFFSET_RAD:
            raise RobotError(
                f"{robot.folder}: the identified offset of {joint} is {robot.offset[i]:g} rad; hardware takes at most "
                f"{MAX_OFFSET_RAD:g}. Calibrate the joint's zero and identify again"
            )
        if not low * nominal.kp[i] <= robot.kp[i] <= high * nominal.kp[i]:
            raise RobotError(
                f"{robot.folder}: the identified kp of {joint} is {robot.kp[i]:g} N·m/rad; hardware takes {low:g} to "
                f"{high:g} times the nominal {nominal.kp[i]:g}. Check the servo's gains and identify again"
            )


def require_motor_limits(robot: RobotSpec, packaged: str) -> None:
    """Refuse gains and effort limits beyond those of a packaged robot's motors.

    Args:
        robot: The robot of a driver.
        packaged: Name of the package's robot that has these motors.

    Raises:
        RobotError: With the folder, the joint and the bound.
    """
    nominal, motors = robot.before_identification, load_robot(PACKAGE_FOLDER / packaged)
    effort = motors.effort_limit[motors.index(robot.joint_names)] * (1 + RELATIVE_TOLERANCE)
    for name, most in (("kp", MAX_KP), ("kd", MAX_KD), ("effort_limit", effort)):
        values, bounds = getattr(nominal, name), np.broadcast_to(most, len(effort))
        beyond = ~(values <= bounds)  # NaN too
        if beyond.any():
            i = int(beyond.argmax())
            raise RobotError(
                f"{robot.folder}: {name} of {robot.joint_names[i]} is {values[i]:g}; the driver of {packaged} takes at "
                f"most {bounds[i]:g}"
            )


def range_violation(robot: RobotSpec, ctrl: Array, joints: Array) -> str:
    """Return why a position command (n) rad must not be written for `joints` (indices), or "" if it may.

    The range is the nominal one, widened by MAX_BEYOND_RANGE_RAD.
    """
    low, high = robot.before_identification.qpos_range.T
    wrong = ~((ctrl >= low - MAX_BEYOND_RANGE_RAD) & (ctrl <= high + MAX_BEYOND_RANGE_RAD))[joints]
    if not wrong.any():
        return ""
    i = int(joints[wrong.argmax()])
    return f"command {ctrl[i]:g} rad to {robot.joint_names[i]} is outside its range, {low[i]:.2f} to {high[i]:.2f} rad"
