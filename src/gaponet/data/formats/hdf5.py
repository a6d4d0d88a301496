"""HDF5 file, or a folder of them: ALOHA, robomimic, or any with arrays of one row per sample.

Signals are called by their path in the file: action, observations/qpos, … ALOHA's names are known;
it has no clock, so logs.toml says rate = 50.0, and joints, as its columns have no names. A file
with several demonstrations (robomimic's data/demo_0, …) holds one recording in each; robomimic's
actions are mostly steps of the hand, not joint positions, so logs.toml must say which array is the
command. Images are not read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.base.structure import MAX_ARRAYS_BYTES
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import WIDEST, RawRecording, Signal, reading
from gaponet.data.formats import files_under

SUFFIXES = (".h5", ".hdf5")
EXTRA = "hdf5"
ALOHA: LogsFile = {
    "ctrl": "action",
    "qpos": "observations/qpos",
    "qvel": "observations/qvel",
    "tau": "observations/effort",
    "position_unit": "rad",
}
MAX_DEPTH = 6  # of groups in groups
MAX_ARRAYS = 5000  # in a file


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every file, or every demonstration in it."""
    for file in files_under(path, SUFFIXES):
        arrays = _listed(file)
        for demo in _demos(arrays) or [""]:
            yield _recording(file, demo, arrays)


def _demos(paths: Iterable[str]) -> list[str]:
    """Return the demonstrations of a file of robomimic's, such as data/demo_0, by number; data/arm
    is none.
    """
    demos = set()
    for path in paths:
        group, *rest = path.split("/")
        # An array in the group itself is no demonstration.
        if group == "data" and len(rest) > 1 and rest[0][-1].isdigit():
            demos.add(f"{group}/{rest[0]}")

    def number(demo: str) -> int:
        return int(re.sub(r"\D", "", demo)[:9] or 0)

    return sorted(sorted(demos), key=number)


def _recording(file: Path, demo: str, arrays: dict[str, tuple[str, ...]]) -> RawRecording:
    """A file, or one demonstration in it.

    Args:
        demo: Its path in the file; "" for the whole file.
        arrays: Of the whole file.
    """
    signals = {}
    for path, labels in arrays.items():
        if not demo or path.startswith(f"{demo}/"):
            signals[path.removeprefix(demo).lstrip("/")] = labels
    default = LogsFile()
    if not demo and {"action", "observations/qpos"} <= signals.keys():
        known = {}
        for field, stated in ALOHA.items():
            if stated in signals or field == "position_unit":
                known[field] = stated
        default = cast("LogsFile", known)
    name = file.stem
    source = str(file)
    part = demo.rpartition("/")[2]
    if part:
        name = f"{file.stem}-{part}"
        source = f"{file}#{part}"
    load = partial(_load, file, demo)
    return RawRecording(name, source, signals, load, str(file), (str(file),), default=default)


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """The file."""
    import h5py

    with reading(file, "HDF5 file"), h5py.File(file, "r") as root:
        yield root


@sandboxed(LogError, "h5py")
def _listed(file: Path) -> dict[str, tuple[str, ...]]:
    """Arrays of numbers with one row per sample, by path, and names of their columns.

    Links are not followed.
    """
    import h5py

    arrays: dict[str, tuple[str, ...]] = {}
    with _opened(file) as root:
        groups = [("", root, 0)]
        for place, group, depth in groups:
            for name in group:
                path = f"{place}/{name}".lstrip("/")
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    continue  # a soft link may make a circle, an external one open another file
                item = group[name]
                if isinstance(item, h5py.Group) and depth < MAX_DEPTH:
                    groups.append((path, item, depth + 1))
                elif isinstance(item, h5py.Dataset) and _is_signal(item):
                    width = item.shape[1] if item.ndim == 2 else 0
                    arrays[path] = tuple(str(i) for i in range(width))
                if len(arrays) > MAX_ARRAYS:
                    raise LogError(
                        f"{file}: more than {MAX_ARRAYS} arrays; give one recording per file"
                    )
    return dict(sorted(arrays.items()))


def _is_signal(item: Any) -> bool:
    """Return True for an array in this file with a row of numbers per sample."""
    if item.dtype.kind not in "fiu" or item.ndim not in (1, 2):
        return False
    if item.external is not None or item.is_virtual:
        return False
    return len(item) > 0 and (item.ndim == 1 or item.shape[1] <= WIDEST)


@sandboxed(LogError, "h5py")
def _load(file: Path, demo: str, names: list[str]) -> dict[str, Signal]:
    with _opened(file) as root:
        arrays = {}
        for name in names:
            item = root[f"{demo}/{name}".lstrip("/")]
            if item.size * 8 > MAX_ARRAYS_BYTES:
                raise LogError(
                    f"{file}: {name} has {item.shape} numbers; cut the log into shorter ones"
                )
            arrays[name] = Signal(np.asarray(item[()], float))
        return arrays
