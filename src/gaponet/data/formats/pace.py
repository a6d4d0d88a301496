"""PACE's .pt, or a folder of them: time, dof_pos, des_dof_pos as tensors.

Loaded with weights_only: nothing pickled runs. The file does not name its joints; without joints in logs.toml the
robot's own order is not assumed either. Files of other names work as well: logs.toml says which tensor is what.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.recording import Recording, from_arrays, reading
from gaponet.data.formats import DESCRIBED, files_under
from gaponet.errors import LogError
from gaponet.structure import LARGEST_ARRAYS

OPTIONS = DESCRIBED
EXTRA = "train"
DEFAULT: LogsFile = {
    "time": "time", "time_unit": "s", "position_unit": "rad", "ctrl": "des_dof_pos", "qpos": "dof_pos",
    "qvel": "dof_vel", "tau": "dof_torque",
}  # fmt: skip


def detects(path: Path) -> bool:
    """A file of that suffix, or a folder with one at or below it."""
    return bool(find(path))


def find(path: Path) -> list[Path]:
    """The files."""
    return files_under(path, (".pt",))


def recordings(path: Path, told: LogsFile) -> Iterator[Recording]:
    """Every file."""
    for file in find(path):
        yield from_arrays(file, _read(file))


def _read(file: Path) -> dict[str, Any]:
    import torch

    with reading(file, ".pt file of tensors"):
        with zipfile.ZipFile(file) as packed:  # as torch 1.6 and later write
            if sum(part.file_size for part in packed.infolist()) > LARGEST_ARRAYS:
                raise LogError(f"{file}: unpacks to more than {LARGEST_ARRAYS >> 20} MiB; cut it into shorter logs")
        told = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(told, dict):
            raise LogError(f"{file}: holds no dictionary of tensors; save {{time, dof_pos, des_dof_pos}}")
        tensors = {str(k): v for k, v in told.items() if isinstance(v, torch.Tensor) and not v.is_complex()}
        # A tensor may claim to be large by repeating one number: its storage is what there is.
        whole = {k: v for k, v in tensors.items() if v.numel() * v.element_size() <= v.untyped_storage().nbytes()}
        return {k: v.detach().to(torch.float64).numpy() for k, v in whole.items()}
