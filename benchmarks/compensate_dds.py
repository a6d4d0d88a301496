"""Compensation over a real DDS bus, as a user would run it: python benchmarks/compensate_dds.py RUN

For each of two runs, without and with the model, a VIRTUAL H1-2 is served anew in a process of its own and
`gaponet run --driver unitree` plays the motion on it in another, watchdog included. RUN: a run of gaponet train on
virtual units other than this one.
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
        motions: Names; variants 0 and 1 are in the packaged recipes, so others were not trained on.
        unit: Of the fleet `hard`.
        payload_mass: kg in each hand.
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
    """Serve a robot, run the motion, and give what gaponet run says."""
    bus = ["--domain", str(domain)]
    command = [*GAPONET, "virtual", "serve", "--robot", "h1_2", *bus, *served]
    robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert robot.stdout is not None
        robot.stdout.readline()  # it says when it is there
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
