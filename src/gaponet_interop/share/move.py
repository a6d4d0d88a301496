"""Push and pull. A push that was killed is gone on with: nothing that arrived is sent again. So is a pull.

A pull downloads beside its place, checks every file by its hash, lets the package read it all, checks what it read by
its hashes, and only then gives it its name: what is there under that name is whole.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from gaponet.errors import GAPONetError, UsageError
from gaponet.files import MARK, writing
from gaponet.progress import bar, noted
from gaponet.structure import parse_json
from gaponet_interop.share import dataset as datasets
from gaponet_interop.share import run as runs
from gaponet_interop.share.errors import RemoteError
from gaponet_interop.share.open import open_target
from gaponet_interop.share.target import INDEX, LARGEST_INDEX, Anew, ChangedError, Index, Kind, Part, Target, part_of

FORMAT = 1
AT_ONCE = 8  # downloads
SPARE = 1 << 28  # bytes of a disk that stay free


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
        prune: Remove from a bucket what earlier pushes left there, a day old or older. Who pulls an earlier state
            at that moment starts again.

    Raises:
        RemoteError: The place cannot be reached or written, or holds something else.
        GAPONetError: The dataset or run is damaged.
    """
    path = Path(path).resolve()
    kind = _kind(path)
    target = open_target(address)
    content = target.index(kind)
    there = _read(target, content)
    with _beside(path, "push") as folder, bar("reading") as update:
        _empty(folder)  # of a push that was killed
        if kind == "dataset":
            contents = datasets.lay_out(path, folder / "files", target.address, update)
            files = {f.relative_to(folder / "files").as_posix(): f for f in sorted((folder / "files").rglob("*"))
                     if f.is_file()}  # fmt: skip
        else:
            files, contents = runs.lay_out(path, folder, target.address)
        index = Index(FORMAT, kind, path.name, contents, {place: part_of(file) for place, file in files.items()})
        written = (json.dumps(asdict(index), indent=1) + "\n").encode()
        for last in (False, False, True):
            if there is not None and not replace:
                _require_newer(there, kind, contents, target.address)
            # Who pushes what is there already wants it mended.
            anew: Anew = "all" if replace else "damaged" if there and there.contents == contents else ""
            try:
                target.store(kind, files, written, private, content, anew)
                break
            except ChangedError:
                if last:
                    raise
                content = target.index(kind)
                there = _read(target, content)
    return Moved(kind, address, path, len(files), index.size, {"pruned": target.prune(index) if prune else 0})


def pull(address: str, out: str | Path) -> Moved:
    """Fetch what was pushed, checked by the hash of each file and each sequence; a pull that was killed goes on.

    Args:
        address: USER/NAME on the Hugging Face Hub (@REVISION behind it for a tag or commit), or s3://, gs:// or
            file:// and a folder.
        out: New or empty folder.

    Raises:
        RemoteError: Nothing there, a file has another hash, or what came is no dataset or run.
        UsageError: The folder holds something.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out}: exists and is not an empty folder; choose a new one")
    target = open_target(address)
    index = read_index(target, None)
    if index is None:
        raise RemoteError(f"{target.address}: nothing was pushed there")
    with _beside(out.absolute(), "pull") as folder:
        download(target, index, folder / "files")
        made = folder / "made"
        if made.exists():
            shutil.rmtree(made)
        try:
            if index.kind == "dataset":
                with bar("checking") as update:
                    facts = datasets.take_in(folder / "files", index, made, update)
            else:
                with writing(made, "run"):
                    facts = runs.take_in(folder / "files", index, made)
        except GAPONetError as error:
            _empty(folder)  # whatever it is, it is not to be gone on with
            raise RemoteError(f"{target.address}: {str(error).replace(str(folder), '')}") from None
        if out.exists():
            out.rmdir()
        made.rename(out)
        _empty(folder)
    return Moved(index.kind, address, out, len(index.files), index.size, facts)


def _kind(path: Path) -> Kind:
    if (path / "dataset.json").is_file():
        return "dataset"
    if (path / "split.json").is_file() and (path / "config.json").is_file():
        return "run"
    raise UsageError(f"{path}: neither a dataset (dataset.json) nor a run of gaponet train (split.json, config.json)")


def read_index(target: Target, kind: Kind | None) -> Index | None:
    """What is there, checked; None where nothing is."""
    return _read(target, target.index(kind))


def _read(target: Target, content: bytes | None) -> Index | None:
    if content is None:
        return None
    where = f"{target.address}: {INDEX}"
    index = parse_json(Index, content[:LARGEST_INDEX], where, RemoteError, "push it again")
    if index.format > FORMAT:
        raise RemoteError(
            f"{where}: format {index.format} is newer than this gaponet reads ({FORMAT}); upgrade gaponet"
        )
    return index


def _require_newer(there: Index, kind: Kind, contents: tuple[str, ...], address: str) -> None:
    """Refuse to take the place of what holds something that we do not."""
    lost = len(set(there.contents) - set(contents))
    if there.kind != kind or lost:
        what = (
            f"a {there.kind}" if there.kind != kind else f"{lost} sequences" if kind == "dataset" else "another network"
        )
        raise RemoteError(
            f"{address}: holds {what} that would be lost ('{there.name}'); push to another place, or say --replace"
        )


def download(target: Target, index: Index, folder: Path) -> None:
    """All files of the index below the folder; those that are there with the right hash stay."""
    folder.mkdir(exist_ok=True)
    missing = [(place, part) for place, part in index.files.items() if not _is(folder / place, part)]
    needed, free = sum(part.size for _, part in missing), shutil.disk_usage(folder).free
    if needed + SPARE > free:
        raise RemoteError(
            f"{target.address}: {needed / 1e9:.2f} GB are to come, {free / 1e9:.2f} GB of the disk are free"
        )

    def fetch(place: str, part: Part) -> str:
        (folder / place).unlink(missing_ok=True)
        target.fetch(place, part, folder)
        if not _is(folder / place, part):
            (folder / place).unlink(missing_ok=True)
            raise RemoteError(
                f"{target.address}: {place} came with another size or hash than {INDEX} says; push it again"
            )
        return place

    with bar("downloading") as update, ThreadPoolExecutor(AT_ONCE) as pool:
        told, jobs = noted(update, ""), [pool.submit(fetch, *one) for one in missing]
        try:
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                told(done, len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _is(file: Path, part: Part) -> bool:
    return file.is_file() and not file.is_symlink() and part_of(file) == part


@contextmanager
def _beside(path: Path, what: str) -> Iterator[Path]:
    """A working folder beside a path, for one process at a time; it goes where it is left empty."""
    place = path.parent if os.access(path.parent, os.W_OK) else Path(gettempdir())  # a disk that is only read
    folder = place / f"{MARK}-{what}-{path.name}"
    with writing(folder, what):
        yield folder
        _empty(folder)
    shutil.rmtree(folder)


def _empty(folder: Path) -> None:
    for child in folder.iterdir():
        if child.name != MARK:
            shutil.rmtree(child) if child.is_dir() else child.unlink()
