"""Network → artifact folder. Refuses to write one that does not answer as the network does."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.errors import ModelError
from gaponet.model.artifact import CARD, WEIGHTS, infer_session, write_card
from gaponet.model.layers import DeltaNet

PARITY = 1e-5  # rad


class Ships(nn.Module):
    """x → (Δa,), and the probes' offsets of a network that chooses them."""

    def __init__(self, net: DeltaNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        """x, (B, dim)."""
        more = (self.net.offsets(x),) if self.net.config.learns_points else ()  # type: ignore[operator]
        return (self.net(x), *more)


def export(net: DeltaNet, folder: Path, card: dict[str, Any], samples: np.ndarray) -> float:
    """Write model.onnx and card.json.

    Args:
        net: Trained network, normalisers inside.
        folder: Artifact folder, made if missing.
        card: What the artifact is; see model/artifact.py.
        samples: Observations [o_t | a_t] to compare on, (k, dim) float32, of states really visited.

    Returns:
        Largest |ONNX − torch| over the samples, rad.

    Raises:
        ModelError: The difference is above 1e-5 rad; nothing is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frozen = Ships(copy.deepcopy(net).eval())
    names = ["delta", "offsets"][: 1 + net.config.learns_points]
    temporary = folder / f".{WEIGHTS}.tmp"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Through torch.export (dynamo=True) it takes 5 to 11 s instead of 0.2 and writes the same function.
        torch.onnx.export(
            frozen, (torch.from_numpy(samples[:2]),), temporary, input_names=["x"], output_names=names,
            dynamo=False, dynamic_axes={name: {0: "batch"} for name in ("x", *names)},
        )  # fmt: skip
    try:
        with torch.inference_mode():
            expected = [y.numpy() for y in frozen(torch.from_numpy(samples))]
        difference = max(
            float(np.abs(infer_session(temporary, name)(samples) - y).max())
            for name, y in zip(names, expected, strict=True)
        )
        if not difference <= PARITY:
            raise ModelError(
                f"{folder}: ONNX and torch differ by {difference:.2e} rad (limit {PARITY:.0e}); not written"
            )
        temporary.replace(folder / WEIGHTS)
        write_card(folder / CARD, card | {"parity_rad": difference})
    finally:
        temporary.unlink(missing_ok=True)
    return difference
