"""The network at run time: onnxruntime or plain numpy, by call or on buffers that are made once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.sandbox import inside
from gaponet.nn.fused import FusedForward

ROWS, ROWS_SHARED = 64, 256  # of a batch at once, by one thread and by several: what lies between layers stays in cache
Backend = Literal["onnxruntime", "numpy"]
TRUSTED: set[str] = set()  # hashes of the ONNX files that were written by this process, or tried


@dataclass(frozen=True)
class Bound:
    """One batch size's buffers: write x, (B, dim) float32, call run, read delta, (B, n) float32; numpy or torch."""

    x: Any
    delta: Any
    run: Callable[[], object]


class Network(Protocol):
    """[o_t | a_t] → Δa."""

    def __call__(self, x: Array) -> Array:
        """x (B, dim) float32 → Δa (B, n) rad, a new array."""

    def bind(self, batch: int) -> Bound:
        """Buffers for `batch` rows; run() allocates nothing of Python's."""


class FunctionNetwork:
    """A function x → Δa on numpy arrays as a network: one that is being trained, or a rule."""

    def __init__(self, infer: Callable[[Array], Array], dim: int, n: int) -> None:
        self.infer, self.dim, self.n = infer, dim, n

    def __call__(self, x: Array) -> Array:
        return self.infer(x)

    def bind(self, batch: int) -> Bound:
        x, delta = np.zeros((batch, self.dim), np.float32), np.zeros((batch, self.n), np.float32)

        def run() -> None:
            delta[:] = self.infer(x)

        return Bound(x, delta, run)


def _require_tried(path: Path) -> None:
    """Refuse an ONNX file that does not answer in the sandbox; each content is tried once in a process.

    Raises:
        ModelError: No ONNX file, or it takes a gigabyte, or for ever: a network of kilobytes can.
    """
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest not in TRUSTED:
        _try(path)
        TRUSTED.add(digest)


@inside(ModelError, "onnxruntime")
def _try(path: Path) -> None:
    network = OnnxNetwork(path, trusted=True)
    for answer in network.session.get_outputs():
        network.output = answer.name
        for x in (0.0, 1.0, -1.0):
            network(np.full((2, network.session.get_inputs()[0].shape[1]), x, np.float32))


class OnnxNetwork:
    """An ONNX file on onnxruntime."""

    def __init__(self, path: Path, threads: int = 1, output: str = "delta", trusted: bool = False) -> None:
        """threads 0 uses all cores; one is quickest for one robot. Models with learned points also have "offsets".

        A file that is not `trusted` is tried first (require_tried).
        """
        self.output = output
        try:
            import onnxruntime as ort
        except ImportError:
            raise ModelError(
                "onnxruntime is not installed; run: pip install 'gaponet[deploy]', or load with backend='numpy'"
            ) from None
        if not trusted:
            _require_tried(path)
        options = ort.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave the core alone
        try:
            self.session: Any = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no base of their own
            raise ModelError(
                f"{path}: not a readable ONNX file ({' '.join(str(error).split())[:120]}); train or copy it again"
            ) from None
        self.rows = ROWS if threads == 1 else ROWS_SHARED
        self.value = ort.OrtValue.ortvalue_from_numpy  # on the CPU it shares the array's memory

    def __call__(self, x: Array) -> Array:
        return self.session.run([self.output], {"x": x})[0]

    def bind(self, batch: int) -> Bound:
        x = np.zeros((batch, self.session.get_inputs()[0].shape[1]), np.float32)
        delta = np.zeros((batch, *self(x[:1]).shape[1:]), np.float32)
        bindings = []
        for start in range(0, batch, self.rows):
            binding, rows = self.session.io_binding(), slice(start, start + self.rows)
            binding.bind_ortvalue_input("x", self.value(x[rows]))
            binding.bind_ortvalue_output(self.output, self.value(delta[rows]))
            bindings.append(binding)
        run = self.session.run_with_iobinding
        if len(bindings) == 1:
            return Bound(x, delta, partial(run, bindings[0]))

        def run_all() -> None:
            for binding in bindings:
                run(binding)

        return Bound(x, delta, run_all)


class NumpyNetwork:
    """The weights of an artifact on numpy alone: for machines without onnxruntime, and to check it."""

    def __init__(self, weights: Path | dict[str, Array]) -> None:
        """weights: weights.npz, or what it holds (nn/fuse.py)."""
        if isinstance(weights, Path) and not weights.is_file():
            raise ModelError(
                f"{weights}: missing: this artifact was written without it, or its kind of network has no numpy form; "
                "write it with gaponet export RUN, or load with backend='onnxruntime'"
            )
        self.weights = FusedForward.read_weights(weights) if isinstance(weights, Path) else weights
        self._made: dict[int, FusedForward] = {}

    def __call__(self, x: Array) -> Array:
        if len(x) not in self._made:
            self._made = {len(x): FusedForward(self.weights, len(x))}
        return self._made[len(x)](x).copy()

    def bind(self, batch: int) -> Bound:
        forward = FusedForward(self.weights, batch)
        return Bound(forward.x, forward.delta, forward.run)
