"""Strangers' pickles, opened without running anything: numbers, text, lists, dictionaries, arrays
and tensors come out.

A pickle names functions to call. Here each name that is not on a short list is refused, and those
on it are not NumPy's or torch's own functions but stand-ins that note what was meant; arrays are
made of that afterwards, with type and size checked.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gaponet.base.errors import LogError
from gaponet.base.structure import MAX_ARRAYS_BYTES
from gaponet.data.describe.raw_recording import reading

KINDS = "biufUS"  # of dtypes: numbers and text of fixed size
# torch's name → dtype
STORAGES = {
    "Float": "f4",
    "Double": "f8",
    "Half": "f2",
    "Long": "i8",
    "Int": "i4",
    "Short": "i2",
    "Char": "i1",
    "Byte": "u1",
    "Bool": "b1",
}
MAX_STEPS = 1 << 20  # values of a tree that is walked; shared ones count each time


@contextmanager
def open_zip(file: Path, what: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip file of arrays.

    Raises:
        LogError: It is damaged, or unpacks to more than MAX_ARRAYS_BYTES.
    """
    with reading(file, what), zipfile.ZipFile(file) as packed:
        if sum(part.file_size for part in packed.infolist()) > MAX_ARRAYS_BYTES:
            raise LogError(
                f"{file}: unpacks to more than {MAX_ARRAYS_BYTES >> 20} MiB; cut it into shorter "
                "logs"
            )
        yield packed


class _RefusedError(Exception):
    """The pickle holds an object that is not allowed."""


class _Type:
    """A dtype that was meant."""

    def __init__(self, text: Any = "", *_: Any) -> None:
        self.text = str(text)
        self.order = ""

    def __setstate__(self, state: Any) -> None:
        self.order = ""
        if isinstance(state, tuple) and len(state) > 1 and state[1] in ("<", ">", "|"):
            self.order = state[1]

    def real(self) -> np.dtype[Any]:
        """Return NumPy's dtype."""
        kind = np.dtype(self.text[:20])
        if self.order in ("<", ">"):
            return np.dtype(self.order + kind.str[1:])
        return kind


class _Array:
    """An array that was meant: shape, dtype and bytes or list."""

    def __init__(self, *_: Any) -> None:
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def real(self, make: Callable[[Any], Any]) -> Any:
        """Return the array; make: what makes the values of an array of objects."""
        shape, kind, fortran, data = self.state[-4:]
        if not isinstance(kind, _Type) or not _is_shape(shape):
            raise _RefusedError("an array without type or shape")
        if kind.text.lstrip("|<>=")[:1] == "O":
            out = np.empty(len(data), object)
            out[:] = [make(value) for value in data]
            return out.reshape(shape)
        if kind.real().kind not in KINDS or not isinstance(data, (bytes, bytearray)):
            raise _RefusedError(f"an array of {kind.text}")
        return np.frombuffer(bytes(data), kind.real()).reshape(shape, order="F" if fortran else "C")


def _is_shape(shape: Any) -> bool:
    return isinstance(shape, tuple) and all(type(n) is int for n in shape)


class _Wrapped:
    """joblib's array: its bytes stand in the stream, behind what describes them."""

    def __init__(self, *_: Any) -> None:
        self.array: Any = None

    def read(self, state: Any, stream: io.BytesIO) -> None:
        """Read the bytes that stand in the stream now, as the state describes them."""
        kind = state.get("dtype")
        shape = state.get("shape")
        is_plain = isinstance(kind, _Type) and kind.real().kind in KINDS
        if not is_plain or not isinstance(shape, tuple):
            raise _RefusedError("an array of objects inside a joblib file")
        if state.get("numpy_array_alignment_bytes") is not None:
            padding = stream.read(1)[0]
            stream.seek(padding, io.SEEK_CUR)
        size = math.prod(int(n) for n in shape) * kind.real().itemsize
        if not 0 <= size <= MAX_ARRAYS_BYTES:
            raise _RefusedError(f"an array of {size} bytes")
        data = stream.read(size)
        order: Any = "F" if state.get("order") == "F" else "C"
        self.array = np.frombuffer(data, kind.real()).reshape(tuple(map(int, shape)), order=order)


def _frombuffer(data: Any, kind: Any, shape: Any, order: Any = "C") -> _Array:
    """numpy's own pickle of a contiguous array, protocol 5."""
    array = _Array()
    array.state = (shape, kind, order == "F", data)
    return array


class _Scalar:
    """A number of NumPy's that was meant."""

    def __init__(self, kind: Any, data: Any = b"") -> None:
        self.kind = kind
        self.data = data

    def real(self, make: Callable[[Any], Any]) -> Any:
        """Return the number."""
        return np.frombuffer(self.data, self.kind.real())[0]


class _Tensor:
    """A tensor that was meant: a view of a storage, which the persistent id before it named."""

    def __init__(self, storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> None:
        _require_view(storage, offset, size, stride)
        steps = [n * storage.itemsize for n in stride]
        self.array = None
        # one may claim to be large by repeating one number: it is left alone
        if math.prod(size) <= len(storage):
            self.array = np.lib.stride_tricks.as_strided(
                storage[offset:], size, steps, writeable=False
            ).copy()


def _require_view(storage: Any, offset: Any, size: Any, stride: Any) -> None:
    """Refuse what is no view of a storage, or reaches beyond it."""
    shaped = isinstance(size, tuple) and isinstance(stride, tuple)
    if not isinstance(storage, np.ndarray) or not shaped:
        raise _RefusedError("a tensor without storage, size or stride")
    counts = all(type(n) is int and n >= 0 for n in (offset, *size, *stride))
    if len(size) != len(stride) or not counts:
        raise _RefusedError("a tensor whose size is not numbers")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) and last >= len(storage):
        raise _RefusedError(f"a tensor of size {size} in a storage of {len(storage)}")


def _codec(text: Any, encoding: Any) -> bytes:
    """How Python 3 wrote bytes into old protocols."""
    if encoding not in ("latin1", "latin-1"):
        raise _RefusedError(f"codec {encoding!r:.40}")
    return str(text).encode("latin1")


MEANT = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Type,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _Scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _frombuffer for core in ("core", "_core")},
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _Wrapped,
    ("_codecs", "encode"): _codec,
    ("collections", "OrderedDict"): dict,
    ("builtins", "bytearray"): bytearray,
    ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
    **{("torch", f"{name}Storage"): kind for name, kind in STORAGES.items()},
}


class _Unpickler(pickle._Unpickler):
    """Python's own, slow one: what it keeps is bounded by what it has read, and BUILD can be
    seen.
    """

    def __init__(self, stream: io.BytesIO, storage: Callable[[str], bytes] | None) -> None:
        super().__init__(stream)
        self.stream = stream
        self.storage = storage

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in MEANT:
            raise _RefusedError(f"it wants to run {module}.{name}")
        return MEANT[module, name]

    def persistent_load(self, pid: Any) -> Any:
        if self.storage is None or not isinstance(pid, tuple) or len(pid) != 5:
            raise _RefusedError("a persistent id that is no storage of tensors")
        _, kind, key, _, _ = pid
        if not isinstance(kind, str) or kind not in STORAGES.values():
            raise _RefusedError("a persistent id that is no storage of tensors")
        return np.frombuffer(self.storage(str(key)), np.dtype("<" + kind))

    def load_build(self) -> None:
        stack = self.stack  # type: ignore[attr-defined]
        state = stack.pop()
        what = stack[-1]
        if isinstance(what, _Wrapped) and isinstance(state, dict):
            what.read(state, self.stream)
        elif isinstance(what, (_Array, _Type)):
            what.__setstate__(state)
        else:
            raise _RefusedError(f"state for a {type(what).__name__}")

    dispatch: ClassVar[Any] = pickle._Unpickler.dispatch | {pickle.BUILD[0]: load_build}


class _Maker:
    """Makes arrays and plain values of what was meant, and counts them."""

    def __init__(self) -> None:
        self.steps = 0

    def make(self, meant: Any) -> Any:
        """Return an array or a plain value; refuse any other."""
        self.steps += 1
        if self.steps > MAX_STEPS:
            raise _RefusedError("too many values")
        if isinstance(meant, (_Array, _Scalar)):
            return meant.real(self.make)
        if isinstance(meant, (_Wrapped, _Tensor)):
            return meant.array
        if isinstance(meant, dict):
            return {key: self.make(value) for key, value in meant.items()}
        if isinstance(meant, (list, tuple)):
            return [self.make(value) for value in meant]
        if meant is None or isinstance(meant, (bool, int, float, str)):
            return meant
        raise _RefusedError(f"a {type(meant).__name__}")


def load(data: bytes, where: str, storage: Callable[[str], bytes] | None = None) -> Any:
    """Return the contents of a pickle, or of an uncompressed or zlib joblib file.

    Args:
        storage: The storages of a file of torch's: key → the bytes of a storage of tensors,
            little-endian.

    Raises:
        LogError: It names anything else, is damaged, or too large.
    """
    try:
        if data[:1] == b"\x78":
            packed = zlib.decompressobj()
            data = packed.decompress(data, MAX_ARRAYS_BYTES)
        return _Maker().make(_Unpickler(io.BytesIO(data), storage).load())
    except Exception as error:  # a damaged stream makes the machine of a pickle fail in any way
        reason = " ".join(str(error).split())[:150] or type(error).__name__
        raise LogError(
            f"{where}: not a pickle of arrays, numbers and text ({reason}); nothing of it was run"
        ) from None
