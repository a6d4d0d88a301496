"""One table over every public recording that is present: what each method leaves, beside the robot's own spread."""

from __future__ import annotations

import functools
import importlib.util
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet import plugins
from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import json_compatible, write_text
from gaponet.experiments.real.adversaries import ADVERSARIES, Adversary
from gaponet.experiments.real.cards import Card, Cards, prepare
from gaponet.experiments.real.questions import Question, floor, questions, recorded
from gaponet.experiments.real.rivals import Method, identified
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import standard_error

Said = Callable[[str], None]


@dataclass(frozen=True)
class Row:
    """What a method leaves of a question: mean |error| of each independent motion, (motions,) rad.

    `nominal` is the same of the nominal simulator, in the same order; `seconds` is what fitting and asking took;
    `notes` are the answers' own; `by_joint` says of joints that were recorded one at a time what is left with each
    payload, mrad, the mean over motions, and of how many recordings.
    """

    set: str
    question: str
    method: str
    error: np.ndarray
    nominal: np.ndarray
    recordings: int
    floor: float
    splits: tuple[str, ...]
    seconds: float
    notes: tuple[str, ...] = ()
    by_joint: dict[str, dict[str, tuple[float, int]]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: mrad, with the standard error over motions, of differences paired."""
        less = 1e3 * (self.nominal - self.error)
        return json_compatible({
            "set": self.set, "question": self.question, "method": self.method, "mrad": 1e3 * self.error.mean(),
            "standard_error": 1e3 * standard_error(self.error), "of_nominal": self.error.mean() / self.nominal.mean(),
            "less_than_nominal": less.mean(), "less_standard_error": standard_error(less), "motions": len(self.error),
            "recordings": self.recordings, "floor_mrad": 1e3 * self.floor, "splits": self.splits,
            "by_joint_mrad": self.by_joint, "seconds": round(self.seconds, 1), "notes": self.notes,
        })  # fmt: skip


@dataclass
class Bench:
    """One measuring: what is done once lies below `work` and is not done again.

    Attributes:
        cards: What there may be; folders that are not there are left out.
        data: Folder of the public recordings.
        work: Folder for datasets, trainings and answers.
        methods: Name → title and method.
        adversary: Name of what was done to the recordings, or "".
        say: Told what was done.
    """

    cards: Cards
    data: Path
    work: Path
    methods: dict[str, tuple[str, Method]]
    adversary: str = ""
    say: Said = print

    def run(self, only: tuple[str, ...] = (), asked: tuple[str, ...] = ()) -> dict[str, Any]:
        """Import, split, fit and measure some sets, by default all, of which some questions are asked, by default all.

        Returns:
            rows (Row.as_dict), cards, labels (set → sentences), left_out (folder → why), seconds (set →).
        """
        unknown = set(only) - {c.name for c in self.cards.set}
        if unknown:
            raise UsageError(f"no set '{min(unknown)}'; there are {', '.join(c.name for c in self.cards.set)}")
        here = [c for c in self.cards.set if self._is_there(c) and (not only or c.name in only)]
        every = {q for c in here for q in c.questions}
        if set(asked) - every:
            raise UsageError(f"no question '{min(set(asked) - every)}'; there are {', '.join(sorted(every))}")
        left_out = {f.folder: f.why for f in self.cards.left_out if (self.data / f.folder).exists()}
        left_out |= {c.folder: "not there" for c in self.cards.set if not self._is_there(c)}
        rows: list[Row] = []
        labels: dict[str, list[str]] = {}
        seconds: dict[str, float] = {}
        for card in here:
            began = time.monotonic()
            try:
                dataset, robot, told = prepare(card, self.data, self.work)
            except GAPONetError as error:
                self.say(f"{card.name}: {error}")
                left_out[card.folder] = str(error)
                continue
            seconds[card.name] = time.monotonic() - began
            self.say(
                f"{card.name}: {len(dataset)} recordings, {dataset.hours() * 60:.1f} min, from file to dataset in "
                f"{seconds[card.name]:.0f} s"
            )
            if told:
                labels[card.name] = told.remarks
            for name in (q for q in card.questions if not asked or q in asked):
                rows += self.ask(card, name, list(questions(name, dataset, robot, self.before(card))))
            seconds[card.name] += sum(r.seconds for r in rows if r.set == card.name)
        return {"rows": [r.as_dict() for r in rows], "cards": {c.name: c.title for c in here}, "labels": labels,
                "left_out": left_out, "adversary": self.adversary,
                "seconds": {k: round(v) for k, v in seconds.items()}}  # fmt: skip

    def _is_there(self, card: Card) -> bool:
        return (self.data / card.folder).exists()

    def before(self, card: Card) -> Callable[[], RobotSpec] | None:
        """What makes the robot as it was identified on the data set that a card names; None where that is not there."""
        other = next((c for c in self.cards.set if c.name == card.elsewhere and self._is_there(c)), None)
        return functools.partial(self._elsewhere, other.name) if other else None

    @functools.cache  # noqa: B019
    def _elsewhere(self, name: str) -> RobotSpec:
        card = next(c for c in self.cards.set if c.name == name)
        dataset, robot, _ = prepare(card, self.data, self.work)
        first = next(questions(card.questions[0], dataset, robot, None))
        return identified(self._at_work(card, first, "")).robot

    __hash__ = object.__hash__

    def _at_work(self, card: Card, question: Question, adversary: str) -> Question:
        """The question with a folder of its own, so that what was identified or trained for it is not again."""
        name = "-".join(filter(None, (card.name, question.split, adversary)))
        return replace(question, work=self.work / "made" / name)

    def ask(self, card: Card, name: str, folds: list[Question]) -> list[Row]:
        """Every method on every fold; those that have nothing to go on are left out."""
        rows: list[Row] = []
        noise = float(np.mean([f for q in folds if (f := floor(q)) == f] or [np.nan]))
        splits = tuple(q.split for q in folds)
        change: Adversary = ADVERSARIES.get(self.adversary, lambda q: q)
        pairs = [(q, change(q)) for q in folds]  # where what is learned from stays, so does what was learned
        folds = [self._at_work(card, new, self.adversary * (new.train is not q.train)) for q, new in pairs]
        for method, (title, answer) in self.methods.items():
            if _nothing_to_go_on(method, folds):
                continue
            found: list[tuple[list[float], float, str]] = []
            try:
                for q in folds:
                    found.append(self._once(card, q, method, answer))
            except Exception as error:  # a method may be anybody's: it loses its own row and no other
                kind = "" if isinstance(error, GAPONetError) else f"{type(error).__name__}: "
                self.say(f"{card.name}, {name}, {title}: {kind}{error}")
                continue
            by_motion: dict[str, list[float]] = {}
            cells: dict[tuple[str, str], dict[str, list[float]]] = {}
            for q, (errors, _, _) in zip(folds, found, strict=True):
                for s, motion, e in zip(q.test, q.motion, errors, strict=True):
                    by_motion.setdefault(motion, []).append(e)
                    if len(columns := recorded(s, q.robot)) == 1 < len(q.robot.operated):
                        cell = q.robot.joint_names[columns[0]], f"{s.meta.payload_mass:g}"
                        cells.setdefault(cell, {}).setdefault(motion, []).append(1e3 * e)
            left = np.array([np.mean(v) for v in by_motion.values()])
            first = rows[0].error if rows else left
            count, took = sum(len(errors) for errors, _, _ in found), sum(s for _, s, _ in found)
            notes = tuple(note for _, _, note in found if note)
            by_joint: dict[str, dict[str, tuple[float, int]]] = {}
            for (joint, kg), motions in sorted(cells.items()):
                mean = float(np.mean([np.mean(v) for v in motions.values()]))
                by_joint.setdefault(joint, {})[kg] = mean, sum(map(len, motions.values()))
            rows.append(Row(card.name, name, title, left, first, count, noise, splits, took, notes, by_joint))
            self.say(f"{card.name}, {name}: {title} leaves {1e3 * left.mean():.2f} of {1e3 * first.mean():.2f} mrad")
        return rows

    def _once(self, card: Card, question: Question, method: str, answer: Method) -> tuple[list[float], float, str]:
        """Mean |error| of each test recording, rad, over the joints that it holds, s, and a note; kept below `work`."""
        words = (card.name, question.name, question.split, method, self.adversary)
        file = self.work / "answers" / (re.sub(r"[^A-Za-z0-9]+", "-", " ".join(words).strip()) + ".json")
        if file.is_file():
            kept = json.loads(file.read_text(encoding="utf-8"))
            return kept["errors"], kept["seconds"], kept.get("note", "")
        began = time.monotonic()
        answered = answer(question)
        errors = answered.errors(question.test)
        seconds = time.monotonic() - began
        file.parent.mkdir(parents=True, exist_ok=True)
        found = answered.robot  # for whoever wants to know what was found
        servos = {
            j: {f: float(getattr(found, f)[found.joint_names.index(j)]) for f in ("kp", "delay", "offset")}
            for j in found.operated
        }
        mounts = [m.pos for m in found.payload_mounts]
        told = {"errors": errors, "seconds": seconds, "note": answered.note, "servos": servos, "mounts": mounts}
        write_text(file, json.dumps(told))
        return errors, seconds, answered.note


def _nothing_to_go_on(method: str, folds: list[Question]) -> bool:
    first = folds[0]
    if method == "constant":
        return len({(s.meta.payload_mass, s.meta.unit_id) for s in first.train}) < 2
    return (method == "elsewhere" and first.before is None) or (method == "adapted" and not first.few)


def load_method(where: str) -> tuple[str, Method]:
    """FILE.py:FUNCTION, or an extension's name → name and function, which is given a Question and returns an Answer."""
    if where in plugins.registry(plugins.METHODS, {}):
        return where, plugins.require(plugins.METHODS, where, {}, "method")
    file, _, name = where.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file) if Path(file).is_file() else None
    if spec is None or spec.loader is None:
        raise UsageError(f"--method {where}: no such file; give FILE.py:FUNCTION")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, name, None)):
        raise UsageError(f"--method {where}: {file} has no function {name}")
    return name, getattr(module, name)
