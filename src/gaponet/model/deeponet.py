"""Networks: sensor predictor, branch, trunk, their inner product; and the MLP baseline on the same features.

All take x = [o_t | a_t] and return Δa_t; normalisers are buffers inside, so the exported file needs nothing beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gaponet.model.config import ModelConfig


def dense(inputs: int, hidden: Sequence[int], outputs: int, last: float | None = None) -> nn.Sequential:
    """Linear layers with ELU between; the last one starts within ±`last` where that is given."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU()]
        inputs = width
    head = nn.Linear(inputs, outputs)
    if last is not None:
        nn.init.uniform_(head.weight, -last, last)
        nn.init.uniform_(head.bias, -last, last)
    return nn.Sequential(*layers, head)


class Standardise(nn.Module):
    """(x − mean) / std with statistics of the training set; std has a floor so that a constant input stays harmless."""

    mean: Tensor
    std: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    def fit(self, x: Tensor, floor: float = 1e-4) -> None:
        """Take mean and std from samples, (N, dim)."""
        self.mean.copy_(x.mean(0))
        self.std.copy_(x.std(0).clamp_min(floor))

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std


class Features(nn.Module):
    """[o_t | a_t] with history and action expressed relative to the present position, then standardised.

    A lag of 10 mrad is invisible in absolute joint angles that span a radian; relative to q_t it is the signal.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.n, self.history = n, config.history
        self.dim = config.observation_dim(n) + n
        self.standardise = Standardise(self.dim)

    def relative(self, x: Tensor) -> Tensor:
        """(B, dim) → (B, dim): positions and targets of the past, and a_t, minus q_t."""
        n = self.n
        q, v, action = x[:, :n], x[:, n : 2 * n], x[:, -n:]
        frames = x[:, 2 * n : 2 * n + 3 * n * self.history].reshape(-1, self.history, 3, n)
        shift = torch.stack([q, torch.zeros_like(q), q], dim=1).unsqueeze(1)  # (B, 1, 3, n)
        past = (frames - shift).flatten(1)
        rest = x[:, 2 * n + 3 * n * self.history : -n]  # payload, if observed
        return torch.cat([q, v, past, rest, action - q], dim=1)

    def forward(self, x: Tensor) -> Tensor:
        """Standardised and kept within ±5: a pose or speed never seen in training must not reach a network as 50 σ."""
        return self.standardise(self.relative(x)).clamp(-5.0, 5.0)


class SensorPredictor(nn.Module):
    """f_φ(o_t) → mean and log-variance of the standardised sensor values, (B, 2nm) each."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.n = n
        self.outputs = Standardise(config.sensor_dim(n))
        self.net = dense(config.observation_dim(n), config.sensor_hidden, 2 * config.sensor_dim(n))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Takes standardised features; the action, their last n columns, is not looked at."""
        mean, log_var = self.net(features[:, : -self.n]).chunk(2, dim=1)
        return mean, log_var.clamp(-10.0, 4.0)


class Bounded(nn.Module):
    """Δ_max · tanh(y / Δ_max): the identity for small corrections, never more than Δ_max."""

    def __init__(self, delta_max: float) -> None:
        super().__init__()
        self.delta_max = delta_max

    def forward(self, y: Tensor) -> Tensor:
        return self.delta_max * torch.tanh(y / self.delta_max)


class OperatorNet(nn.Module):
    """Δa = bounded(⟨branch(sensors), trunk(a, P)⟩ + c), an unstacked DeepONet."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config, self.n = config, n
        self.features = Features(config, n)
        self.predictor = SensorPredictor(config, n) if config.sensors == "predicted" else None
        seen = config.observation_dim(n) if (config.branch_history or self.predictor is None) else 0
        sensed = config.sensor_dim(n) if self.predictor is not None else 0
        self.sees_observation = seen > 0
        self.branch = dense(sensed + seen, config.branch_hidden, n * config.num_basis)
        self.query_dim = 2 * n + int(config.payload_input)
        self.trunk = dense(self.query_dim, config.trunk_hidden, n * config.num_basis, last=0.003)
        self.bias = nn.Parameter(torch.zeros(n))
        self.bounded = Bounded(config.delta_max)
        # Supervised fitting samples the predictor, so that the branch does not trust a number that the predictor is
        # unsure of. PPO and run time take its mean: PPO's ratio needs a policy mean that is the same when asked twice.
        self.sample_sensors = False

    def forward(self, x: Tensor) -> Tensor:
        """x = [o_t | a_t], (B, observation_dim + n) → Δa, (B, n), rad."""
        n, z = self.n, self.features(x)
        parts = []
        if self.predictor is not None:
            mean, log_var = self.predictor(z)
            if self.sample_sensors:
                mean = mean + torch.randn_like(mean) * (0.5 * log_var).exp()
            parts.append(mean)
        if self.sees_observation:
            parts.append(z[:, :-n])
        branch = self.branch(torch.cat(parts, dim=1)).reshape(-1, n, self.config.num_basis)
        # The query a_t reads as (a_t, a_t − q_t): q_t + (a_t − q_t), both standardised, span the action.
        query = [z[:, :n], z[:, -n:]] + ([z[:, -n - 1 : -n]] if self.config.payload_input else [])
        trunk = self.trunk(torch.cat(query, dim=1)).reshape(-1, n, self.config.num_basis)
        return self.bounded((branch * trunk).sum(-1) + self.bias)


class DeltaMLP(nn.Module):
    """Baseline: a plain network on the same features, ASAP's form."""

    predictor = None
    sample_sensors = False

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config, self.n = config, n
        self.features = Features(config, n)
        self.net = dense(self.features.dim, config.mlp_hidden, n, last=0.003)
        self.bounded = Bounded(config.delta_max)

    def forward(self, x: Tensor) -> Tensor:
        """x = [o_t | a_t] → Δa, (B, n), rad."""
        return self.bounded(self.net(self.features(x)))


def build_network(config: ModelConfig, n: int) -> OperatorNet | DeltaMLP:
    """The network a config describes, for n operated joints."""
    return OperatorNet(config, n) if config.kind == "gaponet" else DeltaMLP(config, n)
