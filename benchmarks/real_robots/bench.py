"""The benchmark's run: every method on every question of every public data set that is present."""

from __future__ import annotations

import functools
import importlib.util
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import json_compatible, write_text
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import standard_error
from real_robots.cards import Card, Cards, prepare
from real_robots.methods import Method, identified
from real_robots.questions import Question, questions, recorded_joints, repeatability

Row = dict[str, Any]  # errors of one method on one question (Bench.evaluate)


@dataclass(eq=False)
class Bench:
    """A run of the benchmark. Datasets, trainings and evaluations below `work` are reused."""

    cards: Cards  # data cards; data sets that are not present are skipped
    data: Path  # folder of the public recordings
    work: Path  # folder for datasets, trainings and evaluations
    methods: dict[str, tuple[str, Method]]  # name → title and method
    say: Callable[[str], None] = print  # called with a line about each step

    def run(self, sets: tuple[str, ...] = (), names: tuple[str, ...] = ()) -> dict[str, Any]:
        """Import, split, fit and measure.

        Args:
            sets: Data sets; default all.
            names: Questions; default all.

        Returns:
            rows (evaluate), cards, labels (set → sentences), left_out (folder → reason), seconds
            (set →).

        Raises:
            UsageError: No such data set or question.
        """
        unknown = set(sets) - {c.name for c in self.cards.set}
        if unknown:
            raise UsageError(
                f"no set '{min(unknown)}'; there are {', '.join(c.name for c in self.cards.set)}"
            )
        present = [
            c for c in self.cards.set if self._is_present(c) and (not sets or c.name in sets)
        ]
        every = {q for c in present for q in c.questions}
        if set(names) - every:
            raise UsageError(
                f"no question '{min(set(names) - every)}'; there are {', '.join(sorted(every))}"
            )
        left_out = {f.folder: f.why for f in self.cards.left_out if (self.data / f.folder).exists()}
        left_out |= {c.folder: "not there" for c in self.cards.set if not self._is_present(c)}
        rows: list[Row] = []
        labels: dict[str, list[str]] = {}
        seconds: dict[str, float] = {}
        for card in present:
            start = time.monotonic()
            try:
                dataset, robot, estimated = prepare(card, self.data, self.work)
            except GAPONetError as error:
                self.say(f"{card.name}: {error}")
                left_out[card.folder] = str(error)
                continue
            seconds[card.name] = time.monotonic() - start
            self.say(
                f"{card.name}: {len(dataset)} recordings, {dataset.hours() * 60:.1f} min, from file to dataset in "
                f"{seconds[card.name]:.0f} s"
            )
            if estimated:
                labels[card.name] = estimated.remarks
            for name in (q for q in card.questions if not names or q in names):
                rows += self.evaluate(
                    card, name, list(questions(name, dataset, robot, self._elsewhere(card)))
                )
            seconds[card.name] += sum(r["seconds"] for r in rows if r["set"] == card.name)
        return {"rows": rows, "cards": {c.name: c.title for c in present}, "labels": labels, "left_out": left_out,
                "seconds": {k: round(v) for k, v in seconds.items()}}  # fmt: skip

    def evaluate(self, card: Card, name: str, folds: list[Question]) -> list[Row]:
        """Evaluate every method on every fold of a question; methods without the data that they
        need are skipped.

        Returns:
            A row per method for JSON: mrad, standard errors over motions, of differences paired;
            by_motion_mrad, independent motion → error; floor_mrad, the mean difference of
            repetitions; splits, a hash per fold; and by_joint_mrad, joint → payload, kg → (mean
            error over motions; number of recordings), of data sets in which joints were recorded
            one at a time.
        """
        rows: list[Row] = []
        floors = [f for q in folds if (f := repeatability(q)) == f]
        nominal = np.empty(0)
        folds = [self._with_folder(card, q) for q in folds]
        for method, (title, fit) in self.methods.items():
            if _lacks_data(method, folds[0]):
                continue
            try:
                evaluated = [self._evaluate_fold(card, q, method, fit) for q in folds]
            except Exception as error:  # anybody's method: it loses its own row and no other
                kind = "" if isinstance(error, GAPONetError) else f"{type(error).__name__}: "
                self.say(f"{card.name}, {name}, {title}: {kind}{error}")
                continue
            by_motion, by_joint = _averages(folds, [e["errors"] for e in evaluated])
            errors = np.array([*by_motion.values()])
            nominal = nominal if rows else errors
            less = 1e3 * (nominal - errors)
            rows.append(json_compatible({
                "set": card.name, "question": name, "method": title, "mrad": 1e3 * errors.mean(),
                "standard_error": 1e3 * standard_error(errors), "of_nominal": errors.mean() / nominal.mean(),
                "less_than_nominal": less.mean(), "less_standard_error": standard_error(less), "motions": len(errors),
                "recordings": sum(len(e["errors"]) for e in evaluated),
                "floor_mrad": 1e3 * float(np.mean(floors or [np.nan])), "splits": [q.split_hash for q in folds],
                "by_motion_mrad": {motion: 1e3 * error for motion, error in by_motion.items()},
                "by_joint_mrad": by_joint, "seconds": round(sum(e["seconds"] for e in evaluated), 1),
                "notes": [e["note"] for e in evaluated if e["note"]],
            }))  # fmt: skip
            self.say(
                f"{card.name}, {name}: {title}: {1e3 * errors.mean():.2f} mrad, nominal {1e3 * nominal.mean():.2f}"
            )
        return rows

    def _is_present(self, card: Card) -> bool:
        return (self.data / card.folder).exists()

    def _elsewhere(self, card: Card) -> Callable[[], RobotSpec] | None:
        """Return a function that identifies the robot on the other data set of a card; None if that
        is not present.
        """
        other = next(
            (c for c in self.cards.set if c.name == card.elsewhere and self._is_present(c)), None
        )
        return functools.partial(self._identified_on, other) if other else None

    def _identified_on(self, card: Card) -> RobotSpec:
        dataset, robot, _ = prepare(card, self.data, self.work)
        return identified(
            self._with_folder(card, next(questions(card.questions[0], dataset, robot, None)))
        ).robot

    def _with_folder(self, card: Card, question: Question) -> Question:
        """Return the question with a folder of its own for identified robots and trainings."""
        return replace(question, work=self.work / "made" / f"{card.name}-{question.split_hash}")

    def _evaluate_fold(
        self, card: Card, question: Question, method: str, fit: Method
    ) -> dict[str, Any]:
        """Fit and evaluate, or read the stored evaluation: errors of the test recordings, rad;
        seconds; note.
        """
        words = (card.name, question.name, question.split_hash, method)
        file = self.work / "answers" / (re.sub(r"[^A-Za-z0-9]+", "-", " ".join(words)) + ".json")
        if file.is_file():
            return {"note": "", **json.loads(file.read_text(encoding="utf-8"))}
        start = time.monotonic()
        fitted = fit(question)
        errors = fitted.errors(question.test)
        record = {"errors": errors, "seconds": time.monotonic() - start, "note": fitted.note}
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(record))
        return record


def _averages(
    folds: list[Question], errors: list[list[float]]
) -> tuple[dict[str, float], dict[str, dict[str, tuple[float, int]]]]:
    """Return the mean error of each independent motion, rad, and by_joint_mrad (Bench.evaluate)."""
    by_motion: dict[str, list[float]] = {}
    by_cell: dict[tuple[str, str], dict[str, list[float]]] = {}
    for q, fold in zip(folds, errors, strict=True):
        for s, motion, error in zip(q.test, q.test_motions, fold, strict=True):
            by_motion.setdefault(motion, []).append(error)
            if len(columns := recorded_joints(s, q.robot)) == 1 < len(q.robot.operated):
                cell = q.robot.joint_names[columns[0]], f"{s.meta.payload_mass:g}"
                by_cell.setdefault(cell, {}).setdefault(motion, []).append(1e3 * error)
    by_joint: dict[str, dict[str, tuple[float, int]]] = {}
    for (joint, kg), motions in sorted(by_cell.items()):
        mean = float(np.mean([np.mean(v) for v in motions.values()]))
        by_joint.setdefault(joint, {})[kg] = mean, sum(map(len, motions.values()))
    return {motion: float(np.mean(v)) for motion, v in by_motion.items()}, by_joint


def _lacks_data(method: str, question: Question) -> bool:
    if method == "constant":
        return len({(s.meta.payload_mass, s.meta.unit_id) for s in question.train}) < 2
    return (method == "elsewhere" and question.elsewhere is None) or (
        method == "adapted" and not question.few
    )


def load_method(where: str) -> tuple[str, Method]:
    """Load a method, given as FILE.py:FUNCTION. Return its name and function.

    Raises:
        UsageError: No such file or function.
    """
    file, _, name = where.rpartition(":")
    spec = (
        importlib.util.spec_from_file_location(Path(file).stem, file)
        if Path(file).is_file()
        else None
    )
    if spec is None or spec.loader is None:
        raise UsageError(f"--method {where}: no such file; give FILE.py:FUNCTION")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, name, None)):
        raise UsageError(f"--method {where}: {file} has no function {name}")
    return name, getattr(module, name)
