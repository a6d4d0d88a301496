"""MATLAB .mat (up to v7; v7.3 is HDF5), or a folder of them: arrays of one row per sample.

Signals are called by the names of the variables; a field of a struct is STRUCT.FIELD. logs.toml says which is what.
"""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.recording import Recording, from_arrays, reading
from gaponet.data.formats import DESCRIBED, files_under
from gaponet.errors import LogError
from gaponet.structure import LARGEST_ARRAYS

OPTIONS = DESCRIBED
EXTRA = ""
DEFAULT: LogsFile = {"time": "time"}

PARSE = """
import sys
import numpy as np
from scipy.io import loadmat
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]),) * 2)
except ImportError:  # Windows
    pass
told = loadmat(sys.argv[1], simplify_cells=True)
told |= {f"{name}.{k}": x for name, v in told.items() if isinstance(v, dict) for k, x in v.items()}
np.savez(sys.stdout.buffer, **{n: x for n, x in told.items() if isinstance(x, np.ndarray) and x.dtype.kind in "fiu"})
"""


def detects(path: Path) -> bool:
    """A file of that suffix, or a folder with one at or below it."""
    return bool(find(path))


def find(path: Path) -> list[Path]:
    """The files."""
    return files_under(path, (".mat",))


def recordings(path: Path, told: LogsFile) -> Iterator[Recording]:
    """Every file."""
    for file in find(path):
        yield from_arrays(file, _read(file))


def _read(file: Path) -> dict[str, Any]:
    with file.open("rb") as stream:
        if b"MATLAB 7.3" in stream.read(128):
            raise LogError(f"{file}: a v7.3 file, which is HDF5: rename it to .h5, or save it with -v7")
    if file.stat().st_size > LARGEST_ARRAYS:
        raise LogError(f"{file}: has more than {LARGEST_ARRAYS >> 20} MiB; cut the log into shorter ones")
    # In a process of its own: SciPy's parser, which is C, does not survive every damaged file.
    done = subprocess.run([sys.executable, "-c", PARSE, str(file), str(4 * LARGEST_ARRAYS)], capture_output=True)
    with reading(file, ".mat file"):
        if done.returncode:
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise ValueError(said[-1] if said else f"its parser ended with {done.returncode}")
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            return dict(arrays)
