"""The data card: what a dataset holds, counted and measured from its files; only licence and source are typed in."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from gaponet import __version__
from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json
from gaponet.data.log import UNITS
from gaponet.data.repeatability import Repetitions
from gaponet.data.sequence import ARRAYS
from gaponet.data.store import Dataset, Entry, dataset_hash

QUANTILE_ROWS = 100_000  # so many rows, evenly spread over the set, give the 1 % and 99 % quantiles
NOT_STATED = "not stated"
SHARES: dict[str, Callable[[Entry], str]] = {
    "level": lambda e: e.meta.level,
    "payload_kg": lambda e: f"{e.meta.payload_mass:g}",
    "unit": lambda e: e.meta.unit_id,
    "rate_hz": lambda e: f"{1 / e.dt:.2f}".rstrip("0").rstrip("."),
}


def make_card(dataset: Dataset, progress: Progress = no_progress) -> dict[str, Any]:
    """Read every sequence once, repetitions of a motion one after the other, and count.

    Raises:
        DatasetError: Empty, or a file has other rows than the journal says.
    """
    if not dataset.entries:
        raise DatasetError(f"{dataset.path}: holds no sequences yet; import or collect some")
    stride = max(1, sum(e.rows for e in dataset.entries) // QUANTILE_ROWS)
    ranges = {name: _Range(stride) for name in ARRAYS}
    repeated, done = [], 0
    for group in _repetition_groups(dataset.entries):
        repetitions = Repetitions()
        for entry in group:
            sequence = dataset.read(entry)
            for name in entry.channels:
                ranges[name].add(getattr(sequence, name))
            repetitions.add(sequence)
            done += 1
            progress(done, len(dataset), entry.meta.motion)
        if repetitions.count > 1:
            repeated.append(repetitions.result())
    return counted(dataset) | {
        "signals": {
            name: {"unit": UNITS[name], "sequences": r.sequences, "joints": r.by_joint(dataset.joint_names)}
            for name, r in ranges.items()
            if r.sequences
        },
        "repeatability": Repetitions.summary(repeated, dataset.joint_names),
    }


def counted(dataset: Dataset) -> dict[str, Any]:
    """What of the card the journal says: what the dataset is, where it comes from and how much there is."""
    made = dataset.path / "collect.json"
    recorded = sorted({e.meta.recorded_at for e in dataset.entries} - {""})
    return {
        "name": dataset.path.resolve().name,
        "robot": dataset.robot_name,
        "joints": list(dataset.joint_names),
        "virtual_sequences": sum(e.meta.virtual for e in dataset.entries),
        "licence": dataset.header.get("licence", NOT_STATED),
        "source": dataset.header.get("source", NOT_STATED),
        "recorded": [recorded[0], recorded[-1]] if recorded else NOT_STATED,
        "collected": read_json(dict[str, Any], made, DatasetError, "restore it or delete it")
        if made.is_file()
        else None,
        "dataset_hash": dataset_hash(dataset.entries),
        "format": dataset.header["format"],
        "bytes": sum(f.stat().st_size for f in (dataset.path / "sequences").iterdir()),
        "gaponet": __version__,
        "total": count(dataset.entries),
        "shares": {name: _shares(dataset.entries, key) for name, key in SHARES.items()},
    }


def write_card(dataset: Dataset, card: dict[str, Any], text: str) -> None:
    """card.json and CARD.md in the dataset folder."""
    with dataset.writing():
        write_text(dataset.path / "card.json", json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
        write_text(dataset.path / "CARD.md", text)


def count(entries: list[Entry]) -> dict[str, float]:
    """sequences, hours, frames, motions."""
    return {
        "sequences": len(entries),
        "hours": sum(e.rows * e.dt for e in entries) / 3600,
        "frames": sum(e.rows for e in entries),
        "motions": len({e.meta.motion for e in entries}),
    }


def _shares(entries: list[Entry], key: Callable[[Entry], str]) -> dict[str, dict[str, float]]:
    """Counts by a property, numbers in the order of their size, names in the alphabet's."""
    groups: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        groups[key(entry)].append(entry)
    return {name: count(groups[name]) for name in sorted(groups, key=_number_or_name)}


def _repetition_groups(entries: list[Entry]) -> Iterable[list[Entry]]:
    """Entries of the same motion, unit, payload and period together."""
    groups: dict[tuple[object, ...], list[Entry]] = defaultdict(list)
    for e in entries:
        groups[*e.meta.slot, round(e.dt, 7)].append(e)
    return groups.values()


class _Range:
    """Least, greatest, mean, spread and outer percentiles of one channel, without keeping it; every `stride`-th row
    is kept for the percentiles."""

    def __init__(self, stride: int) -> None:
        self.stride = stride
        self.sequences = self._rows = 0
        self._low, self._high, self._sum, self._squares = np.inf, -np.inf, 0.0, 0.0
        self._kept: list[Array] = []

    def add(self, values: Array) -> None:
        """Take in a sequence, (T, n)."""
        self._kept.append(values[-self._rows % self.stride :: self.stride].copy())
        self.sequences += 1
        self._rows += len(values)
        self._low = np.minimum(self._low, values.min(axis=0))
        self._high = np.maximum(self._high, values.max(axis=0))
        self._sum = self._sum + values.sum(axis=0, dtype=float)
        self._squares = self._squares + (values.astype(float) ** 2).sum(axis=0)

    def by_joint(self, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
        """{joint: min, p1, mean, p99, max, std}."""
        mean = self._sum / self._rows
        std = np.sqrt(np.maximum(self._squares / self._rows - mean**2, 0))
        p1, p99 = np.percentile(np.concatenate(self._kept), [1, 99], axis=0)
        columns = {"min": self._low, "p1": p1, "mean": mean, "p99": p99, "max": self._high, "std": std}
        return {j: {k: float(f"{v[i]:.6g}") for k, v in columns.items()} for i, j in enumerate(names)}


def _number_or_name(text: str) -> tuple[float, str]:
    try:
        return float(text), ""
    except ValueError:
        return 0.0, text
