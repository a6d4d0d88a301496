"""Candidates of an evaluation: an identified robot folder, or a run, whose model corrects a
simulator.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NotRequired

from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError, ModelError, RobotError, UsageError
from gaponet.base.structure import read_json
from gaponet.data.split import SplitHashes
from gaponet.data.store import Dataset, Entry
from gaponet.evaluation.methods import method
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel
from gaponet.nn.loop import DeltaCorrector
from gaponet.robot.folder import PROVENANCE_FILE, PROVENANCE_HINT, STORED_ROBOT
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import require_same_robot, require_stored_robot

DATA_HINT = "data of the robot that the run was trained for"


class Fitted(TypedDict):
    """Recordings and motions that the values of a robot depend on."""

    hashes: tuple[str, ...]  # of the recordings' contents
    motions: tuple[str, ...]


class Origin(TypedDict):
    """Data that a robot was identified from."""

    # path from the robot folder; a name alone: it never was on this machine
    dataset: str
    parts: SplitHashes  # recordings by split
    motions: dict[str, tuple[str, ...]]  # names of motions by split
    # what the robot before was identified from, and what this one was adapted to
    also_fitted: NotRequired[Fitted]
    val_mpjae: dict[str, float]  # nominal and identified → error on validation motions, rad
    findings: NotRequired[tuple[str, ...]]  # sentences about backlash and links
    doctor: NotRequired[dict[str, tuple[str, ...]]]  # faults of the recordings (checks/gate.py)


@dataclass(frozen=True)
class Candidate:
    """A simulator, with or without a model that corrects it."""

    folder: Path  # robot folder, or run
    robot: RobotSpec  # the simulator: identified, or nominal under a model
    model: GapModel | None  # None for a robot folder

    @classmethod
    def load(cls, folder: Path, robot: RobotSpec) -> Candidate:
        """Load a robot folder or a run.

        Args:
            robot: The dataset's robot; the candidate must be the same robot before identification.

        Raises:
            ModelError, RobotError: It is neither, or of another robot.
            UsageError: The robot is not identified.
        """
        if not is_robot(folder):
            return cls(folder, corrected_robot(folder, robot), GapModel.load(folder))
        own = require_same_robot(
            load_robot(folder), robot, folder, RobotError, "data of this robot"
        )
        if not own.is_identified:
            raise UsageError(
                f"{folder}: nothing was identified of this robot; gaponet identify DATASET --out "
                "FOLDER does"
            )
        return cls(folder, own, None)

    @property
    def method(self) -> str:
        """Key of evaluation.methods.METHODS."""
        return "identified" if self.model is None else method(self.model.config.kind, self.robot)

    def corrector(self) -> DeltaCorrector | None:
        """Return the corrector of targets for sim.replay."""
        return None if self.model is None else self.model.corrector(self.robot)


def is_robot(folder: Path) -> bool:
    """Return True for a robot folder, False for a run or a dataset with a stored robot."""
    return (folder / "robot.toml").is_file()


def corrected_robot(run: Path, robot: RobotSpec) -> RobotSpec:
    """Return the simulator that a run's model corrects, as the run stores it: nominal or
    identified.

    Raises:
        ModelError: The robots differ before identification, so that errors would have another
            baseline.
    """
    return require_stored_robot(run, robot, ModelError, DATA_HINT)


def select_entries(
    folders: list[Path],
    dataset: Dataset,
    motions: tuple[str, ...] = (),
    units: tuple[str, ...] = (),
) -> tuple[list[Entry], bool]:
    """Select recordings for an evaluation: those of the given motions, or unseen ones.

    A robot folder without an origin counts as fitted to everything and is evaluated on everything.
    So is one that was adapted to all recordings.

    Args:
        folders: Robot folders and runs.
        motions: Only these, even if they were used. Default: as of `_unseen_entries`.
        units: Only recordings of these units.

    Returns:
        The recordings, and True if no candidate was fitted to any of them.

    Raises:
        DatasetError: Every recording was used in training.
    """
    fitted = []
    for folder in folders:
        data = FittedData.of_folder(folder)
        if data is None:
            return dataset.select(motions, units), False
        fitted.append(data)
    available = dataset.select(units=units)
    unused = [entry for entry in available if not _is_used(entry, fitted)]
    if motions:
        entries = dataset.select(motions, units)
        if not entries:
            raise DatasetError(
                f"{dataset.path}: no recording of {', '.join(motions)} by {', '.join(units)}"
            )
    else:
        entries = _unseen_entries(available, unused, fitted)
    if not entries:
        if all(map(is_robot, folders)):
            return available, False
        raise DatasetError(
            f"{dataset.path}: every sequence was used in training; give logs the runs never saw, "
            "or --motions"
        )
    unused_hashes = {entry.hash for entry in unused}
    return entries, all(entry.hash in unused_hashes for entry in entries)


def _is_used(entry: Entry, fitted: list[FittedData]) -> bool:
    """Return True if a candidate was fitted to a recording, or to its motion."""
    return any(entry in data for data in fitted)


def _unseen_entries(
    available: list[Entry], unused: list[Entry], fitted: list[FittedData]
) -> list[Entry]:
    """Return the first of these that has recordings: the test set of the first candidate; motions
    that no candidate was fitted to; recordings that no candidate was fitted to, though their
    motions were used.

    Args:
        unused: Those of the available recordings that no candidate was fitted to.
    """
    test = [entry for entry in unused if entry.hash in fitted[0].test]
    if test:
        return test
    if unused:
        return unused
    used = set[str]()
    for data in fitted:
        used |= data.hashes
    return [entry for entry in available if entry.hash not in used]


@dataclass(frozen=True)
class FittedData:
    """Recordings and motions that a folder was trained, identified, validated or adapted on.

    A recording of the test set is not among them, whatever the split: a split by unit or payload
    tests motions that were trained on.
    """

    hashes: frozenset[str]  # of the recordings' contents
    motions: frozenset[str]
    test: frozenset[str]  # hashes of the test set

    @classmethod
    def of_folder(cls, folder: Path) -> FittedData | None:
        """Read the data of a run or a robot folder; None if a robot folder has no origin."""
        if is_robot(folder):
            origin = read_origin(folder)
            if origin is None:
                return None
            fitted = fitted_to(origin)
            return cls._of(origin["parts"]["test"], fitted["motions"], fitted["hashes"])
        model = GapModel.load(folder)
        hashes = set[str]()
        for adaptation in Adaptation.load(folder, model.weights_hash()).values():
            hashes.update(adaptation.logs)
        split = split_of_run(folder)
        hashes |= _fitted_hashes(split)
        motions = _fitted_motions(model.card.get("motions", {}))
        origin = read_origin(folder / STORED_ROBOT)  # of the robot under the model
        if origin is not None:
            of_robot = fitted_to(origin)
            hashes.update(of_robot["hashes"])
            motions.update(of_robot["motions"])
        return cls._of(split["test"], motions, hashes)

    @classmethod
    def _of(
        cls, test: Mapping[str, str], motions: Collection[str], hashes: Collection[str]
    ) -> FittedData:
        """Return the data of a test set, {id: hash}, and of what was fitted to."""
        unused = frozenset(test.values()) - frozenset(hashes)
        return cls(frozenset(hashes), frozenset(motions), unused)

    def __contains__(self, entry: Entry) -> bool:
        """Return True if the folder was fitted to a recording, or to another one of its motion
        that is not in the test set.
        """
        if entry.hash in self.hashes:
            return True
        return entry.hash not in self.test and entry.meta.motion in self.motions


def _fitted_hashes(split: Any) -> set[str]:
    """Return the content hashes of the recordings for training and validation."""
    return {*split["train"].values(), *split["val"].values()}


def _fitted_motions(motions: Mapping[str, Collection[str]]) -> set[str]:
    """Return the motions for training and validation, of motions by split."""
    return {*motions.get("train", ()), *motions.get("val", ())}


def split_of_run(run: Path) -> dict[str, dict[str, str]]:
    """Read {split: {sequence id: content hash}} of a run."""
    hint = "give a run folder of gaponet train"
    split = read_json(SplitHashes, run / "split.json", ModelError, hint)
    return {"train": split["train"], "val": split["val"], "test": split["test"]}


def read_origin(folder: Path) -> Origin | None:
    """Read the data that a robot folder was identified from; None if it is not stated.

    Raises:
        RobotError: Damaged.
    """
    file = folder / PROVENANCE_FILE
    if not file.is_file():
        return None
    return read_json(Origin, file, RobotError, PROVENANCE_HINT, allow_extra=True)


def fitted_to(origin: Origin) -> Fitted:
    """Return the recordings and motions that a robot was identified and validated on, and adapted
    to; those of the robot that its identification began with are among them.
    """
    also = origin.get("also_fitted", Fitted(hashes=(), motions=()))
    hashes = _fitted_hashes(origin["parts"]).union(also["hashes"])
    motions = _fitted_motions(origin["motions"]).union(also["motions"])
    return Fitted(hashes=tuple(sorted(hashes)), motions=tuple(sorted(motions)))


def robot_label(entries: list[Entry]) -> str:
    """Return the robot's name; "VIRTUAL h1_2" or "partly VIRTUAL h1_2" where recordings are
    virtual.
    """
    name = entries[0].meta.robot
    virtual = sum(entry.meta.virtual for entry in entries)
    if not virtual:
        return name
    if virtual == len(entries):
        return f"VIRTUAL {name}"
    return f"partly VIRTUAL {name}"


def describe_provenance(dataset: Dataset) -> str:
    """Return a sentence that says on which robot the recordings were made."""
    label = robot_label(dataset.entries)
    if label == dataset.robot_name:
        return f"Recordings of a real {label}."
    fleets = set[str]()
    for entry in dataset.entries:
        if entry.meta.virtual and "fleet" in entry.meta.source:
            fleets.add(entry.meta.source)
    names = f" ({', '.join(sorted(fleets))})" if fleets else ""
    return f"{label[0].upper()}{label[1:]}{names}: these numbers say nothing about real hardware."
