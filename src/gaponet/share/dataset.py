"""A dataset as the files that are pushed, and back.

The files are a LeRobot set (gaponet.data.writers.lerobot), which LeRobot and the Hub's viewer read. The folder
gaponet/ beside it holds what such a set has no place for: the nominal robot, splits, recipe, offsets.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from gaponet.base.errors import DatasetError
from gaponet.base.files import write_text
from gaponet.base.progress import progress_bar
from gaponet.data.card import make_card
from gaponet.data.card_text import card_text
from gaponet.data.formats.lerobot_set import Stated
from gaponet.data.importer import findings
from gaponet.data.offsets import FILE as OFFSETS
from gaponet.data.offsets import read_offsets
from gaponet.data.split import read_split
from gaponet.data.store import Dataset
from gaponet.data.writers.lerobot import write
from gaponet.robot.folder import KEPT, kept_robot, require_bare, save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.readme import dataset_readme
from gaponet.sim.model import model_hash

BESIDE = "gaponet"  # folder beside the LeRobot set
BROUGHT = ("collect.json", OFFSETS)  # files in it, as they lie in the dataset


def lay_out(path: Path, folder: Path, address: str) -> tuple[str, ...]:
    """Write the files of a dataset into an empty folder; returns the hashes of its sequences.

    Raises:
        DatasetError: It is empty, or a recording is damaged.
    """
    dataset = Dataset(path)
    robot = kept_robot(dataset.path, dataset.robot_name)
    contents = tuple(sorted(entry.hash for entry in dataset.select()))
    with progress_bar("reading") as update:
        done = iter(range(1, len(dataset) + 1))
        sets = write(dataset, robot, folder, lambda motion: update(next(done), len(dataset), motion))
    (folder / BESIDE).mkdir()
    save_robot(robot.nominal or robot, folder / BESIDE / KEPT)
    (folder / BESIDE / KEPT / ".gaponet").unlink()
    bring(dataset.path, folder / BESIDE, dataset)
    card = make_card(dataset)
    text = dataset_readme(card, card_text(card), address, [part.path.as_posix() for part in sets])
    write_text(folder / "README.md", text)
    return contents


def take_in(pushed: Dataset, robot: RobotSpec, out: Path) -> None:
    """Copy what a dataset lacks of one that was pushed, in the memory of one recording.

    Args:
        out: Dataset; made where there is none, else brought up to date.

    Raises:
        GAPONetError: It is another robot's, or a recording is not what was pushed.
    """
    new = not (out / "dataset.json").is_file()
    dataset = Dataset.create(out, robot)
    if new:
        dataset.state(**{name: str(pushed.header[name]) for name in Stated.__annotations__ if name in pushed.header})
    missing = [entry for entry in pushed.entries if dataset.find(entry.hash) is None]
    with dataset.appending(), progress_bar("checking") as update:
        for done, entry in enumerate(missing, 1):
            sequence = pushed.read(entry)
            dataset.append(sequence, entry.findings or findings(sequence), entry.hash)
            update(done, len(missing), entry.meta.motion)
    bring(pushed.path, dataset.path, dataset)


def bring(source: Path, out: Path, dataset: Dataset) -> None:
    """Copy splits, recipe and offsets of a dataset, checked, where there are none yet."""
    for file in [source / name for name in BROUGHT] + sorted((source / "splits").glob("*.json")):
        place = out / file.relative_to(source)
        if file.is_file() and not place.exists():
            if file.parent != source:
                read_split(file, dataset)
            place.parent.mkdir(exist_ok=True)
            shutil.copyfile(file, place)
    read_offsets(dataset)


def pushed_robot(folder: Path) -> RobotSpec:
    """The robot in what was downloaded: a stranger's, which may name no file outside its folder."""
    folder = folder / BESIDE / KEPT
    if not (folder / "robot.toml").is_file():
        raise DatasetError(f"{BESIDE}/{KEPT}: no robot.toml; push the dataset again")
    require_bare(folder)
    robot = load_robot(folder)
    model_hash(robot)  # raises if it is none
    return robot
