"""`gaponet virtual serve`: a virtual robot on a real bus."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Literal

import tyro

from gaponet.cli.out import Out
from gaponet.deploy.drivers.unitree_virtual import FaultKind, VirtualH12
from gaponet.errors import UsageError


def virtual(
    action: tyro.conf.Positional[Literal["serve"]],
    robot: str = "h1_2",
    unit: str = "4",
    payload_mass: float = 0.0,
    payload_side: str = "both",
    transport: Literal["dds", "serial"] | None = None,
    fleet: str = "hard",
    domain: int = 0,
    interface: str = "lo",
    rate: float = 500.0,
    seconds: float | None = None,
    fault: FaultKind = "none",
    fault_at: float = 2.0,
    heard: Path | None = None,
    link: Path | None = None,
) -> None:
    """Be a VIRTUAL robot behind the real bus until interrupted, for gaponet run and record in another terminal.

    Args:
        action: serve.
        robot: h1_2 (DDS) or so101 (a serial bus on a pseudo-terminal).
        unit: Unit of the fleet: its number or its name.
        payload_mass: kg in each hand named by payload_side.
        payload_side: both, or one hand.
        transport: dds for h1_2, serial for so101; default the robot's.
        fleet: Virtual units: hard, easy, shifted, or a .toml file.
        domain: DDS domain.
        interface: Network interface; lo reaches this machine only.
        rate: States per second (DDS).
        seconds: End by itself after this time.
        fault: Go wrong on purpose, to rehearse what a controller does then.
        fault_at: s after the first command.
        heard: Write every command that arrived, and where the joints were, to this .npz at the end.
        link: Serial: also give the pseudo-terminal this name, e.g. /tmp/so101.
    """
    from gaponet.robot import load_robot
    from gaponet.virtual.fleet import load_fleet

    out, spec = Out(), load_robot(robot)
    if heard and not heard.parent.is_dir():  # said now, not when all has been heard
        raise UsageError(f"--heard {heard}: there is no folder {heard.parent}")
    natural = "serial" if spec.name == "so101" else "dds"
    if (transport or natural) != natural:
        raise UsageError(f"--transport {transport}: {spec.name} speaks {natural}")
    name = f"virtual-{unit}" if unit.isdigit() else unit
    physics = load_fleet(fleet, spec).unit(name)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    label = f"VIRTUAL {spec.name}, fleet {fleet}, unit {name}, {payload_mass:g} kg"
    if natural == "dds":
        payload = (payload_mass, payload_side)
        served = VirtualH12(spec, physics, payload, domain, interface, rate, fault, fault_at)
        out.say(f"{label}: rt/lowstate at {rate:g} Hz, DDS domain {domain} on {interface}; Ctrl-C ends it")
        _flush()
        try:
            served.run(float("inf") if seconds is None else seconds)
        except KeyboardInterrupt:
            pass
        finally:
            if heard:
                served.heard.save(heard)
        out.say(
            f"{label}: heard {len(served.heard.time)} commands, refused {served.refused}, late {served.missed} periods"
        )
        return
    from gaponet.deploy.drivers.so101_virtual import VirtualSO101

    side = payload_side if payload_side != "both" else "hand"
    arm = VirtualSO101(spec, physics, (payload_mass, side), link=link)
    out.say(f"{label}: servo bus on {arm.port}; Ctrl-C ends it")
    _flush()
    try:
        arm.run(float("inf") if seconds is None else seconds)
    except KeyboardInterrupt:
        pass
    finally:
        arm.close()


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _flush() -> None:
    """Whoever started us through a pipe waits for this line."""
    import sys

    sys.stdout.flush()
