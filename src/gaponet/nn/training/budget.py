"""How long to train, wall-clock time or control steps, and where training stands."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gaponet.base.errors import UsageError

MOST = 1e12  # of steps or of any unit of time
FEWEST = 100  # steps; whoever asks for fewer has left out a unit
UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class Budget:
    """Exactly one of seconds and steps is set."""

    seconds: float | None = None
    steps: int | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """ "90s", "10m", "2h", or a number of control steps such as "2000000" or "2e6"."""
        match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([smh]?)\s*", text, re.IGNORECASE)
        try:
            number = float(match.group(1)) if match else 0.0
        except ValueError:
            number = 0.0
        if not match or not 0 < number <= MOST:
            raise UsageError(f"--budget {text}: give a time such as 90s, 10m or 2h, or a number of control steps")
        unit = match.group(2).lower()
        if not unit and number < FEWEST:
            raise UsageError(f"--budget {text}: {number:g} control steps teach nothing; is it {text}s or {text}m?")
        return cls(seconds=number * UNITS[unit]) if unit else cls(steps=int(number))

    def spent(self, seconds: float, steps: int) -> float:
        """Share of the budget used, 1 when it is out."""
        return seconds / self.seconds if self.seconds is not None else steps / (self.steps or 1)


@dataclass(frozen=True)
class Status:
    """What a progress bar shows."""

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
        """Control steps per second, validation and set-up included."""
        return self.steps / max(self.seconds, 1e-9)

    @property
    def note(self) -> str:
        """Stage, reward, validation error and speed, what there is of them."""
        reward = "" if self.reward != self.reward else f", reward {self.reward:.4f}"
        best = f"{self.best_mpjae / self.nominal_mpjae:.2f} of nominal"
        held = "" if self.val_mpjae != self.val_mpjae else f", validation {self.val_mpjae * 1e3:.2f} mrad (best {best})"
        return f"{self.stage}{reward}{held}, {self.throughput:,.0f} steps/s"
