"""A dataset as the files that are pushed, and back.

What is pushed is a LeRobot set (data.writers.lerobot), so that LeRobot and the Hub's own viewer read it; beside it, in
gaponet/, what such a set has no place for: the nominal robot, splits, card. Twins, offsets and findings are made again.
What comes back is imported from it as any stranger's logs are: nothing of what was downloaded stays.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from gaponet.data.card import NOT_STATED, make_card, write_card
from gaponet.data.card_text import card_text
from gaponet.data.importer import import_logs
from gaponet.data.split import read_split
from gaponet.data.store import Dataset, open_dataset
from gaponet.data.writers import export
from gaponet.errors import DatasetError
from gaponet.files import write_text
from gaponet.progress import Progress
from gaponet.robot import RobotSpec, load_robot
from gaponet.robot_folder import KEPT, require_bare, save_robot
from gaponet.sim.dynamics import gravity_of
from gaponet.sim.model import model_hash
from gaponet_interop.share.errors import RemoteError
from gaponet_interop.share.readme import dataset_readme
from gaponet_interop.share.target import Index

BESIDE = "gaponet"  # folder beside the LeRobot set
COLLECTED = "collect.json"


def lay_out(path: Path, folder: Path, address: str, progress: Progress) -> tuple[str, ...]:
    """Write the files of a dataset below an empty folder; returns the hashes of its sequences."""
    dataset, robot = open_dataset(path)
    for entry in dataset.entries:
        if dataset.read(entry).content_hash() != entry.hash:
            raise DatasetError(f"{path}: '{entry.id}' is not what was recorded, by its hash; restore it first")
    card = make_card(dataset, progress)
    sets = [one.path.relative_to(folder).as_posix() for one in export(dataset, robot, folder, "lerobot", progress)]
    beside = folder / BESIDE
    beside.mkdir()
    save_robot(robot.nominal or robot, beside / KEPT)
    (beside / KEPT / ".gaponet").unlink()
    for split in sorted((path / "splits").glob("*.json")):
        read_split(split, dataset)
        (beside / "splits").mkdir(exist_ok=True)
        shutil.copyfile(split, beside / "splits" / split.name)
    if card["collected"]:
        write_text(beside / COLLECTED, json.dumps(card["collected"], indent=1, ensure_ascii=False) + "\n")
    write_text(
        folder / "README.md", dataset_readme(card, card_text(card), address, ["" if s == "." else s for s in sets])
    )
    return tuple(sorted(entry.hash for entry in dataset.entries))


def take_in(folder: Path, index: Index, out: Path, progress: Progress) -> dict[str, Any]:
    """Import what was downloaded into a new dataset, and compare the hash of every sequence.

    Raises:
        RemoteError: Sequences are missing, or are not those that were pushed.
        GAPONetError: A file is not what it should be.
    """
    robot = pushed_robot(folder)
    import_logs(
        folder, robot, None, None, out, fmt="lerobot", gravity=gravity_of(robot), simulator=model_hash(robot),
        progress=progress,
    )  # fmt: skip
    dataset = Dataset(out)
    found = {entry.hash for entry in dataset.entries}
    if found != set(index.contents):
        odd = len(found ^ set(index.contents))
        raise RemoteError(f"{odd} sequences are not those that were pushed, by their content hashes; push them again")
    bring_beside(folder, dataset)
    card = make_card(dataset)
    write_card(dataset, card, card_text(card))
    return {"sequences": len(dataset), "hours": dataset.hours(), "licence": card.get("licence", NOT_STATED)}


def bring_beside(folder: Path, dataset: Dataset) -> None:
    """Take splits and recipe out of what was downloaded into a dataset."""
    source = folder / BESIDE / COLLECTED
    if source.is_file():
        shutil.copyfile(source, dataset.path / COLLECTED)
    for split in sorted((folder / BESIDE / "splits").glob("*.json")):
        read_split(split, dataset)
        (dataset.path / "splits").mkdir(exist_ok=True)
        shutil.copyfile(split, dataset.path / "splits" / split.name)


def pushed_robot(folder: Path) -> RobotSpec:
    """The robot in what was downloaded: a stranger's, which may name no file outside its folder."""
    folder = folder / BESIDE / KEPT
    if not (folder / "robot.toml").is_file():
        raise DatasetError(f"{BESIDE}/{KEPT}: no robot.toml; push the dataset again")
    require_bare(folder)
    return load_robot(folder)
