"""Tracking of a VIRTUAL robot, uncompensated and compensated, per payload: python benchmarks/compensate.py RUN DATASET

RUN is a run of gaponet train on virtual units, DATASET its recordings. The unit is one that was not trained on, the
motions are the run's test motions; payloads between those trained on take part.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

from gaponet.data.store import Dataset
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import idle_joints
from gaponet.testing.fleet import load_fleet
from gaponet.testing.unit import VirtualRobot

Array = np.ndarray
WARMTH = 12.0  # K above ambient
SKIP = 1.5  # s: blending in

AT_ONCE = CompensatorConfig(blend=0.0)
METHODS: dict[str, CompensatorConfig | None] = {
    "uncompensated": None,
    "simulator: G": replace(AT_ONCE, aim="simulator", feedback=0.0),
    "simulator: G + feedback": replace(AT_ONCE, aim="simulator"),
    "target: gravity alone": replace(AT_ONCE, feedback=0.0),
    "target: gravity + feedback": AT_ONCE,
    "target: gravity + G": replace(AT_ONCE, feedback=0.0),
    "target: gravity + G + feedback": AT_ONCE,
    "the same, payload not told": AT_ONCE,
    "the same, targets 40 ms ahead": replace(AT_ONCE, lead=2),
}
ALONE = ("target: gravity alone", "target: gravity + feedback")  # without the model


def main(
    run: tyro.conf.Positional[Path],
    dataset: tyro.conf.Positional[Path],
    unit: str = "virtual-4",
    payloads: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0),
    seconds: float = 7.0,
    only: tuple[str, ...] = (),
) -> None:
    """Print mean |error| of the operated joints in mrad, to the target and to what the nominal simulator does."""
    data = Dataset(dataset)
    model, robot = GapModel.load(run), load_robot(data.robot_name)
    motions = _motions(data, model, unit, round(seconds / robot.dt))
    rows = [(motion, mass) for motion in motions for mass in payloads]
    targets = np.stack([motions[motion] for motion, _ in rows], axis=1)
    mass = np.array([m for _, m in rows])
    nominal = None
    print(f"VIRTUAL unit {unit}, {', '.join(motions)}; kg: {', '.join(f'{p:g}' for p in payloads)}")
    for name, config in METHODS.items():
        if only and name not in (*only, "uncompensated"):
            continue
        told = None if "not told" in name else mass
        asked = None if config is None or name in ALONE else model
        q, u, aimed = play(robot, asked, unit, targets, mass, config, told)
        if nominal is None:
            nominal = aimed  # the shadow of the first method is the nominal simulator under the targets
        skip, op = round(SKIP / robot.dt), robot.operated_index
        to_target, to_nominal = (np.abs(x - q)[skip:].mean(axis=(0, 2)) * 1e3 for x in (targets[:, :, op], nominal))
        cells = ["  ".join(f"{e[mass == p].mean():6.2f}" for p in payloads) for e in (to_target, to_nominal)]
        rough = np.abs(np.diff(u[skip:], 2, axis=0)).mean() * 1e3
        print(f"{name:32s} to target {cells[0]}   to nominal {cells[1]}   command roughness {rough:.2f}", flush=True)


def play(
    robot: RobotSpec, model: GapModel | None, unit: str, targets: Array, mass: Array, config: CompensatorConfig | None,
    told: Array | None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Measured positions, commands and the shadow's positions of the operated joints, (T, N, n) rad each."""
    op, count = robot.operated_index, len(mass)
    locked = idle_joints(robot, robot.operated)
    physics = load_fleet("easy", robot).unit(unit)
    robots = VirtualRobot(robot, [physics] * count, [(float(m), "both") for m in mass], robot.dt, locked=locked)
    robots.reset(targets[0], list(range(count)), WARMTH)
    shadow = replace(AT_ONCE, aim="simulator", feedback=0.0)  # without a model it sends what it is given
    compensator = Compensator(robot, model, config or shadow, num_envs=count)
    compensator.reset(targets[0], told)
    q, u, aimed = (np.empty((len(targets), count, len(op))) for _ in range(3))
    for t in range(len(targets)):
        reading = robots.read()
        ahead = targets[min(t + compensator.config.lead, len(targets) - 1)]
        command = compensator.step(ahead, reading.qpos, reading.qvel)
        q[t], u[t], aimed[t] = reading.qpos[:, op], command[:, op], compensator.aimed
        robots.step(command)
    return q, u, aimed


def _motions(data: Dataset, model: GapModel, unit: str, rows: int) -> dict[str, Array]:
    """Commands of the test motions, cut or held to as many rows."""
    found: dict[str, Array] = {}
    for entry in data.entries:
        motion = entry.meta.motion
        if entry.meta.unit_id == unit and motion in model.card["motions"]["test"] and motion not in found:
            ctrl = data.sequences([entry])[0].ctrl.astype(float)[:rows]
            found[motion] = np.concatenate([ctrl, np.repeat(ctrl[-1:], rows - len(ctrl), axis=0)])
    return found


if __name__ == "__main__":
    tyro.cli(main)
