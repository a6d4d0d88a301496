"""How much of the simulator's speed is left: bare Batch loop, environment, collection, PPO; interleaved in one run.

All parts take turns, so that a machine that slows down slows all of them. Of turns that are equally long the fastest
counts, since other work on the machine only ever adds time (bench_sim); where a whole is compared with its parts, the
median does: the parts' fastest turns add up to less than the whole's (bench_train).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import torch

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.experiments.speed.turns import Turn, take_turns
from gaponet.nn.config import ModelConfig
from gaponet.nn.deeponet import build_network
from gaponet.nn.layers import size
from gaponet.nn.training.config import RewardConfig, TrainConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.ppo import Learner
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.replay import idle_limbs, replay

Speeds = dict[str, dict[str, float]]
Others = Callable[[DeltaEnv, TrainConfig], dict[str, tuple[Turn, int]]]  # name → a turn, its control steps

EPISODE_S = 10.0


def bench_sim(robot: RobotSpec, num_envs: int = 512, steps: int = 40, rounds: int = 15) -> Speeds:
    """Control steps per second of bare loop, replay and environment, and the ratio to the bare loop.

    Args:
        robot: The robot; limbs without an operated joint are locked, as in training.
        steps: Control periods per turn.
        rounds: Turns each.
    """
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
    return _speeds({name: (num_envs * steps, best) for name, best in seconds.items()}, "bare Batch loop")


def bench_train(
    robot: RobotSpec, config: TrainConfig, num_envs: int = 1024, rounds: int = 3, others: Others | None = None
) -> dict[str, Any]:
    """Control steps per second of each part of PPO training, of the whole, and of other trainers on the same task.

    "expected" is what the parts would give if nothing came between them: physics, inference and update, each once for
    every control step.

    Args:
        robot: The robot; limbs without an operated joint are locked, as in training.
        config: Model and PPO; threads.
        rounds: Turns each, after one that does not count.
        others: Makes the turns of other trainers, and says how many control steps one of each is
            (benchmarks/sb3.py).

    Returns:
        speeds by name, expected (control steps/s) and share of it, times_others (PPO's speed over that of each of the
        others), parameters, peak_memory_bytes.
    """
    torch.set_num_threads(config.learner_threads)
    config = _for_envs(config, num_envs)
    quick = config.fast()
    steps, batch = config.ppo.num_steps, num_envs * config.ppo.num_steps
    env = _environment(robot, config.model, num_envs, config.threads)
    net = build_network(config.model, env.num_actions)
    learner = Learner(env, net, config.ppo)
    quick_learner = Learner(env, build_network(quick.model, env.num_actions), quick.ppo)
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
    counts = dict.fromkeys(turns, batch)
    theirs = {} if others is None else others(env, config)
    counts |= {name: count for name, (_, count) in theirs.items()}
    turns |= {name: turn for name, (turn, _) in theirs.items()}
    seconds = take_turns(turns, rounds, median)
    import resource  # Windows has none

    expected = batch / sum(seconds[part] for part in ("bare Batch loop", "inference", "update"))
    speeds = _speeds({name: (counts[name], best) for name, best in seconds.items()}, "bare Batch loop")
    return {
        "speeds": speeds,
        "expected": expected,
        "share_of_expected": speeds["PPO"]["control_steps_per_s"] / expected,
        "times_others": {name: speeds["PPO"]["ratio"] / speeds[name]["ratio"] for name in theirs},
        "parameters": size(net),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def _for_envs(config: TrainConfig, num_envs: int) -> TrainConfig:
    """The config for another number of environments, with mini-batches of the same size."""
    ppo = config.sized().ppo
    parts = max(1, ppo.mini_batches * num_envs // ppo.num_envs)
    return replace(config, ppo=replace(ppo, num_envs=num_envs, mini_batches=parts))


def _speeds(done: dict[str, tuple[int, float]], base: str) -> Speeds:
    """(control steps, s) of each → control steps per second and ratio to one of them."""
    speed = {name: count / seconds for name, (count, seconds) in done.items()}
    return {name: {"control_steps_per_s": v, "ratio": v / speed[base]} for name, v in speed.items()}


def _environment(robot: RobotSpec, model: ModelConfig, num_envs: int, nthread: int = 0) -> DeltaEnv:
    steps = round(EPISODE_S / robot.dt)
    return DeltaEnv(recordings(robot, 32), robot, model, num_envs, steps, RewardConfig(), nthread=nthread)


def _bare_loop(robot: RobotSpec, num_envs: int, steps: int, nthread: int = 0) -> Turn:
    """The same simulations without anything around them."""
    motions = [slow_sines(robot, steps + 1, seed) for seed in range(num_envs)]
    locked = idle_limbs(motions, robot)
    condition = Condition(0.0, "both", robot.dt)
    sim = BatchSim(robot, [condition] * num_envs, nthread, locked)
    ctrl = np.stack([m.ctrl for m in motions], axis=1).astype(float)[..., robot.index(sim.joint_names)]
    zero = np.zeros_like(ctrl[0])
    past = ctrl[0][:, None]

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


def _inference(learner: Learner, steps: int) -> None:
    """Features, sensors, actor and critic, nothing stored."""
    with torch.no_grad():
        for _ in range(steps):
            learner.look()


def recordings(robot: RobotSpec, count: int) -> list[Sequence]:
    """Motions as long as recorded ones."""
    return [slow_sines(robot, round(20 / robot.dt), seed) for seed in range(count)]


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
