"""The network at run time: an ONNX file on onnxruntime."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.sandbox import sandboxed

Network = Callable[[Any], Any]  # x (B, dim) float32 → Δa (B, n) rad; numpy arrays or torch tensors
TRUSTED: set[str] = set()  # hashes of the ONNX files that were written by this process, or tried


class OnnxNetwork:
    """The content of an ONNX file on onnxruntime: x (B, dim) float32 → Δa (B, n) rad, a new array."""

    def __init__(self, content: bytes, threads: int = 1) -> None:
        """threads 0 uses all cores; one is quickest for one robot."""
        ort = _onnxruntime()
        options = ort.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave the core alone
        self.session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def __call__(self, x: Array) -> Array:
        return self.session.run(None, {"x": x})[0]

    def bind(self, x: Array) -> Callable[[], Array]:
        """Return a function of no arguments: x as it is then → Δa, in one array that the next call overwrites.

        Args:
            x: (B, dim) float32, which stays in place. One robot's answer takes 6 of 20 µs less than by a plain call.
        """
        delta, binding = self(x), self.session.io_binding()
        value = _onnxruntime().OrtValue.ortvalue_from_numpy  # on the CPU it shares the array's memory
        binding.bind_ortvalue_input("x", value(x))
        binding.bind_ortvalue_output(self.session.get_outputs()[0].name, value(delta))

        def answer() -> Array:
            self.session.run_with_iobinding(binding)
            return delta

        return answer

    @classmethod
    def read(cls, path: Path, threads: int = 1) -> OnnxNetwork:
        """Read an ONNX file. A content that is new to this process runs in the sandbox first.

        Raises:
            ModelError: No ONNX file, or it takes a gigabyte, or for ever: a network of kilobytes can.
        """
        _onnxruntime()
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest not in TRUSTED:
            _try(path)
            TRUSTED.add(digest)
        return cls(content, threads)


def _onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ModelError("onnxruntime is not installed; run: pip install 'gaponet[deploy]'") from None
    return onnxruntime


@sandboxed(ModelError, "onnxruntime")
def _try(path: Path) -> None:
    try:
        network = OnnxNetwork(path.read_bytes())
    except Exception as error:  # onnxruntime's errors have no base of their own
        reason = " ".join(str(error).split())[:120]
        raise ModelError(f"{path}: not a readable ONNX file ({reason}); train or copy it again") from None
    for x in (0.0, 1.0, -1.0):
        network(np.full((2, network.session.get_inputs()[0].shape[1]), x, np.float32))
