"""Questions of the benchmark: recordings of a robot to fit, and others to be evaluated on."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.repeatability import MAX_COMMAND_DIFFERENCE_RAD
from gaponet.data.sequence import Sequence
from gaponet.data.split import canonical_motions, hash_order, split_by_order, split_entries
from gaponet.data.store import Dataset, Entry, dataset_hash
from gaponet.robot.spec import RobotSpec

FOLDS = 3
FEW_RECORDINGS = 6  # per joint, of a unit that is new, for adaptation
# rad: mean difference of the commands of two repetitions, one of which may begin a part of a period
# later.
MAX_COMMAND_DIFFERENCE = 0.02
VALIDATION_STRIDE = 8  # one in so many pairs of motion and payload validates, where motions are few
T = TypeVar("T")


@dataclass(frozen=True)
class Question:
    """A split of the recordings of one robot.

    Attributes:
        train, val, test: Recordings for fitting, validation and evaluation.
        test_motions: Independent motion of each test recording.
        split_hash: Hash of the recordings on both sides.
        few: Recordings of the test's unit or session, for adaptation.
        elsewhere: Returns the robot as it was identified on other data.
        shared: Results that several methods use.
        work: Folder of the question for identified robots and trainings.
    """

    name: str
    robot: RobotSpec
    train: list[Sequence]
    val: list[Sequence]
    test: list[Sequence]
    test_motions: list[str]
    split_hash: str
    few: list[Sequence] = field(default_factory=list)
    elsewhere: Callable[[], RobotSpec] | None = None
    shared: dict[str, object] = field(default_factory=dict)
    work: Path | None = None

    @property
    def fitted(self) -> list[Sequence]:
        """Training and validation recordings, for methods without validation."""
        return self.train + self.val

    def once(self, name: str, make: Callable[[], T]) -> T:
        """Return a result that several methods share; the first call makes it."""
        if name not in self.shared:
            self.shared[name] = make()
        return self.shared[name]  # type: ignore[return-value]


def questions(
    name: str, dataset: Dataset, robot: RobotSpec, elsewhere: Callable[[], RobotSpec] | None
) -> Iterator[Question]:
    """Yield the folds of a question: one, or one for each command or unit that is left out in turn.

    Raises:
        UsageError: No such question.
    """
    lead = canonical_motions(dataset)
    for parts in _folds(name, dataset):
        if not parts.val:
            parts = _with_validation(parts)
        fitted_hash = dataset_hash(parts.train + parts.val)
        words = f"{fitted_hash} {dataset_hash(parts.test)}"
        yield Question(
            name=name,
            robot=robot,
            train=dataset.sequences(parts.train),
            val=dataset.sequences(parts.val),
            test=dataset.sequences(parts.test),
            test_motions=[lead[entry.meta.motion] for entry in parts.test],
            split_hash=hashlib.sha256(words.encode()).hexdigest()[:8],
            few=dataset.sequences(parts.few),
            elsewhere=elsewhere,
        )


@dataclass(frozen=True)
class Parts:
    """Entries of a split; without `val`, a part of `train` validates."""

    train: list[Entry]
    val: list[Entry]
    test: list[Entry]
    few: list[Entry] = field(default_factory=list)


def _folds(name: str, dataset: Dataset) -> list[Parts]:
    """Return the splits of a question."""
    if name in ("new motions", "another session"):
        parts = split_entries(dataset)
        few = parts["train"] if name == "another session" else []
        return [Parts(parts["train"], parts["val"], parts["test"], few)]
    if name == "later repetitions":
        parts = split_by_order(dataset, "repetition")
        return [Parts(parts["train"], parts["val"], parts["test"])]
    if name == "new commands":
        return _without_commands(dataset.entries)
    if name.endswith(" kg left out"):
        mass = float(name.split()[0])
        test = [entry for entry in dataset.entries if entry.meta.payload_mass == mass]
        return [Parts(_others(dataset.entries, test), [], test)]
    if name == "a unit left out":
        units = sorted({entry.meta.unit_id for entry in dataset.entries})
        return [_without_unit(dataset.entries, unit) for unit in units]
    raise UsageError(f"question '{name}' is not known; docs/benchmark.md lists them")


def _with_validation(parts: Parts) -> Parts:
    """Move every eighth pair of motion and payload from training to validation."""
    pairs = [f"{entry.meta.motion} {entry.meta.payload_mass:g}" for entry in parts.train]
    judges = hash_order(pairs)[::VALIDATION_STRIDE]
    train = []
    val = []
    for entry, pair in zip(parts.train, pairs, strict=True):
        if pair in judges:
            val.append(entry)
        else:
            train.append(entry)
    return replace(parts, train=train, val=val)


def _without_commands(entries: list[Entry]) -> list[Parts]:
    """Leave out one command of each joint that has several, a fold for each."""
    motions = [hash_order({e.meta.motion for e in part}) for part in _by_joint(entries).values()]
    folds = []
    for fold in range(FOLDS):
        left_out = {names[fold] for names in motions if fold < len(names) > 1}
        test = [entry for entry in entries if entry.meta.motion in left_out]
        folds.append(Parts(_others(entries, test), [], test))
    return folds


def _without_unit(entries: list[Entry], unit: str) -> Parts:
    """Leave out a unit; a few recordings of one motion of each joint are for adaptation."""
    of_unit = [entry for entry in entries if entry.meta.unit_id == unit]
    seen = []
    few = []
    for part in _by_joint(of_unit).values():
        first = hash_order({entry.meta.motion for entry in part})[0]
        of_motion = [entry for entry in part if entry.meta.motion == first]
        seen += of_motion
        few += of_motion[:FEW_RECORDINGS]
    return Parts(_others(entries, of_unit), [], _others(of_unit, seen), few)


def _by_joint(entries: list[Entry]) -> dict[str, list[Entry]]:
    """Return joint → its recordings, in their order."""
    parts: dict[str, list[Entry]] = {}
    for entry in entries:
        parts.setdefault(_joint(entry), []).append(entry)
    return parts


def _others(entries: list[Entry], without: list[Entry]) -> list[Entry]:
    return [entry for entry in entries if entry not in without]


def _joint(entry: Entry) -> str:
    """Return the joint of a recording of a single joint; "" for other recordings."""
    return entry.meta.motion.split("-to")[0] if entry.meta.unrecorded else ""


def train_val(question: Question) -> tuple[list[Sequence], list[Sequence]]:
    """Return training and validation recordings.

    Where joints were recorded one at a time, one command of each joint with several commands
    validates.
    """
    motions: dict[tuple[str, ...], set[str]] = {}
    for s in question.fitted:
        motions.setdefault(s.meta.unrecorded, set()).add(s.meta.motion)
    if len(motions) == 1:
        return question.train, question.val
    judges = {hash_order(names)[0] for names in motions.values() if len(names) > 1}
    train = []
    val = []
    for s in question.fitted:
        if s.meta.motion in judges:
            val.append(s)
        else:
            train.append(s)
    return train, val


def repeatability(question: Question) -> float:
    """Return how far the errors of repetitions of one command, unit and payload differ, rad.

    The mean |difference| of two recordings; NaN without any.
    """
    groups: dict[tuple[object, ...], list[Sequence]] = {}
    for s, motion in zip(question.test, question.test_motions, strict=True):
        key = (motion, *s.meta.repetition_key[1:], s.meta.unrecorded, s.meta.kp)
        groups.setdefault(key, []).append(s)
    pairs: list[tuple[float, float]] = []
    for group in groups.values():
        pairs += _differences(group, question.robot)
    if not pairs:
        return float("nan")
    least = min(command for command, _ in pairs)
    most = max(least, MAX_COMMAND_DIFFERENCE_RAD)
    return float(np.mean([response for command, response in pairs if command <= most]))


def _differences(group: list[Sequence], robot: RobotSpec) -> Iterator[tuple[float, float]]:
    """Yield the mean differences of the commands and of the responses of each pair, rad."""
    for first, second in itertools.combinations(group, 2):
        rows = min(len(first), len(second))
        command = first.ctrl[:rows] - second.ctrl[:rows]
        error: Array = np.abs(first.qpos[:rows] - second.qpos[:rows] - command)
        if np.abs(command).mean() < MAX_COMMAND_DIFFERENCE:
            recorded = error[:, recorded_joints(first, robot)]
            yield float(np.abs(command).mean()), float(recorded.mean())


def recorded_joints(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Return the columns of the operated joints that a recording holds."""
    columns = []
    for column, joint in zip(robot.operated_index, robot.operated, strict=True):
        if joint not in sequence.meta.unrecorded:
            columns.append(int(column))
    return columns
