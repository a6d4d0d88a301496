"""PPO's speed against stable-baselines3 on the same task: batched as ours, and one simulation per process.

    python benchmarks/sb3.py [--robot so101] [--model gaponet] [--num-envs 1024] [--rounds 3]

All take turns with the parts of `speed.py train` in one run. stable-baselines3 and gymnasium are the `bench` extra.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from functools import partial
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from speed import Turn, bench_train, recordings
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from torch import nn

from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import dense, size
from gaponet.nn.loop import DeltaLoop
from gaponet.nn.networks import DeltaMLP, build_network
from gaponet.nn.observation import History
from gaponet.nn.training.config import RewardConfig, TrainConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import build_model
from gaponet.sim.replay import idle_limbs

Array = np.ndarray

THEIR_BATCH = 64  # samples in a mini-batch, where nothing else is said
REWARD = RewardConfig()
PROCESSES = 8
PROCESS_STEPS = 256  # control periods per update and process


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="so101")
    parser.add_argument("--model", default="gaponet", choices=("gaponet", "mlp"))
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    robot, ends = load_robot(args.robot), list[Callable[[], None]]()

    def others(env: DeltaEnv, config: TrainConfig) -> dict[str, tuple[Turn, int]]:
        found, close = learners(robot, env, config)
        ends.append(close)
        return found

    try:
        print(json.dumps(
            bench_train(robot, TrainConfig(ModelConfig(args.model)), args.num_envs, args.rounds, others), indent=1
        ))  # fmt: skip
    finally:
        for close in ends:
            close()


def learners(
    robot: RobotSpec, env: DeltaEnv, config: TrainConfig
) -> tuple[dict[str, tuple[Turn, int]], Callable[[], None]]:
    """Name → a turn and its control steps; and what ends the processes. Mini-batches of 64, unless said otherwise."""
    batch = env.num_envs * config.ppo.num_steps
    ours = batch // config.ppo.mini_batches
    models = {
        "stable-baselines3": (batched(env, config, THEIR_BATCH), batch),
        f"… with mini-batches of {ours:,}": (batched(env, config, ours), batch),
    }
    if config.model.kind != "mlp":
        n = env.num_actions
        weights = size(build_network(config.model, n))
        hidden = DeltaMLP.matched_hidden(config.model.mlp_hidden, weights, lambda w: DeltaMLP(config.model, n, w))
        models["… and an MLP of as many parameters"] = batched(env, config, ours, hidden), batch
    single, samples, close = separate(robot, config, recordings(robot, 8))
    models["stable-baselines3, SubprocVecEnv"] = single, samples
    return {
        name: (partial(m.learn, count, reset_num_timesteps=False), count) for name, (m, count) in models.items()
    }, close


def batched(env: DeltaEnv, config: TrainConfig, batch_size: int, hidden: tuple[int, ...] | None = None) -> PPO:
    """stable-baselines3's PPO on the environment that gaponet trains in, with the same network or with an MLP.

    Args:
        env: Ours.
        config: Network and PPO.
        batch_size: Samples in a mini-batch.
        hidden: Hidden layers of an MLP in the network's place.
    """
    return _ppo(_Batched(env), config, config.ppo.num_steps, batch_size, hidden)


def separate(robot: RobotSpec, config: TrainConfig, motions: ListOf[Sequence]) -> tuple[PPO, int, Callable[[], None]]:
    """The same on processes with one simulation each; the control steps of one of its updates; what ends them."""
    make: list[Callable[[], gymnasium.Env]] = [
        partial(SingleEnv, robot, motions, config.model, seed) for seed in range(PROCESSES)
    ]
    env = SubprocVecEnv(make, start_method="spawn")
    return _ppo(env, config, PROCESS_STEPS, THEIR_BATCH), PROCESSES * PROCESS_STEPS, env.close


class _Networks(nn.Module):
    """Our network and a critic, as stable-baselines3 wants them."""

    def __init__(self, model: ModelConfig, n: int, critic_hidden: ListOf[int]) -> None:
        super().__init__()
        self.net = build_network(model, n)
        if self.net.predictor is not None:
            self.net.predictor.requires_grad_(False)
        *hidden, last = critic_hidden
        self.critic = nn.Sequential(dense(model.input_dim(n), hidden, last), nn.ELU())
        self.latent_dim_pi, self.latent_dim_vf = n, last

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.net(x), self.critic(x)

    def forward_actor(self, x: torch.Tensor) -> torch.Tensor:
        return self.net(x)

    def forward_critic(self, x: torch.Tensor) -> torch.Tensor:
        return self.critic(x)


class SameNetwork(ActorCriticPolicy):
    """stable-baselines3's policy whose mean is our network."""

    def __init__(self, *args: Any, model: ModelConfig, critic_hidden: tuple[int, ...], **kwargs: Any) -> None:
        self.model, self.critic_hidden = model, critic_hidden
        super().__init__(*args, **kwargs)
        self.action_net = nn.Identity()

    def _build_mlp_extractor(self) -> None:
        space: Any = self.action_space
        networks: Any = _Networks(self.model, space.shape[0], self.critic_hidden)
        self.mlp_extractor = networks


def _ppo(
    env: VecEnv, config: TrainConfig, num_steps: int, batch_size: int, hidden: tuple[int, ...] | None = None
) -> PPO:
    """The same network or an MLP, everything else as in ours."""
    ppo, model = config.ppo, config.model
    policy: dict[str, Any] = {"log_std_init": math.log(ppo.std), "ortho_init": False}
    if hidden is None:
        policy |= {"model": model, "critic_hidden": ppo.critic_hidden}
    else:
        policy |= {"net_arch": {"pi": list(hidden), "vf": list(ppo.critic_hidden)}, "activation_fn": nn.ELU}
    return PPO(
        SameNetwork if hidden is None else "MlpPolicy",
        env,
        n_steps=num_steps,
        n_epochs=ppo.epochs,
        batch_size=batch_size,
        learning_rate=ppo.learning_rate,
        gamma=ppo.gamma,
        gae_lambda=ppo.lam,
        clip_range=ppo.clip,
        device="cpu",
        policy_kwargs=policy,
    )


def _spaces(config: ModelConfig, n: int) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Spaces of [o_t | a_t] and of Δa."""
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (config.observation_dim(n) + n,), np.float32),
        gymnasium.spaces.Box(-config.delta_max, config.delta_max, (n,), np.float32),
    )


class _Batched(VecEnv):
    """DeltaEnv as stable-baselines3 wants it."""

    def __init__(self, env: DeltaEnv) -> None:
        self.env = env
        super().__init__(env.num_envs, *_spaces(env.config, env.num_actions))

    def reset(self) -> Array:
        self.env.reset()
        return self.env.get_observations()["actor"].numpy()

    def step_async(self, actions: Array) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        reward, ended = self.env.step(self.actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        observed = self.env.get_observations()["actor"].numpy()
        for i in np.flatnonzero(ended):
            infos[i] = {"TimeLimit.truncated": True, "terminal_observation": observed[i]}
        return observed, reward.mean(axis=1), ended, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class SingleEnv(gymnasium.Env):
    """One simulation chasing recorded motions, written as such environments usually are: mj_step on one MjData."""

    def __init__(self, robot: RobotSpec, motions: ListOf[Sequence], config: ModelConfig, seed: int = 0) -> None:
        n = len(robot.operated)
        self.observation_space, self.action_space = _spaces(config, n)
        self.robot, self.motions, self.config = robot, motions, config
        locked = idle_limbs(motions, robot)
        self.model = build_model(robot, locked=locked, bare=True)
        self.data = mujoco.MjData(self.model)
        free = [j for j in robot.joint_names if j not in locked]
        self.free, self.op = robot.index(free), np.array([free.index(j) for j in robot.operated])
        self.low, self.high = robot.qpos_range[self.free].T
        self.loop = DeltaLoop(config, robot.qpos_range[robot.operated_index], 1)
        self.rng = np.random.default_rng(seed)
        self.steps = round(10 / robot.dt)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        self.motion = self.motions[int(self.rng.integers(len(self.motions)))]
        self.row = self.first = int(self.rng.integers(len(self.motion) - 1))
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.motion.qpos[self.row, self.free]
        self.data.qvel[:] = self.motion.qvel[self.row, self.free]
        before, op = History.rows_before(np.array([self.row]), self.loop.history.depth), self.robot.operated_index
        self.loop.begin(
            slice(None), *(x[before][..., op] for x in (self.motion.qpos, self.motion.qvel, self.motion.ctrl))
        )
        return self._observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        op, data = self.op, self.data
        target = self.motion.ctrl[self.row, self.free].astype(float)
        target[op] += action
        np.clip(target, self.low, self.high, out=target)
        self.loop.push(data.qpos[None, op], data.qvel[None, op], target[None, op])
        data.ctrl[:] = target
        mujoco.mj_step(self.model, data, self.robot.decimation)
        self.row += 1
        error = np.abs(data.qpos[op] - self.motion.qpos[self.row, self.robot.operated_index])
        reward = -float(np.minimum(error / REWARD.position, REWARD.cap).mean())
        over = self.row >= len(self.motion) - 1 or self.row - self.first >= self.steps
        return self._observe(), reward, False, over, {}

    def _observe(self) -> Array:
        op = self.op
        action = self.motion.ctrl[self.row, self.robot.operated_index]
        return self.loop.observe(self.data.qpos[None, op], self.data.qvel[None, op], action[None], 0.0)[0].copy()


if __name__ == "__main__":
    main()
