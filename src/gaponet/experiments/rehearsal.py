"""A small part of a dataset as a dataset of its own, for rehearsals."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gaponet.data.pair import hash_order
from gaponet.data.store import Dataset, Entry
from gaponet.report.evaluate import evenly
from gaponet.robot.spec import RobotSpec

MOTIONS, PAYLOADS, UNITS = 6, 3, 2  # a split by motion has 3 + 1 + 2 of 6
SECONDS = 2.0


def rehearsal(dataset: Dataset) -> list[Entry]:
    """Few motions, payloads and units (evenly spaced), one repetition, all rates: every group stays represented."""
    payloads = evenly(sorted({e.meta.payload_mass for e in dataset.entries}), PAYLOADS)
    units = sorted({e.meta.unit_id for e in dataset.entries})[:UNITS]
    motions = hash_order(e.meta.motion for e in dataset.entries)[:MOTIONS]
    first = min(e.meta.repetition for e in dataset.entries)
    return [
        e for e in dataset.entries
        if e.meta.motion in motions and e.meta.payload_mass in payloads and e.meta.unit_id in units
        and e.meta.repetition == first
    ]  # fmt: skip


def take(dataset: Dataset, robot: RobotSpec, entries: Iterable[Entry], out: Path, seconds: float = SECONDS) -> Dataset:
    """The first seconds of those sequences as a dataset at out; the same call again finds it as it is."""
    part = Dataset.create(out, robot)
    for entry in entries:
        start = dataset.read(entry).rows(slice(0, round(seconds / entry.dt)))
        if part.find(start.content_hash()) is None:
            part.append(start)
    return part
