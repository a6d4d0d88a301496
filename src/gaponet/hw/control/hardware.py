"""Limits of real robots: they come from the package's own robot, or from a folder that the user names.

A run or an identified folder may come from a stranger. On hardware it supplies identified values only. Its nominal
gains, joint ranges, effort limits, inertias and collision shapes must equal those of the known robot.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.robot.collision import read_shapes
from gaponet.robot.spec import PACKAGE_FOLDER, SERVO_FIELDS, RobotSpec, load_robot
from gaponet.sim.model import model_hash

ROBOT_OF_DRIVER = {"unitree": "h1_2", "so101": "so101"}
MAX_OFFSET_RAD = 0.1  # an identified command offset beyond this is a wrong zero, which calibration must remove
KP_RATIO_BOUNDS = (0.25, 4.0)  # identified kp over nominal kp
RELATIVE_TOLERANCE = 1e-6  # between values of two files
MAX_KP = 300.0  # N·m/rad that a driver sends to any joint; the H1-2's legs have 200
MAX_KD = 10.0  # N·m·s/rad
BEYOND_RANGE_RAD = 0.051  # a joint may be found 0.05 rad outside its range, and its first command is where it is


def known_robot(driver: str, limits_from: str | None) -> RobotSpec:
    """The robot whose limits hold for a driver: the package's own, or the folder that the user names."""
    robot = load_robot(limits_from or PACKAGE_FOLDER / ROBOT_OF_DRIVER[driver])
    return robot.before_identification


def for_hardware(robot: RobotSpec, known: RobotSpec) -> RobotSpec:
    """The known robot with the identified values of another folder.

    Args:
        robot: From a run or a robot folder, identified or not.
        known: Supplies gains, ranges, effort limits and collision shapes.

    Raises:
        RobotError: A nominal value of `robot` differs from the known robot's, or an identified value is implausible.
    """
    if robot.folder.resolve() != known.folder.resolve():
        _require_equal(robot.before_identification, known)
    require_plausible(robot)
    if robot.nominal is None:
        return known
    return replace(known, **{name: getattr(robot, name) for name in SERVO_FIELDS}, nominal=known)


def robot_hash(robot: RobotSpec) -> str:
    """12 hex digits of all that decides over motion and limits: simulator, gains, ranges, collision shapes."""
    text = f"{model_hash(robot.before_identification)} {read_shapes(robot.folder)}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _require_equal(robot: RobotSpec, known: RobotSpec) -> None:
    use = f"Use a folder made from {known.folder}, or --limits-from FOLDER with a folder whose values you have read"
    if robot.joint_names != known.joint_names:
        raise RobotError(f"{robot.folder}: its joints are not those of {known.folder}. {use}")
    for name, unit in (("kp", "N·m/rad"), ("kd", "N·m·s/rad"), ("effort_limit", "N·m"), ("qpos_range", "rad")):
        theirs, ours = getattr(robot, name), getattr(known, name)
        differ = ~np.isclose(theirs, ours, rtol=RELATIVE_TOLERANCE, atol=1e-9).reshape(len(ours), -1).all(axis=1)
        if differ.any():
            i = int(differ.argmax())
            raise RobotError(
                f"{robot.folder}: {name} of {known.joint_names[i]} is {_text(theirs[i])} {unit}, the known robot has "
                f"{_text(ours[i])} ({known.folder}). {use}"
            )
    if read_shapes(robot.folder) != read_shapes(known.folder):
        raise RobotError(f"{robot.folder}: collision.toml differs from that of {known.folder}. {use}")
    if model_hash(robot) != model_hash(known):
        raise RobotError(f"{robot.folder}: inertias or geometry of robot.xml differ from {known.folder}. {use}")


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
    """Refuse gains and effort limits beyond what the motors of a packaged robot may get.

    Args:
        robot: The robot that a driver was given.
        packaged: Name of the package's robot whose motors these are.

    Raises:
        RobotError: With the folder, the joint and the bound.
    """
    nominal, motors = robot.before_identification, load_robot(PACKAGE_FOLDER / packaged)
    effort = motors.effort_limit[motors.index(robot.joint_names)]
    for name, values, most in (
        ("kp", nominal.kp, np.full(len(effort), MAX_KP)),
        ("kd", nominal.kd, np.full(len(effort), MAX_KD)),
        ("effort_limit", nominal.effort_limit, effort * (1 + RELATIVE_TOLERANCE)),
    ):
        if not (values <= most).all():
            i = int(np.argmax(~(values <= most)))
            raise RobotError(
                f"{robot.folder}: {name} of {robot.joint_names[i]} is {values[i]:g}; the driver of {packaged} takes at "
                f"most {most[i]:g}"
            )


def outside_range(robot: RobotSpec, ctrl: Array, joints: Array) -> str:
    """Return why a position command (n) rad must not be written for `joints` (indices), or "" if it may.

    The range is the nominal one, widened by BEYOND_RANGE_RAD.
    """
    low, high = robot.before_identification.qpos_range.T
    wrong = ~((ctrl >= low - BEYOND_RANGE_RAD) & (ctrl <= high + BEYOND_RANGE_RAD))[joints]
    if not wrong.any():
        return ""
    i = int(joints[wrong.argmax()])
    return f"command {ctrl[i]:g} rad to {robot.joint_names[i]} is outside its range, {low[i]:.2f} to {high[i]:.2f} rad"
