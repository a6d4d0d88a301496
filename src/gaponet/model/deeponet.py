"""Networks: sensor predictor, branch, trunk, their inner product; and the MLP baseline on the same features.

All take x = [o_t | a_t] and return Δa_t; normalisers are buffers inside, so the exported file needs nothing beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gaponet.model.config import ModelConfig


def dense(inputs: int, hidden: Sequence[int], outputs: int, zero: bool = False) -> nn.Sequential:
    """Linear layers with ELU between; with `zero` it starts by answering 0."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU()]
        inputs = width
    head = nn.Linear(inputs, outputs)
    if zero:
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
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
    """Δ_max · tanh(gain · y / Δ_max): near the identity for small corrections, never more than Δ_max.

    The gain is 1 while training; train/gain.py lowers it where less of a correction does better.
    """

    gain: Tensor

    def __init__(self, delta_max: float) -> None:
        super().__init__()
        self.delta_max = delta_max
        self.register_buffer("gain", torch.tensor(1.0))

    def forward(self, y: Tensor) -> Tensor:
        return self.delta_max * torch.tanh(self.gain * y / self.delta_max)


class OperatorNet(nn.Module):
    """Δa = bounded(⟨branch(sensors), trunk(a, P)⟩ + c), an unstacked DeepONet.

    Coupling "joint": one branch and one trunk, shared by all joints, take what belongs to a joint and its name.
    What other joints do reaches it through its sensors. Coupling "full": the paper's, every joint sees every joint.
    """

    which: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config, self.n = config, n
        self.features = Features(config, n)
        self.predictor = SensorPredictor(config, n) if config.sensors == "predicted" else None
        self.sees_observation = config.branch_history or self.predictor is None
        self.per_joint = config.joint_wise
        self.register_buffer("which", torch.eye(n), persistent=False)
        sensed, seen, asked = self.input_dims(config, n)
        outputs = config.num_basis * (1 if self.per_joint else n)
        self.branch = dense(
            sensed * (self.predictor is not None) + seen * self.sees_observation + n * self.per_joint,
            config.branch_hidden,
            outputs,
        )
        self.trunk = dense(asked + n * self.per_joint, config.trunk_hidden, outputs, zero=True)
        self.bias = nn.Parameter(torch.zeros(n))
        self.bounded = Bounded(config.delta_max)
        # Supervised fitting samples the predictor, so that the branch does not trust a number that the predictor is
        # unsure of. PPO and run time take its mean: PPO's ratio needs a policy mean that is the same when asked twice.
        self.sample_sensors = False

    @staticmethod
    def input_dims(config: ModelConfig, n: int) -> tuple[int, int, int]:
        """Numbers of sensors, observation and query that one pass of branch and trunk sees, joint names aside."""
        payload = int(config.payload_input)
        if config.joint_wise:
            return 2 * config.num_probes, 2 + 3 * config.history + payload, 1 + payload
        return config.sensor_dim(n), config.observation_dim(n), 2 * n + payload

    def forward(self, x: Tensor) -> Tensor:
        """x = [o_t | a_t], (B, observation_dim + n) → Δa, (B, n), rad."""
        z = self.features(x)
        sensors = self.sensors(z) if self.predictor is not None else None
        see, ask = (self._joint_inputs if self.per_joint else self._full_inputs)(z, sensors)
        shape = (-1, self.n, self.config.num_basis)
        branch, trunk = self.branch(see).reshape(shape), self.trunk(ask).reshape(shape)
        return self.bounded((branch * trunk).sum(-1) + self.bias)

    def sensors(self, z: Tensor) -> Tensor:
        """Predicted sensor values, standardised, (B, 2nm): all probes, each n positions and n velocities."""
        assert self.predictor is not None
        mean, log_var = self.predictor(z)
        return mean + torch.randn_like(mean) * (0.5 * log_var).exp() if self.sample_sensors else mean

    def _full_inputs(self, z: Tensor, sensors: Tensor | None) -> tuple[Tensor, Tensor]:
        n = self.n
        see = ([] if sensors is None else [sensors]) + ([z[:, :-n]] if self.sees_observation else [])
        # The query a_t reads as (a_t, a_t − q_t): q_t + (a_t − q_t), both standardised, span the action.
        ask = [z[:, :n], z[:, -n:]] + ([z[:, -n - 1 : -n]] if self.config.payload_input else [])
        return torch.cat(see, dim=1), torch.cat(ask, dim=1)

    def _joint_inputs(self, z: Tensor, sensors: Tensor | None) -> tuple[Tensor, Tensor]:
        n, past = self.n, self.n * (2 + 3 * self.config.history)
        which = self.which.expand(z.shape[0], n, n)
        payload = [z[:, past : past + 1].unsqueeze(1).expand(-1, n, 1)] if self.config.payload_input else []
        see = [which]
        if sensors is not None:
            see.append(sensors.reshape(-1, 2 * self.config.num_probes, n).transpose(1, 2))
        if self.sees_observation:
            see += [z[:, :past].reshape(-1, 2 + 3 * self.config.history, n).transpose(1, 2), *payload]
        return torch.cat(see, dim=2), torch.cat([which, z[:, -n:].unsqueeze(2), *payload], dim=2)


class DeltaMLP(nn.Module):
    """Baseline: a plain network on the same features, ASAP's form."""

    predictor = None
    sample_sensors = False

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config, self.n = config, n
        self.features = Features(config, n)
        self.net = dense(self.features.dim, config.mlp_hidden, n, zero=True)
        self.bounded = Bounded(config.delta_max)

    def forward(self, x: Tensor) -> Tensor:
        """x = [o_t | a_t] → Δa, (B, n), rad."""
        return self.bounded(self.net(self.features(x)))


def build_network(config: ModelConfig, n: int) -> OperatorNet | DeltaMLP:
    """The network a config describes, for n operated joints."""
    return OperatorNet(config, n) if config.kind == "gaponet" else DeltaMLP(config, n)
