"""Export of a network to an artifact folder, checked against torch."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.nn.artifact import CARD, WEIGHTS, facts_in_network
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import MAX_FEATURE, DeltaNet
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_network import CARD_FACTS, TRUSTED, OnnxNetwork

MAX_DIFFERENCE_RAD = 1e-5  # between ONNX and torch


def export(net: DeltaNet, folder: Path, card: dict[str, Any], samples: Array) -> float:
    """Write model.onnx and card.json.

    Args:
        net: Trained network, normalisers inside.
        samples: Inputs x of visited states, (k, dim) float32, for the comparison.

    Returns:
        Largest |ONNX − torch| over the samples, rad.

    Raises:
        ModelError: The difference is larger than MAX_DIFFERENCE_RAD; nothing is written.
    """
    with lock_folder(folder, "model"):
        frozen = copy.deepcopy(net).eval()
        content = _with_facts(onnx_content(frozen), card)
        with torch.inference_mode():
            expected = frozen(torch.from_numpy(samples)).numpy()
        difference = float(np.abs(expected - OnnxNetwork(content)(samples)).max())
        if not difference <= MAX_DIFFERENCE_RAD:
            raise ModelError(
                f"{folder}: ONNX and torch differ by {difference:.2e} rad (limit "
                f"{MAX_DIFFERENCE_RAD:.0e}); not written"
            )
        with atomic_write(folder / WEIGHTS) as onnx:
            onnx.write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        TRUSTED.add(digest)
        facts = {"parity_rad": difference, "sha256": {WEIGHTS: digest}}
        write_text(folder / CARD, json.dumps(card | facts, indent=1, ensure_ascii=False) + "\n")
        return difference


class _FusedFeatures(nn.Module):
    """Network with its features as one linear layer, with which onnxruntime needs a quarter less
    time.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, net: DeltaNet) -> None:
        super().__init__()
        mean = net.features.standardise.mean
        std = net.features.standardise.std
        relative = net.features.relative(torch.eye(len(mean)))
        zero = torch.zeros(1, len(mean))
        weight = net.arrange(relative / std) - net.arrange(zero)
        bias = net.arrange(zero - mean / std)
        self.net = net
        self.shape = bias.shape[1:]
        self.register_buffer("weight", weight.flatten(1).T)
        self.register_buffer("bias", bias.flatten())

    def forward(self, x: Tensor) -> Tensor:
        z = nn.functional.linear(x, self.weight, self.bias).clamp(-MAX_FEATURE, MAX_FEATURE)
        return self.net.correct(z.reshape(-1, *self.shape))


def onnx_content(net: DeltaNet) -> bytes:
    """Return a network in evaluation mode as an ONNX file: x (batch, dim) → delta (batch, n),
    float32.
    """
    config = net.config
    has_linear_features = config.kind not in ("paper", "trees")
    linear = has_linear_features and config.sensors == "off" and not config.context
    content = io.BytesIO()
    x = torch.zeros(2, net.config.input_dim(net.n))
    exported: Any = _FusedFeatures(net) if linear else net
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # dynamo=True writes the same function in 2 to 16 s instead of 0.1, and needs onnxscript;
        # torch 2.14 has both.
        torch.onnx.export(
            exported,
            (x,),
            content,  # type: ignore[arg-type]
            input_names=["x"],
            output_names=["delta"],
            dynamo=False,
            dynamic_axes={name: {0: "batch"} for name in ("x", "delta")},
        )
    return content.getvalue()


def _with_facts(content: bytes, card: dict[str, Any]) -> bytes:
    """Return an ONNX file with the fields of its card that GapModel.load compares."""
    import onnx

    graph = onnx.load_model_from_string(content)
    facts = json.dumps(facts_in_network(card), ensure_ascii=False)
    onnx.helper.set_model_props(graph, {CARD_FACTS: facts})
    result: bytes = graph.SerializeToString()
    return result


def trained_network(run: Path, config: ModelConfig, n: int) -> DeltaNet:
    """Load the best network of a run from its checkpoint.

    Raises:
        ModelError: There is no checkpoint, or it is damaged or has another network.
    """
    path = run / "checkpoint.pt"
    if not path.is_file():
        raise ModelError(
            f"{run}: no checkpoint.pt; give a run folder of gaponet train, not the artifact alone"
        )
    net = build_network(config, n)
    try:
        net.load_state_dict(torch.load(path, weights_only=True)["best_state"])
    except (RuntimeError, KeyError, EOFError, ValueError) as error:
        raise ModelError(
            f"{path}: does not fit this model or is damaged ({str(error).splitlines()[0]})"
        ) from None
    return net.eval()


def sample_inputs(net: DeltaNet, count: int = 256) -> Array:
    """Return inputs x with the statistics of the training data, (count, dim) float32.

    Sensor values are 0.
    """
    features = net.features
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(count, features.dim, generator=generator)
    relative = features.standardise.mean + features.standardise.std * z
    # relative(x) is linear in x.
    matrix = features.relative(torch.eye(features.dim)).T.double()
    x = torch.linalg.solve(matrix, relative.double().T).T.float()
    further = net.config.input_dim(net.n) - features.dim
    return torch.nn.functional.pad(x, (0, further)).contiguous().numpy()
