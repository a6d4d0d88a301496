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
from gaponet.base.files import FOLDER_MARKER, clear_folder, lock_folder, write_text
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
# Kind → what a push would replace, {} being a number.
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
        replace: Replace what is there even if it has content that this lacks, such as sequences.
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
    hub = Hub(address)
    pushed = hub.pushed_index(kind)
    earlier = None
    if pushed is not None and not replace:
        earlier = read_index(hub.address, pushed)
    if earlier is not None and _is_up_to_date(path, kind, hub, earlier):
        return TransferResult(kind, len(earlier.files), earlier.size(earlier.files))
    with _work_folder(path, "push") as folder:
        clear_folder(folder)  # files of a killed push
        files = folder / "files"
        files.mkdir()
        try:
            if kind == "dataset":
                contents = datasets.write_files(path, files, hub.address)
            else:
                facts = ModelFacts(licence, trained_on)
                contents = MODELS[kind].write_files(path, files, hub.address, facts)
            if earlier is not None:
                _require_newer(earlier, kind, contents, hub.address)
            index = Index(FORMAT, kind, path.name, contents, _records_below(files))
            write_text(files / INDEX, index.text())
            hub.store(files, index, private)
        finally:
            clear_folder(folder)
    return TransferResult(kind, len(index.files), index.size(index.files))


def _is_up_to_date(path: Path, kind: Kind, hub: Hub, earlier: Index) -> bool:
    """Return True if the earlier push was of this state of a dataset and is whole at the Hub.

    Of runs and robots nothing tells that before their files are written.
    """
    if kind != "dataset" or earlier.kind != "dataset":
        return False
    return datasets.is_pushed(path, hub.address, earlier) and not hub.is_outdated(earlier)


def _records_below(folder: Path) -> dict[str, FileRecord]:
    """Return path → size and hash of all files below a folder."""
    records = {}
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            records[file.relative_to(folder).as_posix()] = FileRecord.of(file)
    return records


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
    own = None  # the dataset that is there already
    if (out / "dataset.json").is_file():
        own = Dataset(out)
    else:
        _require_empty(out)
    hub = Hub(address)
    index = read_index(hub.address, hub.pushed_index())
    if own is not None:
        if index.kind != "dataset":
            raise UsageError(
                f"{out}: is a dataset, and {address} holds a {index.kind}; choose a new folder"
            )
        if all(own.find(digest) for digest in index.contents):
            return TransferResult(index.kind, 0, 0)
    with _work_folder(out.absolute(), "pull") as folder:
        # A killed pull goes on in the folder of the state that it pulled; others are removed.
        state = hashlib.sha256(index.text().encode()).hexdigest()[:16]
        clear_folder(folder, keep=state)
        work = folder / state
        work.mkdir(exist_ok=True)
        if index.kind == "dataset":
            fetched, new = _pull_dataset(hub, index, work, own)
        else:
            fetched, new = _pull_model(hub, index, work)
        if own is None:
            if out.exists():
                out.rmdir()
            new.rename(out)
        clear_folder(folder)
    return TransferResult(index.kind, len(fetched), index.size(fetched))


def _require_empty(folder: Path) -> None:
    """Refuse a file, and a folder that holds something."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not an empty folder; choose a new one")


def _pull_dataset(
    hub: Hub, index: Index, work: Path, own: Dataset | None
) -> tuple[list[str], Path]:
    """Download the sequences that the user's own dataset lacks, and add them to it, or all to a new
    one in `work`.

    Return the downloaded files, and the folder of the dataset.
    """
    files = work / "files"
    files.mkdir(exist_ok=True)
    small = sorted(path for path in index.files if not datasets.is_recording_file(path))
    hub.download(small, index, files)
    with file_errors(hub.address, files):
        robot = datasets.downloaded_robot(files)
        recordings = datasets.missing_files(files, index, own)
    hub.download(recordings, index, files)
    dataset = work / "dataset" if own is None else own.path
    with file_errors(hub.address, files):
        datasets.add_missing(files, robot, dataset, new=own is None)
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


def _require_newer(earlier: Index, kind: Kind, contents: tuple[str, ...], address: str) -> None:
    """Refuse to replace an earlier push that has content which this one lacks."""
    lost = set(earlier.contents) - set(contents)
    if earlier.kind != kind:
        what = f"a {earlier.kind}"
    elif lost:
        what = LOST[kind].format(len(lost))
    else:
        return
    hint = "push to another place, or say --replace"
    raise RemoteError(f"{address}: holds {what} that would be lost ('{earlier.name}'); {hint}")


@contextmanager
def _work_folder(path: Path, purpose: str) -> Iterator[Path]:
    """Hidden folder beside a path, for one process at a time; it is removed at the end if the
    block does not fail.
    """
    parent = path.parent
    if not os.access(parent, os.W_OK):  # a disk that is only read
        parent = Path(gettempdir())
    folder = parent / f"{FOLDER_MARKER}-{purpose}-{path.name}"
    with lock_folder(folder, purpose):
        yield folder
    shutil.rmtree(folder)
