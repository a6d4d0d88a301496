"""What is compared with recordings: an identified robot folder, or a run of gaponet train, a model on top of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError, ModelError, RobotError, UsageError
from gaponet.base.structure import read_json
from gaponet.data.split import RunSplit
from gaponet.data.store import Dataset, Entry
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel
from gaponet.nn.loop import DeltaCorrector
from gaponet.report.methods import method
from gaponet.robot.folder import PROVENANCE_FILE, STORED_ROBOT
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import require_same_robot, require_stored_robot

DATA = "data of the robot that the run was trained for"


class _Origin(TypedDict):
    """What a robot was identified from: dataset (address, or path from the folder), recordings and motions by part,
    and what that left on validation motions, rad."""

    dataset: str
    parts: RunSplit
    motions: dict[str, tuple[str, ...]]
    val_mpjae: dict[str, float]


@dataclass(frozen=True)
class Candidate:
    """A simulator, and perhaps a model that corrects it.

    Attributes:
        folder: Robot folder, or run.
        robot: The simulator: identified, or nominal under a model.
        model: None for a robot folder.
    """

    folder: Path
    robot: RobotSpec
    model: GapModel | None

    @classmethod
    def load(cls, folder: Path, robot: RobotSpec) -> Candidate:
        """A robot folder or a run.

        Args:
            robot: The dataset's, of which this must be the same robot before identification.

        Raises:
            ModelError, RobotError: It is neither, or of another robot.
            UsageError: Nothing was identified of the robot.
        """
        if not is_robot(folder):
            return cls(folder, corrected_robot(folder, robot), GapModel.load(folder))
        own = require_same_robot(load_robot(folder), robot, folder, RobotError, "data of this robot")
        if own.nominal is None:
            raise UsageError(
                f"{folder}: nothing was identified of this robot; gaponet identify DATASET --out FOLDER does"
            )
        return cls(folder, own, None)

    @property
    def method(self) -> str:
        """Its name among the methods compared."""
        return "identified" if self.model is None else method(self.model.config.kind, self.robot)

    @property
    def kind(self) -> str:
        """What the folder is to gaponet.base.files."""
        return "robot" if self.model is None else "run"

    def corrector(self) -> DeltaCorrector | None:
        """What alters targets on the way, in sim.replay."""
        return None if self.model is None else self.model.corrector(self.robot)

    def adaptations(self) -> Mapping[str, Adaptation]:
        """Units that the model was adapted to."""
        return {} if self.model is None else Adaptation.load(self.folder, self.model.weights_hash())


def is_robot(folder: Path) -> bool:
    """Whether a folder is a robot's own, not a run or a dataset that keeps one."""
    return (folder / "robot.toml").is_file()


def corrected_robot(run: Path, robot: RobotSpec) -> RobotSpec:
    """The simulator that a run's model corrects, as the run keeps it: the nominal one, or an identified one.

    Raises:
        ModelError: They differ before identification: errors would be told against another baseline.
    """
    return require_stored_robot(run, robot, ModelError, DATA)


def choose(
    folders: list[Path], dataset: Dataset, motions: tuple[str, ...] = (), units: tuple[str, ...] = ()
) -> tuple[list[Entry], bool]:
    """Entries to evaluate, and whether none of them was seen by any of the candidates.

    By default the first one's test part, or else everything, each without what any has seen; where all motions were
    seen, recordings that were not. A robot folder that does not say what it was identified from counts as having seen
    everything, and gets everything. Of all these the ones of `units`, if such are named.
    """
    seen = [Seen.by(folder) for folder in folders]
    if None in seen:
        return dataset.select(motions, units), False
    known = [s for s in seen if s is not None]
    mine = dataset.select(units=units)
    fresh = [e for e in mine if not any(e in s for s in known)]
    if motions:
        entries = dataset.select(motions, units)
    else:
        entries = [e for e in fresh if e.hash in known[0].test] or fresh
        entries = entries or [e for e in mine if not any(e.hash in s.hashes for s in known)]
    if not entries:
        raise DatasetError(
            f"{dataset.path}: every sequence was used in training; give logs the runs never saw, or --motions"
        )
    return entries, {e.hash for e in entries} <= {e.hash for e in fresh}


@dataclass(frozen=True)
class Seen:
    """What was trained, identified, chosen or adapted on: recordings, and their motions, whoever played them.

    The own test part is unseen, whatever it was held out by: a split by unit or payload tests motions trained on.
    """

    hashes: frozenset[str]
    motions: frozenset[str]
    test: frozenset[str]

    @classmethod
    def by(cls, folder: Path) -> Seen | None:
        """What a run or a robot folder has seen; None where a robot folder does not say."""
        if is_robot(folder):
            origin = read_origin(folder)
            return None if origin is None else cls._of(origin["parts"], origin["motions"])
        model = GapModel.load(folder)
        logs = {h for c in Adaptation.load(folder, model.weights_hash()).values() for h in c.logs}
        origin = read_origin(folder / STORED_ROBOT)  # of the robot under the model
        logs |= set() if origin is None else {h for part in ("train", "val") for h in origin["parts"][part].values()}
        return cls._of(split_of_run(folder), model.card.get("motions", {}), logs)

    @classmethod
    def _of(cls, split: Any, motions: Mapping[str, Any], more: set[str] | None = None) -> Seen:
        hashes = {h for part in ("train", "val") for h in split[part].values()} | (more or set())
        played = {m for part in ("train", "val") for m in motions.get(part, ())}
        return cls(frozenset(hashes), frozenset(played), frozenset(split["test"].values()) - hashes)

    def __contains__(self, entry: Entry) -> bool:
        return entry.hash in self.hashes or (entry.hash not in self.test and entry.meta.motion in self.motions)


def split_of_run(run: Path) -> dict[str, dict[str, str]]:
    """{part: {sequence id: content hash}} of a run."""
    hint = "give a run folder of gaponet train"
    return dict(read_json(RunSplit, run / "split.json", ModelError, hint))  # type: ignore[arg-type]


def read_origin(folder: Path) -> _Origin | None:
    """What a robot folder was identified from; None where nobody noted it.

    Raises:
        RobotError: Damaged.
    """
    file = folder / PROVENANCE_FILE
    if not file.is_file():
        return None
    return read_json(
        _Origin, file, RobotError, "identify again, or remove it: all recordings then count as seen", allow_extra=True
    )
