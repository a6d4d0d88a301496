"""Options of the paper's experiment. The docstring of a field is its command-line help."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import tyro
from annotated_types import Interval

from gaponet.base.executor import LOCAL

Flag = tyro.conf.FlagCreatePairsOff[bool]
Count = Annotated[int, Interval(ge=1, le=100_000)]


@dataclass(frozen=True)
class PaperOptions:
    """Size of the experiment, and where it runs."""

    seeds: Count = 3
    """Trainings of each setting."""
    steps: Annotated[int, Interval(ge=1_000, le=10**10)] = 600_000
    """Length of each training, control steps."""
    motions: Count = 10
    """Motions of Figure 3, made for the experiment."""
    goals: Count = 50
    """Goals of Table 1, per payload."""
    only: tuple[str, ...] = ()
    """Only these methods; default: all. Without Table 2, unless its trainings exist."""
    unit: str = ""
    """Unit that no network sees. Default: the last unit of the fleet."""
    fleet: str = ""
    """Virtual fleet, or a .toml file. Default: the fleet that was recorded."""
    robot: str | None = None
    """Robot name or folder, if not the one that the dataset stores."""
    workers: Annotated[int, Interval(ge=0, le=1024)] = 0
    """Trainings at a time, on one thread each; 0 for as many as there are cores."""
    executor: str = LOCAL
    """Where they run: local, ray or ray:ADDRESS (docs/install.md)."""
    quick: Flag = False
    """See every part work in three minutes. The numbers mean nothing."""

    def for_quick_run(self) -> PaperOptions:
        """Return the options of a quick run."""
        return replace(self, seeds=1, steps=1_500, motions=1, goals=4)
