"""A study: what all of its cells share, and how long they will take."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.executor import LOCAL, MAX_WORKERS, Pool
from gaponet.data.store import Dataset
from gaponet.experiments.kept import read_kept
from gaponet.experiments.options import (
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
from gaponet.experiments.pool import RESULT, Cell, plan
from gaponet.experiments.rehearsal import rehearsal, take
from gaponet.experiments.variant import Variant, parse_variant
from gaponet.nn.training.budget import Budget
from gaponet.nn.training.config import TrainConfig
from gaponet.report.methods import IDENTIFIED
from gaponet.report.whose import who
from gaponet.robot.spec import RobotSpec

# s on one core, virtual H1-2: whatever the budget, and per control step.
FIXED_S, STEP_S = 50.0, 6e-4
REHEARSAL = 0.25  # of FIXED_S, on a slice


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
    """How many seeds, counted from config.seed."""
    holdout_units: tuple[str, ...] = ()
    workers: int = 0
    """Trainings at once; 0 for as many as there are cores."""
    executor: str = LOCAL
    """Where they run (gaponet.base.executor)."""
    rehearsal: bool = False
    """Whether its numbers mean nothing."""
    identified: RobotSpec | None = None
    """What was identified from robot, for words with identified+ in front and as a baseline."""

    def __post_init__(self) -> None:
        if self.seeds < 1 or self.workers < 0:
            raise UsageError("--seeds is at least 1 and --workers at least 0")
        self.data.require_robot(self.robot)

    @classmethod
    def of(
        cls, data: Dataset, robot: RobotSpec, out: Path, options: Options, holdout_units: tuple[str, ...] = (),
        one_rate: bool = True,
    ) -> Study:  # fmt: skip
        """The study that the options ask for.

        With one_rate at the slowest rate where the dataset holds several and none was asked for, so that rates are
        compared where they are meant to be. A rehearsal is on a slice of the dataset, in OUT/rehearsal; of the units
        held out it knows those that are in the slice.
        """
        config, quick, rates = options.config, options.quick, rates_of(data)
        if one_rate and len(rates) > 1 and not config.rates:
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
            holdout_units, options.workers, options.executor, quick,
        )  # fmt: skip

    @property
    def who(self) -> str:
        """ "VIRTUAL h1_2" where any of it was not recorded on hardware."""
        return who(self.data.entries) + (", REHEARSAL" if self.rehearsal else "")

    @property
    def threads(self) -> int:
        """The numbers of one training."""
        return self.config.threads or 1

    @property
    def at_once(self) -> int:
        """Trainings, as far as is known before a cluster is asked."""
        return self.workers or (Pool.cores(self.threads) if self.executor == LOCAL else MAX_WORKERS)

    def variant(self, word: str) -> Variant:
        """A model as written, on this configuration."""
        if word.startswith(IDENTIFIED) and self.identified is None:
            raise UsageError(
                f"--models {word}: add --identify to gaponet experiment compare, or give an identified robot with "
                "--robot, from which all models then start"
            )
        return parse_variant(word, self.config)

    def cells(self, words: ListOf[str], seeds: int | None = None, into: str = "") -> list[Cell]:
        """Every word with every seed, in OUT/cells, or in OUT/into/cells."""
        numbers = range(self.config.seed, self.config.seed + (seeds or self.seeds))
        variants = [self.variant(w) for w in words]
        return plan(
            self.data, variants, numbers, self._simulator, self.out / into, self.budget, self.holdout_units,
            self.threads,
        )  # fmt: skip

    def _simulator(self, variant: Variant) -> RobotSpec:
        return self.identified if variant.identified and self.identified is not None else self.robot


def rates_of(data: Dataset) -> tuple[float, ...]:
    """Control rates of the recordings, Hz."""
    return tuple(sorted({float(round(1 / e.dt)) for e in data.entries}))


def expected_s(cells: ListOf[Cell], study: Study) -> float:
    """Wall time of what is not there yet, s: from cells of this experiment that are done, else from the H1-2's."""
    done = [c for c in cells if c.done]
    taken = [read_kept(c.folder / RESULT)["seconds"] for c in done]
    factor = sum(taken) / sum(_cost(c) for c in done) if done else REHEARSAL if study.rehearsal else 1.0
    todo = [_cost(c) * factor for c in cells if not c.done]
    return max(sum(todo) / study.at_once, max(todo, default=0.0))


def _cost(cell: Cell) -> float:
    """s on one core, roughly."""
    budget = Budget.parse(cell.budget)
    if budget.seconds is not None:
        return FIXED_S + budget.seconds
    return FIXED_S + STEP_S * (budget.steps or 0)
