"""Object storage through fsspec: s3:// (s3fs), gs:// (gcsfs), and file:// for a shared disk.

PLACE/sha256/<hash>   the files, each under the hash of its content
PLACE/gaponet.json    the names of those that belong together; written last
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from gaponet.base.files import FOLDER_MARKER, write_text
from gaponet.base.progress import progress_bar
from gaponet.base.text import remove_credentials
from gaponet.share.errors import RemoteError
from gaponet.share.target import INDEX, MAX_INDEX_BYTES, Index, Kind, Part, reaching

MODULES = {"s3": "s3fs", "gs": "gcsfs", "file": "fsspec"}  # scheme → library
OBJECTS = "sha256"
AT_ONCE = 8  # transfers
SILENT_S = 30  # that a server of gs:// may take for the next byte
PRUNE_AFTER_S = 24 * 3600  # a younger file may belong to a push under way


class Bucket:
    """A `Target` in object storage; s3fs and gcsfs find the credentials."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or file:///FOLDER.
        """
        self.address = remove_credentials(address)
        scheme, _, rest = address.partition("://")
        if scheme not in MODULES or not rest.strip("/") or "::" in rest:
            raise RemoteError(f"{self.address}: no such place; use USER/NAME, s3://, gs:// or file:// and a folder")
        if scheme != "file" and "@" in rest:
            raise RemoteError(f"{self.address}: an address holds no keys; set them as docs/share.md says")
        import_module(MODULES[scheme])
        import fsspec

        options: dict[str, Any] = {"auto_mkdir": True} if scheme == "file" else {}
        if scheme == "gs":
            from aiohttp import ClientTimeout

            logging.getLogger(MODULES[scheme]).addHandler(logging.NullHandler())  # it logs what it raises, too
            options["requests_timeout"] = ClientTimeout(sock_connect=SILENT_S, sock_read=SILENT_S)  # gcsfs has none
        with reaching(self.address):
            self.fs, self.root = fsspec.url_to_fs(address.rstrip("/"), use_listings_cache=False, **options)
        self._local = scheme == "file"
        self._found: bytes | None = None  # the index that was read last

    def index(self, kind: Kind | None = None) -> bytes | None:
        place, bucket, self._found = f"{self.root}/{INDEX}", self.root.partition("/")[0], None
        with reaching(self.address):
            if (info := self._info(place)).get("type") == "file":
                if info["size"] > MAX_INDEX_BYTES:
                    raise RemoteError(f"{self.address}: {INDEX} has more than {MAX_INDEX_BYTES >> 20} MiB")
                self._found = self.fs.cat_file(place)
            elif bucket and not self.fs.exists(bucket):
                raise RemoteError(f"{self.address}: no bucket '{bucket}'; make it with the provider's tools")
            elif self._info(self.root):
                names = {path.rpartition("/")[2] for path in self.fs.ls(self.root, detail=False)} - {"", OBJECTS}
                if name := min((name for name in names if not name.startswith(FOLDER_MARKER)), default=""):
                    raise RemoteError(f"{self.address}: holds {name} and no {INDEX}: gaponet did not push it")
        return self._found

    def _info(self, path: str) -> dict[str, Any]:
        """Empty for a missing path; `isfile` and `exists` would say so of a path that cannot be read, too."""
        with suppress(FileNotFoundError):
            return dict(self.fs.info(path))
        return {}

    def sizes(self, places: list[str], index: Index) -> list[int | None]:
        with reaching(self.address):
            return list(self.fs.sizes([self._object(index.files[place].sha256) for place in places]))

    def fetch(self, places: list[str], index: Index, folder: Path) -> None:
        files = {folder / place: index.files[place] for place in places}
        missing = {file: part for file, part in files.items() if not file.is_file() or Part.of(file) != part}
        for file in missing:
            file.parent.mkdir(parents=True, exist_ok=True)
        self._move("downloading", self.fs.get, [(self._object(p.sha256), str(file)) for file, p in missing.items()])

    def store(self, folder: Path, index: Index, private: bool, replace: bool, prune: bool) -> int:
        there = {} if replace else self._objects()
        files = {self._object(part.sha256): (folder / place, part.size) for place, part in index.files.items()}
        missing = [(str(file), path) for path, (file, size) in files.items() if there.get(path) != size]
        self._move("uploading", self.fs.put, missing)
        before = self._found
        if self.index() != before:
            raise RemoteError(f"{self.address}: somebody else pushed meanwhile; push again")
        with reaching(self.address):
            if self._local:  # a write to a disk can be cut short
                write_text(Path(self.root) / INDEX, index.text())
            else:
                self.fs.pipe_file(f"{self.root}/{INDEX}", index.text().encode())
        return self._prune(index.text() + str(before)) if prune else 0

    def _prune(self, named: str) -> int:
        """Delete the objects that this text does not name, except young ones; returns their number."""
        left = self._objects().keys() - set(map(self._object, re.findall("[0-9a-f]{64}", named)))
        with reaching(self.address):
            old = [path for path in left if time.time() - self.fs.modified(path).timestamp() > PRUNE_AFTER_S]
            if old:
                self.fs.rm(old)
        return len(old)

    def _move(self, title: str, transfer: Callable[..., Any], pairs: list[tuple[str, str]]) -> None:
        from fsspec.callbacks import Callback

        if pairs:
            with progress_bar(title) as update, reaching(self.address):
                show = Callback(hooks={"bar": lambda size, value, **_: update(value, size or 0, "")})
                transfer(*map(list, zip(*pairs, strict=True)), callback=show, batch_size=AT_ONCE)

    def _objects(self) -> dict[str, int]:
        """Sizes of the objects that are there."""
        with reaching(self.address):
            found = self.fs.find(f"{self.root}/{OBJECTS}", detail=True)
        return {path: info["size"] for path, info in found.items()}

    def _object(self, digest: str) -> str:
        return f"{self.root}/{OBJECTS}/{digest}"
