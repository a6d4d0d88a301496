"""Options of the paper's experiment. The docstring of a field is its command-line help."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gaponet.base.executor import LOCAL

Flag = tyro.conf.FlagCreatePairsOff[bool]
Count = Annotated[int, Interval(ge=1, le=100_000)]
WINDOWS = 40  # as of gaponet identify
Method = Literal["MLP", "shared MLP", "literal", "GAPONet"]
Block = Literal["labels", "ppo", "table2"]


@dataclass(frozen=True)
class PaperOptions:
    """Size of the experiment, and where it runs."""

    seeds: Count = 3
    """Number of trainings of each network, each with another seed."""
    steps: Annotated[int, Interval(ge=1_000, le=10**10)] = 600_000
    """Length of each training, in control steps."""
    methods: tuple[Method, ...] = ("MLP", "shared MLP", "literal", "GAPONet")
    """Networks to train. MLP: a plain network in the form of ASAP, the paper's baseline. shared
    MLP: a plain network with the inputs and the number of weights of GAPONet. literal: the network
    as the paper writes it. GAPONet: the operator network of this package."""
    blocks: tuple[Block, ...] = ("labels", "ppo", "table2")
    """Parts of the experiment. labels: train all networks with supervised pre-training, then PPO.
    ppo: train them with PPO alone, as the paper does. table2: vary one setting of the literal
    network at a time, as in the paper's Table 2."""
    motions: Count = 10
    """Number of motions in Figure 3; they are made for the experiment."""
    goals: Count = 50
    """Number of goals in Table 1 for each payload."""
    unit: str = ""
    """Unit that no network sees. Default: the last unit of the fleet."""
    fleet: str = ""
    """Virtual fleet, or a .toml file. Default: the fleet that was recorded."""
    robot: str | None = None
    """Robot name or folder. Default: the robot that the dataset stores."""
    workers: Annotated[int, Interval(ge=0, le=1024)] = 0
    """Number of trainings at a time, each on one thread; 0 means as many as there are cores."""
    executor: str = LOCAL
    """Where trainings and simulations run: local (processes on this machine), ray or ray:HOST:PORT
    (docs/install.md)."""
    identify_windows: Count = WINDOWS
    """Number of rollouts of 8 s that identification fits. With fewer than the default, only gains,
    damping, friction, armature, delay and offset of each joint alone are fitted, and the tables say
    so."""
    despite_errors: Flag = False
    """Train on recordings in which gaponet doctor finds an error. The page of results says so."""
    quick: Flag = False
    """Run every part in three minutes, to see that it works. The numbers mean nothing."""

    @property
    def identifies_joints_alone(self) -> bool:
        """True if identification is in a hurry: each joint alone, without further terms."""
        return self.identify_windows < WINDOWS

    def for_quick_run(self) -> PaperOptions:
        """Return the options of a quick run."""
        return replace(self, seeds=1, steps=1_500, motions=1, goals=4, identify_windows=2)


# gaponet demo: the experiment in small, the same on every machine.
DEMO = PaperOptions(
    seeds=1,
    steps=76_800,  # two rounds of labels; PPO would train its critic alone at first
    methods=("MLP", "GAPONet"),
    blocks=("labels",),
    motions=4,
    goals=8,
    identify_windows=8,
)
