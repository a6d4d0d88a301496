"""VIRTUAL robots on the buses of real ones: what gaponet virtual serve does."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.robot.spec import load_robot
from gaponet.virtual.unitree_virtual import FaultKind, VirtualH12

if TYPE_CHECKING:
    from gaponet.robot.spec import RobotSpec
    from gaponet.virtual.physics import Physics


@dataclass(frozen=True)
class VirtualOptions:
    """A virtual robot and its bus."""

    robot: str = "h1_2"
    """h1_2 (DDS) or so101 (a serial bus on a pseudo-terminal)."""
    unit: str = "4"
    """Number or name of the robot in the fleet."""
    payload_mass: float = 0.0
    """Payload in each hand that payload_side names, kg."""
    payload_side: str = "both"
    """both, or one hand."""
    fleet: str = "hard"
    """Fleet of the robot: hard, easy, shifted, unnamed, firm, or a .toml file."""
    domain: int = 0
    """DDS domain."""
    interface: str = "lo"
    """Network interface; lo reaches this machine only."""
    rate: float = 500.0
    """States per second (DDS)."""
    seconds: float | None = None
    """Stop after this time, s."""
    fault: FaultKind = "none"
    """DDS: fault to inject, to test the controller."""
    fault_at: float = 2.0
    """DDS: time of the fault after the first command, s."""
    link: Path | None = None
    """Serial: additional name of the pseudo-terminal, such as /tmp/so101."""
    calibration: Path | None = None
    """Serial: file for the calibration in the servos, in the format of lerobot-calibrate."""
    frame: float | None = None
    """Serial: simulated time per goal, s, instead of real time, for programs without a clock."""

    @property
    def unit_name(self) -> str:
        """Name in the fleet: a number stands for virtual-NUMBER."""
        return f"virtual-{self.unit}" if self.unit.isdigit() else self.unit


def serve_virtual_robot(
    options: VirtualOptions, *, report: Callable[[str], None] = lambda text: None
) -> None:
    """Serve a VIRTUAL robot on a real bus until its time is over, or Ctrl-C.

    Args:
        report: Called with where it is to be found, and at the end with what it heard.

    Raises:
        UsageError: The fleet has no such unit, or the robot no such fault.
    """
    from gaponet.virtual.fleet import load_fleet

    robot = load_robot(options.robot)
    physics = load_fleet(options.fleet, robot).unit(options.unit_name)
    label = (
        f"VIRTUAL {robot.name}, fleet {options.fleet}, unit {options.unit_name}, "
        f"{options.payload_mass:g} kg"
    )
    if robot.name == "so101":
        _serve_arm(robot, physics, options, label, report)
    else:
        _serve_humanoid(robot, physics, options, label, report)


def _serve_arm(
    robot: RobotSpec,
    physics: Physics,
    options: VirtualOptions,
    label: str,
    report: Callable[[str], None],
) -> None:
    """Serve an SO-101 on a pseudo-terminal."""
    from gaponet.virtual.so101_virtual import VirtualSO101

    if options.fault != "none":
        raise UsageError(f"--fault {options.fault}: only h1_2 has faults to inject")
    side = "hand" if options.payload_side == "both" else options.payload_side
    arm = VirtualSO101(robot, physics, (options.payload_mass, side), options.link, options.frame)
    if options.calibration is not None:
        rows = {joint: asdict(row) for joint, row in arm.calibration.rows.items()}
        write_text(options.calibration, json.dumps(rows, indent=4) + "\n")
    with closing(arm):
        report(f"{label}: servo bus on {arm.terminal.port}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            arm.run(_limit(options))


def _serve_humanoid(
    robot: RobotSpec,
    physics: Physics,
    options: VirtualOptions,
    label: str,
    report: Callable[[str], None],
) -> None:
    """Serve an H1-2 over DDS."""
    humanoid = VirtualH12(
        robot,
        physics,
        (options.payload_mass, options.payload_side),
        options.domain,
        options.interface,
        options.rate,
    )
    humanoid.inject(options.fault, options.fault_at)
    where = (
        f"rt/lowstate at {options.rate:g} Hz, DDS domain {options.domain} on {options.interface}"
    )
    report(f"{label}: {where}; Ctrl-C ends it")
    with suppress(KeyboardInterrupt):
        humanoid.run(_limit(options))
    heard = len(humanoid.heard)
    report(
        f"{label}: heard {heard} commands, refused {humanoid.refused}, late {humanoid.missed} "
        "periods"
    )


def _limit(options: VirtualOptions) -> float:
    """Return the time to serve, s."""
    return math.inf if options.seconds is None else options.seconds
