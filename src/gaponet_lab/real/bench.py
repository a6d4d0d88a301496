"""One table over every public recording that is present: what each method leaves, beside the robot's own spread."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.json_file import finite
from gaponet.errors import GAPONetError, UsageError
from gaponet.metrics import standard_error
from gaponet.robot import RobotSpec
from gaponet_lab.real.cards import Card, Cards, prepare
from gaponet_lab.real.questions import Question, floor, permuted, questions, recorded
from gaponet_lab.real.rivals import METHODS, Answer, Method, _identify, can_hang

Said = Callable[[str], None]


@dataclass(frozen=True)
class Row:
    """What a method leaves of a question: mean |error| of each independent motion, (motions,) rad.

    `nominal` is the same of the nominal simulator, in the same order.
    """

    set: str
    question: str
    method: str
    error: np.ndarray
    nominal: np.ndarray
    recordings: int
    floor: float
    splits: tuple[str, ...]
    by_payload: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: mrad, with the standard error over motions, of differences paired."""
        less = 1e3 * (self.nominal - self.error)
        return finite({
            "set": self.set, "question": self.question, "method": self.method, "mrad": 1e3 * self.error.mean(),
            "standard_error": 1e3 * standard_error(self.error), "of_nominal": self.error.mean() / self.nominal.mean(),
            "less_than_nominal": less.mean(), "less_standard_error": standard_error(less), "motions": len(self.error),
            "recordings": self.recordings, "floor_mrad": 1e3 * self.floor, "splits": self.splits,
            "by_payload_mrad": self.by_payload,
        })  # fmt: skip


def bench(
    cards: Cards, data: Path, work: Path, only: tuple[str, ...] = (), also: tuple[str, ...] = (),
    shuffle: int | None = None, say: Said = print,
) -> dict[str, Any]:  # fmt: skip
    """Import, split, fit and measure.

    Args:
        cards: What there may be; folders that are not there are left out.
        data: Folder of the public recordings.
        work: Folder for datasets.
        only: Names of sets; default all.
        also: Methods of others, FILE.py:FUNCTION each.
        shuffle: Seed by which payload and unit of training recordings are dealt out anew: an adversary.
        say: Told what was done.

    Returns:
        rows (Row.as_dict), cards, labels (set → agreement), left_out (folder → why).
    """
    methods = METHODS | {name: (name, method) for name, method in map(load_method, also)}
    unknown = set(only) - {c.name for c in cards.set}
    if unknown:
        raise UsageError(f"no set '{min(unknown)}'; there are {', '.join(c.name for c in cards.set)}")
    here = [c for c in cards.set if (data / c.folder).exists() and (not only or c.name in only)]
    left_out = {f.folder: f.why for f in cards.left_out if (data / f.folder).exists()}
    left_out |= {c.folder: "not there" for c in cards.set if not (data / c.folder).exists()}
    identified: dict[str, RobotSpec] = {}
    rows: list[Row] = []
    labels: dict[str, Any] = {}
    for card in here:
        dataset, robot, told = prepare(card, data, work)
        say(f"{card.name}: {len(dataset)} recordings, {dataset.hours() * 60:.1f} min")
        if told:
            labels[card.name] = told.agreement
        before = _before(card, cards, data, work, identified)
        for name in card.questions:
            folds = list(questions(name, dataset, robot, before))
            folds = [permuted(q, shuffle) for q in folds] if shuffle is not None else folds
            rows += _ask(card, name, folds, methods, say)
    return {"rows": [r.as_dict() for r in rows], "cards": {c.name: c.title for c in here}, "labels": labels,
            "left_out": left_out}  # fmt: skip


def load_method(where: str) -> tuple[str, Method]:
    """FILE.py:FUNCTION → its name and the function, which is given a Question and returns an Answer."""
    file, _, name = where.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file) if Path(file).is_file() else None
    if spec is None or spec.loader is None:
        raise UsageError(f"--method {where}: no such file; give FILE.py:FUNCTION")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, name, None)):
        raise UsageError(f"--method {where}: {file} has no function {name}")
    return name, getattr(module, name)


def _before(card: Card, cards: Cards, data: Path, work: Path, known: dict[str, RobotSpec]) -> RobotSpec | None:
    """The robot as it was identified on the data set that a card names; all of that set is another session."""
    if not card.elsewhere:
        return None
    if card.elsewhere not in known:
        other = next((c for c in cards.set if c.name == card.elsewhere), None)
        if other is None or not (data / other.folder).exists():
            return None
        dataset, robot, _ = prepare(other, data, work)
        first = next(questions(other.questions[0], dataset, robot, None))
        known[card.elsewhere] = _identify(first.train, first.val, robot)
    return known[card.elsewhere]


def _ask(card: Card, name: str, folds: list[Question], methods: dict[str, tuple[str, Method]], say: Said) -> list[Row]:
    """Every method on every fold; those that have nothing to go on are left out."""
    rows: list[Row] = []
    noise = float(np.mean([f for q in folds if (f := floor(q)) == f] or [np.nan]))
    splits = tuple(q.split for q in folds)
    for method, (title, answer) in methods.items():
        if (method == "elsewhere" and folds[0].before is None) or (method == "calibrated" and not folds[0].few):
            continue
        if method == "identified_hanging" and not all(can_hang(q) for q in folds):
            continue
        if method == "constant" and len({(s.meta.payload_mass, s.meta.unit_id) for s in folds[0].train}) < 2:
            continue
        try:
            found = [_errors(q, answer(q)) for q in folds]
        except GAPONetError as error:
            say(f"{card.name}, {name}, {title}: {error}")
            continue
        by_motion: dict[str, list[float]] = {}
        by_payload: dict[str, list[float]] = {}
        for q, errors in zip(folds, found, strict=True):
            for s, motion, e in zip(q.test, q.motion, errors, strict=True):
                by_motion.setdefault(motion, []).append(e)
                by_payload.setdefault(f"{s.meta.payload_mass:g}", []).append(1e3 * e)
        left = np.array([np.mean(v) for v in by_motion.values()])
        first = rows[0].error if rows else left
        masses = {k: float(np.mean(v)) for k, v in sorted(by_payload.items())}
        rows.append(Row(card.name, name, title, left, first, sum(map(len, found)), noise, splits, masses))
        say(f"{card.name}, {name}: {title} leaves {1e3 * left.mean():.2f} of {1e3 * first.mean():.2f} mrad")
    return rows


def _errors(question: Question, answer: Answer) -> list[float]:
    """Mean |error| of each test recording, over the joints that it holds, rad."""
    runs = answer.positions(question.test)
    return [
        float(np.abs((q - s.qpos)[1:, recorded(s, question.robot)]).mean())
        for s, q in zip(question.test, runs, strict=True)
    ]
