"""PPO by rsl_rl: our network as its actor, our environment as its VecEnv, one update at a time."""

from __future__ import annotations

import contextlib
import io
import math
from typing import Any

from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from gaponet.model.config import ModelConfig
from gaponet.model.deeponet import build_network
from gaponet.train.config import PPOConfig, TrainConfig
from gaponet.train.env import DeltaEnv

STD_RANGE = (0.001, math.exp(-1))  # rad


class DeltaActor(MLPModel):
    """rsl_rl's model with its MLP swapped for ours; normalisers are inside ours."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        model: ModelConfig,
        distribution_cfg: dict[str, Any],
    ) -> None:
        super().__init__(obs, obs_groups, obs_set, output_dim, hidden_dims=(1,), distribution_cfg=distribution_cfg)
        self.mlp = build_network(model, output_dim)


def make_runner(env: DeltaEnv, config: TrainConfig) -> OnPolicyRunner:
    """A silent runner; call `update` for one iteration. Its actor's network is `runner.alg.actor.mlp`."""
    ppo = config.ppo
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the models
        return OnPolicyRunner(env, _runner_config(config.model, ppo), log_dir=None, device="cpu")


def update(runner: OnPolicyRunner) -> None:
    """One PPO iteration: num_steps control periods in every environment, then the update."""
    runner.learn(1)


def _runner_config(model: ModelConfig, ppo: PPOConfig) -> dict[str, Any]:
    return {
        "num_steps_per_env": ppo.num_steps,
        "save_interval": 10**9,
        "check_for_nan": True,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {
            "class_name": DeltaActor,
            "model": model,
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
            "gamma": ppo.gamma**model.delta_hold,  # a step is a decision
            "lam": ppo.lam,
            "clip_param": ppo.clip,
            "entropy_coef": 0.0,
            "max_grad_norm": 1.0,
            "schedule": "adaptive",
        },
    }
