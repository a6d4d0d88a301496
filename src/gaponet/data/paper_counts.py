"""What the SimLifter and GAPONet paper counts of its dataset, and the same counts of a dataset
here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from gaponet.base.result_table import ResultTable
from gaponet.data.sequence import ARRAYS, whole_rate
from gaponet.data.store import Dataset, Entry
from gaponet.robot.folder import load_stored_robot

COMMAND = "ctrl"  # the input of a recording; all other channels are signals of the robot
# The paper's own numbers do not reconcile, which a reader of both columns must know.
NOT_RECONCILED = (
    "The paper's own counts do not reconcile: 28.46 h at 50 Hz are 5.1 million frames, and "
    "257,493 frames of 11,198 sequences are 23 frames each."
)
MEANING = (
    "The paper's robots are real: three H1-2 and an unseen fourth. Joints: those that are "
    "identified and corrected. Repetitions: the most of one motion by one unit with one payload "
    "at one rate. Signals: channels that every sequence stores, without the command."
)


@dataclass(frozen=True)
class DatasetCounts:
    """Counts of a dataset as the paper states them.

    Attributes:
        hours: Recorded time, h.
        sequences: Recordings.
        frames: Rows of all sequences.
        units: Robots, also those that are kept for tests.
        joints: Joints that are identified and corrected.
        payloads_kg: Masses in each hand, ascending.
        rates_hz: Control rates, ascending.
        repetitions: The most of one motion by one unit with one payload at one rate.
        signals: Channels that every sequence stores, without the command.
    """

    hours: float
    sequences: int
    frames: int
    units: int
    joints: int
    payloads_kg: tuple[float, ...]
    rates_hz: tuple[float, ...]
    repetitions: int
    signals: int


PAPER = DatasetCounts(
    hours=28.46,
    sequences=11_198,
    frames=257_493,
    units=4,
    joints=10,
    payloads_kg=(0.0, 1.0, 2.0, 3.0),
    rates_hz=(50.0, 100.0),
    repetitions=3,
    signals=6,
)


def count_as_paper(dataset: Dataset) -> DatasetCounts:
    """Return the paper's counts of a dataset, from its journal and its stored robot.

    Raises:
        DatasetError: It is empty.
        RobotError: It stores no robot, and the package has none of that name.
    """
    dataset.require_sequences()
    entries = dataset.entries
    repetitions = Counter((entry.meta.repetition_key, whole_rate(entry.dt)) for entry in entries)
    return DatasetCounts(
        hours=dataset.hours(),
        sequences=len(entries),
        frames=sum(entry.rows for entry in entries),
        units=len({entry.meta.unit_id for entry in entries}),
        joints=len(load_stored_robot(dataset.path, dataset.robot_name).operated),
        payloads_kg=tuple(sorted({entry.meta.payload_mass for entry in entries})),
        rates_hz=tuple(sorted({round(1 / entry.dt, 2) for entry in entries})),
        repetitions=max(repetitions.values()),
        signals=len(common_signals(entries)),
    )


def common_signals(entries: Iterable[Entry]) -> tuple[str, ...]:
    """Return the channels that every sequence stores, without the command, in the order of
    ARRAYS.
    """
    common = set(ARRAYS).intersection(*(entry.channels for entry in entries)) - {COMMAND}
    return tuple(name for name in ARRAYS if name in common)


def table_beside_paper(here: DatasetCounts) -> ResultTable:
    """Return the counts of a dataset beside the paper's."""
    rows: tuple[tuple[Any, ...], ...] = (
        ("hours", PAPER.hours, here.hours),
        ("sequences", PAPER.sequences, here.sequences),
        ("frames", PAPER.frames, here.frames),
        ("units", PAPER.units, here.units),
        ("joints", PAPER.joints, here.joints),
        ("payloads, kg per hand", _listed(PAPER.payloads_kg), _listed(here.payloads_kg)),
        ("rates, Hz", _listed(PAPER.rates_hz), _listed(here.rates_hz)),
        ("repetitions", PAPER.repetitions, here.repetitions),
        ("signals", PAPER.signals, here.signals),
    )
    columns = ("what", "the paper", "this dataset")
    return ResultTable("beside_paper", columns, rows, f"{NOT_RECONCILED} {MEANING}")


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
