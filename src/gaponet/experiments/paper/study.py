"""Inputs of the experiment that every worker needs: dataset, simulator, the robot that no network
sees, results folder.

OUT/experiment.json    what the results belong to: another dataset or unit needs another OUT
OUT/unseen/            recordings of the unit that no network sees, a dataset
OUT/identified/        the robot as `gaponet identify` finds it on the training recordings
OUT/trainings/NAME/    run folder of a training, and its result.json
OUT/baselines.json     what is measured without a network
OUT/paper.html         all figures and tables
OUT/paper.json         their numbers, as do the folders OUT/figures/ and OUT/tables/
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.files import write_json
from gaponet.base.structure import read_json
from gaponet.data.sequence import RATE_TOLERANCE
from gaponet.data.split import Splits, split_entries
from gaponet.data.store import Dataset, Entry, dataset_hash
from gaponet.experiments.paper.measure import Recorded, VirtualUnit
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.unseen_motions import make_unseen_motions
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.virtual.collect import fleet_name
from gaponet.virtual.fleet import load_fleet

SETUP_FILE = "experiment.json"
SETUP_HINT = "delete it and run the same command again"
# Of the dataset, in a quick run.
QUICK_MOTIONS = 4
QUICK_UNITS = 2


@dataclass(frozen=True)
class Study:
    """Inputs of the experiment. Everything can be sent to another process.

    Attributes:
        dataset: Folder.
        robot: The nominal simulator that all networks correct.
        out: Folder of the results.
    """

    dataset: str
    robot: RobotSpec
    out: Path
    options: PaperOptions

    @cached_property
    def data(self) -> Dataset:
        """The recordings."""
        return Dataset(self.dataset)

    @cached_property
    def virtual(self) -> bool:
        """True for recordings of a VIRTUAL fleet, of which another unit can be played."""
        return all(entry.meta.virtual for entry in self.data.entries)

    @property
    def delivers(self) -> bool:
        """True if the unseen unit has hands that can bring a payload to a goal."""
        return self.virtual and bool(self.robot.payload_mounts)

    @cached_property
    def payloads(self) -> tuple[float, ...]:
        """Payloads of the recordings, kg in each hand, ascending."""
        return tuple(sorted({entry.meta.payload_mass for entry in self.data.entries}))

    @cached_property
    def rates(self) -> tuple[float, ...]:
        """Control rates of the recordings, Hz, ascending; clocks of 49.4 and 50.2 Hz are one
        rate.
        """
        clocks: list[list[float]] = []  # of each rate
        for rate in sorted({1 / entry.dt for entry in self.data.entries}):
            if not clocks or rate > (1 + RATE_TOLERANCE) * clocks[-1][0]:
                clocks.append([])
            clocks[-1].append(rate)
        return tuple(_middle(of_rate) for of_rate in clocks)

    @property
    def dt(self) -> float:
        """Control period of all comparisons but that of rates, s: the slowest of the dataset."""
        return 1.0 / self.rates[0]

    @property
    def fleet(self) -> str:
        """Name or file of the virtual fleet."""
        return self.options.fleet or fleet_name(self.data)

    @cached_property
    def unit_name(self) -> str:
        """The unit that no network sees."""
        fleet = load_fleet(self.fleet, self.robot)
        if fleet.gain_scale not in (None, self.robot.servo.gain_scale):
            raise UsageError(
                f"fleet '{fleet.name}' is driven with gain_scale {fleet.gain_scale:g}, the robot "
                f"of the dataset with {self.robot.servo.gain_scale:g}; give the fleet that was "
                "recorded"
            )
        name = self.options.unit or list(fleet.units)[-1]
        fleet.unit(name)  # refuses a name that is not in the fleet
        return name

    @cached_property
    def training_units(self) -> tuple[str, ...]:
        """Units that networks are trained on: all recorded ones but the unseen one."""
        units = self._recorded_units()
        if self.virtual:
            units = [unit for unit in units if unit != self.unit_name]
        if not units:
            raise UsageError(
                f"{self.data.path}: only unit {self.unit_name} was recorded, which no network may "
                "see; give another --unit, or record more units"
            )
        return tuple(units)

    @cached_property
    def holdout_units(self) -> tuple[str, ...]:
        """Recorded units that are left out of training."""
        units = self._recorded_units()
        return tuple(unit for unit in units if unit not in self.training_units)

    def _recorded_units(self) -> list[str]:
        return sorted({entry.meta.unit_id for entry in self.data.entries})

    def splits(self) -> Splits:
        """Return the recordings for training, validation and test."""
        return split_entries(self.data, self.holdout_units, rates=self.rates[:1])

    def virtual_unit(self, dt: float | None = None) -> VirtualUnit:
        """Return the unit that no network sees, with its motions at a control period of dt s."""
        period = self.dt if dt is None else dt
        heaviest = max(self.payloads)
        return VirtualUnit(
            name=self.unit_name,
            physics=load_fleet(self.fleet, self.robot).unit(self.unit_name),
            robot=self.robot,
            motions=make_unseen_motions(self.robot, self.options.motions, heaviest, period),
            payloads=self.payloads,
            goal_count=self.options.goals,
            dt=period,
        )

    def recorded(self, rate: float | None = None) -> Recorded:
        """Return the recordings that simulators are compared with, at a rate in Hz; default the
        slowest.
        """
        rate = rate or self.rates[0]
        if not self.virtual:
            splits = split_entries(self.data, self.holdout_units, rates=(rate,))
            entries = entries_at(rate, splits["test"])
            return Recorded(self.data.sequences(entries))
        unseen = Dataset(self.out / "unseen")
        entries = entries_at(rate, unseen.entries)
        return Recorded(unseen.sequences(entries))

    @property
    def has_results(self) -> bool:
        """True if the experiment has begun in this folder."""
        return (self.out / SETUP_FILE).is_file()

    def require_same_setup(self) -> None:
        """Write what the results belong to, or refuse a folder with results of something else.

        Raises:
            UsageError: It names what differs.
        """
        setup: dict[str, Any] = {
            "dataset": dataset_hash(self.data.entries),
            "simulator": model_hash(self.robot),
            "steps": self.options.steps,
            "motions": self.options.motions,
            "goals": self.options.goals,
            "unit": self.unit_name if self.virtual else "",
            "fleet": load_fleet(self.fleet, self.robot).digest() if self.virtual else "",
            "identify_windows": self.options.identify_windows,
            "quick": self.options.quick,
            "despite_errors": self.options.despite_errors,
        }
        file = self.out / SETUP_FILE
        if not self.has_results:
            write_json(file, setup)
            return
        stored = read_json(dict[str, Any], file, DatasetError, SETUP_HINT)
        changed = []
        for name, value in setup.items():
            if stored.get(name) != value:
                changed.append(name)
        if changed:
            raise UsageError(
                f"{self.out}: holds results with another {', '.join(changed)}; choose another --out"
            )


def _middle(clocks: list[float]) -> float:
    """Return the middle of clocks of one rate, Hz, in whole Hz if all are within RATE_TOLERANCE of
    it then.
    """
    middle = (clocks[0] + clocks[-1]) / 2
    whole = round(middle)
    if abs(whole - middle) <= RATE_TOLERANCE / 2 * middle:
        return float(whole)
    return middle


def entries_at(rate: float, entries: list[Entry]) -> list[Entry]:
    """Return the recordings with a control rate, Hz."""
    return [entry for entry in entries if abs(1 / entry.dt - rate) <= RATE_TOLERANCE * rate]


def quick_dataset(
    data: Dataset, robot: RobotSpec, out: Path, training_units: tuple[str, ...]
) -> Dataset:
    """Write a few whole recordings of every rate as a dataset; the same call again finds it."""
    part = Dataset.create(out, robot)
    for entry in _quick_entries(data, training_units[:QUICK_UNITS]):
        sequence = data.read(entry)
        if part.find(sequence.content_hash()) is None:
            part.append(sequence)
    return part


def _quick_entries(data: Dataset, units: tuple[str, ...]) -> list[Entry]:
    """Return recordings of the shortest motions, with the least and the largest payload."""
    rows: dict[str, int] = {}
    for entry in data.entries:
        rows[entry.meta.motion] = max(rows.get(entry.meta.motion, 0), entry.rows)
    motions = sorted(rows, key=lambda motion: (rows[motion], motion))[:QUICK_MOTIONS]
    payloads = sorted({entry.meta.payload_mass for entry in data.entries})
    payloads = [payloads[0], payloads[-1]]
    repetition = min(entry.meta.repetition for entry in data.entries)
    chosen = []
    for entry in data.entries:
        meta = entry.meta
        if meta.motion not in motions or meta.payload_mass not in payloads:
            continue
        if meta.unit_id in units and meta.repetition == repetition:
            chosen.append(entry)
    return chosen
