"""Budget of a training run, wall-clock time or control steps, and the run's status."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gaponet.base.errors import UsageError

MAX_BUDGET = 1e12  # control steps, or any unit of time
MIN_STEPS = 100  # with fewer, the unit of time is probably missing
SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}  # per unit


@dataclass(frozen=True)
class Budget:
    """Seconds or control steps; one of them is set."""

    seconds: float | None = None
    steps: int | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Parse "90s", "10m", "2h", or control steps such as "2000000" or "2e6".

        Raises:
            UsageError: Another text, or fewer than MIN_STEPS control steps.
        """
        match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([smh]?)\s*", text, re.IGNORECASE)
        try:
            number = float(match.group(1)) if match else 0.0
        except ValueError:
            number = 0.0
        if not match or not 0 < number <= MAX_BUDGET:
            raise UsageError(f"--budget {text}: give a time such as 90s, 10m or 2h, or a number of control steps")
        unit = match.group(2).lower()
        if not unit and number < MIN_STEPS:
            raise UsageError(f"--budget {text}: {number:g} control steps teach nothing; is it {text}s or {text}m?")
        return cls(seconds=number * SECONDS[unit]) if unit else cls(steps=int(number))

    def spent(self, seconds: float, steps: int) -> float:
        """Return the used share of the budget; 1 or more at its end."""
        return seconds / self.seconds if self.seconds is not None else steps / (self.steps or 1)


@dataclass(frozen=True)
class Status:
    """State of a run, for a progress bar. Errors are mean position errors in rad; NaN where unknown."""

    stage: str
    fraction: float
    steps: int
    seconds: float
    reward: float
    val_mpjae: float
    best_mpjae: float
    nominal_mpjae: float

    @property
    def throughput(self) -> float:
        """Control steps per second, including validation and set-up."""
        return self.steps / max(self.seconds, 1e-9)

    @property
    def note(self) -> str:
        """Stage, reward, validation error and speed as text."""
        reward = "" if self.reward != self.reward else f", reward {self.reward:.4f}"
        ratio = f"{self.best_mpjae / self.nominal_mpjae:.2f} of nominal"
        error = (
            "" if self.val_mpjae != self.val_mpjae else f", validation {self.val_mpjae * 1e3:.2f} mrad (best {ratio})"
        )
        return f"{self.stage}{reward}{error}, {self.throughput:,.0f} steps/s"
