"""Virtual H1-2 robots: the recordings of a fleet, the errors of a simulator on its last unit, and means by motion.

Used by unnamed.py and paper_adversaries.py. Every number is from VIRTUAL robots.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.metrics import metrics, runs
from gaponet.sim.replay import Corrector, replay

RECIPE = Path(__file__).with_suffix(".toml")
UNIT = "virtual-4"  # the test unit

Errors = list[Array]  # seed by seed: MPJAE of each test sequence, rad


@dataclass(frozen=True)
class Bench:
    """A fleet's recordings by split, and the folder of what is fitted on them."""

    data: Dataset
    nominal: RobotSpec
    work: Path
    train: list[Sequence]
    val: list[Sequence]
    test: list[Sequence]

    @classmethod
    def of(cls, fleet: str, recipe: Path, work: Path) -> Bench:
        """Collect what is missing."""
        name = Path(fleet).stem  # of a file
        run("collect", "--fleet", fleet, "--recipe", recipe, "--out", work / name)
        data = Dataset(work / name)
        parts = split_entries(data, (UNIT,))
        test = [e for e in parts["test"] if e.meta.unit_id == UNIT]
        sequences = (data.sequences(part) for part in (parts["train"], parts["val"], test))
        return cls(data, load_robot("h1_2"), work / f"{name}-fits", *sequences)

    def errors(self, simulator: RobotSpec, corrector: Corrector | None = None) -> Array:
        """Return the MPJAE of every test sequence, rad."""
        simulated = replay(self.test, simulator, corrector, lock_idle=True)
        return np.array([metrics([r])["mpjae"] for r in runs(self.test, [s.qpos for s in simulated], self.nominal)])


def by_motion(errors: Errors, sequences: list[Sequence], payload: float | None = None) -> Array:
    """Return each motion's mean over seeds, and over payloads if none is given, (motions,) mrad."""
    mean = np.mean(errors, axis=0) * 1e3
    own = [payload is None or s.meta.payload_mass == payload for s in sequences]
    names = np.array([s.meta.motion for s in sequences])
    return np.array([mean[(names == m) & own].mean() for m in sorted(set(names))])


def run(*words: object) -> None:
    """Run a gaponet command; exit where it fails."""
    if gaponet([*map(str, words)]):
        raise SystemExit(2)
