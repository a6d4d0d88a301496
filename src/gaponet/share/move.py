"""Push and pull. A push that was killed is gone on with: nothing that arrived is sent again. So is a pull.

A pull downloads beside its place, checks every file by its hash, lets the package read it all, checks what it read by
its hashes, and only then gives it its name: what is there under that name is whole.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import MARK, writing
from gaponet.base.progress import bar
from gaponet.data.store import Dataset
from gaponet.share import dataset as datasets
from gaponet.share import run as runs
from gaponet.share.errors import RemoteError
from gaponet.share.open import open_target
from gaponet.share.reading import open_dataset
from gaponet.share.stream import LARGE, Pushed
from gaponet.share.target import (
    FORMAT,
    Anew,
    ChangedError,
    Index,
    Kind,
    Part,
    Pruned,
    download,
    read_content,
    read_index,
    send,
)

HOURS = 12.0  # that nothing is pruned which was written or replaced in them


@dataclass(frozen=True)
class Moved:
    """What is now there: which files it is made of, how many bytes, and facts by kind."""

    kind: Kind
    address: str
    path: Path
    files: int
    size: int
    facts: dict[str, Any]


def push(path: str | Path, address: str, private: bool = False, replace: bool = False, prune: bool = False) -> Moved:
    """Put a dataset or a run where others can pull it, with a card; one that is there already is brought up to date.

    Args:
        path: Dataset or run.
        address: USER/NAME on the Hugging Face Hub, or s3://, gs:// or file:// and a folder.
        private: Readable by its owner alone, where a new repository of the Hub is made for it.
        replace: Also where something is there of which this is no newer state; every file is sent anew.
        prune: Delete from a bucket what pushes before the last one left there, as `prune` does.

    Raises:
        RemoteError: The place cannot be reached or written, or holds something else.
        GAPONetError: The dataset or run is damaged.
    """
    path = Path(path).resolve()
    kind = _kind(path)
    target = open_target(address)
    content = target.index(kind)
    there = None if replace else read_content(target, content)
    with _beside(path, "push") as folder, bar("reading") as update:
        _empty(folder)  # of a push that was killed
        lay_out: Callable[[Anew], dict[str, Part]]
        if kind == "dataset":
            dataset, robot = open_dataset(path)
            contents = tuple(sorted(entry.hash for entry in dataset.select()))
            lay_out = partial(datasets.lay_out, dataset, robot, folder / "files", target, update)
        else:
            laid, contents = runs.lay_out(path, folder, target.address)
            lay_out = partial(send, target, laid)
        _require_newer(there, kind, contents, target.address)
        # Who pushes what is there already wants it mended.
        files = lay_out("all" if replace else "damaged" if there and there.contents == contents else "")
        index = Index(FORMAT, kind, path.name, contents, files)
        named = {part.sha256 for part in files.values()} | set(re.findall("[0-9a-f]{64}", str(content)))
        pruned = len(target.prune(named, HOURS, True).files) if prune else 0
        for last in (False, False, True):
            try:
                target.store(kind, index, private, content)
                break
            except ChangedError:
                if last:
                    raise
                content = target.index(kind)
                there = None if replace else read_content(target, content)
                _require_newer(there, kind, contents, target.address)
    return Moved(kind, address, path, len(files), index.size, {"pruned": pruned})


def prune(address: str, delete: bool = False, hours: float = HOURS) -> Pruned:
    """Find what earlier pushes left in a bucket and nothing names any more.

    Args:
        address: s3://, gs:// or file:// and a folder that was pushed to.
        delete: Delete it; else it is only counted.
        hours: What was written or replaced in the last so many hours stays: a push or a pull may be under way.

    Raises:
        RemoteError: Nothing was pushed there, or its index is damaged: then nothing is deleted.
    """
    target = open_target(address)
    index = read_index(target, None)
    if index is None:
        raise RemoteError(f"{target.address}: nothing was pushed there")
    return target.prune({part.sha256 for part in index.files.values()}, hours, delete)


def pull(address: str, out: str | Path) -> Moved:
    """Fetch what was pushed, checked by the hash of each file and each sequence; a pull that was killed goes on.

    A dataset that is there already gets the sequences that it lacks, and keeps all else as it is.

    Args:
        address: USER/NAME on the Hugging Face Hub (@REVISION behind it for a tag or commit), or s3://, gs:// or
            file:// and a folder.
        out: New or empty folder, or a dataset of that robot.

    Raises:
        RemoteError: Nothing there, a file has another hash, or what came is no dataset or run.
        UsageError: The folder holds something.
    """
    out = Path(out)
    known = Dataset(out) if (out / "dataset.json").is_file() else None
    if known is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; choose a new one")
    target = open_target(address)
    index = read_index(target, None)
    if index is None:
        raise RemoteError(f"{target.address}: nothing was pushed there")
    if known is not None and index.kind != "dataset":
        raise UsageError(f"{out}: is a dataset, and {target.address} holds a run; choose a new folder")
    if known is not None and all(known.find(digest) for digest in index.contents):
        return Moved(index.kind, address, out, 0, 0, {"sequences": 0})
    with _beside(out.absolute(), "pull") as folder:
        files, made = folder / "files", folder / "made"
        if index.kind == "dataset":
            moved = {place: part for place, part in index.files.items() if not LARGE.fullmatch(place)}
            download(target, moved, files)
            with _kept_if_good(folder, target.address):
                pushed = Pushed(target.address, index, folder)
                new = [entry for entry in pushed.entries if known is None or known.find(entry.hash) is None]
                large = {place: index.files[place] for place in pushed.places(new)}
            download(target, large, files)
            with _kept_if_good(folder, target.address), bar("checking") as update:
                made = pushed.path
                datasets.take_in(pushed, pushed.robot, files / datasets.BESIDE, made if known is None else out, update)
            moved, facts = moved | large, {"sequences": len(new)}
        else:
            moved = index.files
            download(target, moved, files)
            with _kept_if_good(folder, target.address), writing(made, "run"):
                facts = runs.take_in(files, index, made)
        if known is None:
            if out.exists():
                out.rmdir()
            made.rename(out)
        _empty(folder)
    return Moved(index.kind, address, out, len(moved), sum(part.size for part in moved.values()), facts)


def _kind(path: Path) -> Kind:
    if (path / "dataset.json").is_file():
        return "dataset"
    if (path / "split.json").is_file() and (path / "config.json").is_file():
        return "run"
    raise UsageError(f"{path}: neither a dataset (dataset.json) nor a run of gaponet train (split.json, config.json)")


def _require_newer(there: Index | None, kind: Kind, contents: tuple[str, ...], address: str) -> None:
    """Refuse to take the place of what holds something that we do not."""
    if there is None:
        return
    lost = len(set(there.contents) - set(contents))
    if there.kind != kind or lost:
        what = (
            f"a {there.kind}" if there.kind != kind else f"{lost} sequences" if kind == "dataset" else "another network"
        )
        raise RemoteError(
            f"{address}: holds {what} that would be lost ('{there.name}'); push to another place, or say --replace"
        )


@contextmanager
def _beside(path: Path, what: str) -> Iterator[Path]:
    """A working folder beside a path, for one process at a time; it goes where it is left empty."""
    place = path.parent if os.access(path.parent, os.W_OK) else Path(gettempdir())  # a disk that is only read
    folder = place / f"{MARK}-{what}-{path.name}"
    with writing(folder, what):
        yield folder
        _empty(folder)
    shutil.rmtree(folder)


@contextmanager
def _kept_if_good(folder: Path, address: str) -> Iterator[None]:
    """What came stays, for the next pull to go on with, unless it is not what it should be."""
    try:
        yield
    except GAPONetError as error:
        _empty(folder)
        text = str(error).replace(str(folder), "").removeprefix(f"{address}: ")
        raise RemoteError(f"{address}: {text}") from None


def _empty(folder: Path) -> None:
    for child in folder.iterdir():
        if child.name != MARK:
            shutil.rmtree(child) if child.is_dir() else child.unlink()
