"""How far a training run is: budget, best networks, progress lines, checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaponet.nn.layers import DeltaNet
from gaponet.nn.training.checkpoint import Checkpoint
from gaponet.nn.training.config import Budget, Status
from gaponet.nn.training.ppo import Update
from gaponet.nn.training.run_folder import Loggers
from gaponet.nn.training.validation import Validator


class RunProgress:
    """Counts time and steps of a run, validates its networks, and stores the best.

    Attributes:
        state: What a checkpoint holds.
        stage: Name of the stage that runs.
        nominal_error: Validation error of the robot before identification, rad; NaN until known.
        update: Metrics of the last update of PPO.
    """

    def __init__(
        self,
        out: Path,
        net: DeltaNet,
        state: Checkpoint,
        budget: Budget,
        validator: Validator,
        loggers: Loggers,
        show: Callable[[Status], None],
    ) -> None:
        """
        Args:
            net: The network in training, for checkpoints.
            show: Called with the state of the run.
        """
        self.state = state
        self.stage = "start"
        self.nominal_error = float("nan")
        self.update = Update()
        self._out = out
        self._net = net
        self._budget = budget
        self._validator = validator
        self._loggers = loggers
        self._show = show
        self._started_at = time.monotonic()

    def seconds(self) -> float:
        """Return the training time, including earlier parts of a resumed run."""
        return self.state.seconds + time.monotonic() - self._started_at

    def add_seconds(self, seconds: float) -> None:
        """Count time that a result took which another training has made."""
        self._started_at -= seconds

    def is_budget_spent(self) -> bool:
        """Return True if no time or no steps are left."""
        return self._share_spent() >= 1

    def _share_spent(self) -> float:
        return self._budget.spent(self.seconds(), self.state.steps)

    def begin_stage(self, name: str) -> None:
        """Note and report a new stage."""
        self.stage = name
        self.report()

    def report(self) -> None:
        """Report the state of the run."""
        state = self.state
        self._show(
            Status(
                stage=self.stage,
                fraction=min(self._share_spent(), 1.0),
                steps=state.steps,
                seconds=self.seconds(),
                reward=self.update.reward,
                val_mpjae=state.val_error,
                best_mpjae=state.best.error,
                nominal_mpjae=self.nominal_error,
            )
        )

    def validate_and_save(self, metrics: dict[str, float]) -> None:
        """Validate the network in training, and save it with these metrics of its stage."""
        error = float(self._validator.errors(self._net).mean())
        self.state.best_trained.offer(self._net, error)
        self.save_if_best(self._net, error, metrics)

    def save_if_best(
        self, net: DeltaNet, error: float, metrics: dict[str, float] | None = None
    ) -> None:
        """Store a network if it is the best so far; write progress.jsonl and the checkpoint.

        error: Its validation error, rad.
        """
        state = self.state
        state.best.offer(net, error)
        line = {
            "stage": self.stage,
            "steps": state.steps,
            "seconds": round(self.seconds(), 1),
            "val_mpjae": error,
            "nominal_mpjae": self.nominal_error,
        } | (metrics or {})
        state.progress.append({name: _nan_to_none(value) for name, value in line.items()})
        self._loggers.write(line)
        state.seconds = self.seconds()
        self._started_at = time.monotonic()
        state.write(self._out, self._net)
        self.report()

    def close_loggers(self) -> None:
        """Close the files and connections of `--log`."""
        self._loggers.close()


def _nan_to_none(value: Any) -> Any:
    """Return None instead of NaN, which JSON does not have."""
    is_nan = value != value
    return None if is_nan else value
