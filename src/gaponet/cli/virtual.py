"""`gaponet virtual serve`: a virtual robot on a real bus."""

from __future__ import annotations

import json
import signal
import sys
from contextlib import closing, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.cli.out import Out
from gaponet.hw.control.stop import STOP_SIGNALS
from gaponet.virtual.unitree_virtual import FaultKind, VirtualH12

if TYPE_CHECKING:
    from gaponet.virtual.so101_virtual import VirtualSO101


def virtual(
    action: tyro.conf.Positional[Literal["serve"]], robot: str = "h1_2", unit: str = "4", payload_mass: float = 0.0,
    payload_side: str = "both", fleet: str = "hard", domain: int = 0, interface: str = "lo", rate: float = 500.0,
    seconds: float | None = None, fault: FaultKind = "none", fault_at: float = 2.0, link: Path | None = None,
    calibration: Path | None = None, frame: float | None = None,
) -> None:  # fmt: skip
    """Serve a VIRTUAL robot on a real bus, for run and record.

    Args:
        action: serve starts the robot.
        robot: h1_2 (DDS) or so101 (a serial bus on a pseudo-terminal).
        unit: Number or name of the robot in the fleet.
        payload_mass: kg in each hand that payload_side names.
        payload_side: both, or one hand.
        fleet: Virtual units: hard, easy, shifted, unnamed, or a .toml file.
        domain: DDS domain.
        interface: Network interface; lo reaches this machine only.
        rate: States per second (DDS).
        seconds: Stop after this time, s.
        fault: DDS: fault to inject, to test the controller.
        fault_at: DDS: time of the fault after the first command, s.
        link: Serial: additional name of the pseudo-terminal, such as /tmp/so101.
        calibration: Serial: file for the calibration in the servos, in the format of lerobot-calibrate.
        frame: Serial: simulated time per goal, s, instead of real time, for programs without a clock.
    """
    from gaponet.robot.spec import load_robot
    from gaponet.virtual.fleet import load_fleet
    from gaponet.virtual.so101_virtual import VirtualSO101

    out, spec = Out(), load_robot(robot)
    name = f"virtual-{unit}" if unit.isdigit() else unit
    physics = load_fleet(fleet, spec).unit(name)
    for number in STOP_SIGNALS:
        if number.name not in ("SIGINT", "SIGTSTP"):  # Ctrl-Z suspends it, as any program
            signal.signal(number, signal.default_int_handler)
    label = f"VIRTUAL {spec.name}, fleet {fleet}, unit {name}, {payload_mass:g} kg"
    limit = float("inf") if seconds is None else seconds
    if spec.name == "so101":
        if fault != "none":
            raise UsageError(f"--fault {fault}: only h1_2 has faults to inject")
        side = payload_side if payload_side != "both" else "hand"
        arm = VirtualSO101(spec, physics, (payload_mass, side), link, frame)
        if calibration:
            rows = {joint: asdict(row) for joint, row in arm.calibration.rows.items()}
            write_text(calibration, json.dumps(rows, indent=4) + "\n")
        with closing(arm):
            _live(arm, limit, out, f"{label}: servo bus on {arm.port}")
        return
    humanoid = VirtualH12(
        spec, physics, (payload_mass, payload_side), domain, interface, rate, fault, fault_at
    )
    _live(
        humanoid,
        limit,
        out,
        f"{label}: rt/lowstate at {rate:g} Hz, DDS domain {domain} on {interface}",
    )
    summary = f"heard {len(humanoid.heard)} commands, refused {humanoid.refused}, late {humanoid.missed} periods"
    out.say(f"{label}: {summary}")


def _live(served: VirtualH12 | VirtualSO101, seconds: float, out: Out, where: str) -> None:
    """Serve until interrupted; what is written afterwards is not interrupted."""
    out.say(f"{where}; Ctrl-C ends it")
    sys.stdout.flush()  # whoever started us through a pipe waits for this line
    with suppress(KeyboardInterrupt):
        served.run(seconds)
