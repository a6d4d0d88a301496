"""What every network here is made of: dense layers, the features of x, the bound on Δa, and the form they share.

All take x = [o_t | a_t | more] (nn/observation.py) and return Δa_t; normalisers are buffers inside, so the exported
file needs nothing beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import Layout

CLAMP = 5.0  # standard deviations: a feature further off is taken to be here


def dense(inputs: int, hidden: Sequence[int], outputs: int, zero: bool = False) -> nn.Sequential:
    """Linear layers with ELU between; with `zero` it starts by answering 0."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU(inplace=True)]  # in place: half the memory traffic
        inputs = width
    head = nn.Linear(inputs, outputs)
    if zero:
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
    return nn.Sequential(*layers, head)


def size(net: nn.Module) -> int:
    """Number of parameters."""
    return sum(p.numel() for p in net.parameters())


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

    noise = 0.0
    """σ of what is added while a network is fitted to labels, in standard deviations of each feature. Without it a
    network reads the label off what the label did: off targets applied before, or off how far a joint is behind."""

    joint: Tensor
    moves: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.n, self.history = n, config.history
        self.layout = Layout(config, n)
        self.dim = self.layout.query.stop
        self.standardise = Standardise(self.dim)
        moved = self.layout.shifted(np.eye(n))[:, self.layout.query]  # by each joint's position
        moved[:, self.layout.q] = 0.0
        self.register_buffer("joint", torch.from_numpy(moved.argmax(0)), persistent=False)
        self.register_buffer("moves", torch.from_numpy(moved.max(0)).float(), persistent=False)

    def relative(self, x: Tensor) -> Tensor:
        """(B, dim of x) → (B, dim): positions and targets of the past, and a_t, minus q_t."""
        return x[:, self.layout.query] - x.index_select(1, self.joint) * self.moves

    def forward(self, x: Tensor) -> Tensor:
        """Standardised and kept within ±5: a pose or speed never seen in training must not reach a network as 50 σ."""
        z = self.standardise(self.relative(x)).clamp(-CLAMP, CLAMP)
        return z + self.noise * torch.randn_like(z) if self.noise else z


class _Bounded(nn.Module):
    """Δ_max · tanh(gain · unit · y / Δ_max): near gain · unit · y for small corrections, never more than Δ_max.

    A hard bound is gain · unit · y, clipped outside training (the environment clips in training).

    The unit, rad, is what labels usually are, so that y is a number near 1 whatever the robot. The gain is 1 while
    training; nn/training/validation.py lowers it where less of a correction does better.
    """

    gain: Tensor
    unit: Tensor

    def __init__(self, delta_max: float, hard: bool) -> None:
        super().__init__()
        self.delta_max, self.hard = delta_max, hard
        self.register_buffer("gain", torch.tensor(1.0))
        self.register_buffer("unit", torch.tensor(1.0))

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        state.setdefault(prefix + "unit", torch.tensor(1.0))  # checkpoints of before there was one
        super()._load_from_state_dict(state, prefix, *rest)

    def forward(self, y: Tensor) -> Tensor:
        if self.hard:
            delta = self.gain * self.unit * y
            return delta if self.training else delta.clamp(-self.delta_max, self.delta_max)
        return self.delta_max * torch.tanh(self.gain * self.unit / self.delta_max * y)


class DeltaNet(nn.Module):
    """A network that corrects: x = [o_t | a_t] → Δa, (B, n) rad, within ±Δ_max.

    In two parts: `prepare`, which PPO leaves as it is and therefore does once for each sample, and `correct`.
    """

    predictor: Any
    """A network that answers in the simulator's place: fitted before all else (nn/training/sensor_fit.py), then
    frozen."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.config, self.n = config, n
        self.features = Features(config, n)
        self.bounded = _Bounded(config.delta_max, hard=config.kind == "paper")
        self.predictor = None

    def fit_inputs(self, x: Tensor) -> None:
        """Take the statistics of inputs from samples of x."""
        self.features.standardise.fit(self.features.relative(x))

    def sensor_inputs(self, x: Tensor) -> Tensor:
        """x → what the sensor predictor sees, (B, …)."""
        return self.features(x)[:, self.features.layout.observation]

    def prepare(self, x: Tensor) -> Tensor:
        """x → what `correct` is given, (B, …)."""
        return self.arrange(self.features(x))

    def arrange(self, z: Tensor) -> Tensor:
        """Features → what `correct` is given: columns of z, and constants, in another order."""
        return z

    def correct(self, prepared: Tensor) -> Tensor:
        """What `prepare` made → Δa, (B, n) rad."""
        raise NotImplementedError

    def forward(self, x: Tensor) -> Tensor:
        """x → Δa, (B, n) rad."""
        return self.correct(self.prepare(x))
