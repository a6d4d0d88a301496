"""Servos that limit the speed of their targets: the whole fit once more, with such limits."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Comparison
from gaponet.sysid.acceptance import Identified, held_out_errors
from gaponet.sysid.motion_limits import target_speeds

SpeedLimits = dict[str, dict[str, float]]  # joint → target_speed, rad/s


def seen_speed_limits(sequences: ListOf[Sequence], robot: RobotSpec) -> SpeedLimits:
    """Return the speed limits that recordings show; none of a robot that has some, since these are
    taken as true.
    """
    if robot.servo.target_speed.any():
        return {}
    limits: SpeedLimits = {}
    for joint, speed in zip(robot.operated, target_speeds(sequences, robot), strict=True):
        if speed > 0:
            limits[joint] = {"target_speed": float(f"{speed:.3g}")}
    return limits


def better_of(
    plain: Identified,
    limited: Identified,
    limits: SpeedLimits,
) -> Identified:
    """Return the fit with speed limits if motions that were not fitted accept it, else the one
    without.
    """
    errors_without = held_out_errors(plain.held_out)
    errors_with = held_out_errors(limited.held_out)
    comparison = Comparison("ramp", errors_without, errors_with)
    if not comparison.accepted:
        return replace(plain, comparisons=(*plain.comparisons, comparison))
    return replace(
        limited,
        before=plain.before,
        chosen=limited.chosen if limited.improved else "ramp",
        comparisons=(*limited.comparisons, comparison),
        warnings=(_warning(limits), *limited.warnings),
    )


def _warning(limits: SpeedLimits) -> str:
    """Return what to do about servos with speed limits."""
    speeds = [f"{joint} {servo['target_speed']:.3g}" for joint, servo in limits.items()]
    return (
        f"servos limit the speed of their targets, rad/s: {', '.join(speeds)}. That is a setting "
        "of theirs (profile velocity, goal speed). The simulator has it, so record and run with "
        "the same one; engines that load an export do not"
    )
