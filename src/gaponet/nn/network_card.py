"""What the card of a network of the package says for people: data, errors, limits of use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gaponet.base.errors import ModelError
from gaponet.base.structure import validated
from gaponet.nn.artifact import GapModel
from gaponet.nn.packaged_networks import catalogue
from gaponet.robot.by_name import CARD
from gaponet.robot.card import PUBLISHED, Published, folder_size
from gaponet.robot.folder import PackagedRobot

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

    headings = HEADINGS

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
        robot = self.robot
        if self.gain_scale != 1:
            robot += f" × {self.gain_scale:g} gains"
        if self.virtual:
            robot = f"VIRTUAL {robot}"
        return [
            self.name,
            f"{robot}, {self.kind}",
            *self.published.cells(),
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


def network_cards() -> tuple[NetworkCard, ...]:
    """Return the cards of the networks in the package, by name."""
    return tuple(NetworkCard.read(folder) for folder in catalogue().folders())
