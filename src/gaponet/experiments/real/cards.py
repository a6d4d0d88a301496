"""Data cards: which public recordings the benchmark takes, and how each becomes a dataset."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Len

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.structure import Name, read_toml
from gaponet.data.formats import read_logs
from gaponet.data.importer import import_logs
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.labels import Labels, estimate, write

CARDS = Path(__file__).with_name("cards.toml")
ROBOTS = Path(__file__).with_name("robots")  # of data sets alone
DATA = "GAPONET_DATA"  # names the folder of the data sets


@dataclass(frozen=True)
class MissingLabels:
    """Payloads that were in the room, kg, and how many units: who carried what is estimated."""

    payloads: list[float]
    units: int


@dataclass(frozen=True)
class Card:
    """One data set: where it lies, what it is, what is asked of it; `inferred` is what nobody states."""

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
    elsewhere: str = ""  # data set of the same robot that is identified first
    rate: float | None = None
    cut: float | None = None
    position_unit: str | None = None
    joints: list[str] = field(default_factory=list)
    ignore: list[str] = field(default_factory=list)
    posture: dict[str, float] = field(default_factory=dict)
    labels: MissingLabels | None = None


@dataclass(frozen=True)
class LeftOut:
    """A folder of which nothing is asked, and why."""

    folder: str
    why: str


@dataclass(frozen=True)
class Cards:
    """cards.toml."""

    set: list[Card]
    left_out: list[LeftOut] = field(default_factory=list)


def read_cards(file: Path = CARDS) -> Cards:
    """The cards of a file."""
    return read_toml(Cards, file, UsageError, "docs/benchmark.md lists the fields")


def data_folder(given: Path | None) -> Path:
    """Where the data sets lie: given, or GAPONET_DATA, or ../shared/data."""
    folder = given or Path(os.environ.get(DATA, "../shared/data"))
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; say where the public recordings lie with --data or {DATA}")
    return folder


def prepare(card: Card, data: Path, work: Path) -> tuple[Dataset, RobotSpec, Labels | None]:
    """The dataset of a card below `work`, imported where it is not there yet, and the labels that were estimated."""
    own = ROBOTS / card.robot
    robot, place, labels = load_robot(own if own.is_dir() else card.robot), work / card.name, None
    told: dict[str, Any] = {k: v for k in ("rate", "joints", "ignore", "posture") if (v := getattr(card, k))}
    told |= {"position_unit": card.position_unit} if card.position_unit else {}
    place.mkdir(parents=True, exist_ok=True)
    if card.labels:
        gain = dict(zip(robot.joint_names, robot.kp.tolist(), strict=True))
        labels = estimate(
            read_logs(data / card.folder, robot, rate=card.rate), card.labels.payloads, card.labels.units, gain
        )
        write(labels, place)
        told["manifest"] = "labels.csv"
    logs = place / "logs.toml"
    write_text(logs, "".join(f"{k} = {_toml(v)}\n" for k, v in told.items()))
    report = import_logs(
        data / card.folder, robot, card.unit, card.payload, place / "data", logs=logs if told else None, cut=card.cut
    )
    report.dataset.state(licence=card.licence, source=card.source)
    return report.dataset, robot, labels


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    return str(value) if isinstance(value, float) else repr(value).replace("'", '"')


def as_table(card: Card) -> dict[str, Any]:
    """What a page says of a data set."""
    return {k: v for k, v in asdict(card).items() if k in ("title", "source", "licence", "known", "inferred")}
