"""What the card of a network of the package says for people: data, errors, limits of use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Len

from gaponet.base.errors import ModelError
from gaponet.base.structure import validated
from gaponet.nn.artifact import GapModel
from gaponet.nn.packaged_networks import CARD, packaged_folders
from gaponet.robot.folder import PackagedRobot

PUBLISHED = "published"  # field of card.json with a Published
HEADINGS = (
    "name",
    "robot, model",
    "data",
    "motions of the test",
    "nominal → with it, mrad",
    "payload, kg",
    "rate, Hz",
    "training",
)

Text = Annotated[str, Len(1)]


@dataclass(frozen=True)
class SourceOfData:
    """Data set that a network was trained on.

    Attributes:
        title: Its name.
        address: Where it is, or how to make it.
        licence: SPDX identifier of its licence.
    """

    title: Text
    address: Text
    licence: Text


@dataclass(frozen=True)
class ErrorOnTest:
    """Mean |q − q_real| in open-loop rollouts of whole motions that training never saw.

    Attributes:
        recordings: Number of rollouts.
        motions: Names of the motions.
        nominal_mrad: Error of the simulator without correction, mrad.
        model_mrad: Error with the network, as it is stored here, mrad.
    """

    recordings: Annotated[int, Ge(1)]
    motions: Annotated[tuple[str, ...], Len(1)]
    nominal_mrad: float
    model_mrad: float


@dataclass(frozen=True)
class Published:
    """Fields that `benchmarks/ship_networks.py` adds to the card of training.

    Attributes:
        licence: SPDX identifier of the network's licence.
        date: Day of publication, YYYY-MM-DD.
        data: Data set.
        test: Error on its test motions.
        limits_of_use: What the network is not for, in a sentence.
        largest_difference_rad: Largest difference between this network and the one that was
            trained, whose weights have more digits, over states of the training data, rad. 0 if all
            weights are equal.
    """

    licence: Text
    date: Text
    data: SourceOfData
    test: ErrorOnTest
    limits_of_use: Text
    largest_difference_rad: Annotated[float, Ge(0)] = 0.0


@dataclass(frozen=True, kw_only=True)
class NetworkCard:
    """A network of the package.

    Attributes:
        name: What GapModel.load takes.
        robot: Robot of the package.
        gain_scale: Factor on the robot's gains in the simulator of training.
        kind: Kind of network (ModelConfig.kind).
        virtual: True if no real robot made the recordings.
        published: Licence, data, errors and limits of use.
        payloads_kg: Payloads of the training recordings, kg in each hand.
        rates_hz: Their control rates, Hz.
        units: Their units (physical or virtual robots).
        seed: Seed of the training.
        steps: Length of the training, control steps.
        gaponet: Version that trained it.
        size_bytes: Size of all its files.
    """

    name: str
    robot: str
    gain_scale: float
    kind: str
    virtual: bool
    published: Published
    payloads_kg: tuple[float, ...]
    rates_hz: tuple[float, ...]
    units: tuple[str, ...]
    seed: int
    steps: int
    gaponet: str
    size_bytes: int

    @classmethod
    def read(cls, folder: Path) -> NetworkCard:
        """Read the card of a network in a folder that `benchmarks/ship_networks.py` wrote.

        Raises:
            ModelError: A file or field is missing or damaged.
        """
        file = folder / CARD
        mend = "ship the network again with benchmarks/ship_networks.py"
        card, config = GapModel.read_card(file)
        published = validated(
            Published, card.get(PUBLISHED, {}), f"{file}: {PUBLISHED}", ModelError, mend
        )
        simulator = PackagedRobot.read(folder)
        if simulator is None:
            raise ModelError(f"{folder}: names no robot of the package; {mend}")
        needed = ("payload_seen", "dt", "units", "seed", "steps", "versions", "virtual")
        for name in needed:
            if name not in card:
                raise ModelError(f"{file}: {name} is missing; {mend}")
        return cls(
            name=folder.name,
            robot=simulator.name,
            gain_scale=simulator.gain_scale,
            kind=config.kind,
            virtual=card["virtual"],
            published=published,
            payloads_kg=tuple(card["payload_seen"]),
            rates_hz=tuple(round(1 / dt, 1) for dt in card["dt"]),
            units=tuple(card["units"]),
            seed=card["seed"],
            steps=card["steps"],
            gaponet=card["versions"]["gaponet"],
            size_bytes=folder_size(folder),
        )

    def row(self) -> list[str]:
        """Return the cells of a table with HEADINGS, for terminal and documentation."""
        test = self.published.test
        data = self.published.data
        robot = self.robot
        if self.gain_scale != 1:
            robot += f" × {self.gain_scale:g} gains"
        if self.virtual:
            robot = f"VIRTUAL {robot}"
        return [
            self.name,
            f"{robot}, {self.kind}",
            f"{data.title} ({data.licence})",
            f"{test.recordings} recordings of {len(test.motions)} motions",
            f"{test.nominal_mrad:.2f} → {test.model_mrad:.2f}",
            ", ".join(f"{mass:g}" for mass in self.payloads_kg),
            ", ".join(f"{rate:g}" for rate in self.rates_hz),
            f"{self.steps:,} control steps, seed {self.seed}, {self.published.date}",
        ]

    def details(self) -> str:
        """Return a line below the table: licence, version, data, units, limits of use, and what
        storage changed.
        """
        published = self.published
        text = (
            f"licence {published.licence}, gaponet {self.gaponet}; data: {published.data.address}, "
            f"units {', '.join(self.units)}. {published.limits_of_use}"
        )
        if published.largest_difference_rad:
            difference = published.largest_difference_rad
            text += f" Stored as int16: differs by at most {difference:.1e} rad from training."
        return text


def folder_size(folder: Path) -> int:
    """Return the size of all files in a folder, bytes."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def network_cards() -> tuple[NetworkCard, ...]:
    """Return the cards of the networks in the package, by name."""
    return tuple(NetworkCard.read(folder) for folder in packaged_folders())


def markdown_table(cards: tuple[NetworkCard, ...]) -> str:
    """Return the cards as the text of docs/network.md: a table, and a line with the details of
    each network.
    """
    if not cards:
        return "This version of the package has no networks.\n"
    lines = [f"| {' | '.join(HEADINGS)} |", "|---" * len(HEADINGS) + "|"]
    for card in cards:
        cells = card.row()
        cells[0] = f"`{cells[0]}`"
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for card in cards:
        lines.append(f"- `{card.name}`: {card.details()}")
    return "\n".join(lines) + "\n"
