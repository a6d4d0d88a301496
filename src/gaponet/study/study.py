"""Cells of an experiment: models × seeds, each trained and measured in a process of its own, kept, and read back."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gaponet.data.json_file import write_json
from gaponet.data.store import Dataset
from gaponet.errors import ModelError, UsageError
from gaponet.eval.draw_dataset import who
from gaponet.eval.evaluate import read_split
from gaponet.robot import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.study.compare import evaluate_baselines, evaluate_model
from gaponet.study.options import (
    BUDGET,
    QUICK_BUDGET,
    QUICK_PPO,
    QUICK_SEEDS,
    QUICK_SENSORS,
    QUICK_WARM_START,
    SEEDS,
    TRAINING,
    Options,
)
from gaponet.study.pool import RESULT, Cell, Running, Tell, plan, run_cells, train_cell
from gaponet.study.rehearsal import rehearsal, take
from gaponet.study.result import facts
from gaponet.study.table import Spread
from gaponet.study.variant import IDENTIFIED, Variant, parse_variant
from gaponet.train.budget import Budget
from gaponet.train.config import TrainConfig

Found = dict[str, Any]
Show = Callable[[Running, int], None]

# s on one core of the machine of docs/results.md, virtual H1-2: whatever the budget, and per control step.
FIXED_S, STEP_S = 50.0, 6e-4
REHEARSAL = 0.25  # of FIXED_S, on a slice
ASKED = 0.5  # times more for each probe where the simulator itself answers


@dataclass(frozen=True)
class Study:
    """What all cells of an experiment share."""

    data: Dataset
    robot: RobotSpec
    """The simulator corrected."""
    out: Path
    config: TrainConfig = TRAINING
    budget: str = BUDGET
    seeds: int = SEEDS
    """How many, counted from config.seed."""
    holdout_units: tuple[str, ...] = ()
    workers: int = 0
    """Processes at once; 0 for as many as there are cores."""
    rehearsal: bool = False
    """Whether its numbers mean nothing."""

    def __post_init__(self) -> None:
        if self.seeds < 1 or self.workers < 0:
            raise UsageError("--seeds is at least 1 and --workers at least 0")
        self.data.require_robot(self.robot)

    @classmethod
    def of(
        cls, data: Dataset, robot: RobotSpec, out: Path, options: Options, holdout_units: tuple[str, ...] = ()
    ) -> Study:
        """As told.

        At the slowest rate where the dataset holds several and none was asked for, so that rates are compared where
        they are meant to be. A rehearsal is on a slice of the dataset, in OUT/rehearsal; of the units held out it
        knows those that are in the slice.
        """
        config, quick, rates = options.config, options.quick, rates_of(data)
        if len(rates) > 1 and not config.rates:
            config = replace(config, rates=rates[:1])
        if quick:
            out = out / "rehearsal"
            model = replace(config.model, sensor_hidden=QUICK_SENSORS)
            config = replace(config, model=model, warm_start=QUICK_WARM_START, ppo=QUICK_PPO)
            data = take(data, robot, rehearsal(data), out / "slice")
            kept = {e.meta.unit_id for e in data.entries}
            holdout_units = tuple(u for u in holdout_units if u in kept and len(kept) > 1)
        return cls(
            data, robot, out, config, options.budget or (QUICK_BUDGET if quick else BUDGET),
            options.seeds if options.seeds is not None else QUICK_SEEDS if quick else SEEDS,
            holdout_units, options.workers, quick,
        )  # fmt: skip

    @property
    def who(self) -> str:
        """ "VIRTUAL h1_2" where any of it was not recorded on hardware."""
        return who(self.data.entries) + (", REHEARSAL" if self.rehearsal else "")

    @property
    def processes(self) -> int:
        """At once."""
        return self.workers or max(1, (os.cpu_count() or 1) // (self.config.threads or 1))

    def variant(self, word: str) -> Variant:
        """A model as written, on this configuration."""
        if word.startswith(IDENTIFIED):
            raise UsageError(f"--models {word}: give an identified robot with --robot; all models then start from it")
        return parse_variant(word, self.config)

    def facts(self, found: Mapping[str, ListOf[Found]]) -> dict[str, Any]:
        """What it takes to repeat the experiment, and how long its trainings took."""
        spent = [f["seconds"] for part in found.values() for f in part]
        held: dict[str, Any] = {"holdout_units": list(self.holdout_units)} if self.holdout_units else {}
        if self.rehearsal:
            held["rehearsal"] = "a slice of the dataset and a tiny budget: these numbers mean nothing"
        return facts(
            self.data, range(self.config.seed, self.config.seed + self.seeds), budget=self.budget,
            trainings=len(spent), training_hours=round(sum(spent) / 3600, 2), simulator=model_hash(self.robot), **held,
        )  # fmt: skip

    def cells(self, words: ListOf[str], seeds: int | None = None, into: str = "") -> list[Cell]:
        """Every word with every seed, in OUT/cells, or in OUT/into/cells."""
        numbers = range(self.config.seed, self.config.seed + (seeds or self.seeds))
        variants = [self.variant(w) for w in words]
        return plan(
            self.data, variants, numbers, lambda variant: self.robot, self.out / into, self.budget, self.holdout_units,
            self.config.threads or 1,
        )  # fmt: skip


def rates_of(data: Dataset) -> tuple[float, ...]:
    """Control rates of the recordings, Hz."""
    return tuple(sorted({float(round(1 / e.dt)) for e in data.entries}))


def train_and_evaluate(cell: Cell, tell: Tell) -> None:
    """The work of a cell's process."""

    told = train_cell(cell, tell)
    tell(1.0, "evaluation")
    found = evaluate_model(cell.folder, Dataset(cell.dataset), cell.robot, cell.holdout_units, cell.threads)
    start = "identified" if cell.robot.nominal is not None else "nominal"
    told |= {"kind": cell.variant.kind, "changes": list(cell.variant.changes), "start": start}
    write_json(cell.folder / RESULT, told | found)


def train_all(cells: ListOf[Cell], study: Study, show: Show) -> list[str]:
    """Train and measure what is not there yet; returns a sentence for each that failed.

    Raises:
        ModelError: Nothing came out at all.
    """
    todo = [c for c in cells if not c.done]
    failed = run_cells(todo, train_and_evaluate, study.processes, show) if todo else {}
    if not any(c.done for c in cells):
        raise ModelError(f"{study.out}: every training failed; the first: {next(iter(failed.values()))}")
    return [f"{name} failed and is not in these numbers: {reason}" for name, reason in failed.items()]


def outcomes(cells: ListOf[Cell]) -> dict[str, list[Found]]:
    """Word → what each finished seed gave."""
    out: dict[str, list[Found]] = {}
    for cell in cells:
        if cell.done:
            found = json.loads((cell.folder / RESULT).read_text(encoding="utf-8"))
            out.setdefault(cell.variant.name, []).append(found)
    return out


def baselines(cell: Cell, study: Study) -> Found:
    """Nominal simulator and delay + offset on the cell's test motions, as evaluate_baselines; simulated once, kept."""
    split = read_split(cell.folder)
    fitted = (cell.folder / "delay_offset.json").read_text(encoding="utf-8")
    nominal = study.robot.nominal or study.robot
    parts = [*sorted(split["test"].values()), fitted, model_hash(nominal), *cell.holdout_units]
    file = study.out / "baselines" / f"{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:12]}.json"
    if not file.is_file():
        found = evaluate_baselines(cell.folder, study.data, nominal, None, cell.holdout_units)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, found)
    return json.loads(file.read_text(encoding="utf-8"))


def title(word: str) -> str:
    """A model's word for people."""
    return word.replace("gaponet", "GAPONet", 1).replace("mlp:mlp_match=on", "MLP, as many weights")


def spread(found: ListOf[Found], *path: str, scale: float = 1e3) -> Spread:
    """One number over the seeds, by its place in cell.json; mrad of rad unless scale says otherwise."""
    values = []
    for value in found:
        for key in path:
            value = value.get(key) if value else None  # type: ignore[assignment]
        if value is not None:
            values.append(float(value))  # type: ignore[arg-type]
    return Spread.of(values, scale)


def expected_s(cells: ListOf[Cell], study: Study) -> float:
    """Wall time of what is not there yet, s: from cells of this experiment that are done, else from the H1-2's."""
    done = [c for c in cells if c.done]
    taken = [json.loads((c.folder / RESULT).read_text(encoding="utf-8"))["seconds"] for c in done]
    factor = sum(taken) / sum(_cost(c) for c in done) if done else REHEARSAL if study.rehearsal else 1.0
    todo = [_cost(c) * factor for c in cells if not c.done]
    return max(sum(todo) / study.processes, max(todo, default=0.0))


def _cost(cell: Cell) -> float:
    """s on one core, roughly."""
    budget, model = Budget.parse(cell.budget), cell.variant.config.model
    if budget.seconds is not None:
        return FIXED_S + budget.seconds
    asked = 1 + ASKED * model.num_probes if model.asks_simulator else 1.0
    return FIXED_S * asked + STEP_S * asked * (budget.steps or 0)
