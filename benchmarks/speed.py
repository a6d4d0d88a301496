"""Speed of simulation, of PPO training, of one correction, and of the aligned simulator.

    python benchmarks/speed.py sim [--robot so101]             bare Batch loop, replay, environment
    python benchmarks/speed.py train [--model gaponet]         collection, update and PPO, beside the bare loop
    python benchmarks/speed.py latency --run RUN               one correction: onnxruntime, torch, delta()
    python benchmarks/speed.py aligned --run RUN               the aligned simulator beside the nominal one

All parts take turns in one run, so that a slow moment of the machine slows all of them. Of repeated turns the fastest
counts, because other programs only add time. Where a whole is compared with its parts (train) the median counts: the
fastest turns of the parts add up to less than the fastest turn of the whole. Results are printed as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import num_parameters
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import trained_network
from gaponet.nn.training.config import RewardConfig, TrainConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.ppo import PPO
from gaponet.robot.folder import load_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import idle_joints
from gaponet.sim.replay import idle_limbs, replay

Turn = Callable[[], object]
Speeds = dict[str, dict[str, float]]

EPISODE_S = 10.0
TURN_STEPS = 40  # control periods of a turn
INFERENCE_BATCH = 4096


def take_turns(turns: dict[str, Turn], rounds: int, average: Callable[[list[float]], float] = min) -> dict[str, float]:
    """Run the turns round after round and return the seconds of each; the first round is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in turns}
    for _ in range(rounds + 1):
        for name, turn in turns.items():
            start = time.perf_counter()
            turn()
            seconds[name].append(time.perf_counter() - start)
    return {name: average(s[1:]) for name, s in seconds.items()}


def bench_sim(robot: RobotSpec, num_envs: int, rounds: int, steps: int = TURN_STEPS) -> Speeds:
    """Control steps per second of bare loop, replay and environment, and the ratio to the bare loop."""
    sequences = [slow_sines(robot, steps + 1, seed) for seed in range(num_envs)]
    env = _environment(robot, ModelConfig(), num_envs)
    seconds = take_turns(
        {
            "bare Batch loop": _bare_loop(robot, num_envs, steps),
            "replay": lambda: replay(sequences, robot, lock_idle=True),
            "environment step": _idle_steps(env, steps),
        },
        rounds,
    )
    return _speeds({name: (num_envs * steps, s) for name, s in seconds.items()}, "bare Batch loop")


def bench_train(robot: RobotSpec, config: TrainConfig, num_envs: int, rounds: int) -> dict[str, Any]:
    """Control steps per second of each part of PPO training, and of the whole.

    Args:
        robot: Limbs without an operated joint are locked, as in training.
        config: Model, PPO and threads.
        rounds: Turns of each part, after one that is not counted.

    Returns:
        speeds by name; expected (control steps/s, if physics, inference and update ran without overhead) and the share
        of it that PPO reaches; parameters; peak_memory_bytes.
    """
    import resource  # not on Windows

    torch.set_num_threads(config.learner_threads)
    config = _for_envs(config, num_envs)
    quick = config.fast()
    steps, batch = config.ppo.num_steps, num_envs * config.ppo.num_steps
    env = _environment(robot, config.model, num_envs, config.threads)
    net = build_network(config.model, env.num_actions)
    learner = PPO(env, net, config.ppo)
    quick_learner = PPO(env, build_network(quick.model, env.num_actions), quick.ppo)
    collected = learner.collect()
    turns: dict[str, Turn] = {
        "bare Batch loop": _bare_loop(robot, num_envs, steps, config.threads),
        "environment step": _idle_steps(env, steps),
        "inference": lambda: _inference(learner, steps),
        "collection": learner.collect,
        "update": lambda: learner.learn(collected),
        "PPO": learner.update,
        "PPO, fast preset": quick_learner.update,
    }
    seconds = take_turns(turns, rounds, median)
    expected = batch / sum(seconds[part] for part in ("bare Batch loop", "inference", "update"))
    speeds = _speeds({name: (batch, s) for name, s in seconds.items()}, "bare Batch loop")
    return {
        "speeds": speeds,
        "expected": expected,
        "share_of_expected": speeds["PPO"]["control_steps_per_s"] / expected,
        "parameters": num_parameters(net),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def bench_latency(run: Path, calls: int = 3000, threads: int = 1) -> dict[str, Any]:
    """Microseconds of one correction (p50, p99, max) on each runtime, and corrections per second in batches.

    Args:
        run: Run folder of gaponet train.
        calls: Calls of each runtime; they take turns of a tenth.
        threads: Threads of onnxruntime for the batch; 0 for all cores. Single steps use one.
    """
    model, rng = GapModel.load(run), np.random.default_rng(0)
    n = len(model.card["joint_names"])
    x = rng.normal(0, 0.3, (INFERENCE_BATCH, model.config.input_dim(n))).astype(np.float32)
    turns: dict[str, Turn] = {"network, onnxruntime": partial(model.infer, x[:1])}
    if (run / "checkpoint.pt").is_file():
        torch.set_num_threads(1)
        net = trained_network(run, model.config, n)
        turns["network, torch"] = torch.inference_mode()(partial(net, torch.from_numpy(x[:1])))
    turns["delta()"] = _correction(model, rng.normal(0, 0.3, (64, 3, n)))
    micro: dict[str, list[Array]] = {name: [] for name in turns}
    for _ in range(10):
        for name, turn in turns.items():
            micro[name].append(_durations(turn, max(calls // 10, 10)))
    quantiles = {
        name: {"p50": float(np.median(t)), "p99": float(np.quantile(t, 0.99)), "max": float(t.max())}
        for name, t in ((name, np.concatenate(times)) for name, times in micro.items())
    }
    batch = _durations(partial(GapModel.load(run, threads).infer, x), 3).min() * 1e-6
    return {"run": str(run), "joints": n, "model": model.card["model"], "microseconds": quantiles,
            "batch": INFERENCE_BATCH, "threads": threads, "deltas_per_s": INFERENCE_BATCH / batch}  # fmt: skip


def bench_aligned(run: Path, num_envs: int, rounds: int, steps: int = TURN_STEPS) -> Speeds:
    """Control steps per second of the nominal and the aligned simulator; idle limbs are locked in both."""
    model = GapModel.load(run, threads=0)
    robot = load_stored_robot(run, model.card["robot"])
    locked = idle_joints(robot, robot.operated)
    nominal = BatchSim(robot, [Condition(0.0, "both", robot.dt)] * num_envs, 0, locked)
    aligned = AlignedSim(robot, model, 0.0, num_envs=num_envs, locked=locked)
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (num_envs, nominal.n))
    targets = [aligned.qpos_home + 0.3 * np.sin(phase + np.pi * robot.dt * t) for t in range(steps)]

    def run_nominal() -> None:
        nominal.reset(slice(None), targets[0], 0.0, past=targets[0][:, None])  # type: ignore[arg-type]
        for target in targets:
            nominal.step(target)

    def run_aligned() -> None:
        aligned.reset(targets[0])
        for target in targets:
            aligned.step(target)

    seconds = take_turns({"nominal": run_nominal, "aligned": run_aligned}, rounds)
    return _speeds({name: (num_envs * steps, s) for name, s in seconds.items()}, "nominal")


def slow_sines(robot: RobotSpec, rows: int, seed: int) -> Sequence:
    """A slow random motion of the operated joints about home."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows)[:, None] * robot.dt
    op = robot.operated_index
    low, high = np.clip(robot.qpos_range[op].T, -1.5, 1.5)
    wave = np.sin(2 * np.pi * rng.uniform(0.2, 1.0, len(op)) * t + rng.uniform(0, 2 * np.pi, len(op)))
    ctrl = np.tile(robot.qpos_home, (rows, 1))
    ctrl[:, op] = np.clip(ctrl[:, op] + 0.3 * wave, low, high)
    meta = SequenceMeta(robot.name, "bench", f"slow_sines-{seed}", 0.0, virtual=True)
    return Sequence(meta, robot.joint_names, robot.dt, ctrl, ctrl, np.gradient(ctrl, robot.dt, axis=0))


def recordings(robot: RobotSpec, count: int) -> list[Sequence]:
    """Motions of 20 s."""
    return [slow_sines(robot, round(20 / robot.dt), seed) for seed in range(count)]


def _for_envs(config: TrainConfig, num_envs: int) -> TrainConfig:
    """The config for another number of environments, with mini-batches of the same size."""
    ppo = config.sized().ppo
    parts = max(1, ppo.mini_batches * num_envs // ppo.num_envs)
    return replace(config, ppo=replace(ppo, num_envs=num_envs, mini_batches=parts))


def _speeds(done: dict[str, tuple[int, float]], base: str) -> Speeds:
    """(control steps, s) of each → control steps per second, and the ratio to one of them."""
    speed = {name: count / seconds for name, (count, seconds) in done.items()}
    return {name: {"control_steps_per_s": v, "ratio": v / speed[base]} for name, v in speed.items()}


def _environment(robot: RobotSpec, model: ModelConfig, num_envs: int, nthread: int = 0) -> DeltaEnv:
    steps = round(EPISODE_S / robot.dt)
    return DeltaEnv(recordings(robot, 32), robot, model, num_envs, steps, RewardConfig(), nthread=nthread)


def _bare_loop(robot: RobotSpec, num_envs: int, steps: int, nthread: int = 0) -> Turn:
    """The same simulations without anything around them."""
    motions = [slow_sines(robot, steps + 1, seed) for seed in range(num_envs)]
    sim = BatchSim(robot, [Condition(0.0, "both", robot.dt)] * num_envs, nthread, idle_limbs(motions, robot))
    ctrl = np.stack([m.ctrl for m in motions], axis=1).astype(float)[..., robot.index(sim.joint_names)]
    zero, past = np.zeros_like(ctrl[0]), ctrl[0][:, None]

    def run() -> None:
        sim.reset(slice(None), ctrl[0], zero, past)
        for t in range(steps):
            sim.ctrl[:] = ctrl[t]
            sim.batch.step(nstep=robot.decimation)

    return run


def _idle_steps(env: DeltaEnv, steps: int) -> Turn:
    idle = np.zeros((env.num_envs, env.num_actions), np.float32)

    def run() -> None:
        for _ in range(steps):
            env.step(idle)

    return run


def _inference(learner: PPO, steps: int) -> None:
    """Features, sensors, actor and critic, nothing stored."""
    with torch.no_grad():
        for _ in range(steps):
            learner.observe()


def _correction(model: GapModel, states: Array) -> Turn:
    """delta() at changing states, (k, 3, n)."""
    loop, k = model.loop(), 0

    def step() -> Array:
        nonlocal k
        k = (k + 1) % len(states)
        return loop.delta(*states[k], 1.0)

    return step


def _durations(turn: Turn, calls: int) -> Array:
    """Durations of calls after 20 to warm up, (calls,) µs."""
    for _ in range(20):
        turn()
    times = np.empty(calls)
    for k in range(calls):
        start = time.perf_counter()
        turn()
        times[k] = time.perf_counter() - start
    return times * 1e6


def main() -> None:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sim", "train", "latency", "aligned"))
    parser.add_argument("--run", type=Path, default=Path("."), help="run folder of gaponet train")
    parser.add_argument("--robot", default="so101")
    parser.add_argument("--model", default="gaponet", choices=("gaponet", "mlp"))
    parser.add_argument("--num-envs", type=int, default=0, help="default 512, with train 1024")
    parser.add_argument("--rounds", type=int, default=0, help="default 15, with train 3")
    args = parser.parse_args()
    num_envs, rounds = args.num_envs or 512, args.rounds or 15
    match args.what:
        case "latency":
            result: object = bench_latency(args.run)
        case "aligned":
            result = bench_aligned(args.run, num_envs, rounds)
        case "sim":
            result = bench_sim(load_robot(args.robot), num_envs, rounds)
        case _:
            config = TrainConfig(ModelConfig(args.model))
            result = bench_train(load_robot(args.robot), config, args.num_envs or 1024, args.rounds or 3)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
