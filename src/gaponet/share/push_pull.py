"""Push and pull of datasets and runs.

Both work in a hidden folder beside the dataset or run, which gets its name when it is complete. The next push or pull
does not transfer again what a killed one has transferred.
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

from gaponet.base.errors import UsageError
from gaponet.base.files import FOLDER_MARKER, lock_folder, write_text
from gaponet.data.store import Dataset
from gaponet.share import dataset as datasets
from gaponet.share import run as runs
from gaponet.share.remote import (
    FORMAT,
    INDEX,
    FileRecord,
    Index,
    Kind,
    RemoteError,
    download,
    file_errors,
    read_index,
)
from gaponet.share.stream import RemoteDataset, open_remote


@dataclass(frozen=True)
class TransferResult:
    """Result of a push or a pull."""

    kind: Kind  # dataset or run
    files: int  # number of files: all of a push, the downloaded ones of a pull
    size: int  # bytes of these files
    pruned: int = 0  # number of deleted files of earlier pushes


def push(
    path: str | Path,
    address: str,
    private: bool = False,
    replace: bool = False,
    prune: bool = False,
) -> TransferResult:
    """Put a dataset or a run where others can pull it, with a card; one that is there already is brought up to date.

    Args:
        path: Dataset or run.
        address: USER/NAME on the Hugging Face Hub, or s3://, gs:// or file:// and a folder.
        private: Readable by its owner alone, if a new repository of the Hub is made for it.
        replace: Also replace what this is no newer state of; upload every file to a bucket.
        prune: Delete files of earlier pushes from a bucket: those that neither this push nor the one before it uses
            and that are older than a day.

    Raises:
        RemoteError: The place cannot be reached or written, or holds something else.
        GAPONetError: The dataset or run is damaged.
    """
    path = Path(path).resolve()
    kind, remote = _kind(path), open_remote(address)
    content = remote.index(kind)
    present = None if replace or content is None else read_index(remote, content)
    same = (
        present
        and kind == present.kind == "dataset"
        and datasets.is_pushed(path, remote.address, present)
    )
    if present and same and not remote.outdated(present):
        pruned = remote.prune(present) if prune else 0
        return TransferResult(kind, len(present.files), present.size(present.files), pruned)
    with _work_folder(path, "push") as folder:
        _clear(folder)  # files of a killed push
        files = folder / "files"
        files.mkdir()
        try:
            contents = (datasets if kind == "dataset" else runs).write_files(
                path, files, remote.address
            )
            _require_newer(present, kind, contents, remote.address)
            records = {
                file.relative_to(files).as_posix(): FileRecord.of(file)
                for file in sorted(files.rglob("*")) if file.is_file()
            }  # fmt: skip
            index = Index(FORMAT, kind, path.name, contents, records)
            write_text(files / INDEX, index.text())
            remote.store(files, index, records if replace else remote.outdated(index), private)
            pruned = remote.prune(index) if prune else 0
        finally:
            _clear(folder)
    return TransferResult(kind, len(records), index.size(records), pruned)


def pull(address: str, out: str | Path) -> TransferResult:
    """Fetch what was pushed, checked by the hash of each file and each sequence; a pull that was killed goes on.

    A dataset that is there already gets the sequences that it lacks, and keeps all else as it is.

    Args:
        address: USER/NAME on the Hugging Face Hub (@REVISION behind it for a tag or commit), or s3://, gs:// or
            file:// and a folder.
        out: New or empty folder, or a dataset of that robot.

    Raises:
        RemoteError: Nothing is there, a file has another hash, or the content is no dataset or run.
        UsageError: The folder holds something.
    """
    out = Path(out)
    present = Dataset(out) if (out / "dataset.json").is_file() else None
    if present is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; choose a new one")
    remote = open_remote(address)
    index = read_index(remote, remote.index())
    if present is not None and index.kind != "dataset":
        raise UsageError(
            f"{out}: is a dataset, and {remote.address} holds a run; choose a new folder"
        )
    if present is not None and all(present.find(digest) for digest in index.contents):
        return TransferResult(index.kind, 0, 0)
    with _work_folder(out.absolute(), "pull") as folder:
        state = hashlib.sha256(index.text().encode()).hexdigest()[:16]
        _clear(folder, keep=state)  # files of a killed pull of another state
        work = folder / state
        work.mkdir(exist_ok=True)
        if index.kind == "dataset":
            pushed = RemoteDataset(remote, index, work)
            fetched = pushed.fetch(
                [e for e in pushed.entries if present is None or present.find(e.hash) is None]
            )
            new = work / "dataset"
            datasets.add_missing(
                pushed, pushed.robot, new if present is None else out, new=present is None
            )
        else:
            fetched, new = sorted(index.files), work
            with file_errors(remote.address, work):
                runs.require_run_files(index)
                download(remote, index, fetched, work)
                runs.require_pushed_run(work, index)
        if present is None:
            if out.exists():
                out.rmdir()
            new.rename(out)
        _clear(folder)
    return TransferResult(index.kind, len(fetched), index.size(fetched))


def _kind(path: Path) -> Kind:
    if (path / "dataset.json").is_file():
        return "dataset"
    if (path / "split.json").is_file() and (path / "config.json").is_file():
        return "run"
    raise UsageError(
        f"{path}: neither a dataset nor a run of gaponet train; send a robot folder as a .zip"
    )


def _require_newer(
    present: Index | None, kind: Kind, contents: tuple[str, ...], address: str
) -> None:
    """Refuse to replace a push with content that this one lacks."""
    lost = set(present.contents) - set(contents) if present else set()
    if present and (present.kind != kind or lost):
        what = "another network" if kind == "run" else f"{len(lost)} sequences"
        what = what if present.kind == kind else f"a {present.kind}"
        hint = "push to another place, or say --replace"
        raise RemoteError(f"{address}: holds {what} that would be lost ('{present.name}'); {hint}")


@contextmanager
def _work_folder(path: Path, purpose: str) -> Iterator[Path]:
    """Hidden folder beside a path, for one process at a time; it is removed at the end if the block does not fail."""
    parent = (
        path.parent if os.access(path.parent, os.W_OK) else Path(gettempdir())
    )  # a disk that is only read
    folder = parent / f"{FOLDER_MARKER}-{purpose}-{path.name}"
    with lock_folder(folder, purpose):
        yield folder
    shutil.rmtree(folder)


def _clear(folder: Path, keep: str = "") -> None:
    """Delete the content of a work folder, except its lock and one child."""
    for child in folder.iterdir():
        if child.name not in (FOLDER_MARKER, keep):
            shutil.rmtree(child) if child.is_dir() else child.unlink()
