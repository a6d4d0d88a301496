"""The network in the form that runs, on plain numpy: the fewest and largest products that give the same answer.

    z = clip(x R + offset, ±5)              standardised, positions relative to q_t, ordered for what follows
    h = elu(elu(z P0) P1)                   sensor predictor; of its last layer only the mean is kept
    b = branch([sensors | z]),  t = trunk(z)
    Δa = Δ_max · tanh(Σ_basis b t + c)      the trunk's last layer carries gain / Δ_max

With full coupling nothing lies between the predictor's last layer and the branch's first: they are one product. With
one joint at a time z is joint by joint, [q | q̇ | past | payload | a | name] of each, so that a joint's part is a
slice; its name is one-hot. model/fuse.py makes the weights from a trained network.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaponet.errors import ModelError

Array = np.ndarray

FILE = "weights.npz"
CLAMP = 5.0  # as in Features.forward


def read_weights(path: Path) -> dict[str, Array]:
    """Arrays of a weights.npz; no pickle is ever loaded."""
    try:
        with np.load(path, allow_pickle=False) as file:
            weights = {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ModelError(f"{path}: not readable ({error}); write it again with gaponet export RUN") from None
    if "offset" not in weights:
        raise ModelError(f"{path}: written by an earlier gaponet; write it again with gaponet export RUN")
    return weights


class Elu:
    """elu(x) in place, with one buffer: max(x, e^min(x,0) − 1), since e^x − 1 ≥ x everywhere."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.low = np.empty(shape, np.float32)

    def __call__(self, x: Array) -> None:
        low = self.low
        np.minimum(x, 0.0, out=low)
        np.exp(low, out=low)
        np.subtract(low, 1.0, out=low)
        np.maximum(x, low, out=x)


class Dense:
    """Layers x W + b with ELU between, into buffers made once for `rows` rows."""

    def __init__(
        self, layers: Sequence[tuple[Array, Array]], rows: int, last_elu: bool = False, sensed: int = 0
    ) -> None:
        """The first `sensed` inputs of the first layer are given apart."""
        self.sensed = np.empty((0, 0), np.float32)
        self.part = np.empty((0, 0), np.float32)
        self.layers = []
        for i, (weight, bias) in enumerate(layers):
            if i == 0 and sensed:
                self.sensed, weight = (np.ascontiguousarray(w) for w in (weight[:sensed], weight[sensed:]))
                self.part = np.empty((rows, weight.shape[1]), np.float32)
            out = np.empty((rows, weight.shape[1]), np.float32)
            elu = Elu(out.shape) if last_elu or i < len(layers) - 1 else None
            self.layers.append((weight, bias, out, elu))

    def __call__(self, x: Array, sensed: Array | None = None) -> Array:
        for weight, bias, out, elu in self.layers:
            np.dot(x, weight, out=out)
            np.add(out, bias, out=out)
            if sensed is not None:
                np.add(out, np.dot(sensed, self.sensed, out=self.part), out=out)
                sensed = None
            if elu is not None:
                elu(out)
            x = out
        return x


class FusedForward:
    """The forward of `batch` observations; all buffers are made here, a call allocates nothing."""

    def __init__(self, weights: dict[str, Array], batch: int) -> None:
        """
        Args:
            weights: As model/fuse.py made them.
            batch: Rows of x.
        """
        w = self.w = weights
        self.z = np.empty((batch, w["relative"].shape[1]), np.float32)
        self.kind, n = str(w["kind"]), len(w["bias"])
        rows = batch * n if self.kind == "joint" else batch
        self.delta = np.empty((batch, n), np.float32)
        self.rows = self.z.reshape(rows, -1)
        self.predictor = Dense(_layers(w, "predictor"), batch, last_elu=self.kind == "full")
        branch = _layers(w, "branch")
        self.sensed = branch[0][0].shape[0] - self.rows.shape[1] if branch else 0
        self.branch = Dense(branch, rows, sensed=self.sensed)
        self.trunk = Dense(_layers(w, "trunk"), rows)

    def __call__(self, x: Array) -> Array:
        """x (batch, dim) float32 → Δa (batch, n), rad: a buffer that the next call overwrites."""
        w, z, delta = self.w, self.z, self.delta
        np.dot(x, w["relative"], out=z)
        np.add(z, w["offset"], out=z)
        np.maximum(z, -CLAMP, out=z)
        np.minimum(z, CLAMP, out=z)
        y = self.trunk(self.rows)
        if self.branch.layers:
            sensed = self.predictor(z).reshape(-1, self.sensed) if self.sensed else None
            np.multiply(self.branch(self.rows, sensed), y, out=y)
            np.sum(y.reshape(*delta.shape, -1), axis=-1, out=delta)
            np.add(delta, w["bias"], out=delta)
        else:
            np.copyto(delta, y)
        np.tanh(delta, out=delta)
        return np.multiply(delta, w["delta_max"], out=delta)


def _layers(weights: dict[str, Array], name: str) -> list[tuple[Array, Array]]:
    count = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in weights)
    return [(weights[f"{name}.{i}.weight"], weights[f"{name}.{i}.bias"]) for i in range(count)]
