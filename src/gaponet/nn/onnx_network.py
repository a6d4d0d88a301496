"""Network at run time: an ONNX file on onnxruntime."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.installation import install_command
from gaponet.base.sandbox import sandboxed

Network = Callable[[Any], Any]  # x (B, dim) float32 → Δa (B, n) rad; numpy arrays or torch tensors
CARD_FACTS = "gaponet_card"  # key of the file's metadata with fields of the card, as JSON
TRUSTED: set[str] = set()  # hashes of ONNX files that this process wrote or tested in the sandbox


class OnnxNetwork:
    """Content of an ONNX file on onnxruntime: x (B, dim) float32 → Δa (B, n) rad, a new array."""

    def __init__(self, content: bytes, threads: int = 1) -> None:
        """threads: Threads of onnxruntime; 0 for all cores. One is fastest for one robot."""
        ort = _onnxruntime()
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        # Idle threads do not use a core.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self.session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def __call__(self, x: Array) -> Array:
        result: Array = self.session.run(None, {"x": x})[0]
        return result

    @property
    def stored_facts(self) -> dict[str, Any]:
        """Fields of the card that export wrote into the file.

        Empty for a file of an older version or another program.

        Raises:
            ValueError: What is stored there is not a JSON object.
        """
        text = self.session.get_modelmeta().custom_metadata_map.get(CARD_FACTS, "{}")
        try:
            facts = json.loads(text)
        except RecursionError:
            facts = None
        if not isinstance(facts, dict):
            raise ValueError("its metadata is not a JSON object")
        return facts

    def bind(self, x: Array, shape: tuple[int, ...]) -> Callable[[], Array]:
        """Return a function without arguments: present content of x → Δa, rad.

        This is faster than a plain call.

        Args:
            x: (B, dim) float32; its memory is read in each call.
            shape: Shape of the result. All calls return the same array.
        """
        delta = self(x)
        binding = self.session.io_binding()
        # On the CPU it shares the array's memory.
        value = _onnxruntime().OrtValue.ortvalue_from_numpy
        binding.bind_ortvalue_input("x", value(x))
        binding.bind_ortvalue_output(self.session.get_outputs()[0].name, value(delta))
        run = self.session.run_with_iobinding
        result = delta.reshape(shape)

        def answer() -> Array:
            run(binding)
            return result

        return answer

    @classmethod
    def read(cls, path: Path, threads: int = 1) -> OnnxNetwork:
        """Read an ONNX file. Unless this process knows its content, it first runs in the sandbox.

        Raises:
            ModelError: Not an ONNX file, or it exceeds the sandbox's limits of memory or time.
        """
        _onnxruntime()
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest not in TRUSTED:
            _test(path)
            TRUSTED.add(digest)
        return cls(content, threads)


def _onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ModelError(
            f"onnxruntime is not installed; run: {install_command('deploy')}"
        ) from None
    return onnxruntime


@sandboxed(ModelError, "onnxruntime")
def _test(path: Path) -> None:
    try:
        network = OnnxNetwork(path.read_bytes())
    except Exception as error:  # onnxruntime's errors have no base of their own
        reason = " ".join(str(error).split())[:120]
        raise ModelError(
            f"{path}: not a readable ONNX file ({reason}); train or copy it again"
        ) from None
    for x in (0.0, 1.0, -1.0):
        network(np.full((2, network.session.get_inputs()[0].shape[1]), x, np.float32))
