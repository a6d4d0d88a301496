"""gaponet bench sim: speed of replay and environment against a bare Batch loop."""

from __future__ import annotations

from typing import Literal

import tyro

from gaponet.cli.out import Out
from gaponet.robot import load_robot


def bench(
    what: tyro.conf.Positional[Literal["sim"]],
    robot: str = "so101",
    num_envs: int = 512,
    rounds: int = 15,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Measure control steps per second; the ratio is what counts, machines differ.

    Args:
        what: sim.
        robot: Robot name or folder.
        num_envs: Simulations side by side.
        rounds: Interleaved turns of each; the fastest counts.
        json: One JSON object on stdout.
    """
    from gaponet.train.bench import bench_sim

    out = Out(json)
    result = bench_sim(load_robot(robot), num_envs, rounds=rounds)
    out.table(f"{robot}, {num_envs} simulations", ["", "control steps/s", "of bare"], [
        [name, f"{r['control_steps_per_s']:,.0f}", f"{r['ratio'] * 100:.0f} %"] for name, r in result.items()
    ])  # fmt: skip
    out.result({"robot": robot, "num_envs": num_envs, "results": result})
