"""gaponet bench: speed of simulation (sim), of training (train), and of a trained model (latency, aligned)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import tyro

from gaponet.cli.out import Out
from gaponet.robot import load_robot


def bench(
    what: tyro.conf.Positional[Literal["sim", "train", "latency", "aligned"]],
    run: tyro.conf.Positional[Path] = Path("."),
    robot: str = "so101",
    model: Literal["gaponet", "mlp"] = "gaponet",
    num_envs: int | None = None,
    rounds: int | None = None,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Measure speed; of control steps per second the ratio is what counts, machines differ.

    Args:
        what: sim: replay and environment. train: inference, collection, update, PPO as a whole, and stable-baselines3
            where it is installed (pip install 'gaponet[bench]'). latency: one correction of a trained model, on each
            runtime. aligned: the aligned simulator against the nominal one.
        run: Of gaponet train, for latency and aligned.
        robot: Robot name or folder.
        model: Network that is trained.
        num_envs: Simulations side by side; default 512, 1024 with train.
        rounds: Interleaved turns of each; default 15, 3 with train. The fastest counts, with train the median.
        json: One JSON object on stdout.
    """
    from gaponet.cli.aligned import aligned
    from gaponet.cli.latency import latency

    out = Out(json)
    if what == "latency":
        return latency(run, out)
    if what == "aligned":
        return aligned(run, out, num_envs or 512, rounds or 15)
    from gaponet.model.config import ModelConfig
    from gaponet.train.bench import bench_sim, bench_train
    from gaponet.train.config import TrainConfig

    spec = load_robot(robot)
    columns = ["", "control steps/s", "of bare"]
    if what == "sim":
        speeds = bench_sim(spec, num_envs or 512, rounds=rounds or 15)
        out.table(f"{robot}, {num_envs or 512} simulations", columns, _rows(speeds))
        out.result({"robot": robot, "num_envs": num_envs or 512, "results": speeds})
        return
    baseline = all(find_spec(name) for name in ("stable_baselines3", "gymnasium"))
    result = bench_train(spec, TrainConfig(ModelConfig(model)), num_envs or 1024, rounds or 3, baseline)
    out.table(f"{robot}, {model}, {num_envs or 1024} simulations", columns, _rows(result["speeds"]))
    out.say(
        f"PPO: {result['share_of_expected'] * 100:.0f} % of the {result['expected']:,.0f} control steps/s that physics,"
        f" inference and update allow; peak memory {result['peak_memory_bytes'] / 2**30:.2f} GiB"
    )
    if baseline:
        out.say("PPO's speed over theirs, same environment, network and epochs; mini-batches of 64, their default, "
                "unless said otherwise:")  # fmt: skip
        for name, ratio in result["times_sb3"].items():
            out.say(f"  {ratio:.1f} x {name}")
    if not baseline:
        out.say("stable-baselines3 is not installed and left out; pip install 'gaponet[bench]' to compare with it")
    out.result({"robot": robot, "model": model, "num_envs": num_envs or 1024} | result)


def _rows(speeds: dict[str, dict[str, float]]) -> list[list[str]]:
    return [[name, f"{r['control_steps_per_s']:,.0f}", f"{r['ratio'] * 100:.0f} %"] for name, r in speeds.items()]
