"""Base of the experiments on a VIRTUAL unit: models, unit, payloads, and the facts that are needed to repeat them."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.base.errors import UsageError
from gaponet.base.result_table import ResultTable
from gaponet.data.store import Dataset
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.experiments.cells import Cell
from gaponet.experiments.result import Result, facts
from gaponet.experiments.study import DEFAULT_MODELS, QUICK_LABEL, Options, Study
from gaponet.experiments.virtual.play import Progress, TrainedModel
from gaponet.report.candidate import describe_provenance
from gaponet.robot.spec import RobotSpec
from gaponet.testing.collect import fleet_name
from gaponet.testing.fleet import load_fleet
from gaponet.testing.physics import Physics

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class UnitExperiment:
    """An experiment in which a virtual unit executes motions."""

    runs: tuple[Path, ...] = ()
    """Run folders, or folders of them such as the cells of gaponet experiment compare; without any, GAPONet and the MLP
    are trained here, in OUT/cells."""
    unit: str = ""
    """Unit of the fleet that executes the motions; by default one that no model was trained on."""
    fleet: str = ""
    """Virtual units: hard, easy, shifted, unnamed, firm, or a .toml file; by default the fleet that was recorded."""
    payloads: tuple[float, ...] = ()
    """kg in each hand; default those trained on."""

    def require(self, data: Dataset) -> None:
        """Refuse a dataset or options that do not fit, before any training."""

    def study(self, data: Dataset, robot: RobotSpec, out: Path, options: Options) -> Study:
        """Return the study of the trainings where no runs are given; the unit that executes is held out."""
        units = sorted({e.meta.unit_id for e in data.entries})
        holdout = (
            (self.unit or units[-1],)
            if len(units) > 1 and (not self.unit or self.unit in units)
            else ()
        )
        return Study.from_options(data, robot, out, options, holdout_units=holdout)

    def quick(self) -> UnitExperiment:
        """Return the experiment with few motions, for a quick run."""
        return self

    def cells(self, study: Study) -> list[Cell]:
        """Return the trainings that are needed where no runs are given."""
        return study.cells(DEFAULT_MODELS)

    def evaluated(self, cells: ListOf[Cell]) -> tuple[Path, ...]:
        """Return the runs among the cells whose models are evaluated on the unit."""
        return tuple(c.folder for c in cells)

    def run(self, session: Session, progress: Progress) -> Result:
        """Execute the motions and return the result."""
        raise NotImplementedError


@dataclass(frozen=True)
class Session:
    """Inputs of an experiment on a virtual unit.

    Attributes:
        data: Dataset that the models were trained on.
        trained: The models.
        study, cells: The trainings of this experiment, where no runs were given.
    """

    experiment: UnitExperiment
    data: Dataset
    robot: RobotSpec
    trained: list[TrainedModel]
    study: Study | None = None
    cells: tuple[Cell, ...] = ()

    @property
    def fleet(self) -> str:
        """Name or file of the fleet."""
        return self.experiment.fleet or fleet_name(self.data)

    @cached_property
    def trained_units(self) -> set[str]:
        """Units that any model was trained on."""
        return {u for t in self.trained for u in t.model.card["units"]}

    @cached_property
    def unit(self) -> tuple[str, Physics]:
        """Name and physics of the unit.

        Raises:
            UsageError: The fleet has other gains than the dataset.
        """
        fleet = load_fleet(self.fleet, self.robot)
        if fleet.gain_scale not in (None, self.robot.gain_scale):
            raise UsageError(
                f"fleet '{fleet.name}' is driven with gain_scale {fleet.gain_scale:g}, the robot of the dataset with "
                f"{self.robot.gain_scale:g}: train on a dataset of gaponet collect --fleet {self.fleet}"
            )
        unseen = (u for u in reversed(fleet.units) if u not in self.trained_units)
        name = self.experiment.unit or next(unseen, list(fleet.units)[-1])
        return name, fleet.unit(name)

    @cached_property
    def payloads(self) -> tuple[float, ...]:
        """Payloads, kg in each hand."""
        seen = sorted({float(p) for t in self.trained for p in t.model.card["payload_seen"]})
        return self.experiment.payloads or tuple(seen)

    def result(
        self, name: str, title: str, tables: ListOf[ResultTable], figures: Mapping[str, Figure], sentences: ListOf[str],
        config: CompensatorConfig | None = None, **more: Any,
    ) -> Result:  # fmt: skip
        """Return the result with the facts that are needed to repeat it.

        Args:
            config: Settings of the compensators; None if no unit executed anything.
        """
        setup = {} if config is None else {
            "unit": self.unit[0], "fleet": Path(self.fleet).stem, "payloads": [f"{p:g} kg" for p in self.payloads],
            "compensator": ", ".join(f"{k} {v}" for k, v in asdict(config).items()),
        }  # fmt: skip
        runs = [f"{t.method} seed {t.seed} ({t.model.weights_hash()})" for t in self.trained]
        repeat = facts(
            self.data, sorted({t.seed for t in self.trained}), **setup, runs=runs, **more
        )
        provenance = describe_provenance(self.data) + f" {QUICK_LABEL}." * (
            self.study is not None and self.study.quick
        )
        return Result(
            name, title, provenance, repeat, tuple(tables), dict(figures), tuple(sentences)
        )
