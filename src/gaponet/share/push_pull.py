"""Push and pull of datasets, runs and robots.

Both work in a hidden folder beside what is pushed or pulled, which gets its name when it is
complete. The next push or pull does not transfer again what a killed one has transferred.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from gaponet.base.errors import UsageError
from gaponet.base.files import FOLDER_MARKER, lock_folder, write_text
from gaponet.base.network import RemoteError
from gaponet.data.store import Dataset
from gaponet.share import dataset as datasets
from gaponet.share import robot as robots
from gaponet.share import run as runs
from gaponet.share.hub import Hub
from gaponet.share.readme import ModelFacts
from gaponet.share.remote import (
    FORMAT,
    INDEX,
    FileRecord,
    Index,
    Kind,
    file_errors,
    read_index,
)

MODELS: dict[Kind, Any] = {"run": runs, "robot": robots}  # of model repositories
LOST = {"dataset": "{} sequences", "run": "another network", "robot": "another robot"}


@dataclass(frozen=True)
class TransferResult:
    """Result of a push or a pull."""

    kind: Kind
    files: int  # number of files: all of a push, the downloaded ones of a pull
    size: int  # bytes of these files


def push(
    path: str | Path,
    address: str,
    private: bool = False,
    replace: bool = False,
    licence: str = "",
    trained_on: str = "",
) -> TransferResult:
    """Put a dataset, a run or an identified robot where others can pull it, with a card; what is
    there already is brought up to date.

    Args:
        path: Dataset, run or robot folder.
        address: USER/NAME on the Hugging Face Hub.
        private: Readable by its owner alone, if a new repository is made for it.
        replace: Also replace what this is no newer state of.
        licence: SPDX identifier for the card of a run or a robot; a dataset states its own.
        trained_on: Dataset of the Hub that a run or a robot was made from, USER/NAME, for its card.

    Raises:
        RemoteError: The place cannot be reached or written, or holds something else.
        GAPONetError: The dataset, run or robot is damaged.
    """
    path = Path(path).resolve()
    kind = _kind(path)
    if kind == "dataset" and (licence or trained_on):
        raise UsageError("--licence and --trained-on are for runs and robots; leave them out")
    facts = ModelFacts(licence, trained_on)
    hub = Hub(address)
    content = hub.index(kind)
    present = None if replace or content is None else read_index(hub.address, content)
    same = (
        present
        and kind == present.kind == "dataset"
        and datasets.is_pushed(path, hub.address, present)
    )
    if present and same and not hub.is_outdated(present):
        return TransferResult(kind, len(present.files), present.size(present.files))
    with _work_folder(path, "push") as folder:
        _clear(folder)  # files of a killed push
        files = folder / "files"
        files.mkdir()
        try:
            if kind == "dataset":
                contents = datasets.write_files(path, files, hub.address)
            else:
                contents = MODELS[kind].write_files(path, files, hub.address, facts)
            _require_newer(present, kind, contents, hub.address)
            records = {
                file.relative_to(files).as_posix(): FileRecord.of(file)
                for file in sorted(files.rglob("*"))
                if file.is_file()
            }
            index = Index(FORMAT, kind, path.name, contents, records)
            write_text(files / INDEX, index.text())
            hub.store(files, index, private)
        finally:
            _clear(folder)
    return TransferResult(kind, len(records), index.size(records))


def pull(address: str, out: str | Path) -> TransferResult:
    """Fetch what was pushed, checked by the hash of each file and each sequence; a pull that was
    killed goes on.

    A dataset that is there already gets the sequences that it lacks, and keeps all else as it is.

    Args:
        address: USER/NAME on the Hugging Face Hub; @REVISION behind it for a tag or commit.
        out: New or empty folder, or a dataset of that robot.

    Raises:
        RemoteError: Nothing is there, a file has another hash, or the content is no dataset, run or
            robot.
        UsageError: The folder holds something.
    """
    out = Path(out)
    present = Dataset(out) if (out / "dataset.json").is_file() else None
    if present is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; choose a new one")
    hub = Hub(address)
    index = read_index(hub.address, hub.index())
    if present is not None and index.kind != "dataset":
        raise UsageError(
            f"{out}: is a dataset, and {address} holds a {index.kind}; choose a new folder"
        )
    if present is not None and all(present.find(digest) for digest in index.contents):
        return TransferResult(index.kind, 0, 0)
    with _work_folder(out.absolute(), "pull") as folder:
        state = hashlib.sha256(index.text().encode()).hexdigest()[:16]
        _clear(folder, keep=state)  # files of a killed pull of another state
        work = folder / state
        work.mkdir(exist_ok=True)
        if index.kind == "dataset":
            fetched, new = _pull_dataset(hub, index, work, present)
        else:
            fetched, new = _pull_model(hub, index, work)
        if present is None:
            if out.exists():
                out.rmdir()
            new.rename(out)
        _clear(folder)
    return TransferResult(index.kind, len(fetched), index.size(fetched))


def _pull_dataset(
    hub: Hub, index: Index, work: Path, present: Dataset | None
) -> tuple[list[str], Path]:
    """Download what a dataset lacks, and add it to the dataset or to a new one; return the files
    and the dataset.
    """
    files = work / "files"
    files.mkdir(exist_ok=True)
    small = sorted(path for path in index.files if not datasets.is_recording_file(path))
    hub.download(small, index, files)
    with file_errors(hub.address, files):
        robot = datasets.downloaded_robot(files)
        recordings = datasets.missing_files(files, index, present)
    hub.download(recordings, index, files)
    dataset = work / "dataset" if present is None else present.path
    with file_errors(hub.address, files):
        datasets.add_missing(files, robot, dataset, new=present is None)
    return small + recordings, dataset


def _pull_model(hub: Hub, index: Index, work: Path) -> tuple[list[str], Path]:
    """Download and check a run or a robot; return its files and its folder."""
    files = sorted(index.files)
    model = MODELS[index.kind]
    with file_errors(hub.address, work):
        model.require_files(index)
    hub.download(files, index, work)
    with file_errors(hub.address, work):
        model.require_pushed(work, index)
    return files, work


def _kind(path: Path) -> Kind:
    if (path / "dataset.json").is_file():
        return "dataset"
    if (path / "split.json").is_file() and (path / "config.json").is_file():
        return "run"
    if (path / "robot.toml").is_file():
        return "robot"
    raise UsageError(
        f"{path}: neither a dataset, nor a run of gaponet train, nor a robot of gaponet identify"
    )


def _require_newer(
    present: Index | None, kind: Kind, contents: tuple[str, ...], address: str
) -> None:
    """Refuse to replace a push with content that this one lacks."""
    lost = set(present.contents) - set(contents) if present else set()
    if present and (present.kind != kind or lost):
        what = LOST[kind].format(len(lost))
        if present.kind != kind:
            what = f"a {present.kind}"
        hint = "push to another place, or say --replace"
        raise RemoteError(f"{address}: holds {what} that would be lost ('{present.name}'); {hint}")


@contextmanager
def _work_folder(path: Path, purpose: str) -> Iterator[Path]:
    """Hidden folder beside a path, for one process at a time; it is removed at the end if the
    block does not fail.
    """
    # a disk that is only read
    parent = path.parent if os.access(path.parent, os.W_OK) else Path(gettempdir())
    folder = parent / f"{FOLDER_MARKER}-{purpose}-{path.name}"
    with lock_folder(folder, purpose):
        yield folder
    shutil.rmtree(folder)


def _clear(folder: Path, keep: str = "") -> None:
    """Delete the content of a work folder, except its lock and one child."""
    for child in folder.iterdir():
        if child.name not in (FOLDER_MARKER, keep):
            shutil.rmtree(child) if child.is_dir() else child.unlink()
