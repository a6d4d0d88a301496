"""The network in the form that runs, on plain numpy: the fewest and largest products that give the same answer.

    z = clip(x R + offset, ±5)              standardised, positions relative to q_t, ordered for what follows
    h = elu(elu(z P0) P1)                   sensor predictor; of its last layer only the mean is kept
    b = branch([sensors | z]),  t = trunk(z)
    Δa = Δ_max · tanh(Σ_basis b t + c)      the trunk's last layer carries gain / Δ_max

With one joint at a time (kind joint) z is joint by joint, [q | q̇ | past | payload | a | name] of each, so that a
joint's part is a slice; its name is one-hot. Branch and trunk of the same depth are one net side by side (kind pair)
that ends in b + t and b − t: Σ b t = ¼ Σ (b + t)² − (b − t)². nn/fuse.py makes the weights from a trained network.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.structure import read_npz

Layers = list[tuple[Array, Array]]  # weight (in, out), bias (out)

FILE = "weights.npz"
CLAMP = 5.0  # as in Features.forward
PARTS = ("predictor", "branch", "trunk", "pair")
JOINT_WISE = ("joint", "pair")  # kinds whose rows are joints of one simulation after another


class FusedForward:
    """The forward of `batch` observations, as a list of numpy calls on buffers made here; running it allocates nothing.

    Write x, (batch, dim) float32, call run, read delta, (batch, n) rad.
    """

    def __init__(self, weights: dict[str, Array], batch: int) -> None:
        self.weights, self.steps = weights, list[Callable[[], object]]()
        kind, n = str(weights["kind"]), len(weights["bias"])
        self.one = np.ones((batch, weights["relative"].shape[0] + 1), np.float32)  # [x | 1]
        self.x = self.one[:, :-1]
        z = self._standardised()
        rows = z.reshape(batch * n, -1) if kind in JOINT_WISE else z
        predictor, branch, trunk, pair = (_layers(weights, part) for part in PARTS)
        sensed = self._chain(z, predictor) if predictor else None
        self.delta = _empty(batch, n)
        if pair:
            y = self._chain(rows, pair, sensed)
            self._do(np.multiply, y, y, out=y)
            self._do(np.dot, y, weights["quarter"], out=self.delta.reshape(-1, 1))
            self._do(np.add, self.delta, weights["bias"], out=self.delta)
        elif branch:
            y = self._chain(rows, trunk)
            self._do(np.multiply, self._chain(rows, branch, sensed), y, out=y)
            self._do(np.add.reduce, y.reshape(batch, n, -1), 2, out=self.delta)
            self._do(np.add, self.delta, weights["bias"], out=self.delta)
        else:
            self.delta = self._chain(rows, trunk)
        self._do(np.tanh, self.delta, out=self.delta)
        self._do(np.multiply, self.delta, weights["delta_max"], out=self.delta)

    def run(self) -> None:
        """x → delta."""
        for step in self.steps:
            step()

    def __call__(self, x: Array) -> Array:
        """x (batch, dim) → Δa (batch, n), rad: a buffer that the next call overwrites."""
        np.copyto(self.x, x)
        self.run()
        return self.delta

    def _do(self, function: Callable[..., object], *arguments: object, out: Array) -> None:
        self.steps.append(partial(function, *arguments, out=out))

    def _standardised(self) -> Array:
        w = self.weights
        z = _empty(len(self.x), w["relative"].shape[1])
        self._do(np.dot, self.one, np.concatenate([w["relative"], w["offset"][None]]), out=z)
        self._do(np.maximum, z, np.float32(-CLAMP), out=z)
        self._do(np.minimum, z, np.float32(CLAMP), out=z)
        return z

    def _chain(self, x: Array, layers: Layers, sensed: Array | None = None) -> Array:
        """x W + b with ELU between; of [sensed | x], without putting them side by side."""
        for i, (weight, bias) in enumerate(layers):
            out, count = _empty(len(x), weight.shape[1]), weight.shape[0] - x.shape[1]
            self._do(np.dot, x, weight[count:], out=out)
            if i == 0 and sensed is not None:
                part = np.empty_like(out)
                self._do(np.dot, sensed.reshape(-1, count), weight[:count], out=part)
                self._do(np.add, out, part, out=out)
            if bias.any():
                self._do(np.add, out, bias, out=out)
            if i < len(layers) - 1:
                self._elu(out)
            x = out
        return x

    def _elu(self, x: Array) -> None:
        """ELU in place: max(x, e^min(x,0) − 1), since e^x − 1 ≥ x everywhere."""
        low = np.empty_like(x)
        self._do(np.minimum, x, np.float32(0), out=low)
        self._do(np.exp, low, out=low)
        self._do(np.subtract, low, np.float32(1), out=low)
        self._do(np.maximum, x, low, out=x)

    @staticmethod
    def read_weights(path: Path) -> dict[str, Array]:
        """Arrays of a weights.npz; no pickle is ever loaded."""
        weights = read_npz(path, ModelError, "write it again with gaponet export RUN")
        if "offset" not in weights:
            raise ModelError(f"{path}: written by an earlier gaponet; write it again with gaponet export RUN")
        return weights


def _empty(*shape: int) -> Array:
    return np.empty(shape, np.float32)


def _layers(weights: dict[str, Array], name: str) -> Layers:
    count = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in weights)
    return [(weights[f"{name}.{i}.weight"], weights[f"{name}.{i}.bias"]) for i in range(count)]
