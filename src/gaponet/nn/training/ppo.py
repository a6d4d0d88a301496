"""PPO in which each joint has its own reward, value, advantage and probability ratio.

The correction of a joint acts on the error of that joint. In a sum over the robot, the errors of
other joints would be noise in its advantage, and a common ratio would be clipped when any joint
moves. So the robot is n agents that share one network. The critic is trained alone until it
explains the returns, by its own optimiser (Andrychowicz et al. 2021). Exploration noise is
correlated in time, because a servo filters white noise (Korenkevych et al. 2019).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.data.sequence import is_same_rate
from gaponet.nn.layers import MAX_FEATURE, DeltaNet, Standardise, dense
from gaponet.nn.training.config import PPOConfig
from gaponet.nn.training.env import DeltaEnv

LEARNING_RATE_BOUNDS = (1e-6, 1e-3)  # of the actor
LEARNING_RATE_FACTOR = 1.5  # of each adaptation to desired_kl
MAX_GRADIENT_NORM = 1.0


class Critic(nn.Module):
    """Value of each joint, (B, n), from the actor's features and the observations of the critic."""

    def __init__(self, features: int, observations: int, hidden: tuple[int, ...], n: int) -> None:
        super().__init__()
        self.standardise = Standardise(observations)
        self.net = dense(features + observations, hidden, n)

    def forward(self, features: Tensor, observations: Tensor) -> Tensor:
        standardised = self.standardise(observations).clamp(-MAX_FEATURE, MAX_FEATURE)
        result: Tensor = self.net(torch.cat([features, standardised], dim=1))
        return result


@dataclass
class Batch:
    """Decisions of all environments; B rows.

    Attributes:
        prepared: Actor inputs, as `DeltaNet.prepare` returns them.
        features: Features of the actor inputs.
        critic_observations: Observations of the critic.
        mean: Corrections without exploration, (B, n) rad.
        actions: Corrections with the new part of the exploration noise, (B, n) rad.
        exploration_mask: 1 where a joint explores, (B, n). Other joints do not contribute to the
            gradient.
        advantage, returns: One value per joint, (B, n).
    """

    prepared: Tensor
    features: Tensor
    critic_observations: Tensor
    mean: Tensor
    actions: Tensor
    exploration_mask: Tensor
    advantage: Tensor
    returns: Tensor


@dataclass
class Update:
    """Metrics of one update."""

    # Share of the variance of the returns that the critic explains.
    explained_variance: float = float("nan")
    kl: float = float("nan")  # KL divergence of the actor's step, per joint
    learning_rate: float = float("nan")
    critic_learning_rate: float = float("nan")
    mean_delta: float = float("nan")  # mean |Δa|, rad
    at_limit: float = float("nan")  # share of corrections at or beyond Δ_max
    reward: float = float("nan")  # mean reward of a joint and control period


def _control_period(env: DeltaEnv) -> float:
    """Return the mean control period of the environments, s: the robot's own where recordings have
    its rate.
    """
    mean = float(np.mean([condition.dt for condition in env.groups.conditions_of_envs]))
    return env.robot.dt if is_same_rate(mean, env.robot.dt) else mean


class PPO:
    """Actor, critic and environment. `update` collects decisions and learns from them."""

    def __init__(self, env: DeltaEnv, net: DeltaNet, config: PPOConfig) -> None:
        """net: The actor; it is trained in place, except its sensor predictor."""
        self.env = env
        self.net = net.train()
        self.config = config
        if net.predictor is not None:
            net.predictor.requires_grad_(False)
        observations = env.get_observations()["critic"]
        device = observations.device
        width = observations.shape[1]
        critic = Critic(net.features.dim, width, config.critic_hidden, env.num_actions)
        self.critic = critic.to(device)
        trained = [p for p in net.parameters() if p.requires_grad]
        self.optimiser = torch.optim.Adam(trained, lr=config.learning_rate)
        self.critic_optimiser = torch.optim.Adam(
            self.critic.parameters(), lr=config.critic_learning_rate
        )
        decision_s = _control_period(env) * env.config.delta_hold
        self.noise_correlation = 0.0  # from decision to decision
        if config.noise_time:
            self.noise_correlation = math.exp(-decision_s / config.noise_time)
        self.noise = torch.zeros(env.num_envs, env.num_actions, device=device)
        self.updates = 0
        self.actor_enabled = False
        self.metrics = Update()

    @property
    def innovation_std(self) -> float:
        """Standard deviation of the new part of the exploration noise in each decision, rad."""
        config = self.config
        halvings = self.updates / config.std_half_life if config.std_half_life else 0.0
        std = max(config.std * 0.5**halvings, min(config.std, config.std_end))
        result: float = std * math.sqrt(1 - self.noise_correlation**2)
        return result

    def update(self) -> Update:
        """Collect num_steps decisions of each environment and learn from them."""
        batch = self.collect()
        self.learn(batch)
        self.updates += 1
        return self.metrics

    def observe(self) -> dict[str, Tensor]:
        """Return inputs, mean correction and value of the present states."""
        observed = self.env.get_observations()
        x = observed["actor"]
        observations = observed["critic"]
        if not self.updates and not self.critic.standardise.mean.any():
            self.critic.standardise.fit(observations)
        prepared = self.net.prepare(x)
        features = self.net.features(x)
        return {
            "prepared": prepared,
            "features": features,
            "critic_observations": observations,
            "mean": self.net.correct(prepared),
            "value": self.critic(features, observations),
        }

    def collect(self) -> Batch:
        """Simulate with the present network; return the decisions and their advantages."""
        env = self.env
        config = self.config
        mask = (torch.rand_like(self.noise) < config.noise_share).float()
        self.noise *= mask
        rows: list[dict[str, Tensor]] = []
        gamma = config.gamma**env.config.delta_hold  # per decision
        with torch.no_grad():
            for _ in range(config.num_steps):
                row = self.observe()
                correlated = self.noise_correlation * self.noise
                self.noise = correlated + self.innovation_std * mask * torch.randn_like(correlated)
                delta = row["mean"] + self.noise
                reward, done = env.step(delta)
                reward = torch.as_tensor(reward)
                row["actions"] = delta - correlated
                row["exploration_mask"] = mask
                row["done"] = torch.as_tensor(done).float()[:, None]
                # The end of a recording is a time-out: the value of the last state stands for the
                # rewards to come.
                row["reward"] = (1 - gamma) * reward + gamma * row["value"] * row["done"]
                rows.append(row)
            steps = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
            last = self.observe()["value"]
            steps["advantage"] = advantages(
                steps["reward"], steps["value"], last, steps["done"], gamma, config.lam
            )
            steps["returns"] = steps["advantage"] + steps["value"]
            self._measure(steps)
        decisions = {}
        for name in Batch.__dataclass_fields__:
            decisions[name] = steps[name].flatten(0, 1).clone()
        return Batch(**decisions)

    def _measure(self, steps: dict[str, Tensor]) -> None:
        """Measure the collected decisions; enable the actor if the critic explains the returns."""
        residual = (steps["returns"] - steps["value"]).flatten(0, 1).var(0)
        unexplained = residual / steps["returns"].flatten(0, 1).var(0)
        size = steps["mean"].abs()
        at_limit = (size >= self.env.config.delta_max).float().mean()
        explained = 1 - float(unexplained.mean())
        self.metrics = Update(
            explained_variance=explained,
            mean_delta=float(size.mean()),
            at_limit=float(at_limit),
            reward=float(self.env.reward.take_mean()),
        )
        is_warm = self.updates >= self.config.critic_warmup
        if is_warm and explained >= self.config.explained:
            self.actor_enabled = True

    def learn(self, batch: Batch) -> None:
        """Fit the critic, and the actor once the critic explains the returns."""
        config = self.config
        mask = batch.exploration_mask
        count = mask.sum(0).clamp_min(1.0)  # with few environments, no one may explore with a joint
        centred = batch.advantage - (mask * batch.advantage).sum(0) / count
        batch.advantage = centred / ((mask * centred**2).sum(0) / count).sqrt().clamp_min(1e-8)
        divergences = []
        for _ in range(config.epochs):
            shuffled = torch.randperm(len(centred), device=centred.device)
            for rows in shuffled.chunk(config.mini_batches):
                value = self.critic(batch.features[rows], batch.critic_observations[rows])
                self._descend(self.critic_optimiser, (value - batch.returns[rows]).square().mean())
                if self.actor_enabled:
                    divergences.append(self._actor_step(batch, rows))
        self.metrics.kl = sum(divergences) / max(len(divergences), 1)
        self.metrics.learning_rate = 0.0
        if self.actor_enabled:
            self.metrics.learning_rate = self.optimiser.param_groups[0]["lr"]
        self.metrics.critic_learning_rate = self.config.critic_learning_rate

    def _actor_step(self, batch: Batch, rows: Tensor) -> float:
        """Take one gradient step.

        Return the KL divergence from the collecting network, per exploring joint.
        """
        mean = self.net.correct(batch.prepared[rows])
        old = batch.mean[rows]
        actions = batch.actions[rows]
        mask = batch.exploration_mask[rows]
        weight = mask / mask.sum().clamp_min(1.0)
        twice_variance = 2 * self.innovation_std**2
        ratio = (((actions - old) ** 2 - (actions - mean) ** 2) / twice_variance).exp()
        clipped = ratio.clamp(1 - self.config.clip, 1 + self.config.clip)
        advantage = batch.advantage[rows]
        surrogate = torch.minimum(ratio * advantage, clipped * advantage)
        self._descend(self.optimiser, -(weight * surrogate).sum())
        kl = float((weight * (mean.detach() - old) ** 2).sum()) / twice_variance
        lowest, highest = LEARNING_RATE_BOUNDS
        for group in self.optimiser.param_groups:
            if kl > 2 * self.config.desired_kl:
                group["lr"] = max(lowest, group["lr"] / LEARNING_RATE_FACTOR)
            elif kl < self.config.desired_kl / 2:
                group["lr"] = min(highest, group["lr"] * LEARNING_RATE_FACTOR)
        return kl

    @staticmethod
    def _descend(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        parameters = []
        for group in optimiser.param_groups:
            parameters += group["params"]
        nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM)
        optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """Return the state without network and environment, for a checkpoint."""
        return {
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "noise": self.noise,
            "updates": self.updates,
            "ready": self.actor_enabled,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.critic_optimiser.load_state_dict(state["critic_optimiser"])
        self.noise.copy_(state["noise"])
        self.updates = state["updates"]
        self.actor_enabled = state["ready"]


def advantages(
    reward: Tensor, value: Tensor, last: Tensor, done: Tensor, gamma: float, lam: float
) -> Tensor:
    """Return generalised advantage estimates (Schulman et al. 2016), (T, N, n).

    Args:
        reward: (T, N, n). The reward of a recording's last step includes the discounted value of
            that step.
        value: (T, N, n), before each step.
        last: Value after the last step, (N, n).
        done: 1 where a recording ended, (T, N, 1).
        gamma: Discount per step.
        lam: λ.
    """
    estimates = torch.empty_like(reward)
    following = torch.zeros_like(last)
    for t in reversed(range(len(reward))):
        continues = 1 - done[t]
        temporal_difference = reward[t] + gamma * continues * last - value[t]
        following = temporal_difference + gamma * lam * continues * following
        estimates[t] = following
        last = value[t]
    return estimates
