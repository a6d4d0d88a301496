"""The network of an ONNX file as a torch module, for networks without a checkpoint.

It knows the operators that nn/onnx_export.py writes, and no others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from gaponet.base.errors import ModelError

Attributes = dict[str, Any]
Operator = Callable[[list[Any], Attributes], Any]


def _gemm(inputs: list[Any], attributes: Attributes) -> Tensor:
    left, right = inputs[:2]
    if attributes.get("transA", 0):
        left = left.T
    if attributes.get("transB", 0):
        right = right.T
    alpha = attributes.get("alpha", 1.0)
    if len(inputs) == 3:
        beta = attributes.get("beta", 1.0)
        return torch.addmm(inputs[2], left, right, beta=beta, alpha=alpha)
    product: Tensor = alpha * (left @ right)
    return product


def _cast(inputs: list[Any], attributes: Attributes) -> Tensor:
    import onnx

    kind = onnx.helper.tensor_dtype_to_np_dtype(attributes["to"])
    result: Tensor = inputs[0].to(torch.from_numpy(np.zeros(0, kind)).dtype)
    return result


def _clip(inputs: list[Any], attributes: Attributes) -> Tensor:
    return torch.clamp(*inputs[:3])


def _slice(inputs: list[Any], attributes: Attributes) -> Tensor:
    """inputs: Data, starts, ends, axes, and perhaps steps, which are 1."""
    part: Tensor = inputs[0]
    starts, ends, axes = inputs[1:4]
    for start, end, axis in zip(starts, ends, axes, strict=True):
        size = part.shape[axis]
        low = start + size if start < 0 else start
        high = end + size if end < 0 else min(end, size)
        part = part.narrow(axis, low, high - low)
    return part


def _flatten(inputs: list[Any], attributes: Attributes) -> Tensor:
    axis = attributes.get("axis", 1)
    width = math.prod(inputs[0].shape[axis:])
    result: Tensor = inputs[0].reshape(-1, width)
    return result


def _axes(inputs: list[Any], attributes: Attributes) -> list[int]:
    """Return the axes: an input since opset 13, an attribute before."""
    axes: list[int] = attributes["axes"] if len(inputs) < 2 else inputs[1]
    return axes


def _reduce_sum(inputs: list[Any], attributes: Attributes) -> Tensor:
    result: Tensor = inputs[0].sum(
        _axes(inputs, attributes), keepdim=bool(attributes.get("keepdims", 1))
    )
    return result


def _squeeze(inputs: list[Any], attributes: Attributes) -> Tensor:
    result: Tensor = inputs[0].squeeze(tuple(_axes(inputs, attributes)))
    return result


def _unsqueeze(inputs: list[Any], attributes: Attributes) -> Tensor:
    result: Tensor = inputs[0]
    for axis in sorted(_axes(inputs, attributes)):
        result = result.unsqueeze(axis)
    return result


OPERATORS: dict[str, Operator] = {
    "Add": lambda inputs, attributes: inputs[0] + inputs[1],
    "Cast": _cast,
    "Clip": _clip,
    "Concat": lambda inputs, attributes: torch.cat(inputs, dim=attributes["axis"]),
    "Constant": lambda inputs, attributes: attributes["value"],
    "Div": lambda inputs, attributes: inputs[0] / inputs[1],
    "Elu": lambda inputs, attributes: functional.elu(inputs[0], attributes.get("alpha", 1.0)),
    "Flatten": _flatten,
    "Gemm": _gemm,
    "Identity": lambda inputs, attributes: inputs[0],
    "MatMul": lambda inputs, attributes: inputs[0] @ inputs[1],
    "Mul": lambda inputs, attributes: inputs[0] * inputs[1],
    "ReduceSum": _reduce_sum,
    "Reshape": lambda inputs, attributes: inputs[0].reshape(inputs[1]),
    "Slice": _slice,
    "Squeeze": _squeeze,
    "Sub": lambda inputs, attributes: inputs[0] - inputs[1],
    "Tanh": lambda inputs, attributes: torch.tanh(inputs[0]),
    "Transpose": lambda inputs, attributes: inputs[0].permute(attributes["perm"]),
    "Unsqueeze": _unsqueeze,
}


class OnnxModule(nn.Module):
    """An ONNX file as a module: x (B, dim) float32 → Δa (B, n) rad.

    What depends on no input is computed once, so weights that are stored with fewer digits cost
    nothing afterwards.
    """

    def __init__(self, file: Path) -> None:
        """
        Raises:
            ModelError: The file has an operator that nn/onnx_export.py does not write.
        """
        super().__init__()
        import onnx

        graph = onnx.load(str(file)).graph
        known = _weights(graph)
        self.input: str = graph.input[0].name
        self.output: str = graph.output[0].name
        # Operator, names of inputs, attributes, name of the output; in the order of computation.
        self.steps: list[tuple[Operator, list[str], Attributes, str]] = []
        for node in graph.node:
            if node.op_type not in OPERATORS:
                raise ModelError(
                    f"{file}: torch exports do not know its operator {node.op_type}; export from "
                    "a run folder that has its checkpoint.pt"
                )
            operator = OPERATORS[node.op_type]
            names = [name for name in node.input if name]
            attributes = {a.name: _attribute(a) for a in node.attribute}
            if all(name in known for name in names):
                known[node.output[0]] = operator([known[name] for name in names], attributes)
            else:
                self.steps.append((operator, names, attributes, node.output[0]))
        used = set[str]()
        for _, names, _, _ in self.steps:
            used.update(names)
        # name in the file → shape, axes, or places of a slice
        self.sizes: dict[str, list[int]] = {}
        self.buffer_names: dict[str, str] = {}  # name in the file → name of the buffer
        for name in sorted(used & known.keys()):
            if isinstance(known[name], list):
                self.sizes[name] = known[name]
            else:
                self.buffer_names[name] = f"constant_{len(self.buffer_names)}"
                self.register_buffer(self.buffer_names[name], known[name])

    def forward(self, x: Tensor) -> Tensor:
        """x (B, dim) → Δa (B, n) rad."""
        values: dict[str, Any] = dict(self.sizes)
        for name, buffer in self.buffer_names.items():
            values[name] = getattr(self, buffer)
        values[self.input] = x
        for operator, names, attributes, output in self.steps:
            values[output] = operator([values[name] for name in names], attributes)
        result: Tensor = values[self.output]
        return result


def _weights(graph: Any) -> dict[str, Any]:
    """Return the stored constants by name."""
    from onnx import numpy_helper

    weights = {i.name: _constant(numpy_helper.to_array(i)) for i in graph.initializer}
    for sparse in graph.sparse_initializer:
        dense = np.zeros(int(np.prod(sparse.dims)), np.float32)
        dense[numpy_helper.to_array(sparse.indices)] = numpy_helper.to_array(sparse.values)
        weights[sparse.values.name] = _constant(dense.reshape(tuple(sparse.dims)))
    return weights


def _attribute(attribute: Any) -> Any:
    import onnx
    from onnx import numpy_helper

    value = onnx.helper.get_attribute_value(attribute)
    if isinstance(value, onnx.TensorProto):
        return _constant(numpy_helper.to_array(value))
    return value


def _constant(array: np.ndarray) -> Any:
    """Return weights as a tensor, and int64 (shapes, axes) as a list of numbers."""
    if array.dtype == np.int64:
        return array.reshape(-1).tolist()
    return torch.from_numpy(np.array(array))
