"""A dataset as the files that are pushed, and back.

What is pushed is a LeRobot set (data.writers.lerobot), so that LeRobot and the Hub's own viewer read it; beside it, in
gaponet/, what such a set has no place for: the nominal robot, splits, recipe, offsets. Twins are made again.

A set is laid out block by block. What a block became is noted in the dataset's pushed.jsonl under the block's key,
which stands for all that decides its bytes: where the place holds them, nothing of it is read or made again.
"""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError
from gaponet.base.files import write_text
from gaponet.base.progress import Progress
from gaponet.base.structure import parse_json
from gaponet.data.card import counted
from gaponet.data.card_text import card_text
from gaponet.data.formats.lerobot_set import FEATURES
from gaponet.data.importer import findings
from gaponet.data.log import UNITS
from gaponet.data.offsets import FILE as OFFSETS
from gaponet.data.offsets import read_offsets
from gaponet.data.sequence import Sequence
from gaponet.data.split import read_split
from gaponet.data.store import Dataset, Entry
from gaponet.data.writers.lerobot import LeRobotSet, sets_of
from gaponet.data.writers.lerobot_stats import EpisodeStats, plain, pool
from gaponet.robot.folder import KEPT, require_bare, save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.readme import dataset_readme
from gaponet.share.target import Anew, Part, Target, send
from gaponet.sim.model import model_hash

BESIDE = "gaponet"  # folder beside the LeRobot set
BROUGHT = ("collect.json", OFFSETS)  # files in it, as they lie in the dataset
LAID = "pushed.jsonl"


class _Laid(TypedDict):
    """What a block became: its files below the set, and the statistics of its frames."""

    key: str
    files: dict[str, Part]
    stats: dict[str, dict[str, list[float]]]


def lay_out(
    dataset: Dataset, robot: RobotSpec, folder: Path, target: Target, progress: Progress, anew: Anew
) -> dict[str, Part]:
    """Bring a dataset to a place, through an empty folder; returns its files there.

    Raises:
        DatasetError: A recording is damaged.
    """
    known, done = _laid(dataset), 0
    now: list[_Laid] = []
    files: dict[str, Part] = {}
    sets: list[tuple[LeRobotSet, EpisodeStats]] = []
    for part in sets_of(dataset):
        for block in part.blocks:
            laid = known.get(block.key)
            if laid is None or not all(target.holds(place, one, anew) for place, one in laid["files"].items()):
                stats = part.write_block(block, folder, partial(_read, dataset))
                sent = send(target, {place: folder / place for place in block.places}, anew)
                laid = {"key": block.key, "files": sent, "stats": plain(stats)}
                if block.key not in known and not dataset.read_only:
                    with (dataset.path / LAID).open("a", encoding="utf-8") as file:
                        file.write(_line(laid))
                for place in block.places if target.at_once else ():
                    (folder / place).unlink()
            now.append(laid)
            files |= laid["files"]
            done += len(block.episodes)
            progress(done, len(dataset), block.episodes[-1].entry.meta.motion)
        stats = pool([laid["stats"] for laid in now[-len(part.blocks) :]])
        part.write_meta(folder, stats)
        sets.append((part, stats))
    (folder / BESIDE).mkdir()
    save_robot(robot.nominal or robot, folder / BESIDE / KEPT)
    (folder / BESIDE / KEPT / ".gaponet").unlink()
    bring(dataset.path, folder / BESIDE, dataset)
    card = _card(dataset, sets)
    text = dataset_readme(card, card_text(card), target.address, [part.name for part, _ in sets])
    write_text(folder / "README.md", text)
    small = {file.relative_to(folder).as_posix(): file for file in folder.rglob("*") if file.is_file()}
    files |= send(target, {place: file for place, file in small.items() if place not in files}, anew)
    if known.keys() - {laid["key"] for laid in now} and not dataset.read_only:
        write_text(dataset.path / LAID, "".join(map(_line, now)))
    return dict(sorted(files.items()))


def _laid(dataset: Dataset) -> dict[str, _Laid]:
    """What earlier pushes noted; a line that was cut short is none."""
    found, file = {}, dataset.path / LAID
    for line in file.read_bytes().splitlines() if file.is_file() else ():
        with suppress(DatasetError):
            one = parse_json(_Laid, line, file, DatasetError)
            found[one["key"]] = one
    return found


def _line(laid: _Laid) -> str:
    return "\n" + json.dumps(laid, default=vars)


def _read(dataset: Dataset, entry: Entry) -> Sequence:
    sequence = dataset.read(entry)
    if sequence.content_hash() != entry.hash:
        raise DatasetError(f"{dataset.path}: '{entry.id}' is not what was recorded, by its hash; restore it first")
    return sequence


def _card(dataset: Dataset, sets: list[tuple[LeRobotSet, EpisodeStats]]) -> dict[str, Any]:
    """The card without what only reading all of it says: percentiles and repeatability."""
    signals = {}
    for name, feature in FEATURES.items():
        having = [(part, stats) for part, stats in sets if feature in stats]
        if having:
            pooled = pool([{feature: stats[feature]} for _, stats in having])[feature]
            joints = {
                joint: {k: float(f"{pooled[k][j]:.6g}") for k in ("min", "mean", "max", "std")}
                for j, joint in enumerate(dataset.joint_names)
            }
            count = sum(len(part.entries) for part, _ in having)
            signals[name] = {"unit": UNITS[name], "sequences": count, "joints": joints}
    return counted(dataset) | {"signals": signals}


def take_in(pushed: Dataset, robot: RobotSpec, beside: Path, out: Path, progress: Progress) -> None:
    """Copy what a dataset lacks of one that was pushed, each recording checked by its hash, in the memory of one.

    Args:
        beside: Folder of what was pushed beside the set.
        out: Dataset; made where there is none, else brought up to date.

    Raises:
        GAPONetError: It is another robot's, or a recording is not what was pushed.
    """
    model_hash(robot)  # refused, if it is none
    dataset = Dataset.create(out, robot)
    new = [entry for entry in pushed.entries if dataset.find(entry.hash) is None]
    with dataset.appending():
        for done, entry in enumerate(new, 1):
            sequence = pushed.read(entry)
            dataset.append(sequence, entry.findings or findings(sequence), entry.hash)
            progress(done, len(new), entry.meta.motion)
    bring(beside, dataset.path, dataset)


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
    return load_robot(folder)
