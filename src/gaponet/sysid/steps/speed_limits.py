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
    speeds = dict(zip(robot.operated, target_speeds(sequences, robot), strict=True))
    return {joint: {"target_speed": float(f"{v:.3g}")} for joint, v in speeds.items() if v}


def better_of(plain: Identified, limited: Identified, limits: SpeedLimits) -> Identified:
    """Return the fit with speed limits if motions that were not fitted accept it, else the one
    without.
    """
    comparison = Comparison(
        "ramp", held_out_errors(plain.held_out), held_out_errors(limited.held_out)
    )
    if not comparison.accepted:
        return replace(plain, comparisons=(*plain.comparisons, comparison))
    listed = ", ".join(f"{joint} {v['target_speed']:.3g}" for joint, v in limits.items())
    warning = (
        f"servos limit the speed of their targets, rad/s: {listed}. That is a setting of theirs "
        "(profile velocity, goal speed). The simulator has it, so record and run with the same "
        "one; engines that load an export do not"
    )
    return replace(
        limited,
        before=plain.before,
        chosen=limited.chosen if limited.improved else "ramp",
        comparisons=(*limited.comparisons, comparison),
        warnings=(warning, *limited.warnings),
    )
