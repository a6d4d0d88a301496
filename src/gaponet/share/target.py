"""Places that datasets and runs are pushed to, and the index that says what lies there."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

from annotated_types import Interval, Len

from gaponet.base.errors import GAPONetError
from gaponet.base.structure import Name, Sha256, parse_json
from gaponet.share.errors import RemoteError

Kind = Literal["dataset", "run"]
FORMAT = 1
INDEX = "gaponet.json"
MAX_INDEX_BYTES = 96 << 20  # 67 bytes per sequence
MAX_DEPTH = 8  # folders below each other
MIN_FREE_BYTES = 1 << 28  # of a disk, after a download
BUGS = (AssertionError, AttributeError, ModuleNotFoundError, NameError, TypeError)


@dataclass(frozen=True)
class Part:
    """A file: its size in bytes and the SHA-256 of its content."""

    size: Annotated[int, Interval(ge=0, le=1 << 40)]
    sha256: Sha256

    @classmethod
    def of(cls, file: Path) -> Part:
        """Size and hash of a file."""
        with file.open("rb") as content:
            return cls(file.stat().st_size, hashlib.file_digest(content, "sha256").hexdigest())


@dataclass(frozen=True)
class Index:
    """gaponet.json: what was pushed.

    Attributes:
        contents: Hashes of the sequences of a dataset, or of a run's network.
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
            if strange or ":" in path or len(parts) > MAX_DEPTH or len(path) > 400 or path == INDEX:
                raise RemoteError(f"files: '{path}' is not the name of a file inside a folder")
        if len({path.casefold() for path in self.files}) < len(self.files):
            raise RemoteError("files: two names differ in capitals alone")

    def text(self) -> str:
        """Content of gaponet.json."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def size(self, places: list[str]) -> int:
        """Bytes of some files."""
        return sum(self.files[place].size for place in places)


class Target(Protocol):
    """A place for one dataset or run. Errors of the network and of the place become RemoteError."""

    address: str

    def index(self, kind: Kind | None = None) -> bytes | None:
        """Content of gaponet.json, None if nothing was pushed; the Hub looks for this kind alone, if given."""

    def sizes(self, places: list[str], index: Index) -> list[int | None]:
        """Bytes of files of the index as the place has them; None for a missing one."""

    def fetch(self, places: list[str], index: Index, folder: Path) -> None:
        """Download files of the index into a folder, except those that an earlier download left there."""

    def store(self, folder: Path, index: Index, private: bool, replace: bool, prune: bool) -> int:
        """Upload from a folder what the place lacks, then the index at once; returns the number of pruned files.

        Args:
            private: A new repository is readable by its owner alone.
            replace: Upload every file.
            prune: Delete files of earlier pushes.

        Raises:
            RemoteError: Somebody else pushed since `index` was called.
        """


def read_index(target: Target, content: bytes | None) -> Index:
    """Parse and check the content of gaponet.json.

    Raises:
        RemoteError: It is missing, damaged or of a newer format.
    """
    if content is None:
        raise RemoteError(f"{target.address}: nothing was pushed there")
    where = f"{target.address}: {INDEX}"
    index = parse_json(Index, content, where, RemoteError, "push it again, with --replace")
    if index.format > FORMAT:
        raise RemoteError(f"{where}: format {index.format} is newer than this gaponet reads; upgrade gaponet")
    return index


def download(target: Target, index: Index, places: list[str], folder: Path) -> None:
    """Download files of an index into a folder, and compare their sizes and hashes.

    Raises:
        RemoteError: A file is missing or differs, or the disk is too small.
    """
    folder.mkdir(exist_ok=True)
    wrong = "{}: {} is not the file that was pushed, by its size or hash; push it again, with --replace"
    for place, size in zip(places, target.sizes(places, index), strict=True):
        if size != index.files[place].size:
            raise RemoteError(wrong.format(target.address, place))
    needed, free = index.size(places), shutil.disk_usage(folder).free
    if needed + MIN_FREE_BYTES > free:
        raise RemoteError(f"{target.address}: has {needed / 1e9:.2f} GB; {free / 1e9:.2f} GB of the disk are free")
    target.fetch(places, index, folder)
    for place in places:
        if Part.of(folder / place) != index.files[place]:
            (folder / place).unlink()
            raise RemoteError(wrong.format(target.address, place))


@contextmanager
def reaching(address: str, *but: type[Exception]) -> Iterator[None]:
    """Turn errors of the network libraries into a RemoteError with the address and without secrets."""
    try:
        yield
    except Exception as error:
        if isinstance(error, (GAPONetError, *BUGS, *but)):
            raise
        text = re.sub(r"\?\S+", "?…", " ".join(str(error).split()))  # a query may hold a signature
        missing, refused = (isinstance(error, kind) for kind in (FileNotFoundError, PermissionError))
        why = "not found: " * missing + "no permission: " * refused
        raise RemoteError(f"{address}: {why}{text[:300] or type(error).__name__}") from None


@contextmanager
def naming(address: str, folder: Path) -> Iterator[None]:
    """Turn errors about downloaded files into a RemoteError that names the address instead of the folder."""
    try:
        yield
    except GAPONetError as error:
        text = str(error).replace(f"{folder}/", "").removeprefix(f"{address}: ")
        raise RemoteError(f"{address}: {text}") from None
