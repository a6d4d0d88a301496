"""Object storage through pyarrow's own file systems: s3://, gs://, and file:// for a disk that is shared.

    PLACE/sha256/<hash>   the files, each under its hash: never written twice, never changed
    PLACE/gaponet.json    which of them belong together, and their names; written last

No object is renamed or appended to. What an earlier push left and no index names stays there.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from gaponet.errors import RemoteError
from gaponet.share.target import BLOCK, INDEX, LARGEST_INDEX, Kind, Part, part_of, reaching

OBJECTS = "sha256"


class Bucket:
    """A `Target` in object storage; credentials are found as pyarrow's file systems find them."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or file:///FOLDER, with pyarrow's options behind a ?.
        """
        from pyarrow import ArrowException
        from pyarrow.fs import FileSystem

        self.address, self._errors = address.partition("?")[0], (ArrowException, ValueError)
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
            there = self.files.get_file_info(FileSelector(self.root, allow_not_found=True))
        strangers = sorted(one.base_name for one in there if one.base_name != OBJECTS)
        if strangers:
            raise RemoteError(f"{self.address}: holds {strangers[0]} and no {INDEX}: gaponet did not push it")
        return None

    def store(self, kind: Kind, files: Mapping[str, Path], index: bytes, private: bool) -> None:
        with reaching(self.address, *self._errors):
            if self.files.type_name == "local":
                self.files.create_dir(f"{self.root}/{OBJECTS}", recursive=True)
            for file in files.values():
                part = part_of(file)
                place = self._object(part)
                if self.files.get_file_info(place).size != part.size:  # a local one may be cut short by a kill
                    with file.open("rb") as content, self.files.open_output_stream(place) as out:
                        shutil.copyfileobj(content, out, BLOCK)
            with self.files.open_output_stream(f"{self.root}/{INDEX}") as out:
                out.write(index)

    def fetch(self, path: str, part: Part, folder: Path) -> None:
        out = folder / path
        with reaching(self.address, *self._errors):
            out.parent.mkdir(parents=True, exist_ok=True)
            with self.files.open_input_stream(self._object(part)) as content, out.open("wb") as file:
                left = part.size + 1
                while left and (block := content.read(min(BLOCK, left))):
                    file.write(block)
                    left -= len(block)

    def _object(self, part: Part) -> str:
        return f"{self.root}/{OBJECTS}/{part.sha256}"
