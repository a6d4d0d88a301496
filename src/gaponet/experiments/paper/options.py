"""Options of the paper's experiment. The docstring of a field is its command-line help."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gaponet.base.executor import LOCAL

Flag = tyro.conf.FlagCreatePairsOff[bool]
Count = Annotated[int, Interval(ge=1, le=100_000)]
Method = Literal["MLP", "shared MLP", "literal", "GAPONet"]
Block = Literal["labels", "ppo", "table2"]


@dataclass(frozen=True)
class PaperOptions:
    """Size of the experiment, and where it runs."""

    seeds: Count = 3
    """Trainings of each setting."""
    steps: Annotated[int, Interval(ge=1_000, le=10**10)] = 600_000
    """Length of each training, control steps."""
    methods: tuple[Method, ...] = ("MLP", "shared MLP", "literal", "GAPONet")
    """Networks. MLP: ASAP's form, the paper's baseline. shared MLP: the inputs and the number of
    weights of GAPONet. literal: the paper's network in its own form."""
    blocks: tuple[Block, ...] = ("labels", "ppo", "table2")
    """Comparisons. labels: supervised pre-training, then PPO. ppo: PPO alone, the paper's recipe.
    table2: one setting of the literal network at a time."""
    motions: Count = 10
    """Motions of Figure 3, made for the experiment."""
    goals: Count = 50
    """Goals of Table 1, per payload."""
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
    identify_windows: Count = 40
    """Rollouts of 8 s that identification fits; fewer are faster and less exact."""
    despite_errors: Flag = False
    """Train on recordings in which gaponet doctor finds an error; the page says so."""
    quick: Flag = False
    """See every part work in three minutes. The numbers mean nothing."""

    def for_quick_run(self) -> PaperOptions:
        """Return the options of a quick run."""
        return replace(self, seeds=1, steps=1_500, motions=1, goals=4, identify_windows=2)


# gaponet demo: the experiment in small, the same on every machine.
DEMO = PaperOptions(
    seeds=1,
    steps=120_000,
    methods=("MLP", "GAPONet"),
    blocks=("labels",),
    motions=4,
    goals=8,
    identify_windows=8,
)
