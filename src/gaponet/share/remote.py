"""The index file that lists what was pushed to a repository."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from annotated_types import Interval, Len

from gaponet.base.errors import GAPONetError
from gaponet.base.network import RemoteError
from gaponet.base.structure import Name, Sha256, parse_json

Kind = Literal["dataset", "run", "robot"]
FORMAT = 1
INDEX = "gaponet.json"
MAX_INDEX_BYTES = 96 << 20  # 67 bytes per sequence
MAX_FOLDER_DEPTH = 8
MAX_PATH_LENGTH = 400  # characters
MIN_FREE_BYTES = 1 << 28  # disk space that a download leaves free


@dataclass(frozen=True)
class FileRecord:
    """Size of a file in bytes and SHA-256 of its content."""

    size: Annotated[int, Interval(ge=0, le=1 << 40)]
    sha256: Sha256

    @classmethod
    def of(cls, file: Path) -> FileRecord:
        """Measure a file."""
        with file.open("rb") as content:
            return cls(file.stat().st_size, hashlib.file_digest(content, "sha256").hexdigest())


@dataclass(frozen=True)
class Index:
    """Content of gaponet.json: the list of pushed files.

    Attributes:
        contents: Content hashes of a dataset's sequences, or the hash of a run's network.
        files: Files by their path below the place, with forward slashes.
    """

    format: int
    kind: Kind
    name: Name
    contents: Annotated[tuple[Name, ...], Len(1, 1_000_000)]
    files: Annotated[dict[str, FileRecord], Len(1, 20_000)]

    def __post_init__(self) -> None:
        folders = set[str]()
        for path in self.files:
            if not _is_inside_folder(path):
                raise RemoteError(f"files: '{path}' is not the name of a file inside a folder")
            folders.update(str(folder) for folder in PurePosixPath(path).parents)
        if len({path.casefold() for path in self.files}) < len(self.files):
            raise RemoteError("files: two names differ in capitals alone")
        both = folders & self.files.keys()
        if both:
            raise RemoteError(f"files: '{min(both)}' is a file and a folder")

    def text(self) -> str:
        """Return the content of gaponet.json."""
        return json.dumps(asdict(self), indent=1) + "\n"

    def size(self, paths: Collection[str]) -> int:
        """Return the total bytes of some files."""
        return sum(self.files[path].size for path in paths)


def _is_inside_folder(path: str) -> bool:
    """Return True for the path of a pushed file, which no system takes for a place outside the
    folder.
    """
    if ":" in path or path == INDEX:
        return False
    names = path.split("/")
    if len(names) > MAX_FOLDER_DEPTH or len(path) > MAX_PATH_LENGTH:
        return False
    return all(_is_visible_name(name) for name in names)


def _is_visible_name(name: str) -> bool:
    """Return True for the name of a file or folder that is not hidden, and not .. or empty."""
    if not name or name.startswith("."):
        return False
    return "\\" not in name and name.isprintable()


def lost_race(address: str) -> RemoteError:
    """Return the error of the slower one of two simultaneous pushes."""
    return RemoteError(
        f"{address}: somebody else pushed at the same time, and nothing was replaced; push again"
    )


def read_index(address: str, content: bytes | None) -> Index:
    """Parse and check the content of gaponet.json.

    Raises:
        RemoteError: It is missing, damaged or of a newer format.
    """
    if content is None:
        raise RemoteError(f"{address}: nothing was pushed there")
    where = f"{address}: {INDEX}"
    index = parse_json(Index, content, where, RemoteError, "push it again, with --replace")
    if index.format > FORMAT:
        raise RemoteError(
            f"{where}: format {index.format} is newer than this gaponet reads; upgrade gaponet"
        )
    return index


def require_space(address: str, size: int, folder: Path) -> None:
    """Refuse a download that the disk does not hold; size: bytes."""
    free = shutil.disk_usage(folder).free
    if size + MIN_FREE_BYTES > free:
        raise RemoteError(
            f"{address}: has {size / 1e9:.2f} GB; {free / 1e9:.2f} GB of the disk are free"
        )


def require_pushed_files(address: str, index: Index, paths: list[str], folder: Path) -> None:
    """Compare downloaded files with the index by size and hash; one that differs is deleted.

    Raises:
        RemoteError: A file differs.
    """
    for path in paths:
        if FileRecord.of(folder / path) != index.files[path]:
            (folder / path).unlink()
            raise RemoteError(
                f"{address}: {path} is not the file that was pushed, by its size or hash; push it "
                "again with --replace"
            )


@contextmanager
def file_errors(address: str, folder: Path) -> Iterator[None]:
    """Turn errors about downloaded files into a RemoteError that names the address instead of the
    folder.
    """
    try:
        yield
    except GAPONetError as error:
        text = str(error).replace(f"{folder}/", "").removeprefix(f"{address}: ")
        raise RemoteError(f"{address}: {text}") from None
