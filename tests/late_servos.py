"""Servos that are late and have a law of friction, which an engine needs gaponet's files for."""

from __future__ import annotations

from gaponet.robot.spec import RobotSpec

FRICTION_LAW = {
    "stribeck": 0.03,
    "stribeck_speed": 0.05,
    "friction_motor": 0.08,
    "friction_external": 0.15,
}


def with_late_servos(robot: RobotSpec) -> RobotSpec:
    """The robot with servos that are late by 6, 12, … ms, zeros that are off by 10, 20, … mrad, and
    the law of friction.
    """
    found = {}
    for i, joint in enumerate(robot.operated, 1):
        found[joint] = {"delay": 0.006 * i, "offset": 0.01 * i} | FRICTION_LAW
    return robot.with_identified(found)
