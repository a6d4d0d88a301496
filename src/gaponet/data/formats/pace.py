"""PACE's .pt, or a folder of them: time, dof_pos, des_dof_pos as tensors or NumPy arrays, gains
where it states them.

Nothing pickled runs and torch is not needed (formats.pickles). The file does not name its joints;
without joints in logs.toml the robot's own order is not assumed either. kp and kd, one number a
joint or one for all, are the gains while recording. Files of other names work as well: logs.toml
says which tensor is what.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording
from gaponet.data.formats import files_under, pickles

SUFFIXES = (".pt",)
DEFAULT: LogsFile = {
    "time": "time",
    "time_unit": "s",
    "position_unit": "rad",
    "ctrl": "des_dof_pos",
    "qpos": "dof_pos",
    "qvel": "dof_vel",
    "tau": "dof_torque",
}
GAINS = ("kp", "kd")


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every file."""
    for file in files_under(path, SUFFIXES):
        arrays = _read(file)
        gains = {name: arrays.pop(name) for name in GAINS if name in arrays}
        default: LogsFile = {}
        qpos = arrays.get(str(specified.get("qpos")))
        if qpos is not None and qpos.ndim in (1, 2):
            for name, stated in gains.items():
                arrays[name] = _in_each_row(file, name, stated, qpos)
                default[name] = name  # type: ignore[literal-required]
        yield RawRecording.of_arrays(file, arrays, default=default)


def _in_each_row(file: Path, name: str, stated: Array, qpos: Array) -> Array:
    """Return gains, one for all joints or one for each, in the shape of the positions: (k, n) or
    (k,).
    """
    joints = int(np.prod(qpos.shape[1:]))
    if stated.size not in (1, joints):
        raise LogError(
            f"{file}: {name} has {stated.size} values; give 1 or one for each of {joints} joints"
        )
    return np.broadcast_to(stated.ravel(), qpos.shape)


@sandboxed(LogError, "numpy")
def _read(file: Path) -> dict[str, Any]:
    """Every array of numbers; others are left alone."""
    with pickles.open_zip(file, ".pt file of tensors") as packed:  # as torch 1.6 and later write
        pickled = [name for name in packed.namelist() if name.endswith("/data.pkl")]
        top = pickled[0].removesuffix("data.pkl") if pickled else None
        if top is None:
            raise LogError(
                f"{file}: a zip file without data.pkl, so not what torch.save writes; is it the "
                "right file?"
            )
        if f"{top}byteorder" in packed.namelist() and packed.read(f"{top}byteorder") != b"little":
            raise LogError(
                f"{file}: written big-endian; load it and save it again on another machine"
            )
        specified = pickles.load(
            packed.read(f"{top}data.pkl"), str(file), lambda key: packed.read(f"{top}data/{key}")
        )
    if not isinstance(specified, dict):
        raise LogError(
            f"{file}: holds no dictionary of tensors; save {{time, dof_pos, des_dof_pos}}"
        )
    arrays = {}
    for name, value in specified.items():
        is_number = isinstance(value, (np.ndarray, int, float))
        if is_number and np.asarray(value).dtype.kind in "fiub":
            arrays[str(name)] = np.asarray(value, float)
    return arrays
