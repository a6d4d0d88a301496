"""Outcomes of the finished trainings of a study, and of the baselines on the same test motions."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from gaponet.base.errors import ModelError
from gaponet.base.executor import open_pool
from gaponet.base.files import write_json
from gaponet.base.progress import Running
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.cells import RESULT_FILE, Cell, read_record, run_cells
from gaponet.experiments.result import Result, facts
from gaponet.experiments.study import Study
from gaponet.experiments.train_cell import Outcome, evaluate_baselines, train_and_evaluate
from gaponet.report.candidate import split_of_run
from gaponet.report.provenance import describe_provenance
from gaponet.sim.model import model_hash

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BASELINES = ("nominal", "delay_offset", "identified")
Show = Callable[[Running, int], None]  # called with the running cells and the number of finished ones


@dataclass(frozen=True)
class StudyOutcomes:
    """Outcomes of the finished cells by model word.

    Attributes:
        runs: Outcome of each finished seed, as its cell.json holds it.
        baselines: Return the outcomes of the baselines on the test motions of a model word.
        cells: The finished cells.
    """

    runs: Mapping[str, ListOf[Outcome]]
    baselines: Callable[[str], Outcome]
    cells: Mapping[str, ListOf[Cell]]

    @classmethod
    def read(cls, cells: ListOf[Cell], study: Study) -> StudyOutcomes:
        """Read the finished cells. Baselines are simulated on their first use and stored in OUT/baselines."""
        done: dict[str, list[Cell]] = {}
        for cell in cells:
            if cell.done:
                done.setdefault(cell.variant.name, []).append(cell)
        runs = {word: [read_record(c.folder / RESULT_FILE) for c in part] for word, part in done.items()}
        return cls(runs, cache(lambda word: _baselines(done[word][0], study)), done)

    def of_word(self, word: str) -> ListOf[Outcome]:
        """Return the outcome of each finished seed of a model."""
        return self.runs.get(word, [])

    def result(
        self, study: Study, name: str, title: str, tables: ListOf[ResultTable], figures: Mapping[str, Figure], *,
        sentences: ListOf[str], **more: Any,
    ) -> Result:  # fmt: skip
        """Return the result with the facts that are needed to repeat it."""
        seconds = [outcome["seconds"] for runs in self.runs.values() for outcome in runs]
        holdout = {"holdout_units": list(study.holdout_units)} if study.holdout_units else {}
        repeat = facts(
            study.data, range(study.config.seed, study.config.seed + study.seeds), budget=study.budget,
            trainings=len(seconds), training_hours=round(sum(seconds) / 3600, 2), simulator=model_hash(study.robot),
            **holdout, **more,
        )  # fmt: skip
        return Result(name, f"{title}, {study.label}", describe_provenance(study.data), repeat, tuple(tables),
                      dict(figures), tuple(sentences))  # fmt: skip


def train_all(cells: ListOf[Cell], study: Study, show: Show) -> list[str]:
    """Train and evaluate the unfinished cells. Return a sentence for each that failed.

    Raises:
        ModelError: Every cell failed.
    """
    todo = [c for c in cells if not c.done]
    failed = dict[str, str]()
    if todo:
        with open_pool(study.executor, study.workers, study.threads) as pool:
            failed = run_cells(todo, train_and_evaluate, pool, show)
    if not any(c.done for c in cells):
        raise ModelError(f"{study.out}: every training failed; the first: {next(iter(failed.values()))}")
    return [f"{name} failed and is not in these numbers: {reason}" for name, reason in failed.items()]


def summarize(outcomes: ListOf[Outcome], *path: str, scale: float = 1e3) -> MeanStd:
    """Mean and standard deviation of one number of several outcomes.

    Args:
        path: Keys that lead to the number; outcomes without it are left out.
        scale: Factor of the number; 1e3 gives mrad.
    """
    values = []
    for value in outcomes:
        for key in path:
            value = value.get(key) if value else None  # type: ignore[assignment]
        if value is not None:
            values.append(float(value))  # type: ignore[arg-type]
    return MeanStd.from_values(values, scale)


def _baselines(cell: Cell, study: Study) -> Outcome:
    """Return the outcomes of the baselines on the cell's test motions, from their file where it exists."""
    delay_offset = (cell.folder / "delay_offset.json").read_text(encoding="utf-8")
    nominal = study.robot.nominal or study.robot
    identified = study.identified or (study.robot if study.robot.nominal else None)
    parts = [*sorted(split_of_run(cell.folder)["test"].values()), delay_offset, model_hash(nominal)]
    parts += [*cell.holdout_units, *([model_hash(identified)] if identified else [])]
    file = study.out / "baselines" / f"{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:12]}.json"
    if not file.is_file():
        outcome = evaluate_baselines(cell.folder, study.data, nominal, identified, cell.holdout_units)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, outcome)
    return read_record(file)
