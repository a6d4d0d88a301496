"""Data cards: the public recordings of the benchmark, and the import of each as a dataset."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Len
from estimate_labels import Labels, estimate, write

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.structure import Name, read_toml
from gaponet.data.formats import ReadOptions, read_logs
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.public_recordings import DATA_VARIABLE

CARDS = Path(__file__).with_name("cards.toml")
ROBOTS = Path(__file__).with_name(
    "robots"
)  # robots of the data sets that the package does not have


@dataclass(frozen=True)
class MissingLabels:
    """The payloads, kg, and the number of units in recordings whose labels have to be estimated."""

    payloads: list[float]
    units: int


@dataclass(frozen=True)
class Card:
    """One data set.

    Attributes:
        folder: Place below the data folder.
        known, inferred: Facts that the source states, and facts that were read off the data.
        questions: Names of questions (questions.py).
        elsewhere: Data set of the same robot that `elsewhere` methods identify on.
        files: Pattern of the files to take; default all.
        labels: Given if payload and unit have to be estimated.
    """

    name: Name
    folder: str
    robot: str
    title: str
    source: str
    licence: str
    known: str
    inferred: str
    questions: Annotated[list[str], Len(1)]
    unit: str | None = None
    payload: float | None = None
    elsewhere: str = ""
    rate: float | None = None
    cut: float | None = None
    position_unit: str | None = None
    joints: list[str] = field(default_factory=list)
    ignore: list[str] = field(default_factory=list)
    posture: dict[str, float] = field(default_factory=dict)
    files: str = ""
    labels: MissingLabels | None = None


@dataclass(frozen=True)
class LeftOut:
    """A folder without questions, and the reason."""

    folder: str
    why: str


@dataclass(frozen=True)
class Cards:
    """Contents of cards.toml."""

    set: list[Card]
    left_out: list[LeftOut] = field(default_factory=list)


def read_cards(file: Path = CARDS) -> Cards:
    """Read the cards of a file."""
    return read_toml(Cards, file, UsageError, "docs/benchmark.md lists the fields")


def data_folder(given: Path | None) -> Path:
    """Return the folder of the data sets: given, or GAPONET_DATA, or ../shared/data.

    Raises:
        UsageError: No such folder.
    """
    folder = given or Path(os.environ.get(DATA_VARIABLE, "../shared/data"))
    if not folder.is_dir():
        raise UsageError(
            f"{folder}: no such folder; name the folder of the public recordings with --data or "
            f"{DATA_VARIABLE}"
        )
    return folder


def prepare(card: Card, data: Path, work: Path) -> tuple[Dataset, RobotSpec, Labels | None]:
    """Import a card's recordings below `work` once.

    Returns:
        Dataset, robot, and the estimated labels if any.
    """
    own = ROBOTS / card.robot
    robot = load_robot(own if own.is_dir() else card.robot)
    place = work / card.name
    labels = None
    options: dict[str, Any] = {}
    for name in ("rate", "joints", "ignore", "posture", "position_unit"):
        value = getattr(card, name)
        if value:
            options[name] = value
    place.mkdir(parents=True, exist_ok=True)
    source = data / card.folder
    if card.files:
        source = place / "recordings"
        source.mkdir(exist_ok=True)
        for file in sorted((data / card.folder).glob(card.files)):
            shutil.copy2(file, source)
    if card.labels:
        gain = dict(zip(robot.joint_names, robot.servo.kp.tolist(), strict=True))
        recordings = read_logs(source, robot, ReadOptions(rate=card.rate))
        labels = estimate(recordings, card.labels.payloads, card.labels.units, gain)
        write(labels, place)
        options["manifest"] = "labels.csv"
    logs = place / "logs.toml"
    write_text(logs, "".join(f"{k} = {_toml(v)}\n" for k, v in options.items()))
    request = ImportRequest(
        unit_id=card.unit,
        payload_mass=card.payload,
        logs=logs if options else None,
        cut=card.cut,
    )
    report = import_logs(source, robot, place / "data", request)
    report.dataset.set_provenance(licence=card.licence, source=card.source)
    return report.dataset, robot, labels


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    return str(value) if isinstance(value, float) else repr(value).replace("'", '"')
