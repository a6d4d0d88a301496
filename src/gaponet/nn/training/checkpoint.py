"""Checkpoint for exact resume: tensors, numbers and text, no code."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import atomic_write, write_text
from gaponet.nn.layers import DeltaNet
from gaponet.nn.training.sensor_fit import SensorReport

StateDict = dict[str, Any]

CHECKPOINT = "checkpoint.pt"
PROGRESS = "progress.jsonl"


@dataclass
class Checkpoint:
    """State of a training run: best networks, counters and the state of the stage that runs.

    Attributes:
        best_state: Weights of the network with the least validation error.
        best_trained_state: The same among trained networks with gain 1: the start of PPO.
        best_error, best_trained_error: Their validation errors, rad.
        val_error: Validation error of the newest network, rad.
        steps: Control steps.
        seconds: Training time up to this checkpoint.
        pretraining_rounds, ppo_updates: How many are done.
        ppo_from_untrained: PPO started from untrained weights because pre-training increased the
            error.
        sensor_r2: R² of the sensor predictor.
        ppo, env, pretraining: States of PPO, of its environments, and of pre-training; None outside
            these stages.
        progress: Lines of progress.jsonl.
        dataset_hash: Hash of the recordings.
    """

    best_state: StateDict
    best_trained_state: StateDict
    best_error: float = float("inf")
    best_trained_error: float = float("inf")
    val_error: float = float("nan")
    steps: int = 0
    seconds: float = 0.0
    pretraining_rounds: int = 0
    ppo_updates: int = 0
    ppo_from_untrained: bool = False
    sensor_r2: SensorReport | None = None
    ppo: StateDict | None = None
    env: StateDict | None = None
    pretraining: StateDict | None = None
    progress: list[dict[str, Any]] = field(default_factory=list)
    dataset_hash: str = ""

    @property
    def untrained_error(self) -> float:
        """Validation error of the simulator without a network, rad."""
        return float(self.progress[0]["val_mpjae"])

    def write(self, out: Path, net: DeltaNet) -> None:
        """Write checkpoint.pt and progress.jsonl."""
        state = vars(self) | {"net": net.state_dict(), "rng": torch.get_rng_state()}
        content = io.BytesIO()  # torch does not report the error of a full disk
        torch.save(state, content)
        with atomic_write(out / CHECKPOINT) as temporary:
            temporary.write_bytes(content.getbuffer())
        self.write_progress(out)

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
            checkpoint = cls(**state)
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
