"""Places that datasets and runs are pushed to, and what all of them can do."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

from annotated_types import Interval, Len

from gaponet.base.progress import bar, noted
from gaponet.base.structure import Name, Sha256, parse_json
from gaponet.base.text import without_credentials
from gaponet.share.errors import RemoteError

Kind = Literal["dataset", "run"]
Anew = Literal["", "damaged", "all"]
FORMAT = 1
INDEX = "gaponet.json"  # names every file with its size and hash; a place without one holds nothing of ours
LARGEST_INDEX = 96 << 20  # bytes; 67 of each sequence
BLOCK = 1 << 20  # bytes read at once
DEEPEST = 8  # folders below each other
AT_ONCE = 8  # downloads
SPARE = 1 << 28  # bytes of a disk that stay free


@dataclass(frozen=True)
class Part:
    """A file: its size in bytes and the SHA-256 of its content."""

    size: Annotated[int, Interval(ge=0, le=1 << 40)]
    sha256: Sha256


@dataclass(frozen=True)
class Index:
    """gaponet.json: what was pushed.

    Attributes:
        contents: Hashes of what it is about: of each sequence of a dataset; of a run's network.
        files: The files by their path below the place, with slashes.
    """

    format: int
    kind: Kind
    name: Name
    contents: Annotated[tuple[Name, ...], Len(1, 1_000_000)]
    files: Annotated[dict[str, Part], Len(1, 20_000)]

    def __post_init__(self) -> None:
        for path in self.files:
            parts = path.split("/")
            strange = any(p in ("", "..") or p.startswith(".") or "\\" in p or not p.isprintable() for p in parts)
            if strange or ":" in path or len(parts) > DEEPEST or len(path) > 400 or path == INDEX:
                raise RemoteError(f"files: '{path}' is not the name of a file inside a folder")
        if len({path.casefold() for path in self.files}) < len(self.files):
            raise RemoteError("files: two names differ in capitals alone")
        if {parent for path in self.files for parent in _parents(path)} & self.files.keys():
            raise RemoteError("files: a file stands where a folder does")

    @property
    def size(self) -> int:
        """Bytes in all."""
        return sum(part.size for part in self.files.values())


def _parents(path: str) -> Iterator[str]:
    while "/" in path:
        path = path.rpartition("/")[0]
        yield path


@dataclass(frozen=True)
class Pruned:
    """Files in a bucket that no index names, and their bytes; how many others may still be in use."""

    files: list[str]
    size: int
    young: int


class ChangedError(RemoteError):
    """Somebody else pushed to the place since its index was read."""


class Target(Protocol):
    """A place for one dataset or run. What is stored is whole and replaces what was there at once, or not at all.

    Errors of the network and of the place become RemoteError.
    """

    address: str
    at_once: bool

    def index(self, kind: Kind | None = None) -> bytes | None:
        """Content of gaponet.json, at most LARGEST_INDEX bytes; None where nothing is there yet.

        Args:
            kind: Where datasets and runs live apart: look for this kind alone.

        Raises:
            RemoteError: The place cannot be reached, or holds something else.
        """

    def holds(self, path: str, part: Part, anew: Anew) -> bool:
        """Whether a file is there already, and need not be made or sent.

        Args:
            anew: What is not believed: nothing, what is read back with another content, or anything.
        """

    def send(self, path: str, file: Path, part: Part) -> None:
        """Bring a file; it must stay until `store` returns, unless the place takes files `at_once`."""

    def store(self, kind: Kind, index: Index, private: bool, there: bytes | None) -> None:
        """Make what was sent, and what is held, be there under the names of the index, instead of what was.

        Args:
            private: Where the place is made anew and knows of it: readable by its owner alone.
            there: The index that was read, which this one takes the place of.

        Raises:
            ChangedError: Another index is there now; it stays.
        """

    def prune(self, named: set[str], hours: float, delete: bool) -> Pruned:
        """Look for files without a name that no push or pull of the last hours can need, and delete them if asked to.

        Args:
            named: SHA-256 of those that have one.
        """

    def fetch(self, path: str, part: Part, folder: Path) -> None:
        """Copy one file of the index into a folder, under its path; its hash is the caller's to look at."""


def written(index: Index) -> bytes:
    """gaponet.json."""
    return (json.dumps(asdict(index), indent=1) + "\n").encode()


def send(target: Target, files: Mapping[str, Path], anew: Anew) -> dict[str, Part]:
    """Send those files that a place does not hold; returns what they are."""
    parts = {place: part_of(file) for place, file in files.items()}
    for place, part in parts.items():
        if not target.holds(place, part, anew):
            target.send(place, files[place], part)
    return parts


def read_index(target: Target, kind: Kind | None) -> Index | None:
    """What is there, checked; None where nothing is."""
    return read_content(target, target.index(kind))


def read_content(target: Target, content: bytes | None) -> Index | None:
    """What an index that was read says, checked."""
    if content is None:
        return None
    where = f"{target.address}: {INDEX}"
    index = parse_json(Index, content[:LARGEST_INDEX], where, RemoteError, "push it again, with --replace")
    if index.format > FORMAT:
        raise RemoteError(
            f"{where}: format {index.format} is newer than this gaponet reads ({FORMAT}); upgrade gaponet"
        )
    return index


def download(target: Target, files: Mapping[str, Part], folder: Path) -> None:
    """Files of an index, below the folder; those that are there with the right hash stay."""
    folder.mkdir(exist_ok=True)
    missing = [(place, part) for place, part in files.items() if not _is(folder / place, part)]
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


def part_of(file: Path) -> Part:
    """Size and hash of a file."""
    digest = hashlib.sha256()
    with file.open("rb") as content:
        while block := content.read(BLOCK):
            digest.update(block)
    return Part(file.stat().st_size, digest.hexdigest())


@contextmanager
def reaching(address: str, *errors: type[Exception], but: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Errors of these types, and of the operating system's network, become a RemoteError with the address."""
    try:
        yield
    except Exception as error:
        if isinstance(error, (RemoteError, *but)) or not isinstance(error, (*errors, OSError)):
            raise
        cause = error.__cause__ or error
        text = without_credentials(" ".join(str(cause).split())) or type(cause).__name__
        raise RemoteError(f"{address}: {text[:300]}") from None
