"""NumPy .npz, or a folder of them: GAPONet's motion files, ASAP's, or any with arrays of one row
per sample.

GAPONet's files hold many motions in one: real_dof_positions_cmd,
real_dof_positions, real_dof_velocities, real_dof_torques (motions, rows, joints), padded with zero
rows, or one array per motion; joint_sequence; payloads; or windows in which one joint moves,
(windows, rows), with that joint's name in joint_sequence, (windows,). They have no clock: logs.toml
says rate = 50.0, or --rate 50 does. In plain files logs.toml says which array is what; text in
joint_names names the columns. Arrays of objects: gaponet.data.formats.pickles.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording
from gaponet.data.formats import files_under, pickles

SUFFIXES = (".npz",)
DEFAULT: LogsFile = {"time": "time"}
GAPONET: LogsFile = {
    "ctrl": "real_dof_positions_cmd",
    "qpos": "real_dof_positions",
    "qvel": "real_dof_velocities",
    "tau": "real_dof_torques",
    "position_unit": "rad",
    "time_unit": "s",
}
NAMES = ("joint_names", "joint_sequence", "dof_names")
# Version of a .npy file → what reads its header: shape, order and dtype.
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every file, or every motion in it."""
    for file in files_under(path, SUFFIXES):
        arrays = _read(file)
        names = _joint_names(arrays)
        if {"real_dof_positions", "real_dof_positions_cmd"} <= arrays.keys():
            yield from _motions(file, arrays, names)
        else:
            yield RawRecording.of_arrays(file, arrays, names)


def _joint_names(arrays: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of columns that a file holds; () if it holds none."""
    for name in NAMES:
        if name in arrays:
            return tuple(map(str, arrays[name].ravel()))
    return ()


def _motions(file: Path, arrays: dict[str, Any], names: tuple[str, ...]) -> Iterator[RawRecording]:
    """GAPONet's: the first axis counts motions."""
    signals = {name: arrays[name] for name in GAPONET.values() if name in arrays}
    count = min(len(array) for array in signals.values())
    single = len(names) == count and all(_is_table(array) for array in signals.values())
    payloads = np.asarray(arrays["payloads"]).ravel() if "payloads" in arrays else ()
    for i in range(count):
        labels = {}
        if len(payloads) == count:
            labels["payload_mass"] = float(payloads[i])
        yield RawRecording.of_arrays(
            file,
            _motion(file, signals, i, single),
            names[i : i + 1] if single else names,
            f"{file.stem}-{i:04d}",
            str(i),
            meta={"stated": labels},
            default=_described(signals),
        )


def _described(signals: dict[str, Any]) -> LogsFile:
    """Return what logs.toml would say of the signals that a file holds."""
    described = {}
    for field, stated in GAPONET.items():
        if stated in signals or field.endswith("_unit"):
            described[field] = stated
    return cast("LogsFile", described)


def _motion(file: Path, signals: dict[str, Array], i: int, single: bool) -> dict[str, Array]:
    """Return motion i of arrays of motions without padding, (rows, joints) each.

    Args:
        single: Only one joint moves in each motion, so that a motion has no axis of joints.
    """
    motion = {}
    for name, array in signals.items():
        values = np.asarray(array[i], float)
        if single:
            values = values[:, None]
        if values.ndim != 2:
            raise LogError(
                f"{file}: motion {i} of {', '.join(signals)} is not rows of joints; write it again"
            )
        motion[name] = values
    return _without_padding(motion)


def _is_table(array: Array) -> bool:
    return array.dtype != object and array.ndim == 2


def _without_padding(motion: dict[str, Array]) -> dict[str, Array]:
    """Return the arrays (rows, joints) to the last row in which a command or position is not 0."""
    qpos = motion["real_dof_positions"]
    ctrl = motion["real_dof_positions_cmd"]
    rows = min(len(values) for values in motion.values())
    used = np.flatnonzero(qpos[:rows].any(axis=1) | ctrl[:rows].any(axis=1))
    end = int(used[-1]) + 1 if len(used) else 0
    return {name: values[:end] for name, values in motion.items()}


@sandboxed(LogError, "numpy")
def _read(file: Path) -> dict[str, Any]:
    """Every array; those of objects by a safe unpickler."""
    arrays = {}
    with pickles.open_zip(file, "npz file") as packed:
        for name in packed.namelist():
            arrays[name.removesuffix(".npy")] = _array(packed.read(name), f"{file}: {name}")
    return arrays


def _array(data: bytes, where: str) -> Any:
    """Return the array of a .npy file."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = HEADERS.get(version)
    holds_objects = False
    if read_header is not None:
        _, _, kind = read_header(stream)
        holds_objects = kind.hasobject
    if not holds_objects:
        return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    array = pickles.load(stream.read(), where)  # what stands behind the header
    if not isinstance(array, np.ndarray):
        raise LogError(f"{where}: not an array")
    return array
