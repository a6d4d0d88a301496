"""What the card of a robot or a network of the package says for people: data, errors, limits of
use.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Len

from gaponet.base.errors import RobotError
from gaponet.base.structure import read_json
from gaponet.robot.by_name import CARD, identified_catalogue

PUBLISHED = "published"  # field of card.json with a Published
ROBOT_HEADINGS = (
    "name",
    "data",
    "motions of the test",
    "nominal → identified, mrad",
    "payload, kg",
    "rate, Hz",
    "date",
)

Text = Annotated[str, Len(1)]


@dataclass(frozen=True)
class SourceOfData:
    """Data set that a robot was identified from, or a network trained on.

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
    """Mean |q − q_real| in open-loop rollouts of whole motions that fit or training never saw.

    Attributes:
        recordings: Number of rollouts.
        motions: Names of the motions.
        nominal_mrad: Error of the simulator as its maker states it, mrad.
        model_mrad: Error of the identified robot, or with the network, as it is stored here, mrad.
    """

    recordings: Annotated[int, Ge(1)]
    motions: Annotated[tuple[str, ...], Len(1)]
    nominal_mrad: float
    model_mrad: float


@dataclass(frozen=True)
class Published:
    """Fields that the scripts of benchmarks/ add when they put something into the package.

    Attributes:
        licence: SPDX identifier of the licence of the robot's parameters, or of the network.
        date: Day of publication, YYYY-MM-DD.
        data: Data set.
        test: Error on its test motions.
        limits_of_use: What it is not for, in a sentence.
        largest_difference_rad: Of a network whose weights have fewer digits here, the largest
            difference from the one that was trained over states of the training data, rad. 0 if all
            weights are equal.
    """

    licence: Text
    date: Text
    data: SourceOfData
    test: ErrorOnTest
    limits_of_use: Text
    largest_difference_rad: Annotated[float, Ge(0)] = 0.0

    def cells(self) -> list[str]:
        """Return the cells of a table for data, motions and errors."""
        test = self.test
        return [
            f"{self.data.title} ({self.data.licence})",
            f"{test.recordings} recordings of {len(test.motions)} motions",
            f"{test.nominal_mrad:.2f} → {test.model_mrad:.2f}",
        ]


@dataclass(frozen=True)
class RobotFacts:
    """Content of the card.json of an identified robot.

    Attributes:
        robot: Name in robot.toml.
        model: Origin and licence of the MJCF's figures.
        payloads_kg: Payloads of the recordings, kg in each hand.
        rates_hz: Their control rates, Hz.
        units: Their units.
        gaponet: Version that identified the robot.
        plain_mrad: Error on the test motions of its nearest PD servos, which have no servo model,
            mrad.
        published: Licence, data, errors and limits of use.
    """

    robot: Text
    model: Text
    payloads_kg: tuple[float, ...]
    rates_hz: tuple[float, ...]
    units: tuple[str, ...]
    gaponet: Text
    plain_mrad: float
    published: Published


@dataclass(frozen=True)
class RobotCard:
    """An identified robot of the package: the name that load_robot takes, and its facts."""

    name: str
    facts: RobotFacts

    @classmethod
    def read(cls, folder: Path) -> RobotCard:
        """Read the card in a folder that `benchmarks/ship_robots.py` wrote.

        Raises:
            RobotError: It is missing or damaged.
        """
        hint = "ship the robot again with benchmarks/ship_robots.py"
        return cls(folder.name, read_json(RobotFacts, folder / CARD, RobotError, hint))

    def row(self) -> list[str]:
        """Return the cells of a table with ROBOT_HEADINGS, for terminal and documentation."""
        facts = self.facts
        return [
            self.name,
            *facts.published.cells(),
            ", ".join(f"{mass:g}" for mass in facts.payloads_kg),
            ", ".join(f"{rate:g}" for rate in facts.rates_hz),
            facts.published.date,
        ]

    def errors(self) -> str:
        """Return its errors on the test motions as a sentence, for an export without recordings."""
        test = self.facts.published.test
        return (
            f"on {test.recordings} recordings that were not fitted: nominal "
            f"{test.nominal_mrad:.2f} mrad, identified {test.model_mrad:.2f}, without the servo "
            f"model {self.facts.plain_mrad:.2f}"
        )

    def details(self) -> str:
        """Return a line below the table: licences, version, data, units, and the plain error."""
        facts = self.facts
        published = facts.published
        return (
            f"licence {published.licence}, model {facts.model}, gaponet {facts.gaponet}; data: "
            f"{published.data.address}, units {', '.join(facts.units)}; without the servo model "
            f"{facts.plain_mrad:.2f} mrad"
        )


def robot_cards() -> tuple[RobotCard, ...]:
    """Return the cards of the identified robots in the package, by name."""
    return tuple(RobotCard.read(folder) for folder in identified_catalogue().folders())


def folder_size(folder: Path) -> int:
    """Return the size of all files in a folder, bytes."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
