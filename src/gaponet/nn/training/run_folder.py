"""Recordings and files of one training run.

RUN/config.json        all that is needed to repeat it      RUN/progress.jsonl   training curve, one line per validation
RUN/split.json         content hashes of each split         RUN/checkpoint.pt    newest state, for --resume
RUN/delay_offset.json  the delay and offset baseline        RUN/model/           the artifact: model.onnx, card.json
RUN/candidates.json    validation errors of --model auto    RUN/candidates/      the run of each of its networks
RUN/robot/             the simulator that is corrected      RUN/tensorboard/     the same curve, with --log tensorboard
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.data.sequence import Sequence, require_same_gains
from gaponet.data.split import Splits, resolve_splits, stratified_subset
from gaponet.data.store import Dataset, dataset_hash
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training import ranks
from gaponet.nn.training.checkpoint import CHECKPOINT
from gaponet.nn.training.config import Budget, TrainConfig, command
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot, load_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.model import model_hash

MAX_VALIDATION_ROLLOUTS = 24  # per validation, of all payloads, units and rates


@dataclass(frozen=True)
class TrainingData:
    """Recordings of a run by split.

    Attributes:
        splits: Entries of "train", "val" and "test".
        train: Training recordings.
        val: Validation recordings, at most MAX_VALIDATION_ROLLOUTS.
    """

    dataset: Dataset
    robot: RobotSpec
    holdout_units: tuple[str, ...]
    splits: Splits
    train: list[Sequence]
    val: list[Sequence]

    @classmethod
    def load(
        cls, dataset: Dataset, robot: RobotSpec, config: TrainConfig, holdout_units: tuple[str, ...]
    ) -> TrainingData:
        """Split a dataset and read what training needs.

        Raises:
            DatasetError, UsageError: Another robot, recordings with several gains, or splits that share a recording.
        """
        dataset.require_robot(robot)
        rule = (holdout_units, config.holdout_payloads, config.rates, config.train_share)
        splits = resolve_splits(dataset, config.split, *rule)
        if not config.mixed_gains:
            metas = (e.meta for entries in splits.values() for e in entries)
            require_same_gains(metas, dataset.joint_names, robot.operated)
        train = dataset.sequences(splits["train"], optional=False)
        val = dataset.sequences(stratified_subset(splits["val"], MAX_VALIDATION_ROLLOUTS), optional=False)
        data = cls(dataset, robot, holdout_units, splits, train, val)
        if not config.mixed_gains and (other := next((c for c in data.conditions if c.kp or c.kd), None)):
            raise UsageError(
                f"the recordings were made with kp {other.kp} and kd {other.kd}, robot.toml says others: write there "
                "what the robot runs with, or add --mixed-gains to train in simulators of the recordings' own gains"
            )
        return data

    @property
    def conditions(self) -> set[Condition]:
        """Payloads, rates and gains of the training recordings."""
        return {Condition.of(s, self.robot) for s in self.train}

    def labelled_subset(self, max_rows: int) -> list[Sequence]:
        """Return training recordings with about max_rows rows, stratified by payload, unit and rate."""
        entries = self.splits["train"]
        count = max(1, max_rows * len(entries) // sum(e.rows for e in entries))
        return self.dataset.sequences(stratified_subset(entries, count), optional=False)


class RunFolder:
    """Folder of a run: refuses unsuitable ones and writes the files that describe the run."""

    def __init__(self, path: Path, robot: RobotSpec, resume: bool) -> None:
        """
        Args:
            path: Folder; it need not exist.
            robot: The simulator that the network corrects.
            resume: Continue the run in this folder.

        Raises:
            UsageError: The folder holds a run and resume is false, or no run of this simulator and resume is true.
        """
        if not resume and any((path / name).exists() for name in (CHECKPOINT, "model/card.json")):
            raise UsageError(f"{path}: holds a run already; add --resume to go on with it, or choose another --out")
        if resume and not (path / CHECKPOINT).is_file():
            raise UsageError(f"{path}: nothing to resume (no {CHECKPOINT}); train without --resume")
        if resume and has_stored_robot(path) and model_hash(load_stored_robot(path, robot.name)) != model_hash(robot):
            raise UsageError(f"{path}: was trained in another simulator; resume with --robot {path / STORED_ROBOT}")
        self.path, self.robot, self.resume = path, robot, resume

    def write_setup(self, data: TrainingData, config: TrainConfig, budget: Budget) -> None:
        """Write config.json, split.json and the robot."""
        dataset = data.dataset
        source = dataset.address or dataset.path
        words = command(source, self.path, budget, config, self.robot, data.holdout_units, ranks.world())
        facts = asdict(config) | {
            "budget": asdict(budget), "holdout_units": list(data.holdout_units), "robot": self.robot.name,
            "command": words, "dataset": dataset.address or os.path.relpath(dataset.path, self.path),
            "dataset_hash": dataset_hash(dataset.entries),
        }  # fmt: skip
        write_text(self.path / "config.json", json.dumps(facts, indent=1) + "\n")
        folder = self.path / STORED_ROBOT
        if self.robot.folder.resolve() != folder.resolve() and not (self.resume and has_stored_robot(self.path)):
            save_robot(self.robot, folder)
        split = {part: {e.id: e.hash for e in entries} for part, entries in data.splits.items()}
        write_text(self.path / "split.json", json.dumps(split, indent=1, ensure_ascii=False) + "\n")

    def write_baseline(self, baseline: DelayOffset) -> None:
        """Write delay_offset.json."""
        write_text(self.path / "delay_offset.json", json.dumps(asdict(baseline), indent=1) + "\n")


LOG_KINDS = ("tensorboard", "wandb")
Writer = tuple[Callable[[dict[str, float], int], None], Callable[[], None]]  # write(numbers, steps), close()


class Loggers:
    """Writes the finite numbers of each progress line over control steps."""

    def __init__(self, kinds: tuple[str, ...], out: Path, config: dict[str, Any]) -> None:
        """
        Args:
            kinds: Any of LOG_KINDS.
            out: Run folder. TensorBoard's files go to out/tensorboard.
            config: Configuration of the run, for Weights & Biases.

        Raises:
            UsageError: A package is not installed.
        """
        self.writers = [{"tensorboard": _tensorboard, "wandb": _wandb}[kind](out, config) for kind in kinds]

    def write(self, line: dict[str, Any]) -> None:
        """Log one line of progress.jsonl."""
        numbers = {k: float(v) for k, v in line.items() if isinstance(v, (int, float)) and v == v and k != "steps"}
        for write, _ in self.writers:
            write(numbers, line["steps"])

    def close(self) -> None:
        """Close all files and connections."""
        for _, close in self.writers:
            close()


def _tensorboard(out: Path, config: dict[str, Any]) -> Writer:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise _missing("tensorboard") from None
    board = SummaryWriter(str(out / "tensorboard"))

    def write(numbers: dict[str, float], steps: int) -> None:
        for name, value in numbers.items():
            board.add_scalar(name, value, steps)
        board.flush()

    return write, board.close


def _wandb(out: Path, config: dict[str, Any]) -> Writer:
    try:
        import wandb
    except ImportError:
        raise _missing("wandb") from None
    run = wandb.init(project="gaponet", name=out.name, dir=str(out), config=config)
    return lambda numbers, steps: run.log(numbers, step=steps), run.finish


def _missing(kind: str) -> UsageError:
    return UsageError(f"--log {kind}: {kind} is not installed; run: pip install 'gaponet[{kind}]'")
