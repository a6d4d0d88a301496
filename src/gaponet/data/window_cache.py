"""The window cache: what a model trains on, laid out so that any stretch of rows is one read from the disk.

    cache/<key>/frames.f32   little-endian float32; row after row [ctrl | qpos | qvel] of the chosen joints, sequence
                             after sequence in the journal's order
    cache/<key>/index.json   joints, channels, rows and sequences

It is computed from the Parquet files and never changed: the key is a hash of the recordings and the joints in it. A
dataset that has grown gets a new cache, and the old one of these joints is removed.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gaponet.data.store import Dataset
from gaponet.errors import DatasetError, JointMismatchError
from gaponet.files import MARK, writing

Progress = Callable[[float, float, str], None]  # sequences done, total, motion

CHANNELS = ("ctrl", "qpos", "qvel")
FORMAT = 1
DTYPE = "<f4"


def window_cache(dataset: Dataset, joints: tuple[str, ...], progress: Progress | None = None) -> Path:
    """The file frames.f32 of these joints, made first where it is missing or out of date.

    Args:
        dataset: At least one sequence; all of them go in.
        joints: Of the dataset, in the order wanted.
        progress: Called after each sequence while it is being made.
    """
    for name in joints:
        if name not in dataset.joint_names:
            raise JointMismatchError(f"{dataset.path}: no joint '{name}'; it holds {', '.join(dataset.joint_names)}")
    if not dataset.entries:
        raise DatasetError(f"{dataset.path}: holds no sequences yet; import or collect some")
    place = dataset.path / "cache" / cache_key(dataset, joints)
    if not _complete(place, dataset, joints):
        with writing(place.parent, "cache", wait=math.inf):
            if not _complete(place, dataset, joints):  # another process may have made it meanwhile
                _make(place, dataset, joints, progress)
    return place / "frames.f32"


def cache_key(dataset: Dataset, joints: tuple[str, ...]) -> str:
    """Of everything that decides the bytes of a cache."""
    digest = hashlib.sha256(repr((FORMAT, CHANNELS, joints)).encode())
    for entry in dataset.entries:
        digest.update(entry.hash.encode())
    return digest.hexdigest()[:16]


def _complete(place: Path, dataset: Dataset, joints: tuple[str, ...]) -> bool:
    file = place / "frames.f32"
    rows = sum(e.rows for e in dataset.entries)
    return file.is_file() and file.stat().st_size == rows * len(CHANNELS) * len(joints) * np.dtype(DTYPE).itemsize


def _make(place: Path, dataset: Dataset, joints: tuple[str, ...], progress: Progress | None) -> None:
    columns = [dataset.joint_names.index(name) for name in joints]
    temporary = place.with_name(f"{MARK}-{os.getpid()}-{place.name}")
    temporary.mkdir()
    try:
        with (temporary / "frames.f32").open("wb") as file:
            for i, entry in enumerate(dataset.entries, 1):
                arrays = dataset.channels(entry, CHANNELS)
                file.write(np.concatenate([arrays[c][:, columns] for c in CHANNELS], axis=1).astype(DTYPE).tobytes())
                if progress:
                    progress(i, len(dataset), entry.meta.motion)
        index = {
            "format": FORMAT, "joint_names": joints, "channels": CHANNELS, "dtype": DTYPE,
            "rows": sum(e.rows for e in dataset.entries), "sequences": len(dataset),
        }  # fmt: skip
        (temporary / "index.json").write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
        shutil.rmtree(place, ignore_errors=True)
        temporary.rename(place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _remove_others(place, joints)


def _remove_others(place: Path, joints: tuple[str, ...]) -> None:
    """Caches of the same joints that the dataset has outgrown."""
    for index in place.parent.glob("*/index.json"):
        if index.parent != place and tuple(json.loads(index.read_text(encoding="utf-8"))["joint_names"]) == joints:
            shutil.rmtree(index.parent)
