"""Conversion between a dataset and the files that are pushed.

The files are a LeRobot set (gaponet.data.writers.lerobot), which LeRobot and the Hub's viewer read.
The folder gaponet/ beside it holds what such a set has no place for: the nominal robot, splits,
recipe, offsets, and the hashes of the files that the push was made from.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from gaponet import __version__
from gaponet.base.errors import DatasetError
from gaponet.base.files import FOLDER_MARKER, write_text
from gaponet.base.network import RemoteError
from gaponet.base.progress import progress_bar
from gaponet.data.card import card_markdown, make_card
from gaponet.data.formats.lerobot import read_episodes
from gaponet.data.formats.lerobot_set import Set, Stated, sets_under
from gaponet.data.importer import measure_delays
from gaponet.data.journal import FILE as JOURNAL
from gaponet.data.log import Log
from gaponet.data.offsets import FILE as OFFSETS
from gaponet.data.offsets import read_offsets
from gaponet.data.sequence import Sequence, SequenceMeta, to_sequence
from gaponet.data.split import read_split
from gaponet.data.store import Dataset
from gaponet.data.writers.lerobot import write
from gaponet.robot.by_name import require_self_contained
from gaponet.robot.folder import STORED_ROBOT, load_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.readme import dataset_readme
from gaponet.share.remote import INDEX, FileRecord, Index
from gaponet.share.robot import hide_place_of_dataset
from gaponet.sim.model import model_hash

SIDECAR = "gaponet"  # folder beside the LeRobot set
SOURCE = f"{SIDECAR}/source.json"  # hashes of all files that the pushed files follow from
COPIED_FILES = ("collect.json", OFFSETS)
AGAIN = "push it again"


def write_files(path: Path, folder: Path, address: str) -> tuple[str, ...]:
    """Write the files of a dataset into an empty folder; return the hashes of its sequences.

    Raises:
        DatasetError: The dataset is empty, or a recording is damaged.
    """
    dataset = Dataset(path)
    source = _source_text(path, address)
    robot = load_stored_robot(dataset.path, dataset.robot_name)
    contents = tuple(sorted(entry.hash for entry in dataset.select()))
    with progress_bar("reading") as update:
        written = 0

        def show(motion: str) -> None:
            nonlocal written
            written += 1
            update(written, len(dataset), motion)

        sets = write(dataset, folder, show)
    sidecar = folder / SIDECAR
    sidecar.mkdir()
    save_robot(robot.nominal or robot, sidecar / STORED_ROBOT)
    hide_place_of_dataset(sidecar / STORED_ROBOT)
    (sidecar / STORED_ROBOT / FOLDER_MARKER).unlink()
    copy_sidecars(dataset.path, sidecar, dataset)
    card = make_card(dataset)
    places = [part.path.as_posix() for part in sets]
    write_text(folder / "README.md", dataset_readme(card, card_markdown(card), address, places))
    write_text(folder / SOURCE, source)
    return contents


def is_pushed(path: Path, address: str, index: Index) -> bool:
    """Return True if a dataset and all that is pushed with it are as in the push of this index."""
    record = index.files.get(SOURCE)
    if record is None:
        return False
    now = hashlib.sha256(_source_text(path, address).encode()).hexdigest()
    return record.sha256 == now


def _source_text(path: Path, address: str) -> str:
    """Return what the pushed files depend on, as JSON: version, address, and hashes of the
    dataset's small files.

    The journal lists the content hash of every recording, so that no recording is read.
    """
    patterns = ("dataset.json", JOURNAL, *COPIED_FILES, "splits/*.json", f"{STORED_ROBOT}/*.*")
    files: list[Path] = []
    for pattern in patterns:
        files += path.glob(pattern)
    hashes = {}
    for file in sorted(files):
        if file.is_file() and file.name != FOLDER_MARKER:
            hashes[file.relative_to(path).as_posix()] = FileRecord.of(file).sha256
    source = {"gaponet": __version__, "address": address, "files": hashes}
    return json.dumps(source, indent=1) + "\n"


def is_recording_file(path: str) -> bool:
    """Return True for a pushed file that holds recordings, below a folder `data`; all others are
    small.
    """
    return "data" in path.split("/")[:-1]


def missing_files(files: Path, index: Index, present: Dataset | None) -> list[str]:
    """Return the pushed files that hold recordings which a dataset lacks.

    Args:
        files: Folder with the small files of the push.
        present: The dataset; None where there is none yet.

    Raises:
        GAPONetError: The files do not list the sequences of the index.
    """
    sets = sets_under(files)
    listed = []
    for part in sets:
        listed += [str(episode.get("content_hash")) for episode in part.episodes]
    if sorted(listed) != sorted(index.contents):
        raise RemoteError(f"the sequences listed are not those of {INDEX}; {AGAIN}")
    wanted = set()
    for part in sets:
        for episode in part.episodes:
            if present is None or present.find(str(episode["content_hash"])) is None:
                wanted.add(part.data_file(episode).relative_to(files).as_posix())
    unlisted = wanted - index.files.keys()
    if unlisted:
        raise RemoteError(f"{min(unlisted)} is not in {INDEX}; {AGAIN}")
    return sorted(wanted)


def add_missing(files: Path, robot: RobotSpec, out: Path, new: bool) -> None:
    """Copy the sequences that a dataset lacks from pushed files; each is compared with its content
    hash.

    Args:
        files: Folder with the small files of the push and with those of missing_files.
        out: Dataset; made if there is none.
        new: Also copy licence and source.

    Raises:
        GAPONetError: It is another robot's, or a recording differs from the pushed one.
    """
    dataset = Dataset.create(out, robot)
    sets = sets_under(files)
    total = sum(len(part.episodes) for part in sets)
    done = 0  # episodes that the dataset has
    with dataset.appending(), progress_bar("checking") as update:
        for part in sets:
            if part.ours is None:  # the set has no gaponet.json beside its info.json
                raise RemoteError(f"{part.path}: gaponet did not write this set")
            if new:
                dataset.set_provenance(**_provenance(part))
            lacking = [e for e in part.episodes if dataset.find(e["content_hash"]) is None]
            done += len(part.episodes) - len(lacking)
            logs = read_episodes(part, lacking, robot)
            for episode, log in zip(lacking, logs, strict=True):
                sequence = _pushed_sequence(episode, log, robot)
                # Empty if the recording was appended without, as Dataset.append allows.
                findings = episode["findings"] or measure_delays(sequence)
                dataset.append(sequence, findings, str(episode["content_hash"]))
                done += 1
                update(done, total, sequence.meta.motion)
    copy_sidecars(files / SIDECAR, dataset.path, dataset)


def _provenance(part: Set) -> dict[str, str]:
    """Return what a set that gaponet wrote states of licence and source."""
    assert part.ours is not None
    stated: dict[str, Any] = {**part.ours["dataset"]}
    return {name: str(stated[name]) for name in Stated.__annotations__ if name in stated}


def _pushed_sequence(episode: dict[str, Any], log: Log, robot: RobotSpec) -> Sequence:
    """Return the sequence of an episode, as it was recorded.

    Raises:
        RemoteError: It is not the one that was pushed.
    """
    meta = SequenceMeta(**(episode["stated"] | {"robot": robot.name}))
    sequence = replace(to_sequence(log, robot, meta), meta=meta)
    if sequence.content_hash() != episode["content_hash"]:
        raise RemoteError(f"'{meta.motion}' is not what was pushed, by its content hash; {AGAIN}")
    return sequence


def copy_sidecars(source: Path, out: Path, dataset: Dataset) -> None:
    """Copy splits, recipe and offsets of a dataset, checked, where `out` has none yet."""
    for name in COPIED_FILES:
        if _is_new(source / name, out / name):
            shutil.copyfile(source / name, out / name)
    for split in sorted((source / "splits").glob("*.json")):
        copy = out / "splits" / split.name
        if _is_new(split, copy):
            read_split(split, dataset)  # raises an error for a damaged one
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(split, copy)
    read_offsets(dataset)  # raises an error for damaged ones


def _is_new(file: Path, copy: Path) -> bool:
    return file.is_file() and not copy.exists()


def downloaded_robot(folder: Path) -> RobotSpec:
    """Load the robot among downloaded files; it must name no file outside its folder."""
    folder = folder / SIDECAR / STORED_ROBOT
    if not (folder / "robot.toml").is_file():
        raise DatasetError(f"{SIDECAR}/{STORED_ROBOT}: no robot.toml; push the dataset again")
    require_self_contained(folder)
    robot = load_robot(folder)
    model_hash(robot)  # raises an error for an invalid robot
    return robot
