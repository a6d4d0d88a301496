"""Baseline: Fourier neural operator over the time axis (Li et al. 2021).

The Fourier transform of H + 1 samples is a product with a constant matrix, and is written as one: real arithmetic only,
which ONNX knows, and for so few samples faster than a fast transform.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu

from gaponet.model.baselines.tokens import Tokens
from gaponet.model.config import ModelConfig
from gaponet.model.layers import DeltaNet, dense


class _SpectralConv(nn.Module):
    """Convolution over time: each kept frequency is multiplied by a complex width × width matrix of its own."""

    forward_dft: Tensor
    inverse_dft: Tensor

    def __init__(self, count: int, width: int, modes: int) -> None:
        super().__init__()
        modes = min(modes, count + 1)
        forward, inverse = _SpectralConv.dft(count, modes)
        self.register_buffer("forward_dft", forward, persistent=False)
        self.register_buffer("inverse_dft", inverse, persistent=False)
        self.weight = nn.Parameter(torch.randn(2, modes, width, width) / width)  # real, imaginary

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, width) → the same."""
        # Frequencies lead, so that their products are one batched matmul: (modes, B, width) × (modes, width, width).
        real, imaginary = (self.forward_dft @ x).transpose(0, 1).chunk(2)
        a, b = self.weight[0], self.weight[1]
        product = torch.cat([real @ a - imaginary @ b, real @ b + imaginary @ a])
        return self.inverse_dft @ product.transpose(0, 1)

    @staticmethod
    def dft(count: int, modes: int) -> tuple[Tensor, Tensor]:
        """Real Fourier transform of `count` samples and as many zeros, lowest `modes` frequencies, and its inverse.

        The zeros keep the newest sample from meeting the oldest, as a period would have them do.

        Returns:
            Forward (2·modes, count), real parts above imaginary ones, and inverse (count, 2·modes).
        """
        length = 2 * count
        k, t = torch.arange(modes, dtype=torch.float64)[:, None], torch.arange(count, dtype=torch.float64)
        angle = 2 * math.pi * k * t / length
        forward = torch.cat([angle.cos(), -angle.sin()])
        # All but the mean and the highest frequency stand for two conjugate ones.
        twice = torch.where((k == 0) | (2 * k == length), 1.0, 2.0) / length
        inverse = torch.cat([twice * angle.cos(), -twice * angle.sin()]).T
        return forward.float(), inverse.contiguous().float()


class DeltaFNO(DeltaNet):
    """Lift tokens to channels, spectral layers beside pointwise ones, read Δa off the present."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        width = config.fno_width
        self.tokens = Tokens(self.features, config, width)
        layers = range(config.fno_layers)
        self.spectral = nn.ModuleList(_SpectralConv(self.tokens.count, width, config.fno_modes) for _ in layers)
        self.pointwise = nn.ModuleList(nn.Linear(width, width) for _ in layers)
        self.head = dense(width, (4 * width,), n, zero=True)

    def correct(self, prepared: Tensor) -> Tensor:
        v = self.tokens(prepared)
        for spectral, pointwise in zip(self.spectral, self.pointwise, strict=True):
            v = gelu(spectral(v) + pointwise(v))
        return self.bounded(self.head(v[:, -1]))
