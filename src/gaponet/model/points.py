"""Learned points: a network chooses the targets that the simulator is asked about (the paper's literal reading).

The simulator cannot be differentiated, so a surrogate of it, s_ψ(o_t, e), is fitted once at random targets and frozen;
through it the supervised loss reaches the offsets. In roll-outs and at run time the simulator itself answers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gaponet.model.config import ModelConfig
from gaponet.model.layers import Standardise, dense
from gaponet.model.observation import Layout
from gaponet.model.sensor import probe_offsets

NEAR_LIMIT = 0.95  # of the limit: the fixed probes at ±probe_large are where a tanh still has a slope


class ProbePoints(nn.Module):
    """f_φ(o_t) → offsets of all joints for each probe, (B, m, n) rad, within ±probe_large; first the fixed ones."""

    start: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        self.shape, self.limit = (config.num_probes, n), config.probe_large
        self.seen = Layout(config, n).observation
        share = torch.from_numpy(probe_offsets(config, n) / self.limit).float()
        self.register_buffer("start", share.clamp(-NEAR_LIMIT, NEAR_LIMIT).atanh())
        self.net = dense(self.seen.stop, config.sensor_hidden, config.num_probes * n, zero=True)

    def forward(self, features: Tensor) -> Tensor:
        """Takes standardised features; the action is not looked at."""
        return self.limit * torch.tanh(self.start + self.net(features[:, self.seen]).reshape(-1, *self.shape))


class Surrogate(nn.Module):
    """s_ψ(o_t, e) → mean and log-variance of the standardised answers to offsets e (B, m, n), (B, m, 2n) each."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__()
        at = Layout(config, n)
        self.seen = at.observation if config.payload_predictor else slice(0, at.past.stop)  # the payload comes last
        self.limit = config.probe_large
        self.outputs = Standardise(2 * n)
        self.net = dense(self.seen.stop + n, config.sensor_hidden, 4 * n)

    def forward(self, features: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """One set of features may be asked at many offsets."""
        seen = features[:, self.seen].unsqueeze(1).expand(-1, offsets.shape[1], -1)
        mean, log_var = self.net(torch.cat([seen, offsets / self.limit], dim=2)).chunk(2, dim=2)
        return mean, log_var.clamp(-10.0, 4.0)
