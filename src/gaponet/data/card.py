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
from gaponet.data.sequence import ARRAYS
from gaponet.data.statistics import Statistics, pool, statistics
from gaponet.data.store import Dataset, Entry, dataset_hash

# about so many rows, evenly taken from the dataset, give the 1 % and 99 % percentiles
PERCENTILE_ROWS = 100_000
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
    stride = max(1, sum(entry.rows for entry in dataset.entries) // PERCENTILE_ROWS)
    stats: dict[str, list[Statistics]] = defaultdict(list)
    samples: dict[str, list[Array]] = defaultdict(list)
    groups: dict[tuple[object, ...], list[Entry]] = defaultdict(list)
    for entry in dataset.entries:
        groups[*entry.meta.repetition_key, round(entry.dt, 7)].append(entry)
    rows_before: Counter[str] = Counter()
    repeated = []
    done = 0
    for group in groups.values():
        repetitions = Repetitions()
        for entry in group:
            sequence = dataset.read(entry)
            for name in entry.channels:
                values = getattr(sequence, name)
                samples[name].append(values[-rows_before[name] % stride :: stride].copy())
                rows_before[name] += len(values)
                stats[name].append(statistics(values))
            repetitions.add(sequence)
            done += 1
            progress(done, len(dataset), entry.meta.motion)
        if repetitions.count > 1:
            repeated.append(repetitions.result())
    signals: dict[str, Any] = {}
    for name in ARRAYS:
        if stats[name]:
            values = np.concatenate(samples[name])
            signals[name] = {
                "unit": UNITS[name],
                "sequences": len(stats[name]),
                "joints": _by_joint(pool(stats[name]), values, dataset.joint_names),
            }
    return _counted(dataset) | {
        "signals": signals,
        "repeatability": Repetitions.summary(repeated, dataset.joint_names),
    }


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
    collected = dataset.path / "collect.json"
    recorded = sorted({entry.meta.recorded_at for entry in dataset.entries} - {""})
    by_property: dict[str, dict[str, Any]] = {}
    for name, (_, value_of) in PROPERTIES.items():
        groups: dict[str, list[Entry]] = defaultdict(list)
        for entry in dataset.entries:
            groups[value_of(entry)].append(entry)
        by_property[name] = {
            value: count_entries(groups[value]) for value in sorted(groups, key=_number_or_name)
        }
    return {
        "name": dataset.path.resolve().name,
        "robot": dataset.robot_name,
        "joints": list(dataset.joint_names),
        "virtual_sequences": sum(entry.meta.virtual for entry in dataset.entries),
        "licence": dataset.header.get("licence", NOT_STATED),
        "source": dataset.header.get("source", NOT_STATED),
        "recorded": [recorded[0], recorded[-1]] if recorded else NOT_STATED,
        "collected": read_json(dict[str, Any], collected, DatasetError, "restore it or delete it")
        if collected.is_file()
        else None,
        "dataset_hash": dataset_hash(dataset.entries),
        "format": dataset.header["format"],
        "bytes": sum(f.stat().st_size for f in (dataset.path / "sequences").iterdir()),
        "gaponet": __version__,
        "total": count_entries(dataset.entries),
        "shares": by_property,
    }


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
    count = "all" if virtual == total["sequences"] else f"{virtual} of them"
    kind = f", {count} on VIRTUAL robots" if virtual else ""
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
        ask = f"; set with `gaponet data card DIR --{name} …`" if card[name] == NOT_STATED else ""
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
    channels = repeated["channels"]
    joints: dict[str, None] = {}
    for channel in channels.values():
        joints |= dict.fromkeys(channel["joints"])
    rows = []
    for joint in joints:
        values = [channel["joints"].get(joint) for channel in channels.values()]
        rows.append((joint, *map(_digits, values)))
    mean = ("mean", *(_digits(c["mean"]) for c in channels.values()))
    headings = ("joint", *(f"{name}, {c['unit']}" for name, c in channels.items()))
    yield "\n" + ResultTable("repeatability", headings, (*rows, mean)).markdown() + "\n"


def _signals(card: dict[str, Any]) -> Iterator[str]:
    yield "## Signals\n"
    for name, signal in card["signals"].items():
        yield f"### {name}, {signal['unit']} ({signal['sequences']:,} sequences)\n"
        rows = tuple(
            (joint, *map(_digits, values.values())) for joint, values in signal["joints"].items()
        )
        yield (
            ResultTable(
                name, ("joint", "min", "1 %", "mean", "99 %", "max", "std"), rows
            ).markdown()
            + "\n"
        )


def _digits(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
