"""What the parts of a controller share."""

from __future__ import annotations

from dataclasses import dataclass

from gaponet.arrays import Array
from gaponet.robot import RobotSpec
from gaponet_robots.control.clock import Clock
from gaponet_robots.control.driver import Driver
from gaponet_robots.control.phases import ControlConfig
from gaponet_robots.control.plan import Compensates, Planner
from gaponet_robots.control.safety import SafetyConfig


@dataclass(frozen=True)
class Context:
    """Robot, settings and clock of one controller; indices of the commanded joints; control period, s."""

    driver: Driver
    robot: RobotSpec
    config: ControlConfig
    safety: SafetyConfig
    compensator: Compensates | None
    clock: Clock
    planner: Planner | None
    payload_mass: float | None
    joints: Array
    dt: float
