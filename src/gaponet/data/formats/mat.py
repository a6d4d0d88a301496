"""MATLAB .mat (up to v7; v7.3 is HDF5), or a folder of them: arrays of one row per sample.

Signals are called by the names of the variables; a field of a struct is STRUCT.FIELD. logs.toml
says which is what.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording, reading
from gaponet.data.formats import files_under

SUFFIXES = (".mat",)
DEFAULT: LogsFile = {"time": "time"}


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every file."""
    for file in files_under(path, SUFFIXES):
        yield RawRecording.of_arrays(file, _read(file))


@sandboxed(LogError, "scipy.io")
def _read(file: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    with file.open("rb") as stream:
        if b"MATLAB 7.3" in stream.read(128):
            raise LogError(
                f"{file}: a v7.3 file, which is HDF5: rename it to .h5, or save it with -v7"
            )
    with reading(file, ".mat file"):
        variables = loadmat(file, simplify_cells=True)
        members = {}
        for name, struct in variables.items():
            if isinstance(struct, dict):
                for field, value in struct.items():
                    members[f"{name}.{field}"] = value
        arrays = variables | members
        return {name: value for name, value in arrays.items() if _is_array(value)}


def _is_array(value: Any) -> bool:
    """Return True for an array of numbers."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
