"""PPO by rsl_rl: our network as its actor, our environment as its VecEnv, one update at a time."""

from __future__ import annotations

import contextlib
import io
import math
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import nn

from gaponet.model.layers import DeltaNet
from gaponet.training.config import PPOConfig
from gaponet.training.env import DeltaEnv

STD_RANGE = (0.001, math.exp(-1))  # rad


class PreparedEnv(VecEnv):
    """An environment whose actor observation is what the network prepares from it.

    Features and sensors are not trained here, so each sample passes them once, not once in every epoch of every update.
    """

    def __init__(self, env: DeltaEnv, net: DeltaNet) -> None:
        self.env, self.net = env, net
        self.num_envs, self.num_actions, self.device, self.cfg = env.num_envs, env.num_actions, env.device, env.cfg
        self.max_episode_length, self.episode_length_buf = env.max_episode_length, env.episode_length_buf

    def get_observations(self) -> TensorDict:
        """Groups "actor", flattened, and "critic"."""
        return self._prepared(self.env.get_observations())

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Step the environment."""
        obs, reward, done, extras = self.env.step(actions)
        return self._prepared(obs), reward, done, extras

    def _prepared(self, obs: TensorDict) -> TensorDict:
        with torch.inference_mode():
            actor = self.net.prepare(obs["actor"]).flatten(1)
        return TensorDict({"actor": actor, "critic": obs["critic"]}, batch_size=obs.batch_size)


class Correct(nn.Module):
    """The trained part of a network on flattened prepared inputs."""

    def __init__(self, net: DeltaNet) -> None:
        super().__init__()
        self.net = net
        with torch.inference_mode():
            self.shape = net.prepare(torch.zeros(1, net.config.input_dim(net.n))).shape[1:]

    def forward(self, prepared: torch.Tensor) -> torch.Tensor:
        """(B, …) flattened → Δa, (B, n) rad."""
        return self.net.correct(prepared.reshape(-1, *self.shape))


class DeltaActor(MLPModel):
    """rsl_rl's model with its MLP swapped for ours; normalisers are inside ours."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        net: DeltaNet,
        distribution_cfg: dict[str, Any],
    ) -> None:
        super().__init__(obs, obs_groups, obs_set, output_dim, hidden_dims=(1,), distribution_cfg=distribution_cfg)
        self.mlp = Correct(net)

    def get_latent(self, obs: TensorDict, masks: torch.Tensor | None = None, hidden_state: Any = None) -> torch.Tensor:
        """The one observation group as it is; rsl_rl would copy it."""
        return obs["actor"]


def make_runner(env: DeltaEnv, net: DeltaNet, ppo: PPOConfig) -> OnPolicyRunner:
    """A silent runner that trains a copy of net, its sensor predictor excepted; call `update` for one iteration."""
    prepared = PreparedEnv(env, net)
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the models
        runner = OnPolicyRunner(prepared, _runner_config(net, ppo), log_dir=None, device="cpu")
    prepared.net = trained_by(runner)
    if prepared.net.predictor is not None:
        prepared.net.predictor.requires_grad_(False)
    return runner


def trained_by(runner: OnPolicyRunner) -> DeltaNet:
    """The network that a runner trains."""
    return runner.alg.actor.mlp.net


def update(runner: OnPolicyRunner) -> None:
    """Run one PPO iteration: num_steps control periods in every environment, then the update."""
    runner.learn(1)


def _runner_config(net: DeltaNet, ppo: PPOConfig) -> dict[str, Any]:
    return {
        "num_steps_per_env": ppo.num_steps,
        "save_interval": 10**9,
        "check_for_nan": True,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {
            "class_name": DeltaActor,
            "net": net,
            "distribution_cfg": {
                "class_name": "GaussianDistribution",
                "init_std": ppo.init_std,
                "std_range": STD_RANGE,
                "std_type": "log",
            },
        },
        "critic": {
            "class_name": "MLPModel",
            "hidden_dims": ppo.critic_hidden,
            "activation": "elu",
            "obs_normalization": True,
        },
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.mini_batches,
            "learning_rate": ppo.learning_rate,
            "desired_kl": ppo.desired_kl,
            "gamma": ppo.gamma**net.config.delta_hold,  # a step is a decision
            "lam": ppo.lam,
            "clip_param": ppo.clip,
            "entropy_coef": 0.0,
            "max_grad_norm": 1.0,
            "schedule": "adaptive",
        },
    }
