"""Baseline: a plain network on the operator's features, ASAP's form."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaponet.model.config import ModelConfig
from gaponet.model.layers import DeltaNet, dense, size


class DeltaMLP(DeltaNet):
    """x → Δa through dense layers."""

    def __init__(self, config: ModelConfig, n: int, hidden: Sequence[int] | None = None) -> None:
        """hidden: Widths, if not those of the config."""
        super().__init__(config, n)
        self.net = dense(self.features.dim, config.mlp_hidden if hidden is None else hidden, n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        """Features → Δa, (B, n) rad."""
        return self.bounded(self.net(prepared))


def matched_hidden(config: ModelConfig, n: int, parameters: int) -> tuple[int, ...]:
    """mlp_hidden scaled so that the MLP has as near to `parameters` parameters as whole widths allow."""
    largest = max(config.mlp_hidden)

    def scaled(width: int) -> tuple[int, ...]:
        return tuple(max(1, round(w * width / largest)) for w in config.mlp_hidden)

    def miss(width: int) -> int:
        with torch.device("meta"):  # shapes only
            return size(DeltaMLP(config, n, scaled(width))) - parameters

    low, high = 1, 1
    while miss(high) < 0:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if miss(middle) < 0 else (low, middle)
    return scaled(min((low, high), key=lambda width: abs(miss(width))))
