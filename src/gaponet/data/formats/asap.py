"""ASAP's motion pickle (.pkl): {motion: {dof, action, fps, …}}; opened with --allow-pickle only.

`action` is the policy's: the target is default position + action_scale · action, 0.25 in ASAP's
configuration. logs.toml says action_scale, and home in robot.toml is the default position. Joints
have no names in it: logs.toml lists them. Opened as formats.pickles says: nothing runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import LogError
from gaponet.base.sandbox import sandboxed
from gaponet.base.structure import MAX_ARRAYS_BYTES, read_limited
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording, require_content
from gaponet.data.formats import files_under, pickles

SUFFIXES = (".pkl",)
PICKLED = True
DEFAULT: LogsFile = {
    "ctrl": "action",
    "qpos": "dof",
    "qvel": "dof_vel",
    "position_unit": "rad",
    "time_unit": "s",
}


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every motion of every file."""
    for file in files_under(path, SUFFIXES):
        require_content(file)
        content = _read(file)
        motions = {}
        if isinstance(content, dict):
            for name, motion in content.items():
                if isinstance(motion, dict) and "dof" in motion:
                    motions[str(name)] = motion
        if not motions:
            raise LogError(
                f"{file}: no motion with dof in it; an ASAP file is {{motion: {{dof, action, "
                f"fps}}}}"
            )
        for name, motion in motions.items():
            yield _recording(file, name, motion)


@sandboxed(LogError, "numpy")
def _read(file: Path) -> Any:
    return pickles.load(read_limited(file, LogError, "split it", MAX_ARRAYS_BYTES), str(file))


def _is_array(value: Any) -> bool:
    """Return True for an array of numbers."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.ndim > 0


def _recording(file: Path, name: str, motion: dict[str, Any]) -> RawRecording:
    where = f"{file}#{name}"
    arrays = {field: value for field, value in motion.items() if _is_array(value)}
    fps = motion.get("fps")
    if not isinstance(fps, (int, float, np.number)) or not 1 <= float(fps) <= 10_000:
        raise LogError(f"{where}: fps is {fps!r:.40}; a number from 1 to 10000 Hz")
    if "action" not in arrays or "dof" not in arrays:
        raise LogError(
            f"{where}: no {'action' if 'dof' in arrays else 'dof'}: a motion to follow, not a log"
        )
    rows = min(len(arrays["action"]), len(arrays["dof"]))
    arrays = {field: array[:rows] for field, array in arrays.items() if len(array) >= rows}
    default = LogsFile(rate=float(fps))
    names = motion.get("joint_names")
    labels = tuple(map(str, names)) if isinstance(names, (list, np.ndarray)) else ()
    return RawRecording.of_arrays(file, arrays, labels, name, part=name, default=default)
