"""PPO in which every joint has its own reward, value, advantage and ratio.

What a joint's correction does shows in that joint's error. Summed over the robot, the others' errors are noise in its
advantage, and one ratio for all joints is clipped as soon as any of them moves. So the robot is n learners that share
a network. The critic learns alone until it explains the returns (Andrychowicz et al. 2021 on why it has its own
optimiser); exploration is correlated in time, since a servo filters white noise away (Korenkevych et al. 2019).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gaponet.nn.layers import DeltaNet, Standardise, dense
from gaponet.nn.training import ranks
from gaponet.nn.training.config import PPOConfig
from gaponet.nn.training.env import DeltaEnv

LOWEST, HIGHEST, FACTOR = 1e-6, 1e-3, 1.5  # bounds of the actor's step size, and its change when KL asks for one


class _Critic(nn.Module):
    """Value of each joint, (B, n), from the network's features and what only training knows."""

    def __init__(self, features: int, seen: int, hidden: tuple[int, ...], n: int) -> None:
        super().__init__()
        self.standardise, self.net = Standardise(seen), dense(features + seen, hidden, n)

    def forward(self, features: Tensor, seen: Tensor) -> Tensor:
        return self.net(torch.cat([features, self.standardise(seen).clamp(-5.0, 5.0)], dim=1))


@dataclass
class _Batch:
    """What was collected, one row per decision: targets, values and advantages are (B, n), of each joint."""

    prepared: Tensor
    features: Tensor
    seen: Tensor
    mean: Tensor
    sampled: Tensor
    """The correction less the part of its noise that was known before."""
    explored: Tensor
    """1 where the joint was disturbed; elsewhere nothing can be learned about its correction."""
    advantage: Tensor
    returns: Tensor


@dataclass
class Update:
    """What an update found. Attributes: share of the returns' variance that the critic explains; KL of the actor's
    step, per joint; step sizes; mean |Δa|, rad; share of corrections at or beyond Δ_max; mean reward."""

    explained_variance: float = float("nan")
    kl: float = float("nan")
    learning_rate: float = float("nan")
    critic_learning_rate: float = float("nan")
    mean_delta: float = float("nan")
    at_limit: float = float("nan")
    reward: float = float("nan")


class PPO:
    """A network, the environment it acts in, and a critic; `update` is one iteration."""

    def __init__(self, env: DeltaEnv, net: DeltaNet, config: PPOConfig) -> None:
        """net: Trained in place, its sensor predictor excepted."""
        self.env, self.net, self.config = env, net.train(), config
        if net.predictor is not None:
            net.predictor.requires_grad_(False)
        self.trained = [p for p in net.parameters() if p.requires_grad]
        observed = env.get_observations()
        seen = observed["critic"]
        self.critic = _Critic(net.features.dim, seen.shape[1], config.critic_hidden, env.num_actions).to(seen.device)
        ranks.spread(self.critic)
        self.optimiser = torch.optim.Adam(self.trained, lr=config.learning_rate)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=config.critic_learning_rate)
        step = env.robot.dt * env.config.delta_hold
        self.noise_correlation = math.exp(-step / config.noise_time) if config.noise_time else 0.0
        self.noise = torch.zeros(env.num_envs, env.num_actions, device=seen.device)
        self.updates, self.ready, self.found = 0, False, Update()

    @property
    def spread(self) -> float:
        """Standard deviation of what is new in the exploration of a decision, rad."""
        config = self.config
        halvings = self.updates / config.std_half_life if config.std_half_life else 0.0
        std = max(config.std * 0.5**halvings, min(config.std, config.std_end))
        return std * math.sqrt(1 - self.noise_correlation**2)

    def update(self) -> Update:
        """Run num_steps decisions in every environment, then learn from them."""
        batch = self.collect()
        self.learn(batch)
        self.updates += 1
        return self.found

    def collect(self) -> _Batch:
        """Roll out with the present network; returns what was seen and what came of it."""
        env, config = self.env, self.config
        explored = (torch.rand_like(self.noise) < config.noise_share).float()
        self.noise *= explored
        rows: list[dict[str, Tensor]] = []
        gamma = config.gamma**env.config.delta_hold  # a step is a decision
        with torch.no_grad():
            for _ in range(config.num_steps):
                row = self.look()
                known = self.noise_correlation * self.noise
                self.noise = known + self.spread * explored * torch.randn_like(known)
                delta = row["mean"] + self.noise
                reward, done = (torch.as_tensor(x) for x in env.step(delta))
                row |= {"sampled": delta - known, "explored": explored, "done": done.float()[:, None]}
                # The end of a motion is a time-out: what would have come is worth what the critic says of now.
                row["reward"] = (1 - gamma) * reward + gamma * row["value"] * row["done"]
                rows.append(row)
            seen = {name: torch.stack([r[name] for r in rows]) for name in rows[0]}
            last = self.look()["value"]
            seen["advantage"] = PPO.advantages(seen["reward"], seen["value"], last, seen["done"], gamma, config.lam)
            seen["returns"] = seen["advantage"] + seen["value"]
            self._measure(seen)
        fields = _Batch.__dataclass_fields__
        return _Batch(**{name: x.flatten(0, 1).clone() for name, x in seen.items() if name in fields})

    def look(self) -> dict[str, Tensor]:
        """What the network and the critic make of the present state."""
        observed = self.env.get_observations()
        x, seen = observed["actor"], observed["critic"]
        if not self.updates and not self.critic.standardise.mean.any():
            self.critic.standardise.fit(seen)
            ranks.pool(self.critic)
        prepared, features = self.net.prepare(x), self.net.features(x)
        return {"prepared": prepared, "features": features, "seen": seen, "mean": self.net.correct(prepared),
                "value": self.critic(features, seen)}  # fmt: skip

    def _measure(self, seen: dict[str, Tensor]) -> None:
        left = (seen["returns"] - seen["value"]).flatten(0, 1).var(0) / seen["returns"].flatten(0, 1).var(0)
        size = seen["mean"].abs()
        at_limit = (size >= self.env.config.delta_max).float().mean()
        explained, delta, limited, reward = ranks.mean(
            1 - float(left.mean()), float(size.mean()), float(at_limit), self.env.mean_reward()
        )
        found = self.found = Update(explained_variance=explained, mean_delta=delta, at_limit=limited, reward=reward)
        self.ready |= self.updates >= self.config.critic_warmup and found.explained_variance >= self.config.explained

    def learn(self, batch: _Batch) -> None:
        """Fit the critic and, once it explains the returns, move the actor."""
        config, explored = self.config, batch.explored
        count = explored.sum(0).clamp_min(1.0)  # few environments may leave a joint without any
        own = batch.advantage - (explored * batch.advantage).sum(0) / count
        batch.advantage = own / ((explored * own**2).sum(0) / count).sqrt().clamp_min(1e-8)
        distances = []
        for _ in range(config.epochs):
            for rows in torch.randperm(len(own), device=own.device).chunk(config.mini_batches):
                value = self.critic(batch.features[rows], batch.seen[rows])
                self._descend(self.critic_optimiser, (value - batch.returns[rows]).square().mean())
                if self.ready:
                    distances.append(self._move(batch, rows))
        self.found.kl = sum(distances) / max(len(distances), 1)
        self.found.learning_rate = self.optimiser.param_groups[0]["lr"] if self.ready else 0.0
        self.found.critic_learning_rate = self.config.critic_learning_rate

    def _move(self, batch: _Batch, rows: Tensor) -> float:
        """One step of the actor; returns its KL from the network that collected, per joint that explored."""
        mean, old, sampled = self.net.correct(batch.prepared[rows]), batch.mean[rows], batch.sampled[rows]
        weight = batch.explored[rows] / batch.explored[rows].sum().clamp_min(1.0)
        ratio = (((sampled - old) ** 2 - (sampled - mean) ** 2) / (2 * self.spread**2)).exp()
        clipped = ratio.clamp(1 - self.config.clip, 1 + self.config.clip)
        advantage = batch.advantage[rows]
        self._descend(self.optimiser, -(weight * torch.minimum(ratio * advantage, clipped * advantage)).sum())
        kl = ranks.mean(float((weight * (mean.detach() - old) ** 2).sum()) / (2 * self.spread**2))[0]
        for group in self.optimiser.param_groups:
            if kl > 2 * self.config.desired_kl:
                group["lr"] = max(LOWEST, group["lr"] / FACTOR)
            elif kl < self.config.desired_kl / 2:
                group["lr"] = min(HIGHEST, group["lr"] * FACTOR)
        return kl

    @staticmethod
    def _descend(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        parameters = [p for group in optimiser.param_groups for p in group["params"]]
        ranks.average(*(p.grad for p in parameters if p.grad is not None))
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()

    def state(self) -> dict[str, Any]:
        """All but the network and the environment, for a checkpoint."""
        return {
            "critic": self.critic.state_dict(), "optimiser": self.optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(), "noise": self.noise,
            "updates": self.updates, "ready": self.ready,
        }  # fmt: skip

    def load(self, state: dict[str, Any]) -> None:
        """Undo `state`."""
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.critic_optimiser.load_state_dict(state["critic_optimiser"])
        self.noise.copy_(state["noise"])
        self.updates, self.ready = state["updates"], state["ready"]

    @staticmethod
    def advantages(reward: Tensor, value: Tensor, last: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
        """Generalised advantage estimates (Schulman et al. 2016).

        Args:
            reward: (T, N, n), of a motion's last step with what is worth what would have come.
            value: (T, N, n), of the state before each step.
            last: (N, n), of the state after the last.
            done: (T, N, 1), 1 where a motion ended.
            gamma: Discount per step.
            lam: λ.
        """
        found, ahead = torch.empty_like(reward), torch.zeros_like(last)
        for t in reversed(range(len(reward))):
            goes_on = 1 - done[t]
            surprise = reward[t] + gamma * goes_on * last - value[t]
            ahead = surprise + gamma * lam * goes_on * ahead
            found[t], last = ahead, value[t]
        return found
