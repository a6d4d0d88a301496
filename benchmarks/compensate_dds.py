"""Compensation of a VIRTUAL H1-2 over a real DDS bus, by commands: python benchmarks/compensate_dds.py RUN

One process serves the robot, and `gaponet run --driver unitree` plays the motion on it in another, with the watchdog:
once without and once with the model. RUN: a run of gaponet train on other virtual units.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import tyro

GAPONET = [sys.executable, "-m", "gaponet"]


def main(
    run: tyro.conf.Positional[Path],
    motions: tuple[str, ...] = ("wander-both-7", "stir-both-7"),
    unit: str = "4",
    payload_mass: float = 3.0,
    state_rate: float = 500.0,
    domain: int = 43,
) -> None:
    """Print mean |error| to the target, mrad, by motion.

    Args:
        run: Folder of gaponet train.
        motions: Names of motions; the packaged recipes contain variants 0 and 1 only.
        unit: Unit of the fleet `hard`.
        payload_mass: Payload in each hand, kg.
        state_rate: States per second.
        domain: DDS domain.
    """
    print(f"VIRTUAL h1_2 unit {unit}, {payload_mass:g} kg per hand, DDS on lo, states at {state_rate:g} Hz")
    for motion in motions:
        options = ["--motion", motion, "--payload-mass", f"{payload_mass:g}", "--max-payload", "3"]
        raw, compensated = (
            play(
                domain,
                ["--unit", unit, "--payload-mass", f"{payload_mass:g}", "--rate", f"{state_rate:g}"],
                options + m,
            )
            for m in ([], ["--model", str(run)])
        )
        before, after = (1e3 * r["tracking_error_rad"]["mean"] for r in (raw, compensated))
        late = ", ".join(f"{r['late_ms']['max']:.1f}" for r in (raw, compensated))
        print(
            f"{motion}: {before:.1f} mrad uncompensated, {after:.1f} with the model, {1 - after / before:.0%} less; "
            f"latest period {late} ms late, missed {raw['missed']}, {compensated['missed']}",
            flush=True,
        )


def play(domain: int, served: list[str], options: list[str]) -> dict[str, Any]:
    """Serve a robot, run the motion, and return the result of gaponet run."""
    bus = ["--domain", str(domain)]
    command = [*GAPONET, "virtual", "serve", "--robot", "h1_2", *bus, *served]
    robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert robot.stdout is not None
        robot.stdout.readline()  # printed when the robot is ready
        command = [*GAPONET, "run", "--driver", "unitree", *bus, "--yes", "--json", *options]
        said = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    finally:
        robot.terminate()
        robot.wait()
    if not said.stdout:
        sys.exit("gaponet run failed; its message stands above")
    result: dict[str, Any] = json.loads(said.stdout)
    if said.returncode or "tracking_error_rad" not in result:
        sys.exit(f"the run was stopped: {result['events']}")
    return result


if __name__ == "__main__":
    tyro.cli(main)
