"""Drivers by kind; a driver's module is imported when one of its kind is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gaponet import plugins
from gaponet.hw.control.driver import Driver
from gaponet.robot.spec import RobotSpec, load_robot

DRIVERS = {"so101": "gaponet.hw.drivers.so101:SO101Driver", "unitree": "gaponet.hw.drivers.unitree:UnitreeDriver"}


def open_driver(kind: str, robot: RobotSpec | str | Path, **options: Any) -> Driver:
    """A driver, not yet connected.

    Args:
        kind: unitree, so101 or that of an extension; virtual ones live in the caller's process and are made there
            (testing.virtual_driver).
        options: Options of the driver's class.
    """
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    driver: Driver = plugins.require(plugins.DRIVERS, kind, DRIVERS, "driver")(spec, **options)
    return driver
