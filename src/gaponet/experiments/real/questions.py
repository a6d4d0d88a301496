"""What is asked of a data set: recordings to learn from, and others to be right about, of the same robot."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.pair import hash_order
from gaponet.data.repeatability import SAME_COMMAND
from gaponet.data.sequence import Sequence
from gaponet.data.split import in_turn, one_motion, split_entries
from gaponet.data.store import Dataset, Entry, dataset_hash
from gaponet.robot.spec import RobotSpec

FOLDS = 3
FEW = 6  # recordings of a unit, of each joint, to adapt with
ALIKE = 0.02  # rad that repetitions' commands differ by in the mean: one may begin a part of a period later
VAL = 8  # one in so many pairs of motion and payload judges, where motions are too few for a part of their own
Made = TypeVar("Made")


@dataclass(frozen=True)
class Question:
    """One question: name; recordings for training, validation and testing; `few` of the test's own, to adapt with.

    `motion` says of each test recording which independent motion it is of; `split` is the hash of both sides; `before`
    makes the robot as it was identified elsewhere; `made` is what methods share, `work` a folder of the question's own
    where they may keep it.
    """

    name: str
    robot: RobotSpec
    train: list[Sequence]
    val: list[Sequence]
    test: list[Sequence]
    motion: list[str]
    split: str
    few: list[Sequence] = field(default_factory=list)
    before: Callable[[], RobotSpec] | None = None
    made: dict[str, object] = field(default_factory=dict)
    work: Path | None = None

    @property
    def known(self) -> list[Sequence]:
        """All that may be learned from, for methods that choose nothing."""
        return self.train + self.val

    def once(self, name: str, make: Callable[[], Made]) -> Made:
        """What several methods rest on, made by the first that asks."""
        if name not in self.made:
            self.made[name] = make()
        return self.made[name]  # type: ignore[return-value]


def questions(
    name: str, dataset: Dataset, robot: RobotSpec, before: Callable[[], RobotSpec] | None
) -> Iterator[Question]:
    """The parts of a question: one, or a fold for each command or unit that is left out in turn."""
    lead = one_motion(dataset)
    entries = dataset.entries

    def ask(train: list[Entry], val: list[Entry], test: list[Entry], few: list[Entry] = []) -> Question:  # noqa: B006
        if not val:
            cell = {e.id: f"{e.meta.motion} {e.meta.payload_mass:g}" for e in train}
            judges = hash_order(cell.values())[::VAL]
            val = [e for e in train if cell[e.id] in judges]
            train = [e for e in train if cell[e.id] not in judges]
        digest = hashlib.sha256(f"{dataset_hash(train + val)} {dataset_hash(test)}".encode()).hexdigest()[:8]
        read = lambda part: dataset.sequences(part)  # noqa: E731
        motion = [lead[e.meta.motion] for e in test]
        return Question(name, robot, read(train), read(val), read(test), motion, digest, read(few), before)

    if name in ("new motions", "another session"):
        parts = split_entries(dataset)
        few = parts["train"] if name == "another session" else []
        yield ask(parts["train"], parts["val"], parts["test"], few)
    elif name == "later repetitions":
        parts = in_turn(dataset, "repetition")
        yield ask(parts["train"], parts["val"], parts["test"])
    elif name == "new commands":
        order = {
            j: hash_order({e.meta.motion for e in entries if _joint(e) == j}) for j in {_joint(e) for e in entries}
        }
        for fold in range(FOLDS):
            out = {names[fold] for names in order.values() if fold < len(names) > 1}
            yield ask(
                [e for e in entries if e.meta.motion not in out], [], [e for e in entries if e.meta.motion in out]
            )
    elif name.endswith(" kg left out"):
        mass = float(name.split()[0])
        away = [e for e in entries if e.meta.payload_mass == mass]
        yield ask([e for e in entries if e not in away], [], away)
    elif name == "a unit left out":
        for unit in sorted({e.meta.unit_id for e in entries}):
            away = [e for e in entries if e.meta.unit_id == unit]
            first = {
                j: hash_order({e.meta.motion for e in away if _joint(e) == j})[0] for j in {_joint(e) for e in away}
            }
            known = [e for e in away if e.meta.motion in first.values()]
            few = [e for j in first for e in [e for e in known if _joint(e) == j][:FEW]]
            yield ask([e for e in entries if e not in away], [], [e for e in away if e not in known], few)
    else:
        raise UsageError(f"question '{name}' is not known; docs/benchmark.md lists them")


def _joint(entry: Entry) -> str:
    """What a recording of one joint is about; "" of others."""
    unknown = entry.meta.unrecorded
    return entry.meta.motion.split("-to")[0] if unknown else ""


def rehearsal(question: Question) -> tuple[list[Sequence], list[Sequence]]:
    """Recordings to learn from, and others that judge: where joints were recorded one at a time, a command of each
    joint that has several."""
    known, judges = question.known, set()
    if len({s.meta.unrecorded for s in known}) == 1:
        return question.train, question.val
    for unrecorded in {s.meta.unrecorded for s in known}:
        motions = hash_order(s.meta.motion for s in known if s.meta.unrecorded == unrecorded)
        judges |= set(motions[:1] if len(motions) > 1 else [])
    return [s for s in known if s.meta.motion not in judges], [s for s in known if s.meta.motion in judges]


def floor(question: Question) -> float:
    """Mean |difference| in how two recordings of one command, unit and payload follow it, rad; nan without any."""
    groups: dict[tuple[object, ...], list[Sequence]] = {}
    for s, motion in zip(question.test, question.motion, strict=True):
        groups.setdefault((motion, *s.meta.slot[1:], s.meta.unrecorded, s.meta.kp), []).append(s)
    pairs = [d for group in groups.values() for d in _differences(group, question.robot)]
    least = min((command for command, _ in pairs), default=0.0)
    apart = [d for command, d in pairs if command <= max(least, SAME_COMMAND)]
    return float(np.mean(apart)) if apart else float("nan")


def _differences(group: list[Sequence], robot: RobotSpec) -> Iterator[tuple[float, float]]:
    """How far the commands of two recordings differ in the mean, and how far their answers do, rad."""
    for a, first in enumerate(group):
        for second in group[a + 1 :]:
            rows = min(len(first), len(second))
            told = first.ctrl[:rows] - second.ctrl[:rows]
            error: Array = np.abs(first.qpos[:rows] - second.qpos[:rows] - told)[:, recorded(first, robot)]
            if np.abs(told).mean() < ALIKE:
                yield float(np.abs(told).mean()), float(error.mean())


def recorded(sequence: Sequence, robot: RobotSpec) -> list[int]:
    """Columns of the operated joints that a recording holds."""
    return [
        int(i) for i, j in zip(robot.operated_index, robot.operated, strict=True) if j not in sequence.meta.unrecorded
    ]
