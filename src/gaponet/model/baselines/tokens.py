"""The time axis of [o_t | a_t]: H past frames and the present, one token each, for baselines that read a sequence."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gaponet.model.config import ModelConfig
from gaponet.model.layers import Features


class Tokens(nn.Module):
    """Features → tokens, oldest first, the present last.

    A past frame is [q_s − q_t, q̇_s, u_s − q_t]; the present is [q_t, q̇_t, a_t − q_t, payload], and so has weights of
    its own. Where in time a token stands is a learned vector added to it.
    """

    def __init__(self, features: Features, config: ModelConfig, width: int) -> None:
        super().__init__()
        n, self.layout = features.n, features.layout
        self.count = config.history + 1
        self.past = nn.Linear(3 * n, width)
        self.present = nn.Linear(3 * n + int(config.payload_input), width)
        self.place = nn.Parameter(0.02 * torch.randn(self.count, width))

    def forward(self, z: Tensor) -> Tensor:
        """Standardised features (B, dim) → (B, H + 1, width)."""
        at = self.layout
        past = z[:, at.past].reshape(-1, at.history, 3 * at.n).flip(1)
        present = torch.cat([z[:, at.state], z[:, at.action], z[:, at.payload]], dim=1)
        return torch.cat([self.past(past), self.present(present).unsqueeze(1)], dim=1) + self.place
