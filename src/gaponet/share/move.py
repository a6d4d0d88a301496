"""Push and pull: lay out and upload, download and check.

Both work in a hidden folder beside the dataset or run. A file that a killed push or pull has transferred is not
transferred again.
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
from gaponet.base.files import FOLDER_MARKER, lock_folder
from gaponet.data.store import Dataset
from gaponet.share import dataset as datasets
from gaponet.share import run as runs
from gaponet.share.errors import RemoteError
from gaponet.share.places import open_target
from gaponet.share.stream import Pushed
from gaponet.share.target import FORMAT, INDEX, Index, Kind, Part, download, naming, read_index


@dataclass(frozen=True)
class Moved:
    """Result of a push or a pull: number and bytes of the files, and number of deleted files of earlier pushes."""

    kind: Kind
    path: Path
    files: int
    size: int
    pruned: int = 0


def push(path: str | Path, address: str, private: bool = False, replace: bool = False, prune: bool = False) -> Moved:
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
    kind, target = _kind(path), open_target(address)
    content = target.index(kind)
    there = None if replace or content is None else read_index(target, content)
    with _beside(path, "push") as folder:
        _empty(folder)  # what a killed push left
        files = folder / "files"
        files.mkdir()
        try:
            contents = (datasets if kind == "dataset" else runs).lay_out(path, files, target.address)
            _require_newer(there, kind, contents, target.address)
            laid = sorted(file for file in files.rglob("*") if file.is_file())
            parts = {file.relative_to(files).as_posix(): Part.of(file) for file in laid}
            index = Index(FORMAT, kind, path.name, contents, parts)
            (files / INDEX).write_text(index.text(), encoding="utf-8")
            pruned = target.store(files, index, private, replace, prune)
        finally:
            _empty(folder)
    return Moved(kind, path, len(parts), index.size(list(parts)), pruned)


def pull(address: str, out: str | Path) -> Moved:
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
    known = Dataset(out) if (out / "dataset.json").is_file() else None
    if known is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; choose a new one")
    target = open_target(address)
    index = read_index(target, target.index())
    if known is not None and index.kind != "dataset":
        raise UsageError(f"{out}: is a dataset, and {target.address} holds a run; choose a new folder")
    if known is not None and all(known.find(digest) for digest in index.contents):
        return Moved(index.kind, out, 0, 0)
    with _beside(out.absolute(), "pull") as folder:
        state = hashlib.sha256(index.text().encode()).hexdigest()[:16]
        _empty(folder, state)  # what a killed pull of another state left
        work = folder / state
        work.mkdir(exist_ok=True)
        if index.kind == "dataset":
            pushed = Pushed(target, index, work)
            fetched = pushed.fetch([e for e in pushed.entries if known is None or known.find(e.hash) is None])
            datasets.take_in(pushed, pushed.robot, out)
        else:
            fetched = sorted(index.files)
            with naming(target.address, work):
                runs.require_run(index)
                download(target, index, fetched, work)
                runs.take_in(work, index, out)
        _empty(folder)
    return Moved(index.kind, out, len(fetched), index.size(fetched))


def _kind(path: Path) -> Kind:
    if (path / "dataset.json").is_file():
        return "dataset"
    if (path / "split.json").is_file() and (path / "config.json").is_file():
        return "run"
    raise UsageError(f"{path}: neither a dataset (dataset.json) nor a run of gaponet train (split.json, config.json)")


def _require_newer(there: Index | None, kind: Kind, contents: tuple[str, ...], address: str) -> None:
    """Refuse to replace what holds something that this push does not."""
    lost = set(there.contents) - set(contents) if there else set()
    if there and (there.kind != kind or lost):
        what = "another network" if kind == "run" else f"{len(lost)} sequences"
        what = what if there.kind == kind else f"a {there.kind}"
        hint = "push to another place, or say --replace"
        raise RemoteError(f"{address}: holds {what} that would be lost ('{there.name}'); {hint}")


@contextmanager
def _beside(path: Path, what: str) -> Iterator[Path]:
    """A working folder beside a path, for one process at a time; it is removed if it is empty at the end."""
    place = path.parent if os.access(path.parent, os.W_OK) else Path(gettempdir())  # a disk that is only read
    folder = place / f"{FOLDER_MARKER}-{what}-{path.name}"
    with lock_folder(folder, what):
        yield folder
    shutil.rmtree(folder)


def _empty(folder: Path, but: str = "") -> None:
    for child in folder.iterdir():
        if child.name not in (FOLDER_MARKER, but):
            shutil.rmtree(child) if child.is_dir() else child.unlink()
