"""Train, validation and test splits of a dataset, by a fixed rule or from a split file.

By motion, every repetition, payload and unit of a motion is in one split. Motions with equal
commands count as one motion, whatever their names (data.fingerprint). By unit or payload, the test
split holds the held-out ones; validation holds some motions of the others. By repetition the last
repetitions are for testing, by time the last pieces of each recording that was cut (gaponet import
--cut). Splits share no recording, also not under another name, unit or payload.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from gaponet.base.arrays import evenly_spread_order
from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.files import write_json
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json
from gaponet.data.fingerprint import CommandFingerprint, equal_commands, fingerprint
from gaponet.data.sequence import RATE_TOLERANCE
from gaponet.data.store import Dataset, Entry, dataset_hash

Splits = dict[str, list[Entry]]

FORMAT = 1
SPLITS = ("train", "val", "test")
PROPERTIES: dict[str, Callable[[Entry], str]] = {
    "motion": lambda entry: entry.meta.motion,
    "unit": lambda entry: entry.meta.unit_id,
    "payload": lambda entry: f"{entry.meta.payload_mass:g}",
    "repetition": lambda entry: str(entry.meta.repetition),
    "time": lambda entry: f"{entry.meta.notes.get('from_s', 0.0):g}",
}
ORDERED = ("repetition", "time")  # properties of which the last values are held out
MIN_MOTIONS = 3  # one for each split
TEST_SHARE = 0.25  # of motions, units or payloads; at least one
VAL_SHARE = 0.125  # of motions; at least one


class SplitHashes(TypedDict):
    """{sequence id: content hash} of each split, as stored in a run or a split file."""

    train: dict[str, str]
    val: dict[str, str]
    test: dict[str, str]


class _SplitFile(TypedDict):
    parts: SplitHashes


def hash_order(names: Iterable[str]) -> list[str]:
    """Return distinct names in the order of their SHA-256: shuffled, and the same on every
    machine.
    """
    return sorted(set(names), key=lambda name: hashlib.sha256(name.encode()).hexdigest())


def resolve_splits(dataset: Dataset, split_file: str, *rule: Any) -> Splits:
    """Return the splits of a split file, if one is given, else of `split_entries(dataset, *rule)`.

    Raises:
        UsageError: Both a file and a rule are given.
    """
    if not split_file:
        return split_entries(dataset, *rule)
    if rule != ((), (), (), 1):
        raise UsageError(
            f"--split {split_file} says already which recordings are for training: leave out "
            "--holdout-units, --holdout-payloads, --rates and --train-share, or make another "
            "split with gaponet data split"
        )
    return read_split(split_file, dataset)


def split_entries(
    dataset: Dataset,
    holdout_units: tuple[str, ...] = (),
    holdout_payloads: tuple[float, ...] = (),
    rates: tuple[float, ...] = (),
    train_share: float = 1.0,
) -> Splits:
    """Split by motion with the fixed rule, the same for all rates and shares.

    Where recordings hold different sets of joints, each set is split by itself. Fewer than three
    motions with three or more repetitions are split by repetition.

    Args:
        holdout_units: Units that appear in the test split only.
        holdout_payloads: Payloads that appear in the test split only, kg.
        rates: Rates of the recordings to use, Hz; all by default.
        train_share: Share of the training motions to use, at least one, in hash_order: a smaller
            set is part of a larger one.

    Raises:
        UsageError: A unit, payload or rate is not in the dataset, or a split would be empty.
    """
    _require_present(dataset, holdout_units, holdout_payloads, rates)
    _require_share(train_share)
    canonical = canonical_motions(dataset)
    if _repeats_few_motions(dataset, canonical):
        splits = split_by_order(dataset, "repetition")
    else:
        splits = _split_by_motion(dataset, canonical)
    splits["train"] = _share_of_motions(splits["train"], train_share, canonical)
    for name in ("train", "val"):
        splits[name] = _not_held_out(splits[name], holdout_units, holdout_payloads)
    if rates:
        for name in SPLITS:
            splits[name] = [entry for entry in splits[name] if _has_rate(entry, rates)]
    held_out = [*holdout_units, *(f"{mass:g} kg" for mass in holdout_payloads)]
    _require_entries(dataset, splits, held_out or ["all other rates"])
    return splits


def _split_by_motion(dataset: Dataset, canonical: dict[str, str]) -> Splits:
    """Return all entries, those of equal commands (`canonical`) in one split."""
    unrecorded: dict[str, frozenset[str]] = {}  # motion → joints that its recordings do not hold
    for entry in dataset.entries:
        unrecorded[canonical[entry.meta.motion]] = frozenset(entry.meta.unrecorded)
    motions = _split_by_joints(unrecorded)
    splits: Splits = {}
    for name in SPLITS:
        chosen = [e for e in dataset.entries if canonical[e.meta.motion] in motions[name]]
        splits[name] = chosen
    return splits


def _share_of_motions(entries: list[Entry], share: float, canonical: dict[str, str]) -> list[Entry]:
    """Return the entries of the first motions in hash_order, a share of them, at least one."""
    motions = hash_order(canonical[entry.meta.motion] for entry in entries)
    kept = motions[: max(1, round(share * len(motions)))]
    return [entry for entry in entries if canonical[entry.meta.motion] in kept]


def _require_entries(dataset: Dataset, splits: Splits, held_out: list[str]) -> None:
    for name in SPLITS:
        if not splits[name]:
            raise UsageError(
                f"{dataset.path}: nothing left for {name} after holding out {', '.join(held_out)}"
            )


def _require_share(train_share: float) -> None:
    if not 0 < train_share <= 1:
        raise UsageError(
            f"train_share is {train_share:g}; it is a share of the training motions, above 0 and "
            "up to 1"
        )


def _repeats_few_motions(dataset: Dataset, canonical: dict[str, str]) -> bool:
    """Return True if there are too few motions to split, but one has as many repetitions."""
    repetitions = Counter(
        (canonical[entry.meta.motion], *entry.meta.repetition_key[1:]) for entry in dataset.entries
    )
    motions = set(canonical.values())
    return len(motions) < MIN_MOTIONS <= max(repetitions.values(), default=0)


def _has_rate(entry: Entry, rates: tuple[float, ...]) -> bool:
    return any(abs(rate - 1 / entry.dt) < RATE_TOLERANCE * rate for rate in rates)


def _not_held_out(
    entries: list[Entry], units: tuple[str, ...], payloads: tuple[float, ...]
) -> list[Entry]:
    """Return the entries that have none of the held-out units and payloads."""
    of_units = [entry for entry in entries if entry.meta.unit_id not in units]
    return [entry for entry in of_units if entry.meta.payload_mass not in payloads]


def _require_present(
    dataset: Dataset, units: tuple[str, ...], payloads: tuple[float, ...], rates: tuple[float, ...]
) -> None:
    known_units = sorted({entry.meta.unit_id for entry in dataset.entries})
    for unit in units:
        if unit not in known_units:
            raise UsageError(
                f"unit '{unit}' is not in {dataset.path}; it holds {', '.join(known_units)}"
            )
    known_payloads = sorted({entry.meta.payload_mass for entry in dataset.entries})
    for payload in payloads:
        if payload not in known_payloads:
            raise UsageError(
                f"no recording with {payload:g} kg in {dataset.path}; it holds "
                f"{_listed(known_payloads)} kg"
            )
    known_rates = sorted({round(1 / entry.dt, 2) for entry in dataset.entries})
    for rate in rates:
        if not any(abs(rate - known) <= RATE_TOLERANCE * rate for known in known_rates):
            raise UsageError(
                f"no recording at {rate:g} Hz in {dataset.path}; it holds {_listed(known_rates)} Hz"
            )


def _listed(numbers: Iterable[float]) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


def split_by_order(dataset: Dataset, by: str) -> Splits:
    """Split by repetition or time: the last quarter for testing, the one before for validation,
    the rest for training.

    Recordings of one command are repetitions, whatever their names. Recordings with fewer than
    three repetitions or pieces are for training.

    Raises:
        UsageError: No recording has three.
    """
    canonical = canonical_motions(dataset) if by == "repetition" else {}
    # repetitions of one motion, or pieces of one source, by one unit with one payload
    groups: dict[tuple[Any, ...], list[Entry]] = {}
    for entry in dataset.entries:
        whole = canonical.get(entry.meta.motion, entry.meta.source)
        groups.setdefault((*entry.meta.repetition_key[1:], whole), []).append(entry)
    splits: Splits = {split: [] for split in SPLITS}
    for group in groups.values():
        places = sorted({_place(entry, by) for entry in group}, reverse=True)
        held_out = 0
        if len(places) >= MIN_MOTIONS:
            held_out = max(1, round(TEST_SHARE * len(places)))
        for entry in group:
            rank = places.index(_place(entry, by))  # 0 is the last one
            splits[_split_of_rank(rank, held_out)].append(entry)
    if not splits["test"]:
        kind = "pieces of one recording (gaponet import --cut 8)"
        if by == "repetition":
            kind = "repetitions"
        raise UsageError(f"a split by {by} needs {MIN_MOTIONS} {kind} or more")
    return splits


def _place(entry: Entry, by: str) -> tuple[Any, ...]:
    """Return by what the repetitions of a motion, or the pieces of a recording, are ordered."""
    if by == "repetition":
        return (entry.meta.motion, entry.meta.repetition)
    return (entry.meta.notes.get("from_s", 0.0),)


def _split_of_rank(rank: int, held_out: int) -> str:
    """Return the split of the `rank`-th last repetition: the last `held_out` are for testing, the
    one before for validation.
    """
    if rank < held_out:
        return "test"
    if held_out and rank == held_out:
        return "val"
    return "train"


def make_split(dataset: Dataset, by: str, holdout: tuple[str, ...] = ()) -> Splits:
    """Split a dataset by one of PROPERTIES.

    Args:
        holdout: Values of the property for the test split; default a quarter, in hash_order.

    Returns:
        train, val and test, none of them empty.

    Raises:
        UsageError: A value is not in the dataset, or a split would be empty.
    """
    if by in ORDERED and not holdout:
        return split_by_order(dataset, by)
    canonical = canonical_motions(dataset)

    def motion_of(entry: Entry) -> str:
        return canonical[entry.meta.motion]

    value_of = motion_of if by == "motion" else PROPERTIES[by]
    held_out = _held_out_values(dataset, by, holdout, value_of)
    splits: Splits = {"train": [], "val": [], "test": []}
    rest = []
    for entry in dataset.entries:
        if value_of(entry) in held_out:
            splits["test"].append(entry)
        else:
            rest.append(entry)
    if by in ORDERED:  # the last repetition or piece that is left is for validation
        validating = {max(map(value_of, rest), key=float, default="")}
        group_of = value_of
    else:  # some of the motions that are left, whichever property was held out
        count = max(1, round(len(set(canonical.values())) * VAL_SHARE))
        validating = set(hash_order(map(motion_of, rest))[:count])
        group_of = motion_of
    for entry in rest:
        name = "val" if group_of(entry) in validating else "train"
        splits[name].append(entry)
    empty = [name for name in SPLITS if not splits[name]]
    if empty:
        left = len(set(map(motion_of, rest)))
        raise UsageError(
            f"{dataset.path}: holding out {by} {', '.join(sorted(held_out))} leaves nothing for "
            f"{empty[0]} ({left} motion(s) remain); hold out less"
        )
    return splits


def _held_out_values(
    dataset: Dataset, by: str, holdout: tuple[str, ...], value_of: Callable[[Entry], str]
) -> set[str]:
    """Return the values that are for testing, as `value_of` has them.

    Args:
        holdout: Values that a person names, as PROPERTIES has them; default a quarter.
        value_of: As PROPERTIES[by]; of a motion, the canonical one, so that a motion takes those
            with equal commands with it.
    """
    values = hash_order(map(PROPERTIES[by], dataset.entries))
    if by == "payload":
        try:
            holdout = tuple(f"{float(text):g}" for text in holdout)
        except ValueError:
            raise UsageError(f"--holdout {' '.join(holdout)}: payloads are numbers, kg") from None
    for value in holdout:
        if value not in values:
            raise UsageError(
                f"{dataset.path}: no {by} '{value}' to hold out; it holds "
                f"{', '.join(sorted(values))}"
            )
    if len(values) < 2:
        raise UsageError(
            f"{dataset.path}: one {by} only ({', '.join(values)}); split it by another property"
        )
    distinct = hash_order(map(value_of, dataset.entries))
    if len(distinct) < 2:
        raise UsageError(
            f"{dataset.path}: all {len(values)} {by}s have equal commands, so they are one: "
            "nothing to split"
        )
    if holdout:
        return {value_of(entry) for entry in dataset.entries if PROPERTIES[by](entry) in holdout}
    return set(distinct[: max(1, round(len(distinct) * TEST_SHARE))])


def canonical_motions(dataset: Dataset) -> dict[str, str]:
    """Return motion → the name under which it is split: of motions with equal commands, the first
    in hash_order.
    """
    fingerprints = _fingerprints(dataset)
    names = hash_order(fingerprints)
    owners: list[str] = []
    commands: list[CommandFingerprint] = []
    for name in names:
        for command in fingerprints[name]:
            owners.append(name)
            commands.append(command)
    group = {name: name for name in names}  # motion → a name that its group has in common
    for i, j in equal_commands(commands):
        joined = group[owners[i]]
        other = group[owners[j]]
        for name in names:
            if group[name] == other:
                group[name] = joined
    first: dict[str, str] = {}  # of each group
    for name in names:
        first.setdefault(group[name], name)
    return {name: first[group[name]] for name in names}


def _fingerprints(dataset: Dataset) -> dict[str, list[CommandFingerprint]]:
    """Return motion → the distinct commands of its recordings."""
    fingerprints: dict[str, list[CommandFingerprint]] = {}
    for entry in dataset.entries:
        of_motion = fingerprints.setdefault(entry.meta.motion, [])
        command = entry.command
        # an old journal: one recording is enough for its motion
        if command is None and not of_motion:
            command = fingerprint(dataset.channels(entry, ("ctrl",))["ctrl"], entry.dt)
        if command is not None and command not in of_motion:
            of_motion.append(command)
    return fingerprints


def split_motions(motions: Iterable[str]) -> dict[str, list[str]]:
    """Split names of motions by a fixed rule without a seed: hash_order, test first, then
    validation, then training.

    A motion that is added later moves few others.

    Raises:
        UsageError: There are fewer than three.
    """
    names = hash_order(motions)
    if len(names) < MIN_MOTIONS:
        raise UsageError(
            f"{len(names)} motion(s) ({', '.join(names)}): a split by motion needs {MIN_MOTIONS} "
            "or more; motions with equal commands count once. Long recordings can be cut into "
            "several: gaponet import --cut 8"
        )
    test = max(1, round(len(names) * TEST_SHARE))
    val = max(1, round(len(names) * VAL_SHARE))
    return {"train": names[test + val :], "val": names[test : test + val], "test": names[:test]}


def _split_by_joints(unrecorded: dict[str, frozenset[str]]) -> dict[str, list[str]]:
    """Split motions, each set of recorded joints by itself, so that every joint is validated.

    Args:
        unrecorded: Motion → joints that it does not hold.
    """
    groups = defaultdict[frozenset[str], list[str]](list)
    for motion, joints in unrecorded.items():
        groups[joints].append(motion)
    if len(groups) == 1 or max(map(len, groups.values())) < MIN_MOTIONS:
        return split_motions(unrecorded)
    splits: dict[str, list[str]] = {split: [] for split in SPLITS}
    for names in map(hash_order, groups.values()):
        parts = {"train": names[-1:], "val": names[:-1], "test": []}
        if len(names) >= MIN_MOTIONS:
            parts = split_motions(names)
        for split, part in parts.items():
            splits[split] += part
    return {split: hash_order(motions) for split, motions in splits.items()}


def stratified_subset(entries: ListOf[Entry], count: int) -> list[Entry]:
    """Return at most `count` entries, taken in turn from each payload, unit and rate, with
    different motions.

    Those of each payload, unit and rate are spread evenly over the order of the entries, in which
    similar motions, and repetitions of one, are neighbours.
    """
    groups: dict[tuple[object, ...], list[Entry]] = {}
    for entry in entries:
        meta = entry.meta
        rate = round(1 / entry.dt, 1)
        kind = (meta.payload_mass, meta.payload_side, meta.unit_id, rate)
        groups.setdefault(kind, []).append(entry)
    orders = []
    for number, group in enumerate(groups.values()):
        order = evenly_spread_order(len(group), phase=number / len(groups))
        orders.append([group[place] for place in order])
    in_turn: list[str] = []
    for turn in itertools.zip_longest(*orders):
        in_turn += [entry.id for entry in turn if entry is not None]
    chosen = set(in_turn[:count])
    return [entry for entry in entries if entry.id in chosen]


def require_distinct_samples(
    dataset: Dataset, splits: Splits, progress: Progress = no_progress
) -> None:
    """Refuse splits that share samples under different units or payloads, which content hashes do
    not show.

    Raises:
        DatasetError: Naming both sequences.
    """
    seen: dict[str, tuple[str, Entry]] = {}
    total = sum(map(len, splits.values()))
    done = 0
    for split, entries in splits.items():
        for entry in entries:
            arrays = dataset.channels(entry, ("ctrl", "qpos"))
            digest = hashlib.sha256(arrays["ctrl"].tobytes() + arrays["qpos"].tobytes()).hexdigest()
            other_split, other = seen.setdefault(digest, (split, entry))
            if other_split != split:
                raise DatasetError(
                    f"{dataset.path}: '{entry.id}' ({split}) and '{other.id}' ({other_split}) "
                    "hold the same samples; delete the line of the wrong one from sequences.jsonl"
                )
            done += 1
            progress(done, total, entry.meta.motion)


def _hashes(entries: list[Entry]) -> dict[str, str]:
    """Return id → hash of entries."""
    return {entry.id: entry.hash for entry in entries}


def write_split(dataset: Dataset, splits: Splits, by: str, holdout: tuple[str, ...] = ()) -> Path:
    """Write splits/<by>[-<held out>].json in the dataset folder; return its path."""
    stated = "-".join([by, *holdout])
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", stated)[:100]
    if name != stated or any("-" in value for value in holdout):  # others may look the same
        name = f"{name}-{hashlib.sha256(stated.encode()).hexdigest()[:8]}"
    path = dataset.path / "splits" / f"{name}.json"
    record: dict[str, Any] = {
        "format": FORMAT,
        "robot": dataset.robot_name,
        "dataset_hash": dataset_hash(dataset.entries),
        "by": by,
        "held_out": sorted({PROPERTIES[by](entry) for entry in splits["test"]}),
        "virtual": any(entry.meta.virtual for entry in dataset.entries),
        "parts": {split: _hashes(splits[split]) for split in SPLITS},
    }
    with dataset.writing():
        path.parent.mkdir(exist_ok=True)
        write_json(path, record)
    return path


def read_split(path: str | Path, dataset: Dataset) -> Splits:
    """Return the entries of a split file, found in the dataset by content, whatever their names.

    Raises:
        DatasetError: It is no split file, a sequence is not in the dataset, or two splits share
            one.
    """
    file = read_json(
        _SplitFile, Path(path), DatasetError, "make one with gaponet data split", allow_extra=True
    )
    splits: Splits = {split: [] for split in SPLITS}
    split_of_hash: dict[str, str] = {}
    for split in SPLITS:
        part: dict[str, str] = file["parts"][split]  # type: ignore[literal-required]
        for name, digest in part.items():
            entry = dataset.find(digest)
            if entry is None:
                raise DatasetError(
                    f"{path}: '{name}' is not in {dataset.path}; split that dataset anew"
                )
            other = split_of_hash.setdefault(digest, split)
            if other != split:
                raise DatasetError(
                    f"{path}: '{name}' is in {other} and in {split}; split the dataset anew"
                )
            splits[split].append(entry)
    return splits
