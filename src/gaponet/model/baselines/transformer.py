"""Baseline: attention over the past frames and the present (Vaswani et al. 2017; normalised before each part)."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from gaponet.model.baselines.tokens import Tokens
from gaponet.model.config import ModelConfig
from gaponet.model.layers import DeltaNet, dense


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
        self.tokens = Tokens(self.features, config, width)
        self.blocks = nn.Sequential(
            *(_Block(width, config.transformer_heads) for _ in range(config.transformer_layers))
        )
        self.norm = nn.LayerNorm(width)
        self.head = dense(width, (), n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        tokens = self.blocks(self.tokens(prepared))
        return self.bounded(self.head(self.norm(tokens[:, -1])))
