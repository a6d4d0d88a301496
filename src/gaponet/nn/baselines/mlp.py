"""Baseline: a plain network on the operator's features, ASAP's form."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet, dense, size


class DeltaMLP(DeltaNet):
    """x → Δa through dense layers."""

    def __init__(self, config: ModelConfig, n: int, hidden: Sequence[int] | None = None) -> None:
        """hidden: Widths, if not those of the config."""
        super().__init__(config, n)
        self.net = dense(self.features.dim, config.mlp_hidden if hidden is None else hidden, n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        return self.bounded(self.net(prepared))

    @staticmethod
    def matched_hidden(
        hidden: Sequence[int], parameters: int, build: Callable[[tuple[int, ...]], nn.Module]
    ) -> tuple[int, ...]:
        """The widths scaled so that what `build` makes of them has as near to `parameters` parameters as they allow."""
        largest = max(hidden)

        def scaled(width: int) -> tuple[int, ...]:
            return tuple(max(1, round(w * width / largest)) for w in hidden)

        def miss(width: int) -> int:
            with torch.device("meta"):  # shapes only
                return size(build(scaled(width))) - parameters

        low, high = 1, 1
        while miss(high) < 0:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if miss(middle) < 0 else (low, middle)
        return scaled(min((low, high), key=lambda width: abs(miss(width))))
