"""gaponet bench: speed of replay and environment against a bare Batch loop (sim), of a model (latency, aligned)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from gaponet.cli.out import Out
from gaponet.robot import load_robot


def bench(
    what: tyro.conf.Positional[Literal["sim", "latency", "aligned"]],
    run: tyro.conf.Positional[Path] = Path("."),
    robot: str = "so101",
    num_envs: int = 512,
    rounds: int = 15,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Measure speed; of control steps per second the ratio is what counts, machines differ.

    Args:
        what: sim: replay and training environment. latency: one correction of a trained model, on each runtime.
            aligned: the aligned simulator against the nominal one.
        run: Of gaponet train, for latency and aligned.
        robot: Robot name or folder.
        num_envs: Simulations side by side.
        rounds: Interleaved turns of each; the fastest counts.
        json: One JSON object on stdout.
    """
    from gaponet.cli.aligned import aligned
    from gaponet.cli.latency import latency

    out = Out(json)
    if what == "latency":
        return latency(run, out)
    if what == "aligned":
        return aligned(run, out, num_envs, rounds)
    from gaponet.train.bench import bench_sim

    result = bench_sim(load_robot(robot), num_envs, rounds=rounds)
    out.table(f"{robot}, {num_envs} simulations", ["", "control steps/s", "of bare"], [
        [name, f"{r['control_steps_per_s']:,.0f}", f"{r['ratio'] * 100:.0f} %"] for name, r in result.items()
    ])  # fmt: skip
    out.result({"robot": robot, "num_envs": num_envs, "results": result})
