"""What questions that play a VIRTUAL unit have in common: models, unit, payloads, and what it takes to repeat them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.base.result_table import ResultTable
from gaponet.data.store import Dataset
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.experiments.options import MODELS, Options
from gaponet.experiments.played.trained import Trained, load_trained
from gaponet.experiments.pool import Cell
from gaponet.experiments.result import Result, facts
from gaponet.experiments.study import Study
from gaponet.report.whose import label
from gaponet.robot.spec import RobotSpec
from gaponet.testing.collect import fleet_of
from gaponet.testing.fleet import load_fleet
from gaponet.testing.physics import Physics

Tell = Callable[[str, float], None]  # what is done now, share of it done
REHEARSAL = " REHEARSAL: hardly any training, on a slice of the dataset; these numbers mean nothing."


@dataclass(frozen=True)
class Playing:
    """A question for which a unit is played."""

    runs: tuple[Path, ...] = ()
    """Run folders, or folders of them such as the cells of gaponet experiment compare; without any, GAPONet and the MLP
    are trained here, in OUT/cells."""
    unit: str = ""
    """Unit of the fleet that plays; by default one that no model was trained on."""
    fleet: str = ""
    """Virtual units: hard, easy, shifted, unnamed, firm, or a .toml file; by default the fleet that was recorded."""
    payloads: tuple[float, ...] = ()
    """kg in each hand; default those trained on, with --quick the lightest and the heaviest of them."""

    def require(self, data: Dataset) -> None:
        """Refuse what cannot be played, before anything takes time."""

    def cells(self, study: Study) -> list[Cell]:
        """The trainings that are needed where no runs are given."""
        return study.cells(MODELS)

    def played(self, cells: ListOf[Cell]) -> tuple[Path, ...]:
        """Which of them are played."""
        return tuple(c.folder for c in cells)

    def play(self, session: Session, tell: Tell) -> Result:
        raise NotImplementedError


def study_to_play(asked: Playing, data: Dataset, robot: RobotSpec, out: Path, options: Options) -> Study:
    """The trainings for a question without runs: without the unit that will be played."""
    units = sorted({e.meta.unit_id for e in data.entries})
    holdout = (asked.unit or units[-1],) if len(units) > 1 and (not asked.unit or asked.unit in units) else ()
    return Study.of(data, robot, out, options, holdout)


@dataclass(frozen=True)
class Session:
    """Everything that is there before a unit is played.

    Attributes:
        data, whole: What the models were trained on; and what that was cut from, if it was.
        out: Folder of the results; what each method did is kept in its folder parts.
        study, cells: What was trained here, where no runs were given.
    """

    asked: Playing
    data: Dataset
    whole: Dataset
    robot: RobotSpec
    trained: list[Trained]
    out: Path
    quick: bool
    study: Study | None = None
    cells: tuple[Cell, ...] = ()
    began: float = field(default_factory=time.monotonic)

    @classmethod
    def of(
        cls, asked: Playing, data: Dataset, whole: Dataset, robot: RobotSpec, runs: tuple[Path, ...], out: Path,
        quick: bool, study: Study | None = None, cells: tuple[Cell, ...] = (),
    ) -> Session:  # fmt: skip
        """A session with the models of these runs; a rehearsal takes one seed."""
        trained = load_trained(runs, robot)
        if quick:
            trained = [t for t in trained if t.seed == trained[0].seed]
        return cls(asked, data, whole, robot, trained, out, quick, study, cells)

    @property
    def parts(self) -> Path:
        """Where what each method did is kept."""
        return self.out / "parts"

    @property
    def fleet(self) -> str:
        """Name or file of the fleet that plays."""
        return self.asked.fleet or fleet_of(self.whole)

    @cached_property
    def known_units(self) -> set[str]:
        """Units that any model was trained on."""
        return {u for t in self.trained for u in t.model.card["units"]}

    @cached_property
    def cast(self) -> tuple[str, Physics, tuple[float, ...]]:
        """Name and physics of the unit, and payloads, kg."""
        fleet, asked = load_fleet(self.fleet, self.robot), self.asked
        if fleet.gain_scale not in (None, self.robot.gain_scale):
            raise UsageError(
                f"fleet '{fleet.name}' is driven with gain_scale {fleet.gain_scale:g}, the robot of the dataset with "
                f"{self.robot.gain_scale:g}: train on a dataset of gaponet collect --fleet {self.fleet}"
            )
        who = asked.unit or next((u for u in reversed(fleet.units) if u not in self.known_units), list(fleet.units)[-1])
        seen = sorted({float(p) for t in self.trained for p in t.model.card["payload_seen"]})
        return who, fleet.unit(who), asked.payloads or tuple({seen[0]: 0, seen[-1]: 0} if self.quick else seen)

    def result(
        self, name: str, heading: str, tables: ListOf[ResultTable], figures: Mapping[str, Any], sentences: ListOf[str],
        config: CompensatorConfig | None = None, **more: Any,
    ) -> Result:  # fmt: skip
        """Everything together, with what it takes to repeat it; config as the unit was driven by, if it was played."""
        told = {} if config is None else {
            "unit": self.cast[0], "fleet": Path(self.fleet).stem,
            "payloads": [f"{p:g} kg" for p in self.cast[2]],
            "compensator": ", ".join(f"{k} {v}" for k, v in asdict(config).items()),
        }  # fmt: skip
        runs = [f"{t.method} seed {t.seed} ({t.model.weights_hash()})" for t in self.trained]
        minutes = round((time.monotonic() - self.began) / 60, 1)
        repeat = facts(self.data, sorted({t.seed for t in self.trained}), **told, runs=runs, **more, minutes=minutes)
        whose = label(self.data) + (REHEARSAL if self.quick and not self.asked.runs else "")
        return Result(name, heading, whose, repeat, tuple(tables), dict(figures), tuple(sentences))
