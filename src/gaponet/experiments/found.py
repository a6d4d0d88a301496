"""A question about trainings, and the way from its cells to its answer."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

from gaponet.base.errors import ModelError
from gaponet.base.executor import open_pool
from gaponet.base.files import write_json
from gaponet.base.progress import Running
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.kept import read_kept
from gaponet.experiments.measure import Outcome, evaluate_baselines, train_and_evaluate
from gaponet.experiments.pool import RESULT, Cell, run_cells
from gaponet.experiments.result import Result, facts
from gaponet.experiments.study import Study
from gaponet.report.candidate import split_of_run
from gaponet.report.whose import label
from gaponet.sim.model import model_hash

Key = tuple[str, str]  # a model's word, and the unit left out or ""
Show = Callable[[Running, int], None]


class Question(Protocol):
    """What can be asked of a study: its fields are options, their docstrings command-line help."""

    @property
    def holdout_units(self) -> tuple[str, ...]:
        """Units never trained on."""

    def cells(self, study: Study) -> list[Cell]:
        """The trainings that are needed, each word and seed once."""

    def result(self, study: Study, found: Found) -> Result:
        """The result that the finished cells give."""


@dataclass(frozen=True)
class Found:
    """What the finished cells of a question gave.

    Attributes:
        runs: What each finished seed gave, as its cell.json holds it.
        baselines: Errors of the baselines on the same test motions: {"nominal", "delay_offset", maybe "identified"}.
    """

    runs: Mapping[Key, ListOf[Outcome]]
    baselines: Callable[[Key], Outcome]
    cells: Mapping[Key, ListOf[Cell]]

    @classmethod
    def of(cls, cells: ListOf[Cell], study: Study) -> Found:
        """Read what is done; baselines are simulated when they are asked for, and kept in OUT/baselines."""
        done: dict[Key, list[Cell]] = {}
        for cell in cells:
            if cell.done:
                left_out = cell.holdout_units[0] if cell.holdout_units != study.holdout_units else ""
                done.setdefault((cell.variant.name, left_out), []).append(cell)
        runs = {k: [read_kept(c.folder / RESULT) for c in v] for k, v in done.items()}
        return cls(runs, cache(lambda key: baselines(done[key][0], study)), done)

    def of_word(self, word: str, left_out: str = "") -> ListOf[Outcome]:
        """What each finished seed of a model gave."""
        return self.runs.get((word, left_out), [])

    def spread(self, word: str, *path: str, left_out: str = "", scale: float = 1e3) -> MeanStd:
        """One number of a model over its seeds, by its place in cell.json; mrad of rad unless scale says otherwise."""
        return spread(self.of_word(word, left_out), *path, scale=scale)

    def base(self, name: str, *path: str, word: str = "", left_out: str = "", scale: float = 1e3) -> MeanStd:
        """One number of a baseline, on the test motions of a model, or of any that leaves the same unit out."""
        keys = [k for k in self.runs if k[1] == left_out and word in ("", k[0])]
        found = self.baselines(keys[0]).get(name) if keys else None
        return spread([found] if found else [], *path, scale=scale)

    def result(
        self, study: Study, name: str, heading: str, tables: ListOf[ResultTable], figures: Mapping[str, Any],
        sentences: ListOf[str], **more: Any,
    ) -> Result:  # fmt: skip
        """Everything together, with what it takes to repeat it and how long the trainings took."""
        spent = [f["seconds"] for part in self.runs.values() for f in part]
        held: dict[str, Any] = {"holdout_units": list(study.holdout_units)} if study.holdout_units else {}
        if study.rehearsal:
            held["rehearsal"] = "a slice of the dataset and a tiny budget: these numbers mean nothing"
        repeat = facts(
            study.data, range(study.config.seed, study.config.seed + study.seeds), budget=study.budget,
            trainings=len(spent), training_hours=round(sum(spent) / 3600, 2), simulator=model_hash(study.robot), **held,
            **more,
        )  # fmt: skip
        whose = f"{heading}, {study.who}"
        return Result(name, whose, label(study.data), repeat, tuple(tables), dict(figures), tuple(sentences))


def answer(question: Question, study: Study, show: Show) -> Result:
    """Train and measure what is not there yet, and say what came out; those that failed are named.

    Raises:
        ModelError: Nothing came out at all.
    """
    cells = question.cells(study)
    failed = train_all(cells, study, show)
    result = question.result(study, Found.of(cells, study))
    return replace(result, sentences=(*result.sentences, *failed))


def train_all(cells: ListOf[Cell], study: Study, show: Show) -> list[str]:
    """Train and measure what is not there yet; returns a sentence for each that failed.

    Raises:
        ModelError: Nothing came out at all.
    """
    todo = [c for c in cells if not c.done]
    failed = dict[str, str]()
    if todo:
        with open_pool(study.executor, study.workers, study.threads) as pool:
            failed = run_cells(todo, train_and_evaluate, pool, show)
    if not any(c.done for c in cells):
        raise ModelError(f"{study.out}: every training failed; the first: {next(iter(failed.values()))}")
    return [f"{name} failed and is not in these numbers: {reason}" for name, reason in failed.items()]


def baselines(cell: Cell, study: Study) -> Outcome:
    """What needs no training of ours, on the cell's test motions; simulated once, kept."""
    fitted = (cell.folder / "delay_offset.json").read_text(encoding="utf-8")
    nominal = study.robot.nominal or study.robot
    identified = study.identified or (study.robot if study.robot.nominal else None)
    parts = [*sorted(split_of_run(cell.folder)["test"].values()), fitted, model_hash(nominal), *cell.holdout_units]
    parts += [model_hash(identified)] if identified else []
    file = study.out / "baselines" / f"{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:12]}.json"
    if not file.is_file():
        found = evaluate_baselines(cell.folder, study.data, nominal, identified, cell.holdout_units)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, found)
    return read_kept(file)


def spread(found: ListOf[Outcome], *path: str, scale: float = 1e3) -> MeanStd:
    """One number over several outcomes, by its place in them; those that do not hold it are passed over."""
    values = []
    for value in found:
        for key in path:
            value = value.get(key) if value else None  # type: ignore[assignment]
        if value is not None:
            values.append(float(value))  # type: ignore[arg-type]
    return MeanStd.from_values(values, scale)
