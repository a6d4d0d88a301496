"""The data, settings and options that all trainings of an experiment share. Docstrings of options are help texts."""

from __future__ import annotations

import re
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from gaponet.base.errors import UsageError
from gaponet.base.executor import LOCAL
from gaponet.data.split import hash_order
from gaponet.data.store import Dataset, Entry
from gaponet.experiments.cells import Cell
from gaponet.experiments.variant import Variant, parse_variant
from gaponet.nn.training.config import Budget, PPOConfig, PretrainingConfig, TrainConfig
from gaponet.report.candidate import robot_label
from gaponet.report.evaluate import evenly_spaced
from gaponet.report.methods import IDENTIFIED
from gaponet.robot.spec import RobotSpec

# Small rounds, fitted until the labels are fitted (progress.jsonl: label_rmse). With 200 gradient steps a product
# network has the advantage.
TRAINING = TrainConfig(
    pretraining=PretrainingConfig(rounds=2, num_envs=128, steps=300, gradient_steps=800)
)
DEFAULT_MODELS = ("gaponet", "shared_mlp", "mlp:mlp_match=on")
DEFAULT_BUDGET, DEFAULT_SEEDS = "76800", 3  # control steps of two rounds
QUICK_BUDGET, QUICK_SEEDS = "2560", 1  # control steps of a training
QUICK_LABEL = "QUICK RUN, numbers mean nothing"
QUICK_PRETRAINING = PretrainingConfig(
    rounds=2, num_envs=16, steps=80, gradient_steps=40, batch_size=256, sensor_states=256
)  # fmt: skip
QUICK_PPO = PPOConfig(num_envs=32, num_steps=16, epochs=1, critic_warmup=1)
QUICK_SENSOR_HIDDEN = (
    32,
)  # hidden layers of the predictor, whose fit takes most of a short training
QUICK_MOTIONS, QUICK_PAYLOADS, QUICK_UNITS = 6, 3, 2  # a split of six motions has 3 + 1 + 2
QUICK_RECORDING_S = 2.0


def quick_config(config: TrainConfig) -> TrainConfig:
    """Return the settings with small networks and rounds."""
    model = replace(config.model, sensor_hidden=QUICK_SENSOR_HIDDEN)
    return replace(config, model=model, pretraining=QUICK_PRETRAINING, ppo=QUICK_PPO)


def quick_dataset(data: Dataset, robot: RobotSpec, out: Path) -> Dataset:
    """Write the first seconds of a few recordings as a dataset; the same call again finds it."""
    part = Dataset.create(out, robot)
    for entry in _few(data):
        start = data.read(entry).rows(slice(0, round(QUICK_RECORDING_S / entry.dt)))
        if part.find(start.content_hash()) is None:
            part.append(start)
    return part


def _few(data: Dataset) -> list[Entry]:
    """Return few motions, payloads and units, one repetition, all rates: every group stays represented."""
    payloads = evenly_spaced(sorted({e.meta.payload_mass for e in data.entries}), QUICK_PAYLOADS)
    units = sorted({e.meta.unit_id for e in data.entries})[:QUICK_UNITS]
    motions = hash_order(e.meta.motion for e in data.entries)[:QUICK_MOTIONS]
    first = min(e.meta.repetition for e in data.entries)
    return [
        e for e in data.entries
        if e.meta.motion in motions and e.meta.payload_mass in payloads and e.meta.unit_id in units
        and e.meta.repetition == first
    ]  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of all experiments that train."""

    seeds: int = DEFAULT_SEEDS
    """Number of seeds, counted from --seed."""
    budget: str = DEFAULT_BUDGET
    """Length of each training: time such as 90s or 10m, or control steps."""
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run in minutes, in OUT/quick: a small part of the dataset, 2560 control steps and one seed for each training. The
    numbers mean nothing."""
    workers: int = 0
    """Trainings at a time, each on --threads (here 1 by default) threads; 0 for as many as there are cores."""
    executor: str = LOCAL
    """Where they run: local, ray or ray:ADDRESS (docs/install.md)."""
    robot: str | None = None
    """Robot name or folder, if not the one that the dataset stores; all models correct it."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object on stdout."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TRAINING
    """Settings of all models; rows of a table change one of them."""


@dataclass(frozen=True)
class Study:
    """Settings that all cells of an experiment share."""

    data: Dataset
    robot: RobotSpec  # the simulator that models correct
    out: Path  # folder of the results
    config: TrainConfig = TRAINING
    budget: str = DEFAULT_BUDGET  # control steps or time of each training, as gaponet.nn.training.config reads it
    seeds: int = DEFAULT_SEEDS  # number of seeds, counted from config.seed
    holdout_units: tuple[str, ...] = ()
    workers: int = 0  # trainings at a time; 0 for as many as there are cores
    executor: str = LOCAL  # where they run (gaponet.base.executor)
    identified: RobotSpec | None = (
        None  # the identified robot, for words with identified+ in front and as a baseline
    )
    quick: bool = False  # True for a quick run, whose numbers mean nothing

    def __post_init__(self) -> None:
        if self.seeds < 1 or self.workers < 0:
            raise UsageError("--seeds is at least 1 and --workers at least 0")
        self.data.require_robot(self.robot)

    @classmethod
    def from_options(
        cls, data: Dataset, robot: RobotSpec, out: Path, options: Options, *,
        holdout_units: tuple[str, ...] = (), one_rate: bool = True,
    ) -> Study:  # fmt: skip
        """Return the study that the options describe.

        With one_rate, a dataset of several control rates is used at its slowest one unless the options name rates.
        Rates are then compared in those comparisons alone that are about rates.
        """
        config, rates = options.config, control_rates(data)
        budget, seeds = options.budget, options.seeds
        if one_rate and len(rates) > 1 and not config.rates:
            config = replace(config, rates=rates[:1])
        if options.quick:
            out, config, budget, seeds = (
                out / "quick",
                quick_config(config),
                QUICK_BUDGET,
                QUICK_SEEDS,
            )
            data = quick_dataset(data, robot, out / "data")
            units = {e.meta.unit_id for e in data.entries}
            holdout_units = tuple(u for u in holdout_units if u in units and len(units) > 1)
        return cls(data, robot, out, config, budget, seeds, holdout_units, options.workers, options.executor,
                   quick=options.quick)  # fmt: skip

    @property
    def label(self) -> str:
        """The robot's name; "VIRTUAL h1_2" where any recording is virtual."""
        return robot_label(self.data.entries) + f" ({QUICK_LABEL})" * self.quick

    @property
    def threads(self) -> int:
        """Threads of one training."""
        return self.config.threads or 1

    def variant(self, word: str) -> Variant:
        """Parse a model's word with this study's settings as defaults.

        Raises:
            UsageError: No such model or setting; or identified+ without an identified robot.
        """
        if word.startswith(IDENTIFIED) and self.identified is None:
            raise UsageError(
                f"--models {word}: add --identify to gaponet experiment compare, or give an identified robot with "
                "--robot, from which all models then start"
            )
        return parse_variant(word, self.config)

    def cells(self, words: ListOf[str]) -> list[Cell]:
        """Return a cell in OUT/cells for every model word and seed.

        They come seed by seed, so that an interrupted comparison has every model.

        Raises:
            UsageError: The same model twice, or an existing cell that was set up differently.
        """
        if len(set(words)) < len(words):
            raise UsageError(
                f"--models: '{max(words, key=words.count)}' is there twice; name each once, seeds repeat it"
            )
        Budget.parse(self.budget)
        cells, data = list[Cell](), self.data.address or str(self.data.path.resolve())
        for seed in range(self.config.seed, self.config.seed + self.seeds):
            for variant in map(self.variant, words):
                folder = (
                    self.out
                    / "cells"
                    / f"{re.sub(r'[^A-Za-z0-9_.=+-]+', '_', variant.name)}-{seed}"
                )
                robot = self.identified if variant.identified and self.identified else self.robot
                cells.append(
                    Cell(
                        variant,
                        seed,
                        folder,
                        data,
                        robot,
                        self.budget,
                        self.holdout_units,
                        self.threads,
                    )
                )
        for cell in cells:
            cell.require_same_setup(self.data)
        return cells


def control_rates(data: Dataset) -> tuple[float, ...]:
    """Control rates of the recordings in ascending order, Hz."""
    return tuple(sorted({float(round(1 / e.dt)) for e in data.entries}))
