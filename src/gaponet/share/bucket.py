"""Object storage through pyarrow's own file systems: s3://, gs://, and file:// for a disk that is shared.

    PLACE/sha256/<hash>   the files, each under its hash: written again only where its content is another
    PLACE/gaponet.json    which of them belong together, and their names; written last

No object is renamed or appended to. What an earlier push left and no index names stays there until it is pruned.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gaponet.base.files import MARK, whole
from gaponet.base.text import without_credentials
from gaponet.share.errors import RemoteError
from gaponet.share.target import (
    BLOCK,
    INDEX,
    LARGEST_INDEX,
    Anew,
    ChangedError,
    Index,
    Kind,
    Part,
    Pruned,
    reaching,
    written,
)

if TYPE_CHECKING:
    from pyarrow import NativeFile
    from pyarrow.fs import FileInfo

OBJECTS = "sha256"
OLD = 6 * 3600  # s: what has had no name for longer may be gone in a moment, and is sent again
PATIENCE = 20  # s that a request to gs:// is tried again; 15 minutes where nobody says, s3:// gives up after 6


class Bucket:
    """A `Target` in object storage; credentials are found as pyarrow's file systems find them."""

    at_once = True

    def __init__(self, address: str) -> None:
        """
        Args:
            address: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or file:///FOLDER, with pyarrow's options behind a ?.
        """
        from pyarrow import ArrowException
        from pyarrow.fs import FileSystem

        self.address = without_credentials(address.partition("?")[0])
        self._errors = (ArrowException, ValueError)
        if address.startswith(("gs:", "gcs:")) and "retry_limit_seconds=" not in address:
            address += f"{'&' if '?' in address else '?'}retry_limit_seconds={PATIENCE}"
        with reaching(self.address, *self._errors):
            self.files, self.root = FileSystem.from_uri(address)
        self.root = self.root.rstrip("/")
        self._index, self._since = b"", 0.0  # that was read last, and since when it has been there
        self._there: dict[str, FileInfo] | None = None  # objects by their hash, as they were listed first

    def index(self, kind: Kind | None = None) -> bytes | None:
        from pyarrow.fs import FileSelector, FileType

        place, self._index = f"{self.root}/{INDEX}", b""
        with reaching(self.address, *self._errors):
            info = self.files.get_file_info(place)
            if info.type == FileType.File:
                if info.size > LARGEST_INDEX:
                    raise RemoteError(f"{self.address}: {INDEX} has more than {LARGEST_INDEX >> 20} MiB")
                with self.files.open_input_stream(place) as content:
                    self._index, self._since = bytes(content.read(LARGEST_INDEX)), _time(info)
                return self._index
            bucket, inside, _ = self.root.partition("/")
            if inside and bucket and self.files.get_file_info(bucket).type == FileType.NotFound:
                raise RemoteError(f"{self.address}: no bucket '{bucket}' there; make it first, by the provider's tools")
            there = self.files.get_file_info(FileSelector(self.root, allow_not_found=True))
        strangers = sorted(name for one in there if (name := one.base_name) != OBJECTS and not name.startswith(MARK))
        if strangers:
            raise RemoteError(f"{self.address}: holds {strangers[0]} and no {INDEX}: gaponet did not push it")
        return None

    def holds(self, path: str, part: Part, anew: Anew) -> bool:
        with reaching(self.address, *self._errors):
            self._there = self._list() if self._there is None else self._there
            info = self._there.get(part.sha256)
            if anew == "all" or info is None or info.size != part.size:  # it may have been cut short by a kill
                return False
            if anew:
                return self._sha256(part) == part.sha256
            return part.sha256.encode() in self._index or time.time() - _time(info) < OLD

    def send(self, path: str, file: Path, part: Part) -> None:
        with reaching(self.address, *self._errors):
            if self.files.type_name == "local":
                self.files.create_dir(f"{self.root}/{OBJECTS}", recursive=True)
            with file.open("rb") as content, self.files.open_output_stream(self._object(part)) as out:
                shutil.copyfileobj(content, out, BLOCK)

    def store(self, kind: Kind, index: Index, private: bool, there: bytes | None) -> None:
        with reaching(self.address, *self._errors):
            listed = self._list()
            gone = [place for place, part in index.files.items() if part.sha256 not in listed]
            if gone:
                raise RemoteError(f"{self.address}: {gone[0]} was removed meanwhile; push again")
            if self.index(kind) != there:
                raise ChangedError(f"{self.address}: somebody else pushed meanwhile; push again")
            content = written(index)
            if content == there:
                return
            if self.files.type_name == "local":  # where a write can be cut short
                with whole(Path(self.root) / INDEX) as file:
                    file.write_bytes(content)
            else:
                with self.files.open_output_stream(f"{self.root}/{INDEX}") as out:
                    out.write(content)

    def fetch(self, path: str, part: Part, folder: Path) -> None:
        out = folder / path
        with reaching(self.address, *self._errors):
            info = self.files.get_file_info(self._object(part))
            if not info.is_file or info.size != part.size:  # a local one may be a pipe
                raise RemoteError(f"{self.address}: {path} is not there with {part.size:,} bytes; push it again")
            out.parent.mkdir(parents=True, exist_ok=True)
            with self.files.open_input_stream(self._object(part)) as content, out.open("wb") as file:
                left = part.size + 1
                while left and (block := content.read(min(BLOCK, left))):
                    file.write(block)
                    left -= len(block)

    def prune(self, named: set[str], hours: float, delete: bool) -> Pruned:
        before = time.time() - 3600 * hours
        with reaching(self.address, *self._errors):
            left = [info for name, info in self._list().items() if name not in named]
            # Of a place whose index is young, somebody may still pull what was named before.
            gone = [info for info in left if max(_time(info), self._since) < before]
            for info in gone if delete else ():
                if _time(self.files.get_file_info(info.path)) < before:  # not sent again meanwhile
                    self.files.delete_file(info.path)
        return Pruned([info.base_name for info in gone], sum(info.size for info in gone), len(left) - len(gone))

    def open(self, path: str, part: Part) -> NativeFile:
        """A file of the index, to read pieces of it.

        Raises:
            RemoteError: It is not there with that size.
        """
        with reaching(self.address, *self._errors):
            file = self.files.open_input_file(self._object(part))
            if file.size() != part.size:
                raise RemoteError(f"{self.address}: {path} has another size than {INDEX} says; push it again")
        return file

    def _list(self) -> dict[str, FileInfo]:
        from pyarrow.fs import FileSelector

        there = self.files.get_file_info(FileSelector(f"{self.root}/{OBJECTS}", allow_not_found=True))
        return {info.base_name: info for info in there if info.is_file}

    def _sha256(self, part: Part) -> str:
        digest = hashlib.sha256()
        with self.files.open_input_stream(self._object(part)) as content:
            while block := content.read(BLOCK):
                digest.update(block)
        return digest.hexdigest()

    def _object(self, part: Part) -> str:
        return f"{self.root}/{OBJECTS}/{part.sha256}"


def _time(info: FileInfo) -> float:
    """When it was written, s since 1970; now, where the place does not say."""
    return float(info.mtime.timestamp()) if info.mtime is not None else time.time()
