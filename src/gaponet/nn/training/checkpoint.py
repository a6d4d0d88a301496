"""Checkpoint for exact resume: tensors, numbers and text, no code."""

from __future__ import annotations

import copy
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import atomic_write, write_text
from gaponet.nn.layers import DeltaNet
from gaponet.nn.training.sensor_fit import SensorReport

StateDict = dict[str, Any]

CHECKPOINT = "checkpoint.pt"
PROGRESS = "progress.jsonl"


@dataclass
class BestNetwork:
    """Network with the least validation error so far.

    Attributes:
        weights: Its weights.
        error: Its validation error, rad.
    """

    weights: StateDict
    error: float = float("inf")

    def offer(self, net: DeltaNet, error: float) -> None:
        """Keep a copy of a network if its validation error, rad, is the least."""
        if error < self.error:
            self.error = error
            self.weights = copy.deepcopy(net.state_dict())


class PPOState(NamedTuple):
    """States of PPO and of its environments."""

    learner: StateDict
    env: StateDict


@dataclass
class Checkpoint:
    """State of a training run: best networks, counters and the state of the stage that runs.

    Attributes:
        best: Best network: the one that is exported.
        best_trained: The same among trained networks with gain 1: the start of PPO.
        steps: Control steps.
        seconds: Training time up to this checkpoint.
        pretraining_rounds, ppo_updates: How many are done.
        ppo_from_untrained: PPO started from untrained weights because pre-training increased the
            error.
        sensor_r2: R² of the sensor predictor.
        pretraining, ppo: States of these stages; None outside them.
        progress: Lines of progress.jsonl.
        dataset_hash: Hash of the recordings.
    """

    best: BestNetwork
    best_trained: BestNetwork
    steps: int = 0
    seconds: float = 0.0
    pretraining_rounds: int = 0
    ppo_updates: int = 0
    ppo_from_untrained: bool = False
    sensor_r2: SensorReport | None = None
    pretraining: StateDict | None = None
    ppo: PPOState | None = None
    progress: list[dict[str, Any]] = field(default_factory=list)
    dataset_hash: str = ""

    @property
    def val_error(self) -> float:
        """Validation error of the newest network, rad; NaN where unknown."""
        error = self.progress[-1]["val_mpjae"] if self.progress else None
        return float("nan") if error is None else float(error)

    @property
    def untrained_error(self) -> float:
        """Validation error of the simulator without a network, rad."""
        return float(self.progress[0]["val_mpjae"])

    def write(self, out: Path, net: DeltaNet) -> None:
        """Write checkpoint.pt and progress.jsonl."""
        state = self._fields_of_file() | {"net": net.state_dict(), "rng": torch.get_rng_state()}
        content = io.BytesIO()  # torch does not report the error of a full disk
        torch.save(state, content)
        with atomic_write(out / CHECKPOINT) as temporary:
            temporary.write_bytes(content.getbuffer())
        self.write_progress(out)

    def _fields_of_file(self) -> StateDict:
        """Return this checkpoint by the names in checkpoint.pt, which has no nested objects."""
        fields = dict(vars(self))
        for name in ("best", "best_trained"):
            network = fields.pop(name)
            fields[f"{name}_state"] = network.weights
            fields[f"{name}_error"] = network.error
        fields["val_error"] = self.val_error
        fields["ppo"] = self.ppo.learner if self.ppo else None
        fields["env"] = self.ppo.env if self.ppo else None
        return fields

    @classmethod
    def _of_file(cls, fields: StateDict) -> Checkpoint:
        """Return the checkpoint with these fields of checkpoint.pt.

        Fields that an older version did not write have their defaults.
        """
        fields.pop("val_error", None)
        for name in ("best", "best_trained"):
            network = BestNetwork(fields.pop(f"{name}_state"))
            network.error = fields.pop(f"{name}_error", network.error)
            fields[name] = network
        learner = fields.pop("ppo", None)
        env = fields.pop("env", None)
        if learner is not None and env is not None:
            fields["ppo"] = PPOState(learner, env)
        return cls(**fields)

    def write_progress(self, out: Path) -> None:
        """Write progress.jsonl."""
        write_text(out / PROGRESS, "".join(json.dumps(line) + "\n" for line in self.progress))

    @classmethod
    def read(cls, out: Path, net: DeltaNet, dataset_hash: str) -> Checkpoint:
        """Load checkpoint.pt, and set the network and torch's random numbers to their states in it.

        Args:
            dataset_hash: Hash of the recordings to train on.

        Raises:
            ModelError: The file is damaged or belongs to another network.
            UsageError: The run has other recordings, or several processes trained it.
        """
        try:
            state = torch.load(out / CHECKPOINT, weights_only=True, map_location="cpu")
            net.load_state_dict(state.pop("net"))
            other_processes = state.pop("others", [])  # of versions that trained with torchrun
            torch.set_rng_state(state.pop("rng"))
            checkpoint = cls._of_file(state)
        except Exception as error:  # torch and its unpickler have no common base of errors
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise ModelError(
                f"{out / CHECKPOINT}: does not fit this model or is damaged ({reason})"
            ) from None
        if other_processes:
            raise UsageError(
                f"{out}: was trained by {len(other_processes) + 1} processes of torchrun, which an "
                "earlier version did; train anew"
            )
        if checkpoint.dataset_hash != dataset_hash:
            raise UsageError(
                f"{out}: was trained on other recordings than this dataset holds; train anew"
            )
        return checkpoint
