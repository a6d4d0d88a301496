"""Questions of the benchmark: recordings of a robot to fit, and others to be evaluated on."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
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
    entries = dataset.entries

    def split(
        train: list[Entry],
        val: list[Entry],
        test: list[Entry],
        few: list[Entry] = [],  # noqa: B006
    ) -> Question:
        if not val:
            cell = {e.id: f"{e.meta.motion} {e.meta.payload_mass:g}" for e in train}
            judges = hash_order(cell.values())[::VALIDATION_STRIDE]
            val = [e for e in train if cell[e.id] in judges]
            train = [e for e in train if cell[e.id] not in judges]
        digest = hashlib.sha256(
            f"{dataset_hash(train + val)} {dataset_hash(test)}".encode()
        ).hexdigest()[:8]
        read = lambda part: dataset.sequences(part)  # noqa: E731
        motions = [lead[e.meta.motion] for e in test]
        return Question(
            name, robot, read(train), read(val), read(test), motions, digest, read(few), elsewhere
        )

    if name in ("new motions", "another session"):
        parts = split_entries(dataset)
        few = parts["train"] if name == "another session" else []
        yield split(parts["train"], parts["val"], parts["test"], few)
    elif name == "later repetitions":
        parts = split_by_order(dataset, "repetition")
        yield split(parts["train"], parts["val"], parts["test"])
    elif name == "new commands":
        order = {
            j: hash_order({e.meta.motion for e in entries if _joint(e) == j})
            for j in {_joint(e) for e in entries}
        }
        for fold in range(FOLDS):
            out = {names[fold] for names in order.values() if fold < len(names) > 1}
            yield split(
                [e for e in entries if e.meta.motion not in out],
                [],
                [e for e in entries if e.meta.motion in out],
            )
    elif name.endswith(" kg left out"):
        mass = float(name.split()[0])
        test = [e for e in entries if e.meta.payload_mass == mass]
        yield split([e for e in entries if e not in test], [], test)
    elif name == "a unit left out":
        for unit in sorted({e.meta.unit_id for e in entries}):
            of_unit = [e for e in entries if e.meta.unit_id == unit]
            first = {
                j: hash_order({e.meta.motion for e in of_unit if _joint(e) == j})[0]
                for j in {_joint(e) for e in of_unit}
            }
            seen = [e for e in of_unit if e.meta.motion in first.values()]
            few = [e for j in first for e in [e for e in seen if _joint(e) == j][:FEW_RECORDINGS]]
            yield split(
                [e for e in entries if e not in of_unit],
                [],
                [e for e in of_unit if e not in seen],
                few,
            )
    else:
        raise UsageError(f"question '{name}' is not known; docs/benchmark.md lists them")


def _joint(entry: Entry) -> str:
    """Return the joint of a recording of a single joint; "" for other recordings."""
    return entry.meta.motion.split("-to")[0] if entry.meta.unrecorded else ""


def train_val(question: Question) -> tuple[list[Sequence], list[Sequence]]:
    """Return training and validation recordings.

    Where joints were recorded one at a time, one command of each joint with several commands
    validates.
    """
    fitted, val = question.fitted, set()
    if len({s.meta.unrecorded for s in fitted}) == 1:
        return question.train, question.val
    for unrecorded in {s.meta.unrecorded for s in fitted}:
        motions = hash_order(s.meta.motion for s in fitted if s.meta.unrecorded == unrecorded)
        val |= set(motions[:1] if len(motions) > 1 else [])
    return [s for s in fitted if s.meta.motion not in val], [
        s for s in fitted if s.meta.motion in val
    ]


def repeatability(question: Question) -> float:
    """Mean |difference| between the errors of two recordings of one command, unit and payload, rad;
    NaN without any.
    """
    groups: dict[tuple[object, ...], list[Sequence]] = {}
    for s, motion in zip(question.test, question.test_motions, strict=True):
        groups.setdefault(
            (motion, *s.meta.repetition_key[1:], s.meta.unrecorded, s.meta.kp), []
        ).append(s)
    pairs = [d for group in groups.values() for d in _differences(group, question.robot)]
    least = min((command for command, _ in pairs), default=0.0)
    errors = [d for command, d in pairs if command <= max(least, MAX_COMMAND_DIFFERENCE_RAD)]
    return float(np.mean(errors)) if errors else float("nan")


def _differences(group: list[Sequence], robot: RobotSpec) -> Iterator[tuple[float, float]]:
    """Yield the mean differences of the commands and of the responses of each pair of recordings,
    rad.
    """
    for first, second in itertools.combinations(group, 2):
        rows = min(len(first), len(second))
        command = first.ctrl[:rows] - second.ctrl[:rows]
        error: Array = np.abs(first.qpos[:rows] - second.qpos[:rows] - command)[
            :, recorded_joints(first, robot)
        ]
        if np.abs(command).mean() < MAX_COMMAND_DIFFERENCE:
            yield float(np.abs(command).mean()), float(error.mean())


def recorded_joints(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Return the columns of the operated joints that a recording holds."""
    return [
        int(i)
        for i, j in zip(robot.operated_index, robot.operated, strict=True)
        if j not in sequence.meta.unrecorded
    ]
