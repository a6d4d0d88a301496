"""The data card: counts and measured ranges of a dataset, as JSON and Markdown."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from gaponet import __version__
from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import write_json, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.result_table import ResultTable
from gaponet.base.structure import read_json
from gaponet.base.text import escape_markdown
from gaponet.data.log import UNITS
from gaponet.data.paper_counts import (
    NOT_RECONCILED,
    PAPER,
    DatasetCounts,
    count_as_paper,
    table_beside_paper,
)
from gaponet.data.repeatability import Repetitions
from gaponet.data.sequence import ARRAYS, whole_rate
from gaponet.data.statistics import Statistics, pool, statistics
from gaponet.data.store import Dataset, Entry, dataset_hash

PERCENTILE_ROWS = 100_000  # about, evenly taken from the dataset, for the 1 % and 99 % percentiles
NOT_STATED = "not stated"
# Property → its heading and its value; the card counts sequences by each.
PROPERTIES: dict[str, tuple[str, Callable[[Entry], str]]] = {
    "level": ("Level", lambda entry: entry.meta.level),
    "payload_kg": ("Payload, kg per hand", lambda entry: f"{entry.meta.payload_mass:g}"),
    "unit": ("Unit", lambda entry: entry.meta.unit_id),
    "rate_hz": ("Rate, Hz", lambda entry: f"{1 / entry.dt:.2f}".rstrip("0").rstrip(".")),
}


def make_card(dataset: Dataset, progress: Progress = no_progress) -> dict[str, Any]:
    """Read every sequence once, and return counts, ranges and repeatability.

    Raises:
        DatasetError: It is empty, or a file is damaged.
    """
    dataset.require_sequences()
    groups: dict[tuple[object, ...], list[Entry]] = defaultdict(list)
    for entry in dataset.entries:
        groups[*entry.meta.repetition_key, whole_rate(entry.dt)].append(entry)
    signals = _Signals(max(1, sum(entry.rows for entry in dataset.entries) // PERCENTILE_ROWS))
    repeated = []
    done = 0
    for group in groups.values():
        repetitions = Repetitions()
        for entry in group:
            sequence = dataset.read(entry)
            for name in entry.channels:
                signals.add(name, getattr(sequence, name))
            repetitions.add(sequence)
            done += 1
            progress(done, len(dataset), entry.meta.motion)
        if repetitions.count > 1:
            repeated.append(repetitions.result())
    return _counted(dataset) | {
        "signals": signals.by_name(dataset.joint_names),
        "repeatability": Repetitions.summary(repeated, dataset.joint_names),
    }


class _Signals:
    """Accumulates the samples of each channel: statistics of all, and every `stride`-th row."""

    def __init__(self, stride: int) -> None:
        self.stride = stride
        self.statistics: dict[str, list[Statistics]] = defaultdict(list)  # of each recording
        self.samples: dict[str, list[Array]] = defaultdict(list)
        self.rows_before: Counter[str] = Counter()

    def add(self, name: str, values: Array) -> None:
        """Add a channel of one recording, (T, n)."""
        start = -self.rows_before[name] % self.stride
        self.samples[name].append(values[start :: self.stride].copy())
        self.rows_before[name] += len(values)
        self.statistics[name].append(statistics(values))

    def by_name(self, joint_names: tuple[str, ...]) -> dict[str, Any]:
        """Return unit, number of recordings and ranges by joint, of each channel."""
        signals = {}
        for name in ARRAYS:
            of_recordings = self.statistics[name]
            if not of_recordings:
                continue
            samples = np.concatenate(self.samples[name])
            signals[name] = {
                "unit": UNITS[name],
                "sequences": len(of_recordings),
                "joints": _by_joint(pool(of_recordings), samples, joint_names),
            }
        return signals


def beside_paper(dataset: Dataset) -> dict[str, Any]:
    """Return the paper's counts and those of a dataset, for the card's key "beside_paper".

    Raises:
        DatasetError: It is empty.
        RobotError: It stores no robot, and the package has none of that name.
    """
    return {
        "paper": asdict(PAPER),
        "here": asdict(count_as_paper(dataset)),
        "note": NOT_RECONCILED,
    }


def _counted(dataset: Dataset) -> dict[str, Any]:
    """Return what the journal and dataset.json alone say."""
    collected = None
    collect_file = dataset.path / "collect.json"
    if collect_file.is_file():
        hint = "restore it or delete it"
        collected = read_json(dict[str, Any], collect_file, DatasetError, hint)
    dates = sorted({entry.meta.recorded_at for entry in dataset.entries} - {""})
    return {
        "name": dataset.path.resolve().name,
        "robot": dataset.robot_name,
        "joints": list(dataset.joint_names),
        "virtual_sequences": sum(entry.meta.virtual for entry in dataset.entries),
        "licence": dataset.header.get("licence", NOT_STATED),
        "source": dataset.header.get("source", NOT_STATED),
        "recorded": [dates[0], dates[-1]] if dates else NOT_STATED,
        "collected": collected,
        "dataset_hash": dataset_hash(dataset.entries),
        "format": dataset.header["format"],
        "bytes": sum(file.stat().st_size for file in (dataset.path / "sequences").iterdir()),
        "gaponet": __version__,
        "total": count_entries(dataset.entries),
        "shares": {name: _shares(dataset.entries, name) for name in PROPERTIES},
    }


def _shares(entries: list[Entry], name: str) -> dict[str, dict[str, float]]:
    """Return value → counts of the entries that have it, by one of PROPERTIES."""
    _, value_of = PROPERTIES[name]
    groups: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        groups[value_of(entry)].append(entry)
    return {value: count_entries(groups[value]) for value in sorted(groups, key=_number_or_name)}


def count_entries(entries: list[Entry]) -> dict[str, float]:
    """Return the number of sequences, hours, frames and motions."""
    return {
        "sequences": len(entries),
        "hours": sum(entry.rows * entry.dt for entry in entries) / 3600,
        "frames": sum(entry.rows for entry in entries),
        "motions": len({entry.meta.motion for entry in entries}),
    }


def _by_joint(
    pooled: Statistics, samples: Array, names: tuple[str, ...]
) -> dict[str, dict[str, float]]:
    p1, p99 = np.percentile(samples, [1, 99], axis=0)
    columns = {
        "min": pooled["min"],
        "p1": p1,
        "mean": pooled["mean"],
        "p99": p99,
        "max": pooled["max"],
        "std": pooled["std"],
    }
    by_joint: dict[str, dict[str, float]] = {name: {} for name in names}
    for statistic, values in columns.items():
        for name, value in zip(names, values, strict=True):
            by_joint[name][statistic] = float(f"{value:.6g}")
    return by_joint


def _number_or_name(text: str) -> tuple[float, str]:
    """Return a sort key: numbers by size, names by the alphabet."""
    try:
        return float(text), ""
    except ValueError:
        return 0.0, text


def write_card(dataset: Dataset, card: dict[str, Any]) -> None:
    """Write card.json and CARD.md into the dataset folder."""
    with dataset.writing():
        write_json(dataset.path / "card.json", card)
        write_text(dataset.path / "CARD.md", card_markdown(card))


def headline(card: dict[str, Any]) -> str:
    """Return the first line: "demo: 128 sequences, 0.39 h of h1_2, all on VIRTUAL robots"."""
    total = card["total"]
    virtual = card["virtual_sequences"]
    kind = ""
    if virtual == total["sequences"]:
        kind = ", all on VIRTUAL robots"
    elif virtual:
        kind = f", {virtual} of them on VIRTUAL robots"
    return (
        f"{card['name']}: {total['sequences']:,} sequences, {total['hours']:.2f} h of "
        f"{card['robot']}{kind}"
    )


def count_table(card: dict[str, Any], by: str) -> ResultTable:
    """Return sequences, hours, frames and motions by one of PROPERTIES."""
    columns = ("sequences", "hours", "frames", "motions")
    rows = []
    for value, counts in card["shares"][by].items():
        rows.append((value, *(counts[column] for column in columns)))
    return ResultTable(by, (PROPERTIES[by][0], *columns), tuple(rows))


def paper_table(card: dict[str, Any]) -> ResultTable:
    """Return the table of a card with the key "beside_paper"."""
    return table_beside_paper(DatasetCounts(**card["beside_paper"]["here"]))


def card_markdown(card: dict[str, Any]) -> str:
    """Return the card as Markdown; the first line says if robots were virtual."""
    tables: list[str] = []
    for by in PROPERTIES:
        tables += (count_table(card, by).markdown(), "")
    lines = [
        f"# {escape_markdown(headline(card))}",
        "",
        *_facts(card),
        *tables,
        *_beside_paper(card),
        *_repeatability(card),
        *_signals(card),
    ]
    return "\n".join(lines)


def _facts(card: dict[str, Any]) -> Iterator[str]:
    total = card["total"]
    recorded = card["recorded"]
    collected = card["collected"]
    for name in ("licence", "source"):
        ask = ""
        if card[name] == NOT_STATED:
            ask = f"; set with `gaponet data card DIR --{name} …`"
        yield f"- {name}: {escape_markdown(card[name])}{ask}"
    dates = recorded if isinstance(recorded, str) else " to ".join(dict.fromkeys(recorded))
    yield f"- recorded: {escape_markdown(dates)}"
    if collected:
        fleet = escape_markdown(str(collected.get("fleet")))
        seed = escape_markdown(str(collected.get("seed")))
        yield f"- made by gaponet collect: fleet {fleet}, seed {seed}"
    joints = len(card["joints"])
    yield f"- {total['frames']:,} frames of {joints} joints, {total['motions']} motions"
    yield (
        f"- {card['bytes'] / 1e6:,.1f} MB, dataset hash {card['dataset_hash']}, "
        f"gaponet {card['gaponet']}"
    )
    yield (
        "\nEvery number was counted or measured from the files; `gaponet data card DIR` writes "
        "this page again.\n"
    )


def _beside_paper(card: dict[str, Any]) -> Iterator[str]:
    if "beside_paper" in card:
        yield "## Beside the paper's counts\n"
        yield paper_table(card).markdown() + "\n"


def _repeatability(card: dict[str, Any]) -> Iterator[str]:
    repeated = card["repeatability"]
    yield "## Repeatability\n"
    if not repeated["channels"]:
        yield (
            "No motion was repeated with the same command by the same unit with the same payload.\n"
        )
        return
    yield (
        "Standard deviation over repetitions of the same command, root mean square over rows; "
        f"{repeated['groups']:,} groups, {repeated['sequences']:,} sequences; joints that were "
        "commanded to move."
    )
    if excluded := repeated["left_out_other_command"]:
        yield f"{excluded:,} sequences of these groups had another command and were left out."
    yield "\n" + _repeatability_table(repeated["channels"]).markdown() + "\n"


def _repeatability_table(channels: dict[str, Any]) -> ResultTable:
    """Return a row per joint and a column per channel, and their means."""
    joints: dict[str, None] = {}  # in the order in which they come
    headings = ["joint"]
    mean = ["mean"]
    for name, channel in channels.items():
        joints |= dict.fromkeys(channel["joints"])
        headings.append(f"{name}, {channel['unit']}")
        mean.append(_digits(channel["mean"]))
    rows = []
    for joint in joints:
        values = [channel["joints"].get(joint) for channel in channels.values()]
        rows.append((joint, *map(_digits, values)))
    return ResultTable("repeatability", tuple(headings), (*rows, tuple(mean)))


def _signals(card: dict[str, Any]) -> Iterator[str]:
    yield "## Signals\n"
    for name, signal in card["signals"].items():
        yield f"### {name}, {signal['unit']} ({signal['sequences']:,} sequences)\n"
        rows = []
        for joint, values in signal["joints"].items():
            rows.append((joint, *map(_digits, values.values())))
        headings = ("joint", "min", "1 %", "mean", "99 %", "max", "std")
        yield ResultTable(name, headings, tuple(rows)).markdown() + "\n"


def _digits(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
