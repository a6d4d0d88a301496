"""A small part of a dataset as a dataset of its own, for rehearsals: files are linked, not copied."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from gaponet.data.pair import hash_order
from gaponet.data.store import Dataset, Entry, write_text

MOTIONS, PAYLOADS, UNITS = 8, 3, 3  # a split by motion has 5 + 1 + 2 of 8


def rehearsal(dataset: Dataset) -> list[Entry]:
    """Few motions, payloads and units (evenly spaced), one repetition, all rates: every group stays represented."""
    payloads = _few(sorted({e.meta.payload_mass for e in dataset.entries}), PAYLOADS)
    units = sorted({e.meta.unit_id for e in dataset.entries})[:UNITS]
    motions = hash_order(e.meta.motion for e in dataset.entries)[:MOTIONS]
    first = min(e.meta.repetition for e in dataset.entries)
    return [
        e for e in dataset.entries
        if e.meta.motion in motions and e.meta.payload_mass in payloads and e.meta.unit_id in units
        and e.meta.repetition == first
    ]  # fmt: skip


def take(dataset: Dataset, entries: Iterable[Entry], out: Path) -> Dataset:
    """Those sequences as a dataset at out; the same call again finds it as it is."""
    entries = list(entries)
    (out / "sequences").mkdir(parents=True, exist_ok=True)
    shutil.copyfile(dataset.path / "dataset.json", out / "dataset.json")
    for entry in entries:
        file = out / "sequences" / f"{entry.id}.parquet"
        if not file.exists():
            _link(dataset.path / "sequences" / file.name, file)
    lines = [json.dumps(asdict(e), ensure_ascii=False, allow_nan=False) + "\n" for e in entries]
    write_text(out / "sequences.jsonl", "".join(lines))
    return Dataset(out)


def _few(values: list[float], most: int) -> list[float]:
    """So many of them, the first and the last among them."""
    if len(values) <= most:
        return values
    return [values[round(i * (len(values) - 1) / (most - 1))] for i in range(most)]


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another disk
        shutil.copyfile(source, target)
