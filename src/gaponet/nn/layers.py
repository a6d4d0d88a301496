"""Parts of all networks: dense layers, features of the input x, the limit of Δa, and their common
base class.

All networks map x = [o_t | a_t | …] (nn/observation.py) to Δa_t. Normalisers are buffers, so the
exported file is complete.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import Layout

MAX_FEATURE = 5.0  # standard deviations; larger features are clamped


def dense(
    inputs: int, hidden: Sequence[int], outputs: int, zero_output: bool = False
) -> nn.Sequential:
    """Return linear layers with ELU between them. With zero_output, the initial output is 0."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers.append(nn.Linear(inputs, width))
        layers.append(nn.ELU(inplace=True))  # in place: half the memory traffic
        inputs = width
    head = nn.Linear(inputs, outputs)
    if zero_output:
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
    return nn.Sequential(*layers, head)


def num_parameters(net: nn.Module) -> int:
    """Return the number of parameters."""
    return sum(p.numel() for p in net.parameters())


class Standardise(nn.Module):
    """(x − mean) / std with statistics of the training set."""

    mean: Tensor
    std: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    def fit(self, x: Tensor, min_std: float = 1e-4) -> None:
        """Set mean and std from samples, (N, dim). The least std keeps constant inputs finite."""
        self.mean.copy_(x.mean(0))
        self.std.copy_(x.std(0).clamp_min(min_std))

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std


class Features(nn.Module):
    """[o_t | a_t] with history and action relative to the present position, standardised.

    A lag of 10 mrad is hard to see in joint angles that span a radian. Relative to q_t it is the
    signal.

    Attributes:
        noise_std: σ of the noise during supervised pre-training, in standard deviations of each
            feature; else 0.
        position_column: Column of x with the position of the same joint, per feature.
        is_position: 1 for features that are relative to that position, else 0.
    """

    position_column: Tensor
    is_position: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.noise_std = 0.0
        self.layout = Layout(config, n)
        self.dim = self.layout.query.stop
        self.standardise = Standardise(self.dim)
        # Features that a shift of each joint changes.
        moved = self.layout.shifted(np.eye(n))[:, self.layout.query]
        moved[:, self.layout.q] = 0.0
        column = torch.from_numpy(moved.argmax(0))
        is_position = torch.from_numpy(moved.max(0)).float()
        self.register_buffer("position_column", column, persistent=False)
        self.register_buffer("is_position", is_position, persistent=False)

    def relative(self, x: Tensor) -> Tensor:
        """(B, dim of x) → (B, dim): subtract q_t from past positions, past targets and a_t."""
        return x[:, self.layout.query] - x.index_select(1, self.position_column) * self.is_position

    def forward(self, x: Tensor) -> Tensor:
        """Return standardised features within ±MAX_FEATURE, because a network cannot extrapolate
        to 50 σ.
        """
        z = self.standardise(self.relative(x)).clamp(-MAX_FEATURE, MAX_FEATURE)
        if self.noise_std:
            z = z + self.noise_std * torch.randn_like(z)
        result: Tensor = z
        return result


class BoundedOutput(nn.Module):
    """Δa = Δ_max · tanh(gain · scale · y / Δ_max): gain · scale · y for small corrections, and
    never above Δ_max.

    A hard bound is gain · scale · y, clipped outside training. The environment clips in training.
    """

    # 1 in training; nn/training/validation.py lowers it if a smaller correction has a smaller error
    gain: Tensor
    scale: Tensor  # RMS of the labels, rad, so that y is of order 1 for any robot

    def __init__(self, delta_max: float, hard: bool) -> None:
        super().__init__()
        self.delta_max = delta_max
        self.hard = hard
        self.register_buffer("gain", torch.tensor(1.0))
        self.register_buffer("scale", torch.tensor(1.0))

    def forward(self, y: Tensor) -> Tensor:
        if self.hard:
            delta = self.gain * self.scale * y
            if self.training:
                return delta
            return delta.clamp(-self.delta_max, self.delta_max)
        return self.delta_max * torch.tanh(self.gain * self.scale / self.delta_max * y)


class DeltaNet(nn.Module):
    """Base class of the networks: x = [o_t | a_t | …] → Δa, (B, n) rad, within ±Δ_max.

    `prepare` has no parameters that PPO trains, so PPO evaluates it once per sample. `correct` has
    them.

    Attributes:
        predictor: Network that predicts the simulator's answers, or None. It is fitted before the
            other training (nn/training/sensor_fit.py), and then frozen.
    """

    predictor: Any

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config = config
        self.n = n
        self.features = Features(config, n)
        self.bounded = BoundedOutput(config.delta_max, hard=config.kind in ("paper", "trees"))
        self.predictor = None

    def fit_inputs(self, x: Tensor) -> None:
        """Set the statistics of the inputs from samples of x."""
        self.features.standardise.fit(self.features.relative(x))

    def sensor_inputs(self, x: Tensor) -> Tensor:
        """x → inputs of the sensor predictor, (B, …)."""
        result: Tensor = self.features(x)[:, self.features.layout.observation]
        return result

    def prepare(self, x: Tensor) -> Tensor:
        """x → input of `correct`, (B, …)."""
        return self.arrange(self.features(x))

    def arrange(self, z: Tensor) -> Tensor:
        """Features → input of `correct`: columns of z and constants in the network's order."""
        return z

    def correct(self, prepared: Tensor) -> Tensor:
        """Output of `prepare` → Δa, (B, n) rad."""
        raise NotImplementedError

    def forward(self, x: Tensor) -> Tensor:
        """x → Δa, (B, n) rad."""
        return self.correct(self.prepare(x))
