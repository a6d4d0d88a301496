"""Drivers by kind; a driver's module is imported when one of its kind is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gaponet.errors import UsageError
from gaponet.robot import RobotSpec, load_robot
from gaponet_robots.control.driver import Driver

KINDS = ("virtual", "unitree", "so101")


def open_driver(kind: str, robot: RobotSpec | str | Path, **options: Any) -> Driver:
    """A driver, not yet connected.

    Args:
        kind: unitree or so101; virtual ones live in the caller's process and are made there (drivers.virtual).
        options: Options of the driver's class.
    """
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    if kind == "unitree":
        from gaponet_robots.drivers.unitree import UnitreeDriver

        return UnitreeDriver(spec, **options)
    if kind == "so101":
        from gaponet_robots.drivers.so101 import SO101Driver

        return SO101Driver(spec, **options)
    raise UsageError(f"no driver '{kind}'; there are {', '.join(KINDS)}")
