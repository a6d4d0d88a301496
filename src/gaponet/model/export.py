"""Network → artifact folder. Refuses to write one that does not answer as the network does."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.errors import ModelError
from gaponet.model.artifact import CARD, WEIGHTS, infer_session, write_card
from gaponet.model.layers import DeltaNet

PARITY = 1e-5  # rad


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
    frozen = copy.deepcopy(net).eval()
    temporary = folder / f".{WEIGHTS}.tmp"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Through torch.export (dynamo=True) it takes 5 to 11 s instead of 0.2 and writes the same function.
        torch.onnx.export(
            frozen, (torch.from_numpy(samples[:2]),), temporary, input_names=["x"], output_names=["delta"],
            dynamo=False, dynamic_axes={"x": {0: "batch"}, "delta": {0: "batch"}},
        )  # fmt: skip
    try:
        answer = infer_session(temporary)(samples)
        with torch.inference_mode():
            difference = float(np.abs(frozen(torch.from_numpy(samples)).numpy() - answer).max())
        if not difference <= PARITY:
            raise ModelError(
                f"{folder}: ONNX and torch differ by {difference:.2e} rad (limit {PARITY:.0e}); not written"
            )
        temporary.replace(folder / WEIGHTS)
        write_card(folder / CARD, card | {"parity_rad": difference})
    finally:
        temporary.unlink(missing_ok=True)
    return difference
