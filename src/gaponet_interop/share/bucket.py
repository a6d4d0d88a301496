"""Object storage through pyarrow's own file systems: s3://, gs://, and file:// for a disk that is shared.

    PLACE/sha256/<hash>   the files, each under its hash: written again only where its content is another
    PLACE/gaponet.json    which of them belong together, and their names; written last

No object is renamed or appended to. What an earlier push left and no index names stays there until it is pruned.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from gaponet_interop.share.errors import RemoteError
from gaponet_interop.share.target import (
    BLOCK,
    INDEX,
    LARGEST_INDEX,
    Anew,
    ChangedError,
    Index,
    Kind,
    Part,
    part_of,
    reaching,
)

if TYPE_CHECKING:
    from pyarrow import NativeFile

OBJECTS = "sha256"
SETTLED = 86_400  # s: younger files may be of a push that is under way
PATIENCE = 20  # s that a request to gs:// is tried again; 15 minutes where nobody says, s3:// gives up after 6


class Bucket:
    """A `Target` in object storage; credentials are found as pyarrow's file systems find them."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or file:///FOLDER, with pyarrow's options behind a ?.
        """
        from pyarrow import ArrowException
        from pyarrow.fs import FileSystem

        self.address = re.sub("//[^/@]*@", "//", address.partition("?")[0])  # without keys, if there are any
        self._errors = (ArrowException, ValueError)
        if address.startswith(("gs:", "gcs:")) and "retry_limit_seconds=" not in address:
            address += f"{'&' if '?' in address else '?'}retry_limit_seconds={PATIENCE}"
        with reaching(self.address, *self._errors):
            self.files, self.root = FileSystem.from_uri(address)
        self.root = self.root.rstrip("/")

    def index(self, kind: Kind | None = None) -> bytes | None:
        from pyarrow.fs import FileSelector, FileType

        place = f"{self.root}/{INDEX}"
        with reaching(self.address, *self._errors):
            info = self.files.get_file_info(place)
            if info.type == FileType.File:
                if info.size > LARGEST_INDEX:
                    raise RemoteError(f"{self.address}: {INDEX} has more than {LARGEST_INDEX >> 20} MiB")
                with self.files.open_input_stream(place) as content:
                    return bytes(content.read(LARGEST_INDEX))
            bucket, inside, _ = self.root.partition("/")
            if inside and bucket and self.files.get_file_info(bucket).type == FileType.NotFound:
                raise RemoteError(f"{self.address}: no bucket '{bucket}' there; make it first, by the provider's tools")
            there = self.files.get_file_info(FileSelector(self.root, allow_not_found=True))
        strangers = sorted(one.base_name for one in there if one.base_name != OBJECTS)
        if strangers:
            raise RemoteError(f"{self.address}: holds {strangers[0]} and no {INDEX}: gaponet did not push it")
        return None

    def store(
        self, kind: Kind, files: Mapping[str, Path], index: bytes, private: bool, there: bytes | None, anew: Anew
    ) -> None:
        with reaching(self.address, *self._errors):
            if self.files.type_name == "local":
                self.files.create_dir(f"{self.root}/{OBJECTS}", recursive=True)
            for file in files.values():
                part = part_of(file)
                if anew == "all" or not self._holds(part, anew == "damaged"):
                    with file.open("rb") as content, self.files.open_output_stream(self._object(part)) as out:
                        shutil.copyfileobj(content, out, BLOCK)
            if self.index(kind) != there:
                raise ChangedError(f"{self.address}: somebody else pushed meanwhile; push again")
            with self.files.open_output_stream(f"{self.root}/{INDEX}") as out:
                out.write(index)

    def fetch(self, path: str, part: Part, folder: Path) -> None:
        out = folder / path
        with reaching(self.address, *self._errors):
            if not self._holds(part):
                raise RemoteError(f"{self.address}: {path} is not there with {part.size:,} bytes; push it again")
            out.parent.mkdir(parents=True, exist_ok=True)
            with self.files.open_input_stream(self._object(part)) as content, out.open("wb") as file:
                left = part.size + 1
                while left and (block := content.read(min(BLOCK, left))):
                    file.write(block)
                    left -= len(block)

    def prune(self, index: Index) -> int:
        from pyarrow.fs import FileSelector

        named, before = {part.sha256 for part in index.files.values()}, time.time() - SETTLED
        with reaching(self.address, *self._errors):
            there = self.files.get_file_info(FileSelector(f"{self.root}/{OBJECTS}", allow_not_found=True))
            left = [one for one in there if one.is_file and one.base_name not in named]
            gone = [one.path for one in left if one.mtime is not None and one.mtime.timestamp() < before]
            for path in gone:
                self.files.delete_file(path)
        return len(gone)

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

    def _holds(self, part: Part, read: bool = False) -> bool:
        """Whether there is a file of this hash by its name and size, or where it is read, by its content."""
        info = self.files.get_file_info(self._object(part))
        if not info.is_file or info.size != part.size:  # a local one may be a pipe, or cut short by a kill
            return False
        digest = hashlib.sha256()
        if read:
            with self.files.open_input_stream(self._object(part)) as content:
                while block := content.read(BLOCK):
                    digest.update(block)
        return not read or digest.hexdigest() == part.sha256

    def _object(self, part: Part) -> str:
        return f"{self.root}/{OBJECTS}/{part.sha256}"
