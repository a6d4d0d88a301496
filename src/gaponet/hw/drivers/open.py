"""Drivers by name: those of this package and of extensions (entry points `gaponet.drivers`),
imported when opened.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaponet.base import plugins
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import Driver
from gaponet.hw.control.hardware import hardware_robot, reference_robot
from gaponet.robot.spec import RobotSpec, load_robot

DRIVERS = {
    "unitree": "gaponet.hw.drivers.unitree:UnitreeDriver",
    "so101": "gaponet.hw.drivers.so101:SO101Driver",
}


def driver_names() -> tuple[str, ...]:
    """Return the names of all installed drivers, extensions included; nothing is imported."""
    return tuple(plugins.registry(plugins.DRIVERS, DRIVERS))


def supported_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return those options that the driver of a name has parameters for.

    Raises:
        UsageError: There is no such driver, or its package is broken.
    """
    make_driver = plugins.require(plugins.DRIVERS, name, DRIVERS, "driver")
    parameters = inspect.signature(make_driver).parameters
    return {option: value for option, value in options.items() if option in parameters}


def open_driver(
    kind: str, robot: RobotSpec | str | Path, *, limits_from: str | None = None, **options: Any
) -> Driver:
    """Return a driver that is not yet connected.

    Args:
        kind: One of driver_names(). Virtual robots live in the caller's process
            (virtual.virtual_driver).
        robot: The robot, its name or its folder.
        limits_from: Robot folder whose gains and ranges hold instead of the package's; read it
            first. The robot must equal it, but for identified values.
        options: Parameters of the driver's class or function.

    Raises:
        UsageError: There is no such driver, its package is broken, or it lacks a member of Driver.
        RobotError: The robot's gains, ranges or effort limits are beyond those that hold.
    """
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    if limits_from is not None:
        spec = hardware_robot(spec, reference_robot(kind, limits_from))
    driver: Driver = plugins.require(plugins.DRIVERS, kind, DRIVERS, "driver")(spec, **options)
    if missing := missing_members(driver):
        raise UsageError(
            f"driver '{kind}' lacks {', '.join(missing)} (gaponet.hw.control.driver.Driver says "
            "what they do)"
        )
    return driver


def missing_members(driver: object) -> list[str]:
    """Return the members of `Driver` that an object does not have."""
    members = list(Driver.__annotations__)
    members += [name for name in vars(Driver) if not name.startswith("_")]
    return [name for name in members if not hasattr(driver, name)]
