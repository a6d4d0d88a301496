"""What live targets cost a compensated VIRTUAL robot: python benchmarks/live_targets.py RUN DATASET

RUN, DATASET, unit and motions as of benchmarks/compensate.py. The same motions come from a file (row k in period k) and
live: sent at the motion's rate by a clock of the sender's own, at any phase of the control period, with a jitter, and
taken in the period that follows. The error is to where the sender was when the state was read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from compensate import AT_ONCE, SKIP, _motions, play

from gaponet.data.store import Dataset
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import load_robot

Array = np.ndarray
STREAMS = {  # mean jitter, s; share of messages that are lost
    "live, 0.5 ms jitter": (0.0005, 0.0),
    "live, 5 ms jitter, 1 % lost": (0.005, 0.01),
}
METHODS = {"uncompensated": None, "compensated": AT_ONCE, "compensated, dynamics": replace(AT_ONCE, dynamics=True)}


def received(motion: Array, dt: float, jitter: float, lost: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Targets in force in each period, and where the sender was at its begin, (T, n) rad each."""
    rows = np.arange(len(motion))
    phase = rng.uniform(0, dt)
    arrived = rows * dt + phase + rng.exponential(jitter, len(rows))
    arrived[rng.random(len(rows)) < lost] = np.inf
    arrived[0] = 0.0
    newest = np.array([np.flatnonzero(arrived <= k * dt + 1e-9).max() for k in rows])
    at = np.clip(rows - phase / dt, 0, None)
    return motion[newest], np.stack([np.interp(at, rows, column) for column in motion.T], axis=1)


def main(
    run: tyro.conf.Positional[Path],
    dataset: tyro.conf.Positional[Path],
    unit: str = "virtual-4",
    payloads: tuple[float, ...] = (0.0, 3.0),
    seconds: float = 7.0,
    phases: int = 3,
) -> None:
    """Print mean |error| of the operated joints, mrad, and what live adds to each motion's, ± over the motions."""
    data = Dataset(dataset)
    model, robot = GapModel.load(run), load_robot(data.robot_name)
    motions = _motions(data, model, unit, round(seconds / robot.dt))
    rows = [(motion, mass, k) for motion in motions for mass in payloads for k in range(phases)]
    mass = np.array([m for _, m, _ in rows])
    skip, op = round(SKIP / robot.dt), robot.operated_index
    print(f"VIRTUAL unit {unit}, {len(motions)} motions, {phases} phases each; kg: {', '.join(map(str, payloads))}")
    for name, config in METHODS.items():
        file: Array | None = None
        for stream, (jitter, lost) in ({"file": (0.0, 0.0)} | STREAMS).items():
            rng = np.random.default_rng(0)
            told = [(motions[m], motions[m]) if stream == "file" else received(motions[m], robot.dt, jitter, lost, rng)
                    for m, *_ in rows]  # fmt: skip
            targets, meant = (np.stack([pair[i] for pair in told], axis=1) for i in range(2))
            q, u, _ = play(robot, model, unit, targets, mass, config, mass)
            error = 1e3 * np.abs(meant[:, :, op] - q)[skip:].mean(axis=(0, 2))
            file = error if file is None else file
            rough = 1e3 * np.abs(np.diff(u[skip:], 2, axis=0)).mean()
            cells = ", ".join(
                f"{error[mass == p].mean():6.2f} (+{(error - file)[mass == p].mean():.2f} ± "
                f"{(error - file)[mass == p].reshape(len(motions), -1).mean(axis=1).std():.2f})" for p in payloads
            )  # fmt: skip
            print(f"{name:24s} {stream:28s} {cells}   command roughness {rough:.2f}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
