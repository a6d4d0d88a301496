"""Network → artifact folder. Refuses to write one that does not answer as the network does."""

from __future__ import annotations

import copy
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.files import whole, write_text, writing
from gaponet.nn import fused
from gaponet.nn.artifact import CARD, WEIGHTS, sha256
from gaponet.nn.backends import TRUSTED, OnnxNetwork
from gaponet.nn.deeponet import build_network
from gaponet.nn.fuse import FusedNet, fuse
from gaponet.nn.layers import DeltaNet

PARITY = 1e-5  # rad


def export(net: DeltaNet, folder: Path, card: dict[str, Any], samples: Array) -> float:
    """Write model.onnx, weights.npz (for numpy; kinds with a fused form, nn/fuse.py) and card.json.

    Args:
        net: Trained network, normalisers inside.
        samples: Observations [o_t | a_t] to compare on, (k, dim) float32, of states really visited.

    Returns:
        Largest |ONNX or numpy − torch| over the samples, rad.

    Raises:
        ModelError: The difference is above 1e-5 rad; nothing is written.
    """
    with writing(folder, "model"):
        frozen = copy.deepcopy(net).eval()
        weights = fuse(frozen)
        with whole(folder / WEIGHTS) as onnx:
            _write_onnx(frozen if weights is None else FusedNet(weights), onnx, samples[:2])
            TRUSTED.add(sha256(onnx))
            with torch.inference_mode():
                expected = frozen(torch.from_numpy(samples)).numpy()
            difference = _require(folder, "ONNX", OnnxNetwork(onnx)(samples), expected)
            if weights is not None:
                answer = fused.FusedForward(weights, len(samples))(samples)
                difference = max(difference, _require(folder, "numpy", answer, expected))
                with whole(folder / fused.FILE) as npz:
                    np.savez(npz, **weights)  # type: ignore[arg-type]
            else:
                (folder / fused.FILE).unlink(missing_ok=True)
        files = {name: sha256(folder / name) for name in (WEIGHTS, fused.FILE) if (folder / name).is_file()}
        text = json.dumps(card | {"parity_rad": difference, "sha256": files}, indent=1, ensure_ascii=False)
        write_text(folder / CARD, text + "\n")
        return difference


def _write_onnx(net: nn.Module, path: Path, x: Array) -> None:
    """Input x (batch, dim), output delta (batch, n), float32."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # dynamo=True writes the same function in 2 to 16 s instead of 0.5, and needs onnxscript; torch 2.14 has both.
        torch.onnx.export(
            net, (torch.from_numpy(x),), path, input_names=["x"], output_names=["delta"],
            dynamo=False, dynamic_axes={name: {0: "batch"} for name in ("x", "delta")},
        )  # fmt: skip


def _require(folder: Path, what: str, answer: Array, expected: Array) -> float:
    difference = float(np.abs(expected - answer).max())
    if not difference <= PARITY:
        raise ModelError(f"{folder}: {what} and torch differ by {difference:.2e} rad (limit {PARITY:.0e}); not written")
    return difference


def trained_network(run: Path, config: Any, n: int) -> DeltaNet:
    """The network that a run kept, from its checkpoint."""
    path = run / "checkpoint.pt"
    if not path.is_file():
        raise ModelError(f"{run}: no checkpoint.pt; give a run folder of gaponet train, not the artifact alone")
    net = build_network(config, n)
    try:
        net.load_state_dict(torch.load(path, weights_only=True)["best_state"])
    except (RuntimeError, KeyError, EOFError, ValueError) as error:
        raise ModelError(f"{path}: does not fit this model or is damaged ({str(error).splitlines()[0]})") from None
    return net.eval()


def drawn_states(net: DeltaNet, count: int = 256, seed: int = 0) -> Array:
    """Inputs x spread as those trained on, (count, dim) float32, where no recording is at hand; sensor values are 0."""
    features = net.features
    generator = torch.Generator().manual_seed(seed)
    z = torch.randn(count, features.dim, generator=generator)
    relative = features.standardise.mean + features.standardise.std * z
    # relative(x) is linear and the identity but for differences to q_t: its inverse is solved for, not written down.
    x = torch.linalg.solve(features.relative(torch.eye(features.dim)).T.double(), relative.double().T).T
    return torch.nn.functional.pad(x.float(), (0, net.config.input_dim(net.n) - features.dim)).contiguous().numpy()
