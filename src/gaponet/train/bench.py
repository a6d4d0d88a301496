"""How much of the simulator's speed is left: bare Batch loop, replay and environment, interleaved in one run."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.model.config import ModelConfig
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.replay import replay
from gaponet.train.config import RewardConfig
from gaponet.train.env import DeltaEnv

Array = np.ndarray


def bench_sim(robot: RobotSpec, num_envs: int = 512, steps: int = 40, rounds: int = 15) -> dict[str, dict[str, float]]:
    """Control steps per second of each, and its ratio to the bare loop.

    The three take turns, so that a machine that slows down slows all of them; of each the fastest turn counts, since
    other work on the machine only ever adds time.

    Args:
        robot: The robot.
        num_envs: Simulations side by side.
        steps: Control periods per turn.
        rounds: Turns each.
    """
    sequences = [_wander(robot, steps + 1, seed) for seed in range(num_envs)]
    conditions = [(0.0, "both", robot.dt)] * num_envs
    ctrl = np.stack([s.ctrl for s in sequences], axis=1).astype(float)
    loop = BatchSim(robot, conditions)
    motions = [_wander(robot, round(20 / robot.dt), seed) for seed in range(32)]  # as long as recorded ones
    env = DeltaEnv(motions, robot, ModelConfig(), num_envs, 10**9, RewardConfig())
    idle = torch.zeros(num_envs, env.num_actions)

    def run_bare() -> None:
        loop.reset(slice(None), ctrl[0], np.zeros_like(ctrl[0]))
        for t in range(steps):
            loop.ctrl[:] = ctrl[t]
            loop.batch.step(nstep=robot.decimation)

    def run_env() -> None:
        for _ in range(steps):
            env.step(idle)

    turns: dict[str, Callable[[], object]] = {
        "bare Batch loop": run_bare, "replay": lambda: replay(sequences, robot), "environment step": run_env,
    }  # fmt: skip
    seconds: dict[str, list[float]] = {name: [] for name in turns}
    for _ in range(rounds + 1):
        for name, turn in turns.items():
            start = time.perf_counter()
            turn()
            seconds[name].append(time.perf_counter() - start)
    speed = {name: num_envs * steps / min(s[1:]) for name, s in seconds.items()}
    bare_speed = speed["bare Batch loop"]
    return {name: {"control_steps_per_s": v, "ratio": v / bare_speed} for name, v in speed.items()}


def _wander(robot: RobotSpec, rows: int, seed: int) -> Sequence:
    """A slow random motion about home."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows)[:, None] * robot.dt
    n = len(robot.joint_names)
    low, high = np.clip(robot.qpos_range.T, -1.5, 1.5)
    wave = np.sin(2 * np.pi * rng.uniform(0.2, 1.0, n) * t + rng.uniform(0, 2 * np.pi, n))
    ctrl = np.clip(robot.qpos_home + 0.3 * wave, low, high)
    meta = SequenceMeta(robot.name, "bench", f"wander-{seed}", 0.0, virtual=True)
    return Sequence(meta, robot.joint_names, robot.dt, ctrl, ctrl, np.gradient(ctrl, robot.dt, axis=0))
