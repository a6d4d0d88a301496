"""Limits of real robots: they come from the package's own robot, or from a folder that the user
names.

A run or an identified folder may come from a stranger. On hardware it supplies identified values
only. Its nominal gains, joint ranges, effort limits, inertias and collision shapes must equal those
of the reference robot.
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
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model, model_hash
from gaponet.sysid.axes import MAX_ARMATURE_TIME_S

ROBOT_OF_DRIVER = {"unitree": "h1_2", "so101": "so101"}
# of an identified command offset; a larger one is a wrong zero, which calibration removes
MAX_OFFSET_RAD = 0.1
KP_RATIO_BOUNDS = (0.25, 4.0)  # of identified kp to nominal kp
MAX_WEIGHT_SHARE = 0.5  # of the effort limit, that identified masses may weigh on a joint
POSTURES = 64  # in which identified masses are weighed
RELATIVE_TOLERANCE = 1e-6  # between values of two files
RANGE_TOLERANCE_RAD = 1e-6  # between joint ranges of two files
MAX_KP = 300.0  # N·m/rad of any joint; the H1-2's legs have 200
MAX_KD = 10.0  # N·m·s/rad
# of a command: a joint may start 0.05 rad outside its range, and is commanded there
MAX_BEYOND_RANGE_RAD = 0.051


def reference_robot(driver: str, limits_from: str | None) -> RobotSpec:
    """Return the robot whose limits hold for a driver: the package's own, or the folder that the
    user names.

    Raises:
        UsageError: The driver is an extension's, and no folder is named.
    """
    if limits_from is None and driver not in ROBOT_OF_DRIVER:
        raise UsageError(
            f"driver '{driver}' is an extension, whose robot this package does not have; give "
            "--limits-from FOLDER, a robot folder whose gains, joint ranges, effort limits and "
            "collision shapes you have read"
        )
    if limits_from is None:
        return load_robot(PACKAGE_FOLDER / ROBOT_OF_DRIVER[driver]).before_identification
    return replace(load_robot(limits_from).before_identification, limits_accepted=True)


def hardware_robot(robot: RobotSpec, reference: RobotSpec) -> RobotSpec:
    """Return the reference robot with the identified values of another one.

    Args:
        robot: From a run or a robot folder, identified or not.
        reference: Supplies gains, ranges, effort limits and collision shapes.

    Raises:
        RobotError: A nominal value of `robot` differs from the reference, or an identified value is
            implausible.
    """
    _require_equal(robot.before_identification, reference)
    require_plausible(robot)
    if not robot.is_identified:
        return reference
    effort = np.minimum(robot.servo.effort_limit, reference.servo.effort_limit)
    values = {name: robot.servo[name] for name in SERVO_FIELDS} | {"effort_limit": effort}
    return replace(reference.with_servo(**values), nominal=reference)


def robot_hash(robot: RobotSpec) -> str:
    """Return 12 hex digits of all values that determine motion and limits: simulator, gains,
    ranges, shapes.
    """
    text = f"{model_hash(robot.before_identification)} {read_shapes(robot.folder)}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _require_equal(robot: RobotSpec, reference: RobotSpec) -> None:
    use = _advice(reference)
    if robot.joint_names != reference.joint_names:
        raise RobotError(f"{robot.folder}: its joints are not those of {reference.folder}. {use}")
    for name, unit, theirs, ours in (
        ("kp", "N·m/rad", robot.servo.kp, reference.servo.kp),
        ("kd", "N·m·s/rad", robot.servo.kd, reference.servo.kd),
        ("effort_limit", "N·m", robot.servo.effort_limit, reference.servo.effort_limit),
        ("qpos_range", "rad", robot.qpos_range, reference.qpos_range),
    ):
        differ = ~np.isclose(theirs, ours, rtol=RELATIVE_TOLERANCE, atol=1e-9).reshape(
            len(ours), -1
        ).all(axis=1)
        if differ.any():
            i = int(differ.argmax())
            raise RobotError(
                f"{robot.folder}: {name} of {reference.joint_names[i]} is {_text(theirs[i])} "
                f"{unit}, the known robot has {_text(ours[i])} ({reference.folder}). {use}"
            )
    if robot.folder.resolve() == reference.folder.resolve():
        return  # the same files; only numbers in memory may differ
    if read_shapes(robot.folder) != read_shapes(reference.folder):
        raise RobotError(
            f"{robot.folder}: collision.toml differs from that of {reference.folder}. {use}"
        )
    if model_hash(robot) != model_hash(reference):
        raise RobotError(
            f"{robot.folder}: inertias or geometry of robot.xml differ from {reference.folder}. "
            f"{use}"
        )


def _text(value: Array | float) -> str:
    return " to ".join(f"{x:g}" for x in np.atleast_1d(value))


def require_plausible(robot: RobotSpec) -> None:
    """Refuse identified values that would move commands of a real robot far from their targets.

    Raises:
        RobotError: With the folder, the joint and the bounds.
    """
    nominal = robot.before_identification
    n = len(robot.joint_names)
    bounds = {
        "kp": np.outer(KP_RATIO_BOUNDS, nominal.servo.kp),
        "armature": np.outer((0, MAX_ARMATURE_TIME_S**2), robot.servo.kp),
    }
    bounds |= dict.fromkeys(
        ("offset", "zero"), np.outer((-MAX_OFFSET_RAD, MAX_OFFSET_RAD), np.ones(n))
    )
    for name, field in SERVO_FIELDS.items():
        if field.bounds and field.axis in ("value", "over kp") and name not in bounds:
            scale = robot.servo.kp if field.axis == "over kp" else np.ones(n)
            bounds[name] = np.outer(field.bounds[:2], scale)
    for name, (low, high) in bounds.items():
        values = robot.servo[name]
        field = SERVO_FIELDS[name]
        # NaN: the MJCF's; other fields have none
        beyond = ~((values >= low) & (values <= high) | np.isnan(values))
        if beyond.any():
            i = int(beyond.argmax())
            raise RobotError(
                f"{robot.folder}: the identified {name} of {robot.joint_names[i]} is "
                f"{values[i]:g} {field.unit}; hardware takes {low[i]:g} to {high[i]:g}. To do: "
                f"{field.advice}; then identify again"
            )
    if robot.links or robot.payload_mounts != nominal.payload_mounts:
        _require_light(robot, nominal)


def _require_light(robot: RobotSpec, nominal: RobotSpec) -> None:
    """Refuse identified masses whose weight changes a joint's torque by more than a share of its
    effort limit.
    """
    low, high = np.clip(nominal.qpos_range.T, -np.pi, np.pi)
    postures = np.random.default_rng(0).uniform(low, high, (POSTURES, len(robot.joint_names)))
    with_mass = static_torque(build_model(robot.with_table(None)), postures)
    without = static_torque(build_model(nominal.with_table(None)), postures)
    share = np.abs(with_mass - without).max(axis=0) / nominal.servo.effort_limit
    if not share.max() <= MAX_WEIGHT_SHARE:
        joint = robot.joint_names[int(share.argmax())]
        raise RobotError(
            f"{robot.folder}: identified masses change the torque of {joint} by {share.max():.2f} "
            f"of its effort limit; hardware takes {MAX_WEIGHT_SHARE:g}. Check kp's unit and the "
            "payload, or identify without --masses"
        )


def require_known_limits(robot: RobotSpec, packaged: str) -> None:
    """Refuse the robot of a driver whose gains, ranges or effort limits are beyond those of the
    known robot.

    The drivers of this package call it, so it holds for whoever makes one. The known robot is the
    package's. A robot of `reference_robot` whose folder the user named may have other gains and
    ranges, but nothing beyond its motors.

    Args:
        robot: The robot of a driver.
        packaged: Name of the package's robot that has these motors.

    Raises:
        RobotError: With the folder, the joint and the bound.
    """
    _require_motor_limits(robot, packaged)
    nominal = robot.before_identification
    if nominal.limits_accepted:
        return
    known = load_robot(PACKAGE_FOLDER / packaged)
    columns = known.index(nominal.joint_names)
    _require_within(nominal, "kp", "N·m/rad", known.servo.kp[columns], known)
    _require_within(nominal, "kd", "N·m·s/rad", known.servo.kd[columns], known)
    low, high = known.qpos_range[columns].T
    lowest, highest = nominal.qpos_range.T
    wider = ~((lowest >= low - RANGE_TOLERANCE_RAD) & (highest <= high + RANGE_TOLERANCE_RAD))
    if wider.any():
        joint = int(wider.argmax())
        raise RobotError(
            f"{robot.folder}: the range of {nominal.joint_names[joint]} is "
            f"{_text(nominal.qpos_range[joint])} rad, the known robot has {low[joint]:g} to "
            f"{high[joint]:g} ({known.folder}). {_advice(known)}"
        )


def accepted_folder(robot: RobotSpec) -> str | None:
    """Return the folder whose limits the user accepted for this robot, or None.

    The path is as another process finds it.
    """
    nominal = robot.before_identification
    return str(nominal.folder.resolve()) if nominal.limits_accepted else None


def _require_within(
    robot: RobotSpec, name: str, unit: str, bounds: Array, known: RobotSpec
) -> None:
    """Refuse gains above the known robot's, (n,); NaN too."""
    values = robot.servo[name]
    beyond = ~(values <= bounds * (1 + RELATIVE_TOLERANCE))
    if beyond.any():
        joint = int(beyond.argmax())
        raise RobotError(
            f"{robot.folder}: {name} of {robot.joint_names[joint]} is {values[joint]:g} {unit}, "
            f"the known robot has {bounds[joint]:g} ({known.folder}). {_advice(known)}"
        )


def _advice(reference: RobotSpec) -> str:
    return (
        f"Use a folder made from {reference.folder}, or --limits-from FOLDER (Python: "
        "limits_from) with a folder whose values you have read"
    )


def _require_motor_limits(robot: RobotSpec, packaged: str) -> None:
    """Refuse gains and effort limits beyond those of a packaged robot's motors."""
    nominal = robot.before_identification
    motors = load_robot(PACKAGE_FOLDER / packaged)
    effort = motors.servo.effort_limit[motors.index(robot.joint_names)] * (1 + RELATIVE_TOLERANCE)
    for name, most in (("kp", MAX_KP), ("kd", MAX_KD), ("effort_limit", effort)):
        values = nominal.servo[name]
        bounds = np.broadcast_to(most, len(effort))
        beyond = ~(values <= bounds)  # NaN too
        if beyond.any():
            i = int(beyond.argmax())
            raise RobotError(
                f"{robot.folder}: {name} of {robot.joint_names[i]} is {values[i]:g}; the driver "
                f"of {packaged} takes at most {bounds[i]:g}"
            )


def range_violation(robot: RobotSpec, ctrl: Array, joints: Array) -> str:
    """Return why a position command (n) rad must not be written for `joints` (indices), or "" if
    it may.

    The range is the nominal one, widened by MAX_BEYOND_RANGE_RAD.
    """
    low, high = robot.before_identification.qpos_range.T
    wrong = ~((ctrl >= low - MAX_BEYOND_RANGE_RAD) & (ctrl <= high + MAX_BEYOND_RANGE_RAD))[joints]
    if not wrong.any():
        return ""
    i = int(joints[wrong.argmax()])
    return (
        f"command {ctrl[i]:g} rad to {robot.joint_names[i]} is outside its range, {low[i]:.2f} to "
        f"{high[i]:.2f} rad"
    )
