"""Recordings and files of one training run.

RUN/config.json        all that is needed to repeat it
RUN/split.json         content hashes of each split
RUN/delay_offset.json  the delay and offset baseline
RUN/robot/             the simulator that is corrected
RUN/progress.jsonl     training curve, one line per validation
RUN/checkpoint.pt      newest state, for --resume
RUN/model/             the artifact: model.onnx, card.json
RUN/tensorboard/       the training curve, with --log tensorboard
RUN/candidates.json    validation errors of --model auto
RUN/candidates/        the run of each of its networks
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.base.files import write_json
from gaponet.base.installation import pip
from gaponet.data.sequence import Sequence, require_same_gains
from gaponet.data.split import Splits, resolve_splits, stratified_subset
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.training.checkpoint import CHECKPOINT
from gaponet.nn.training.config import Budget, TrainConfig, command
from gaponet.nn.training.simulators import in_many_simulators, in_validation_simulators
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot, load_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.model import model_hash

MAX_VALIDATION_ROLLOUTS = 24  # per validation, of all payloads, units and rates


class TrainingData:
    """Recordings of a run by split.

    Attributes:
        splits: Entries of "train", "val" and "test".
        recorded: Training recordings.
        train: The same, or their pieces in many simulators.
        val: Validation recordings, at most MAX_VALIDATION_ROLLOUTS.
    """

    def __init__(
        self,
        dataset: Dataset,
        robot: RobotSpec,
        config: TrainConfig,
        holdout_units: tuple[str, ...],
    ) -> None:
        """Split a dataset and read what training needs.

        Raises:
            DatasetError, UsageError: Another robot, recordings with several gains, or splits that
                share a recording.
        """
        dataset.require_robot(robot)
        self.dataset = dataset
        self.robot = robot
        self.holdout_units = holdout_units
        self.splits = training_splits(dataset, config, holdout_units)
        if not config.mixed_gains:
            every_entry = chain.from_iterable(self.splits.values())
            metas = (entry.meta for entry in every_entry)
            require_same_gains(metas, dataset.joint_names, robot.operated)
        self.config = config
        self.recorded = dataset.sequences(self.splits["train"], optional=False)
        self.train = in_many_simulators(self.recorded, robot, config)
        val = stratified_subset(self.splits["val"], MAX_VALIDATION_ROLLOUTS)
        self.val = in_validation_simulators(dataset.sequences(val, optional=False), robot, config)
        if not config.mixed_gains:
            self._require_gains_of_robot()

    def _require_gains_of_robot(self) -> None:
        """Refuse recordings with other gains than the robot's."""
        for condition in self.conditions:
            if condition.kp or condition.kd:
                raise UsageError(
                    f"the recordings were made with kp {condition.kp} and kd {condition.kd}, "
                    "robot.toml says others: write there what the robot runs with, or add "
                    "--mixed-gains to train in simulators of the recordings' own gains"
                )

    @property
    def conditions(self) -> set[Condition]:
        """Payloads, rates and gains of the training recordings."""
        return {Condition.of(s, self.robot) for s in self.train}

    def labelled_subset(self, max_rows: int) -> list[Sequence]:
        """Return training recordings with about max_rows rows, stratified by payload, unit and
        rate.

        A row counts once for each of its simulators.
        """
        entries = self.splits["train"]
        if self.config.simulators:
            max_rows //= self.config.simulators_per_piece
        count = max(1, max_rows * len(entries) // sum(e.rows for e in entries))
        chosen = self.dataset.sequences(stratified_subset(entries, count), optional=False)
        return in_many_simulators(chosen, self.robot, self.config)


def training_splits(
    dataset: Dataset, config: TrainConfig, holdout_units: tuple[str, ...]
) -> Splits:
    """Return the splits that training with these options uses.

    Raises:
        DatasetError, UsageError: A split would be empty, or the split file does not fit.
    """
    rule = (holdout_units, config.holdout_payloads, config.rates, config.train_share)
    return resolve_splits(dataset, config.split, *rule)


def require_suitable(run: Path, robot: RobotSpec, resume: bool) -> None:
    """Refuse a folder that holds a run and is not to be resumed, or that holds no run of this
    simulator and is.

    Raises:
        UsageError: The folder does not fit.
    """
    if not resume:
        if (run / CHECKPOINT).exists() or (run / "model/card.json").exists():
            raise UsageError(
                f"{run}: holds a run already; add --resume to go on with it, or choose another "
                "--out"
            )
        return
    if not (run / CHECKPOINT).is_file():
        raise UsageError(f"{run}: nothing to resume (no {CHECKPOINT}); train without --resume")
    if not has_stored_robot(run):
        return
    if model_hash(load_stored_robot(run, robot.name)) != model_hash(robot):
        raise UsageError(
            f"{run}: was trained in another simulator; resume with --robot {run / STORED_ROBOT}"
        )


def write_setup(
    run: Path,
    data: TrainingData,
    config: TrainConfig,
    budget: Budget,
    resume: bool,
    despite_errors: bool = False,
) -> None:
    """Write config.json, split.json and the robot."""
    dataset = data.dataset
    robot = data.robot
    words = command(dataset.path, run, budget, config, robot, data.holdout_units)
    if despite_errors:
        words += " --despite-errors"
    facts = {
        "budget": asdict(budget),
        "holdout_units": data.holdout_units,
        "robot": robot.name,
        "command": words,
        "dataset": os.path.relpath(dataset.path, run),
        "dataset_hash": dataset_hash(dataset.entries),
    }
    write_json(run / "config.json", asdict(config) | facts)
    is_stored_there = robot.folder.resolve() == (run / STORED_ROBOT).resolve()
    is_kept = resume and has_stored_robot(run)
    if not is_stored_there and not is_kept:
        save_robot(robot, run / STORED_ROBOT)
    split = {}
    for part, entries in data.splits.items():
        split[part] = {entry.id: entry.hash for entry in entries}
    write_json(run / "split.json", split)


# write(numbers, steps), close()
Writer = tuple[Callable[[dict[str, float], int], None], Callable[[], None]]


class Loggers:
    """Writes the finite numbers of each progress line over control steps."""

    def __init__(self, kinds: tuple[str, ...], out: Path, config: dict[str, Any]) -> None:
        """
        Args:
            kinds: Any of tensorboard and wandb.
            out: Run folder. TensorBoard's files go to out/tensorboard.
            config: Configuration of the run, for Weights & Biases.

        Raises:
            UsageError: A package is not installed.
        """
        self.writers: list[Writer] = []
        for kind in kinds:
            try:
                if kind == "tensorboard":
                    self.writers.append(_tensorboard(out))
                else:
                    self.writers.append(_wandb(out, config))
            except ImportError:
                raise UsageError(f"--log {kind}: not installed; run: {pip()} {kind}") from None

    def write(self, line: dict[str, Any]) -> None:
        """Log one line of progress.jsonl."""
        numbers = {}
        for name, value in line.items():
            is_number = isinstance(value, (int, float)) and value == value
            if is_number and name != "steps":
                numbers[name] = float(value)
        for write, _ in self.writers:
            write(numbers, line["steps"])

    def close(self) -> None:
        """Close all files and connections."""
        for _, close in self.writers:
            close()


def _tensorboard(out: Path) -> Writer:
    from torch.utils.tensorboard import SummaryWriter

    board = SummaryWriter(str(out / "tensorboard"))

    def write(numbers: dict[str, float], steps: int) -> None:
        for name, value in numbers.items():
            board.add_scalar(name, value, steps)
        board.flush()

    return write, board.close


def _wandb(out: Path, config: dict[str, Any]) -> Writer:
    import wandb

    run = wandb.init(project="gaponet", name=out.name, dir=str(out), config=config)
    return lambda numbers, steps: run.log(numbers, step=steps), run.finish
