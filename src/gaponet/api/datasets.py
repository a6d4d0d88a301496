"""What a dataset holds, its parts and pictures, and a copy for LeRobot: the actions of gaponet
data.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gaponet.api.opening import Place, open_dataset
from gaponet.base.progress import Progress, no_progress
from gaponet.base.result_table import ResultTable
from gaponet.data.store import Dataset, Entry
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.data.writers.lerobot import Written

SplitBy = Literal["motion", "unit", "payload", "repetition", "time"]


@dataclass(frozen=True, kw_only=True)
class CardResult:
    """Counts, ranges and repeatability of a dataset.

    Attributes:
        card: What card.json holds.
        written: False if the folder of the dataset may not be written.
    """

    dataset: Dataset
    card: dict[str, Any] = field(repr=False)
    written: bool

    @property
    def headline(self) -> str:
        """The dataset in a sentence."""
        from gaponet.data.card import headline

        return headline(self.card)

    def counts(self) -> list[ResultTable]:
        """Return recordings by level, payload, unit and rate."""
        from gaponet.data.card import PROPERTIES, count_table

        return [count_table(self.card, name) for name in PROPERTIES]

    def beside_paper(self) -> ResultTable | None:
        """Return the counts beside those of the paper's dataset, if they were asked for."""
        from gaponet.data.card import paper_table

        return paper_table(self.card) if "beside_paper" in self.card else None

    def states(self, name: Literal["licence", "source"]) -> bool:
        """Return True if the dataset states its licence or source."""
        from gaponet.data.card import NOT_STATED

        return bool(self.card[name] != NOT_STATED)

    def to_dict(self) -> dict[str, Any]:
        return dict(self.card)


@dataclass(frozen=True, kw_only=True)
class SplitPart:
    """One part of a split dataset.

    Attributes:
        counts: sequences, hours, frames and motions → their number.
        payloads_kg: Payloads as text.
    """

    counts: dict[str, float]
    units: list[str]
    payloads_kg: list[str]

    def to_dict(self) -> dict[str, Any]:
        return self.counts | {"units": self.units, "payloads_kg": self.payloads_kg}


@dataclass(frozen=True, kw_only=True)
class SplitResult:
    """Parts of a dataset that share no recording.

    Attributes:
        path: File in the dataset's folder splits.
        parts: train, val and test.
    """

    dataset: Dataset
    path: Path
    by: SplitBy
    parts: dict[str, SplitPart]

    def to_dict(self) -> dict[str, Any]:
        parts = {name: part.to_dict() for name, part in self.parts.items()}
        return {"split": str(self.path), "by": self.by, "parts": parts}


@dataclass(frozen=True, kw_only=True)
class FiguresResult:
    """Pictures of a dataset.

    Attributes:
        written: Files.
        left_out: Picture → why the dataset has no data for it.
    """

    written: list[Path]
    left_out: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        return {"figures": [str(path) for path in self.written], "left_out": self.left_out}


@dataclass(frozen=True, kw_only=True)
class LeRobotResult:
    """A dataset in LeRobot's format.

    Attributes:
        folder: Folder that was written.
        sets: One for each rate.
    """

    dataset: Dataset
    folder: Path
    sets: list[Written]

    def to_dict(self) -> dict[str, Any]:
        sets = []
        for made in self.sets:
            sets.append({"path": str(made.path), "episodes": made.episodes, "frames": made.frames})
        return {"sets": sets}


def dataset_card(
    dataset: Dataset | Place,
    *,
    licence: str | None = None,
    source: str | None = None,
    beside_paper: bool = False,
    progress: Progress = no_progress,
) -> CardResult:
    """Count and measure what a dataset holds, and write card.json and CARD.md into it.

    Args:
        licence: Record this licence in dataset.json; "" removes it.
        source: Record where the recordings come from.
        beside_paper: Add the counts of the paper's dataset.

    Raises:
        DatasetError: The dataset is empty, or damaged.
    """
    from gaponet.data import card as cards

    data = _opened(dataset)
    stated = {}
    if licence is not None:
        stated["licence"] = licence
    if source is not None:
        stated["source"] = source
    if stated:
        data.set_provenance(**stated)
    card = cards.make_card(data, progress)
    if beside_paper:
        card["beside_paper"] = cards.beside_paper(data)
    if not data.read_only:
        cards.write_card(data, card)
    return CardResult(dataset=data, card=card, written=not data.read_only)


def split_dataset(
    dataset: Dataset | Place,
    *,
    by: SplitBy,
    holdout: tuple[str, ...] = (),
    progress: Progress = no_progress,
) -> SplitResult:
    """Divide a dataset into training, validation and test parts that share no recording.

    Args:
        by: Property whose values are divided among the parts.
        holdout: Values for the test part; default a quarter of them by a fixed rule.

    Raises:
        DatasetError, UsageError: A value is not there, or two parts would hold the same recording.
    """
    from gaponet.data.card import count_entries
    from gaponet.data.split import make_split, require_distinct_samples, write_split

    data = _opened(dataset)
    splits = make_split(data, by, holdout)
    require_distinct_samples(data, splits, progress)
    path = write_split(data, splits, by, holdout)
    parts = {}
    for name, entries in splits.items():
        payloads = sorted({entry.meta.payload_mass for entry in entries})
        parts[name] = SplitPart(
            counts=count_entries(entries),
            units=sorted({entry.meta.unit_id for entry in entries}),
            payloads_kg=[f"{payload:g}" for payload in payloads],
        )
    return SplitResult(dataset=data, path=path, by=by, parts=parts)


def draw_dataset(
    dataset: Dataset | Place,
    *,
    out: Place,
    robot: RobotSpec | Place | None = None,
    progress: Progress = no_progress,
) -> FiguresResult:
    """Draw joint ranges, composition, torque and temperature of a dataset, as SVG and PNG.

    Raises:
        DatasetError: The dataset is empty, damaged, or another robot's.
    """
    from gaponet.report.figures.dataset_figures import write_figures

    data, spec = open_dataset(dataset, robot)
    written, left_out = write_figures(data, spec, Path(out), progress)
    return FiguresResult(written=written, left_out=left_out)


def export_dataset(
    dataset: Dataset | Place, *, out: Place, progress: Progress = no_progress
) -> LeRobotResult:
    """Write a dataset in the format LeRobotDataset v3.0, one set for each rate.

    Args:
        out: New folder.

    Raises:
        DatasetError, FolderError: A recording is damaged, or the folder holds something else.
    """
    from gaponet.data.writers import export

    data = _opened(dataset)
    sets = export(data, out, progress)
    return LeRobotResult(dataset=data, folder=Path(out), sets=sets)


def remove_recordings(
    dataset: Dataset | Place, ids: tuple[str, ...]
) -> tuple[Dataset, list[Entry]]:
    """Remove recordings and their simulated replays; return the dataset and what is gone.

    Args:
        ids: Ids in sequences.jsonl, or patterns: '*-1kg-*'.

    Raises:
        DatasetError: There is no such recording.
    """
    data = _opened(dataset)
    return data, data.remove(ids)


def _opened(dataset: Dataset | Place) -> Dataset:
    return dataset if isinstance(dataset, Dataset) else Dataset(dataset)
