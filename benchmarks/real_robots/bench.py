"""The benchmark's run: every method on every question of every public data set that is present."""

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
    failed: list[str] = field(default_factory=list)  # rows that a method's error cost

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
        present = self._chosen(sets, names)
        left_out = self._left_out()
        rows: list[Row] = []
        labels: dict[str, list[str]] = {}
        seconds: dict[str, float] = {}
        for card in present:
            began = time.monotonic()
            try:
                dataset, robot, estimated = prepare(card, self.data, self.work)
            except GAPONetError as error:
                self.say(f"{card.name}: {error}")
                left_out[card.folder] = str(error)
                continue
            seconds[card.name] = time.monotonic() - began
            self.say(
                f"{card.name}: {len(dataset)} recordings, {dataset.hours() * 60:.1f} min, from "
                f"file to dataset in {seconds[card.name]:.0f} s"
            )
            if estimated:
                labels[card.name] = estimated.remarks
            for name in [q for q in card.questions if q in (names or card.questions)]:
                folds = list(questions(name, dataset, robot, self._elsewhere(card)))
                found = self.evaluate(card, name, folds)
                seconds[card.name] += sum(row["seconds"] for row in found)
                rows += found
        return {
            "rows": rows,
            "cards": {card.name: card.title for card in present},
            "labels": labels,
            "left_out": left_out,
            "seconds": {name: round(value) for name, value in seconds.items()},
        }

    def _left_out(self) -> dict[str, str]:
        """Return folder → reason why it is not used."""
        left_out = {}
        for folder in self.cards.left_out:
            if (self.data / folder.folder).exists():
                left_out[folder.folder] = folder.why
        for card in self.cards.set:
            if not self._is_present(card):
                left_out[card.folder] = "not there"
        return left_out

    def _chosen(self, sets: tuple[str, ...], names: tuple[str, ...]) -> list[Card]:
        """Return the cards that are wanted and whose data are there.

        Raises:
            UsageError: No such data set or question.
        """
        known = [card.name for card in self.cards.set]
        unknown = set(sets) - set(known)
        if unknown:
            raise UsageError(f"no set '{min(unknown)}'; there are {', '.join(known)}")
        present = []
        asked: set[str] = set()
        for card in self.cards.set:
            if self._is_present(card) and (not sets or card.name in sets):
                present.append(card)
                asked |= set(card.questions)
        unknown = set(names) - asked
        if unknown:
            raise UsageError(f"no question '{min(unknown)}'; there are {', '.join(sorted(asked))}")
        return present

    def evaluate(self, card: Card, name: str, folds: list[Question]) -> list[Row]:
        """Evaluate every method on every fold of a question.

        Methods without the data that they need are skipped.

        Returns:
            A row per method for JSON: mrad, standard errors over motions, of differences paired;
            by_motion_mrad, independent motion → error; floor_mrad, the mean difference of
            repetitions; splits, a hash per fold; and by_joint_mrad, joint → payload, kg → (mean
            error over motions; number of recordings), of data sets in which joints were recorded
            one at a time.
        """
        rows: list[Row] = []
        nominal = np.empty(0)
        floor_mrad = 1e3 * _floor(folds)
        folds = [self._with_folder(card, question) for question in folds]
        for method, (title, fit) in self.methods.items():
            if _lacks_data(method, folds[0]):
                continue
            try:
                evaluated = [self._evaluate_fold(card, fold, method, fit) for fold in folds]
            except Exception as error:  # anybody's method: it loses its own row and no other
                kind = "" if isinstance(error, GAPONetError) else f"{type(error).__name__}: "
                self.say(f"{card.name}, {name}, {title}: {kind}{error}")
                self.failed.append(f"{card.name}, {name}, {title}")
                continue
            by_motion, by_joint = _averages(folds, [fold["errors"] for fold in evaluated])
            errors = np.array([*by_motion.values()])
            if not rows:
                nominal = errors
            row: Row = {"set": card.name, "question": name, "method": title}
            row |= _statistics(errors, nominal)
            row |= _costs_and_notes(evaluated)
            row |= {
                "floor_mrad": floor_mrad,
                "splits": [question.split_hash for question in folds],
                "by_motion_mrad": {motion: 1e3 * error for motion, error in by_motion.items()},
                "by_joint_mrad": by_joint,
            }
            rows.append(json_compatible(row))
            self.say(
                f"{card.name}, {name}: {title}: {1e3 * errors.mean():.2f} mrad, "
                f"nominal {1e3 * nominal.mean():.2f}"
            )
        return rows

    def _is_present(self, card: Card) -> bool:
        return (self.data / card.folder).exists()

    def _elsewhere(self, card: Card) -> Callable[[], RobotSpec] | None:
        """Return a function that identifies the robot on the other data set of a card.

        None if that is not present.
        """
        for other in self.cards.set:
            if other.name == card.elsewhere and self._is_present(other):
                return functools.partial(self._identified_on, other)
        return None

    def _identified_on(self, card: Card) -> RobotSpec:
        dataset, robot, _ = prepare(card, self.data, self.work)
        question = next(questions(card.questions[0], dataset, robot, None))
        return identified(self._with_folder(card, question)).robot

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
        began = time.monotonic()
        fitted = fit(question)
        errors = fitted.errors(question.test)
        record = {"errors": errors, "seconds": time.monotonic() - began, "note": fitted.note}
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(record))
        return record


def _statistics(errors: np.ndarray, nominal: np.ndarray) -> Row:
    """Return the columns of a row that follow from the errors of each motion, (motions,) rad."""
    less = 1e3 * (nominal - errors)
    return {
        "mrad": 1e3 * errors.mean(),
        "standard_error": 1e3 * standard_error(errors),
        "of_nominal": errors.mean() / nominal.mean(),
        "less_than_nominal": less.mean(),
        "less_standard_error": standard_error(less),
        "motions": len(errors),
    }


def _costs_and_notes(evaluated: list[dict[str, Any]]) -> Row:
    """Return the columns that follow from what was stored about each fold."""
    return {
        "recordings": sum(len(fold["errors"]) for fold in evaluated),
        "seconds": round(sum(fold["seconds"] for fold in evaluated), 1),
        "notes": [fold["note"] for fold in evaluated if fold["note"]],
    }


def _floor(folds: list[Question]) -> float:
    """Return the mean difference of repetitions, rad; NaN without any."""
    floors = np.array([repeatability(question) for question in folds])
    floors = floors[np.isfinite(floors)]
    return float(np.mean(floors)) if len(floors) else float("nan")


def _averages(
    folds: list[Question], errors: list[list[float]]
) -> tuple[dict[str, float], dict[str, dict[str, tuple[float, int]]]]:
    """Return the mean error of each independent motion, rad, and by_joint_mrad (Bench.evaluate)."""
    by_motion: dict[str, list[float]] = {}
    by_cell: dict[tuple[str, str], dict[str, list[float]]] = {}  # joint, kg → motion → mrad
    for question, errors_of_fold in zip(folds, errors, strict=True):
        robot = question.robot
        for s, motion, error in zip(
            question.test, question.test_motions, errors_of_fold, strict=True
        ):
            by_motion.setdefault(motion, []).append(error)
            columns = recorded_joints(s, robot)
            if len(columns) == 1 and len(robot.operated) > 1:
                cell = (robot.joint_names[columns[0]], f"{s.meta.payload_mass:g}")
                by_cell.setdefault(cell, {}).setdefault(motion, []).append(1e3 * error)
    by_joint: dict[str, dict[str, tuple[float, int]]] = {}
    for (joint, kg), motions in sorted(by_cell.items()):
        mean = float(np.mean([np.mean(values) for values in motions.values()]))
        count = sum(map(len, motions.values()))
        by_joint.setdefault(joint, {})[kg] = (mean, count)
    return {motion: float(np.mean(values)) for motion, values in by_motion.items()}, by_joint


def _lacks_data(method: str, question: Question) -> bool:
    if method == "constant":
        return len({(s.meta.payload_mass, s.meta.unit_id) for s in question.train}) < 2
    if method == "elsewhere":
        return question.elsewhere is None
    if method == "adapted":
        return not question.few
    return False


def load_method(where: str) -> tuple[str, Method]:
    """Load a method, given as FILE.py:FUNCTION. Return its name and function.

    Raises:
        UsageError: No such file or function.
    """
    file, _, name = where.rpartition(":")
    spec = None
    if Path(file).is_file():
        spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    if spec is None or spec.loader is None:
        raise UsageError(f"--method {where}: no such file; give FILE.py:FUNCTION")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, name, None)):
        raise UsageError(f"--method {where}: {file} has no function {name}")
    return name, getattr(module, name)
