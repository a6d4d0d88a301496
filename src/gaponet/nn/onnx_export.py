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
MIN_SPARSE_ELEMENTS = 2048  # of a matrix that is stored sparsely; smaller ones need no index
MAX_SPARSE_DENSITY = 0.1  # share of its elements that are not zero
# Of a matrix that is stored as int16: the small first layers matter most for the output and little
# for the size.
MIN_INT16_ELEMENTS = 32_768


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


def with_small_matrices(content: bytes, *, int16: bool) -> bytes:
    """Return an ONNX file whose large matrices need less space.

    A matrix that selects features has few elements; only these are stored, and all outputs stay
    equal bit for bit.

    Args:
        content: ONNX file with float32 matrices.
        int16: Store other matrices of MIN_INT16_ELEMENTS and more as int16 with one float32 scale a
            row. Outputs then change: a weight by up to 1/65,534 of the largest one in its row.
            float16 would change it by up to 1/4,096 of itself, which changes outputs some eight
            times as much.
    """
    import onnx

    model = onnx.load_model_from_string(content)
    graph = model.graph
    decoding = []
    for tensor in list(graph.initializer):
        matrix = onnx.numpy_helper.to_array(tensor)
        if matrix.ndim != 2:
            continue
        few = np.count_nonzero(matrix) <= MAX_SPARSE_DENSITY * matrix.size
        if few and matrix.size >= MIN_SPARSE_ELEMENTS:
            graph.sparse_initializer.append(_sparse(tensor.name, matrix))
        elif int16 and matrix.size >= MIN_INT16_ELEMENTS:
            stored, nodes = _as_int16(tensor.name, matrix)
            graph.initializer.extend(stored)
            decoding += nodes
        else:
            continue
        graph.initializer.remove(tensor)
    nodes = [*decoding, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return bytes(model.SerializeToString())


def _sparse(name: str, matrix: Array) -> Any:
    """Return a matrix as a sparse tensor of ONNX."""
    import onnx

    index = np.flatnonzero(matrix)
    values = onnx.numpy_helper.from_array(matrix.ravel()[index], name)
    indices = onnx.numpy_helper.from_array(index.astype(np.int64), f"{name}_index")
    return onnx.helper.make_sparse_tensor(values, indices, list(matrix.shape))


def _as_int16(name: str, matrix: Array) -> tuple[list[Any], list[Any]]:
    """Return a matrix as int16 steps with a scale for each row, and the nodes that compute it from
    these.
    """
    import onnx

    scale = np.abs(matrix).max(axis=1, keepdims=True) / np.iinfo(np.int16).max
    scale = np.where(scale > 0, scale, 1.0).astype(np.float32)
    steps = np.round(matrix / scale).astype(np.int16)
    stored = [
        onnx.numpy_helper.from_array(steps, f"{name}_steps"),
        onnx.numpy_helper.from_array(scale, f"{name}_scale"),
    ]
    nodes = [
        onnx.helper.make_node(
            "Cast", [f"{name}_steps"], [f"{name}_float"], to=onnx.TensorProto.FLOAT
        ),
        onnx.helper.make_node("Mul", [f"{name}_float", f"{name}_scale"], [name]),
    ]
    return stored, nodes


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


def sample_inputs(net: DeltaNet, count: int = 256, seed: int = 0) -> Array:
    """Return inputs x with the statistics of the training data, (count, dim) float32.

    Sensor values are 0.
    """
    features = net.features
    generator = torch.Generator().manual_seed(seed)
    z = torch.randn(count, features.dim, generator=generator)
    relative = features.standardise.mean + features.standardise.std * z
    # relative(x) is linear in x.
    matrix = features.relative(torch.eye(features.dim)).T.double()
    x = torch.linalg.solve(matrix, relative.double().T).T.float()
    further = net.config.input_dim(net.n) - features.dim
    return torch.nn.functional.pad(x, (0, further)).contiguous().numpy()
