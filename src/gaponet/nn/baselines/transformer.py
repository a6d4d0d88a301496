"""Baseline: attention over the past frames and the present (Vaswani et al. 2017; normalised before each part)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, Features, dense


class _Tokens(nn.Module):
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


class _Block(nn.Module):
    """x + attention(norm(x)), then x + mlp(norm(x)); written out, since torch's own layer does not export as traced."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, width) → the same."""
        _, count, width = x.shape
        parts = self.qkv(self.norm1(x)).reshape(-1, count, 3, self.heads, width // self.heads)
        query, key, value = parts.permute(2, 0, 3, 1, 4).unbind(0)  # (B, heads, T, width / heads)
        seen = scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(-1, count, width)
        x = x + self.out(seen)
        return x + self.mlp(self.norm2(x))


class DeltaTransformer(DeltaNet):
    """Δa is read off the present token; all tokens see all others, none of them is of the future."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        width = config.transformer_width
        self.tokens = _Tokens(self.features, config, width)
        self.blocks = nn.Sequential(
            *(_Block(width, config.transformer_heads) for _ in range(config.transformer_layers))
        )
        self.norm = nn.LayerNorm(width)
        self.head = dense(width, (), n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        tokens = self.blocks(self.tokens(prepared))
        return self.bounded(self.head(self.norm(tokens[:, -1])))
