"""Split files: which sequences are for training, validation (choosing) and test (reporting), by content hash.

By motion, a fixed rule puts every repetition, payload and unit of a motion into one part; motions with equal commands
are one motion, whatever they are called (data.commands). By unit or payload, the test part is what is held out, and
validation is a part of the motions of the rest. By repetition the last ones are the test, by time the last pieces of
each recording that was cut (gaponet import --cut): both ask for what was asked before. Parts share no recording:
neither one listed twice nor the same samples under another name, unit or payload.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json
from gaponet.data.commands import Sketch, alike, sketch
from gaponet.data.pair import hash_order
from gaponet.data.store import Dataset, Entry, dataset_hash

Parts = dict[str, list[Entry]]

FORMAT = 1
PARTS = ("train", "val", "test")
BY: dict[str, Callable[[Entry], str]] = {
    "motion": lambda e: e.meta.motion,
    "unit": lambda e: e.meta.unit_id,
    "payload": lambda e: f"{e.meta.payload_mass:g}",
    "repetition": lambda e: str(e.meta.repetition),
    "time": lambda e: f"{e.meta.notes.get('from_s', 0.0):g}",
}
IN_TURN = ("repetition", "time")  # what was asked before comes again: the later ones are held out
MOTIONS = 3  # one for each part
TEST_SHARE, VAL_SHARE = 0.25, 0.125  # of motions, units or payloads; at least one each


class RunSplit(TypedDict):
    """{sequence id: content hash} of each part."""

    train: dict[str, str]
    val: dict[str, str]
    test: dict[str, str]


class _SplitFile(TypedDict):
    """A split file, and whatever else stands there."""

    parts: RunSplit


def split_entries(
    dataset: Dataset,
    holdout_units: tuple[str, ...] = (),
    holdout_payloads: tuple[float, ...] = (),
    rates: tuple[float, ...] = (),
    train_share: float = 1.0,
) -> Parts:
    """Entries per part: the fixed split by motion, the same for all rates and shares, of each set of joints by itself
    where recordings hold different ones; by repetition, where one or two motions were played three times or more.

    Args:
        holdout_units: Appear in the test part only, with its motions.
        holdout_payloads: The same, kg.
        rates: Only recordings at these, Hz; all by default.
        train_share: Share of the training motions to use, in the order of the hash of their names: a smaller one lies
            in a larger.
    """
    units = {e.meta.unit_id for e in dataset.entries}
    payloads = {e.meta.payload_mass for e in dataset.entries}
    strangers = [u for u in holdout_units if u not in units]
    if strangers:
        raise UsageError(f"unit '{strangers[0]}' is not in {dataset.path}; it holds {', '.join(sorted(units))}")
    unknown = [p for p in holdout_payloads if p not in payloads]
    if unknown:
        known = ", ".join(f"{p:g}" for p in sorted(payloads))
        raise UsageError(f"no recording with {unknown[0]:g} kg in {dataset.path}; it holds {known} kg")
    held_rates = sorted({round(1 / e.dt, 2) for e in dataset.entries})
    absent = [r for r in rates if not any(_same_rate(r, h) for h in held_rates)]
    if absent:
        known = ", ".join(f"{h:g}" for h in held_rates)
        raise UsageError(f"no recording at {absent[0]:g} Hz in {dataset.path}; it holds {known} Hz")
    if not 0 < train_share <= 1:
        raise UsageError(f"train_share is {train_share:g}; it is a share of the training motions, above 0 and up to 1")
    away = lambda m: m.unit_id in holdout_units or m.payload_mass in holdout_payloads  # noqa: E731
    lead = one_motion(dataset)
    played = Counter((lead[e.meta.motion], *e.meta.slot[1:]) for e in dataset.entries)
    if len(set(lead.values())) < MOTIONS <= max(played.values(), default=0):
        parts = in_turn(dataset, "repetition")
        return parts | {p: [e for e in parts[p] if not away(e.meta)] for p in ("train", "val")}
    motions = _split_by_joints({lead[e.meta.motion]: frozenset(e.meta.unrecorded) for e in dataset.entries})
    motions["train"] = motions["train"][: max(1, round(train_share * len(motions["train"])))]
    entries_at = [e for e in dataset.entries if not rates or any(_same_rate(r, 1 / e.dt) for r in rates)]
    parts = {
        part: [e for e in entries_at if lead[e.meta.motion] in motions[part] and (part == "test" or not away(e.meta))]
        for part in PARTS
    }
    for part, entries in parts.items():
        if not entries:
            held = ", ".join([*holdout_units, *(f"{p:g} kg" for p in holdout_payloads)]) or "all other rates"
            raise UsageError(f"{dataset.path}: nothing left for {part} after holding out {held}")
    return parts


def in_turn(dataset: Dataset, by: str) -> Parts:
    """The last quarter of the repetitions (or of the pieces of each recording in time) for testing, one before it for
    validation, the rest for training. Recordings of one command are repetitions, whatever they are called.

    Raises:
        UsageError: There are fewer than three.
    """
    entries, lead = dataset.entries, one_motion(dataset) if by == "repetition" else {}
    group: Callable[[Entry], Any] = lambda e: (*e.meta.slot[1:], lead[e.meta.motion] if lead else e.meta.source)  # noqa: E731
    place: Callable[[Entry], Any] = (
        (lambda e: (e.meta.motion, e.meta.repetition)) if lead else (lambda e: e.meta.notes.get("from_s", 0.0))
    )
    parts: Parts = {part: [] for part in PARTS}
    for key in dict.fromkeys(map(group, entries)):
        mine = [e for e in entries if group(e) == key]
        turns = sorted({place(e) for e in mine})
        test = max(1, round(TEST_SHARE * len(turns))) if len(turns) >= MOTIONS else 0
        for e in mine:
            last = len(turns) - 1 - turns.index(place(e))
            parts["test" if last < test else "val" if test and last == test else "train"].append(e)
    if not parts["test"]:
        what = "repetitions" if by == "repetition" else "pieces of one recording (gaponet import --cut 8)"
        raise UsageError(f"a split by {by} needs {MOTIONS} {what} or more")
    return parts


def spread(entries: ListOf[Entry], most: int) -> list[Entry]:
    """At most so many entries, taken in turn from each payload, unit and rate, and from other motions each time.

    Every k-th of a recipe's entries can have the same payload: recipes count in fours as well.
    """
    groups: dict[tuple[object, ...], list[Entry]] = {}
    for entry in entries:
        m = entry.meta
        groups.setdefault((m.payload_mass, m.payload_side, m.unit_id, round(1 / entry.dt, 1)), []).append(entry)
    turned = [g[i % len(g) :] + g[: i % len(g)] for i, g in enumerate(groups.values())]
    found = [e.id for turn in itertools.zip_longest(*turned) for e in turn if e is not None][:most]
    return [e for e in entries if e.id in found]


def one_motion(dataset: Dataset) -> dict[str, str]:
    """Motion → the name under which it is split: of motions with equal commands, the first in hash_order."""
    sketches: dict[str, list[Sketch]] = {}
    for entry in dataset.entries:
        known = sketches.setdefault(entry.meta.motion, [])
        told = entry.command
        if told is None and not known:  # imported before sketches were kept: one recording speaks for the motion
            told = sketch(dataset.channels(entry, ("ctrl",))["ctrl"], entry.dt)
        if told is not None and told not in known:
            known.append(told)
    names = hash_order(sketches)
    whose = [name for name in names for _ in sketches[name]]
    leads = {name: name for name in names}
    for i, j in alike([one for name in names for one in sketches[name]]):
        first, second = leads[whose[i]], leads[whose[j]]
        if first != second:
            leads = {name: first if lead == second else lead for name, lead in leads.items()}
    heads: dict[str, str] = {}
    for name in names:
        heads.setdefault(leads[name], name)
    return {name: heads[lead] for name, lead in leads.items()}


def _by_motion(motions: Iterable[str]) -> dict[str, list[str]]:
    """The motions of each part by a fixed rule without a seed: in the order of the SHA-256 of their names, test first,
    then validation. Repetitions, payloads and units of a motion stay together. Adding a motion later moves few others.
    """
    names = hash_order(motions)
    if len(names) < MOTIONS:
        raise UsageError(
            f"{len(names)} motion(s) ({', '.join(names)}): a split by motion needs {MOTIONS} or more; motions with "
            "equal commands count once. Long recordings can be cut into several: gaponet import --cut 8"
        )
    test, val = (max(1, round(len(names) * share)) for share in (TEST_SHARE, VAL_SHARE))
    return {"train": names[test + val :], "val": names[test : test + val], "test": names[:test]}


def _split_by_joints(unrecorded: dict[str, frozenset[str]]) -> dict[str, list[str]]:
    """Split motions; where they hold different joints (one at a time, say) those of each set by themselves, so that
    each joint is judged; of two motions one judges."""
    groups = [[m for m in unrecorded if unrecorded[m] == joints] for joints in set(unrecorded.values())]
    if len(groups) == 1 or max(map(len, groups)) < MOTIONS:
        return _by_motion(unrecorded)
    parts: dict[str, list[str]] = {part: [] for part in PARTS}
    for names in map(hash_order, groups):
        few = {"train": names[-1:], "val": names[:-1], "test": []}
        for part, mine in (_by_motion(names) if len(names) >= MOTIONS else few).items():
            parts[part] += mine
    return {part: hash_order(names) for part, names in parts.items()}


def _same_rate(a: float, b: float) -> bool:
    """Rates of recordings are as measured."""
    return abs(a - b) < 0.02 * a


def make_split(dataset: Dataset, by: str, holdout: tuple[str, ...] = ()) -> Parts:
    """Divide a dataset's sequences.

    Args:
        by: motion, unit, payload, repetition or time.
        holdout: Motions, units or payloads (kg) for the test part; default a quarter, by the hash of their names.

    Returns:
        train, val and test, none of them empty.

    Raises:
        UsageError: Something held out is not there, or nothing is left for a part.
    """
    if by in IN_TURN and not holdout:
        return in_turn(dataset, by)
    lead = one_motion(dataset)
    key = (lambda e: lead[e.meta.motion]) if by == "motion" else BY[by]
    held = _held_out(dataset, by, holdout, key)
    rest = [e for e in dataset.entries if key(e) not in held]
    motions = hash_order(lead[e.meta.motion] for e in rest)
    choice = key if by in IN_TURN else lambda e: lead[e.meta.motion]
    if by in IN_TURN and rest:
        motions = [max(map(key, rest), key=float)]  # of those that are not held out, the last
    chosen = set(motions[: max(1, round(len(set(lead.values())) * VAL_SHARE))])
    parts = {
        "train": [e for e in rest if choice(e) not in chosen],
        "val": [e for e in rest if choice(e) in chosen],
        "test": [e for e in dataset.entries if key(e) in held],
    }
    for part in PARTS:
        if not parts[part]:
            raise UsageError(
                f"{dataset.path}: holding out {by} {', '.join(sorted(held))} leaves nothing for {part} "
                f"({len(motions)} motion(s) remain); hold out less"
            )
    return parts


def _held_out(dataset: Dataset, by: str, holdout: tuple[str, ...], key: Callable[[Entry], str]) -> set[str]:
    """Keys of what is held out; a motion takes those with equal commands with it."""
    values = hash_order(map(BY[by], dataset.entries))
    if by == "payload":
        holdout = tuple(_kilograms(text) for text in holdout)
    for value in holdout:
        if value not in values:
            raise UsageError(f"{dataset.path}: no {by} '{value}' to hold out; it holds {', '.join(sorted(values))}")
    if len(values) < 2:
        raise UsageError(f"{dataset.path}: one {by} only ({', '.join(values)}); split it by another property")
    keys = hash_order(map(key, dataset.entries))
    if len(keys) < 2:
        raise UsageError(
            f"{dataset.path}: all {len(values)} {by}s have equal commands, so they are one: nothing to split"
        )
    if holdout:
        return {key(e) for e in dataset.entries if BY[by](e) in holdout}
    return set(keys[: max(1, round(len(keys) * TEST_SHARE))])


def _kilograms(text: str) -> str:
    try:
        return f"{float(text):g}"
    except ValueError:
        raise UsageError(f"--holdout {text}: payloads are numbers, kg") from None


def require_distinct_samples(dataset: Dataset, parts: Parts, progress: Progress = no_progress) -> None:
    """Refuse parts that share samples, whatever unit or payload these are filed under.

    Content hashes contain unit and payload: a log imported twice, for two units, has two. So commands and states are
    read and hashed without them, one sequence at a time.
    """
    seen: dict[str, tuple[str, Entry]] = {}
    total, done = sum(map(len, parts.values())), 0
    for part, entries in parts.items():
        for entry in entries:
            arrays = dataset.channels(entry, ("ctrl", "qpos"))
            digest = hashlib.sha256(arrays["ctrl"].tobytes() + arrays["qpos"].tobytes()).hexdigest()
            other, twin = seen.setdefault(digest, (part, entry))
            if other != part:
                raise DatasetError(
                    f"{dataset.path}: '{entry.id}' ({part}) and '{twin.id}' ({other}) hold the same samples; delete "
                    "the line of the wrong one from sequences.jsonl"
                )
            done += 1
            progress(done, total, entry.meta.motion)


def write_split(dataset: Dataset, parts: Parts, by: str, holdout: tuple[str, ...] = ()) -> Path:
    """Write splits/<by>[-<held out>].json in the dataset folder; the same call writes the same file."""
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join([by, *holdout]))[:100]
    path = dataset.path / "splits" / f"{name}.json"
    record: dict[str, Any] = {
        "format": FORMAT,
        "robot": dataset.robot_name,
        "dataset_hash": dataset_hash(dataset.entries),
        "by": by,
        "held_out": sorted({BY[by](e) for e in parts["test"]}),
        "virtual": any(e.meta.virtual for e in dataset.entries),
        "parts": {part: {e.id: e.hash for e in parts[part]} for part in PARTS},
    }
    with dataset.writing():
        path.parent.mkdir(exist_ok=True)
        write_text(path, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    return path


def parts_of(dataset: Dataset, split: str, *rule: Any) -> Parts:
    """The parts by a split file, where one is given, else by the fixed rule; `rule` as split_entries takes it.

    Raises:
        UsageError: Both are given.
    """
    if not split:
        return split_entries(dataset, *rule)
    if rule != ((), (), (), 1):
        raise UsageError(
            f"--split {split} says already who is for training: leave out --holdout-units, --holdout-payloads, "
            "--rates and --train-share, or make another split with gaponet data split"
        )
    return read_split(split, dataset)


def read_split(path: str | Path, dataset: Dataset) -> Parts:
    """Entries of a dataset by a split file; sequences found are those with the same content, whatever their name.

    Raises:
        DatasetError: Not a split file, a sequence of it is not in the dataset, or parts share one.
    """
    hashes = read_json(_SplitFile, Path(path), DatasetError, "make one with gaponet data split", allow_extra=True)[
        "parts"
    ]
    parts: Parts = {part: [] for part in PARTS}
    taken: dict[str, str] = {}
    for part in PARTS:
        for name, digest in hashes[part].items():  # type: ignore[literal-required]
            entry = dataset.find(digest)
            if entry is None:
                raise DatasetError(f"{path}: '{name}' is not in {dataset.path}; split that dataset anew")
            if taken.setdefault(digest, part) != part:
                raise DatasetError(f"{path}: '{name}' is in {taken[digest]} and in {part}; split the dataset anew")
            parts[part].append(entry)
    return parts
