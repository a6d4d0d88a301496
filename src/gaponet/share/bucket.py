"""Object storage through fsspec: s3:// (s3fs), gs:// (gcsfs), and file:// for a shared disk.

PLACE/sha256/<hash>   the files, each under the hash of its content
PLACE/gaponet.json    the index: paths, sizes and hashes of the files; written last
"""

from __future__ import annotations

import json
import logging
import os
import re
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from gaponet.base.files import FOLDER_MARKER, flush_to_disk, lock_file, write_text
from gaponet.base.progress import progress_bar
from gaponet.base.text import remove_credentials
from gaponet.share.remote import (
    INDEX,
    MAX_INDEX_BYTES,
    FileRecord,
    Index,
    Kind,
    RemoteError,
    lost_race,
    network_errors,
)

MODULES = {"s3": "s3fs", "gs": "gcsfs", "file": "fsspec"}  # scheme → library
OBJECTS = "sha256"
TRANSFERS = 8  # at a time
SERVER_TIMEOUT_S = {
    "s3": 28,
    "gs": 12,
}  # for the first byte of an answer, per attempt: two minutes in all
S3_ATTEMPTS = 2  # of s3fs, each with two attempts of botocore; gcsfs makes six attempts with pauses
MIN_PRUNE_AGE_S = 24 * 3600  # a younger object may belong to a push that is running


class Bucket:
    """A `Remote` in object storage; s3fs and gcsfs find the credentials."""

    def __init__(self, address: str) -> None:
        """
        Args:
            address: s3://BUCKET/FOLDER, gs://BUCKET/FOLDER or file:///FOLDER.
        """
        self.address = remove_credentials(address)
        self.scheme, _, rest = address.partition("://")
        if self.scheme not in MODULES or not rest.strip("/") or "::" in rest:
            raise RemoteError(
                f"{self.address}: no such place; use USER/NAME, s3://, gs:// or file:// and a folder"
            )
        if self.scheme != "file" and "@" in rest:
            raise RemoteError(
                f"{self.address}: an address holds no keys; set them as docs/reference/datasets.md says"
            )
        import_module(MODULES[self.scheme])
        import fsspec

        with network_errors(self.address):
            self.fs, self.root = fsspec.url_to_fs(
                address.rstrip("/"), use_listings_cache=False, **_options(self.scheme)
            )
        if self.scheme == "s3":
            self.fs.retries = S3_ATTEMPTS
        self._index_path = f"{self.root}/{INDEX}"
        self._index: bytes | None = None  # as read last
        self._index_info: dict[str, Any] = {}

    def index(self, kind: Kind | None = None) -> bytes | None:
        bucket, self._index = self.root.partition("/")[0], None
        with network_errors(self.address):
            self._index_info = self._info(self._index_path)
            if self._index_info.get("type") == "file":
                if self._index_info["size"] > MAX_INDEX_BYTES:
                    raise RemoteError(
                        f"{self.address}: {INDEX} has more than {MAX_INDEX_BYTES >> 20} MiB"
                    )
                self._index = self.fs.cat_file(self._index_path)
            elif bucket and not self.fs.exists(bucket):
                raise RemoteError(
                    f"{self.address}: no bucket '{bucket}'; make it with the provider's tools"
                )
            elif self._info(self.root):
                names = {
                    path.rpartition("/")[2] for path in self.fs.ls(self.root, detail=False)
                } - {"", OBJECTS}
                if name := min(
                    (name for name in names if not name.startswith(FOLDER_MARKER)), default=""
                ):
                    raise RemoteError(
                        f"{self.address}: holds {name} and no {INDEX}: gaponet did not push it"
                    )
        return self._index

    def sizes(self, paths: list[str], index: Index) -> list[int | None]:
        objects = [self._object(index.files[path].sha256) for path in paths]
        with network_errors(self.address):
            if self.scheme != "file":
                return list(self.fs.sizes(objects))
            infos = [
                self._info(path) for path in objects
            ]  # opening a pipe or a device would never end
            return [
                info["size"] if info.get("type") == "file" and not info["islink"] else None
                for info in infos
            ]

    def outdated(self, index: Index) -> set[str]:
        objects, listed = self._objects(), _digests(self._index)
        return {
            path
            for path, record in index.files.items()
            if not self._intact(
                objects.get(self._object(record.sha256)), record, record.sha256 in listed
            )
        }

    def _intact(self, info: dict[str, Any] | None, record: FileRecord, listed: bool) -> bool:
        """True unless an object is missing or damaged, as far as that is known without a download.

        An object that the present index lists must not be younger than this index: it was overwritten then.
        """
        if info is None or info["size"] != record.size or info["type"] != "file":
            return False
        if self.scheme == "file":
            return not info["islink"] and FileRecord.of(Path(info["name"])) == record
        return not listed or _modified(info) <= _modified(self._index_info)

    def fetch(self, paths: list[str], index: Index, folder: Path) -> None:
        files = {folder / path: index.files[path] for path in paths}
        missing = {
            f: record
            for f, record in files.items()
            if not f.is_file() or FileRecord.of(f) != record
        }
        for file in missing:
            file.parent.mkdir(parents=True, exist_ok=True)
        self._transfer(
            "downloading",
            self.fs.get,
            [(self._object(r.sha256), str(f)) for f, r in missing.items()],
        )

    def store(self, folder: Path, index: Index, paths: Collection[str], private: bool) -> None:
        objects = {self._object(index.files[path].sha256): folder / path for path in paths}
        self._transfer(
            "uploading", self.fs.put, [(str(file), path) for path, file in objects.items()]
        )
        if self.scheme == "file":
            for path in objects:
                flush_to_disk(Path(path))
        before, text = self._index, index.text()
        if self.index() != before:
            raise lost_race(self.address)
        try:
            with network_errors(self.address):
                self._replace_index(before, text)
        except RemoteError:
            now = self.index()
            if now not in (before, text.encode()):
                raise lost_race(self.address) from None
            if now == before:
                raise  # otherwise an attempt was successful, and only its answer was lost
        self._index = (before or b"") + text.encode()  # `prune` keeps the files of both

    def _replace_index(self, before: bytes | None, text: str) -> None:
        """Write the index on condition that it is still the one that was read last."""
        if self.scheme == "s3":
            condition = (
                {"IfNoneMatch": "*"} if before is None else {"IfMatch": self._index_info["ETag"]}
            )
            self.fs.pipe_file(self._index_path, text.encode(), **condition)
        elif self.scheme == "gs":
            bucket, name = self._index_path.split("/", 1)
            head, types = (
                json.dumps({"name": name}),
                ("application/json; charset=UTF-8", "application/json"),
            )
            parts = "".join(
                f"--{INDEX}\nContent-Type: {t}\n\n{x}\n"
                for t, x in zip(types, (head, text), strict=True)
            )
            self.fs.call(  # gcsfs has conditions for new objects only
                "POST", f"{self.fs._location}/upload/storage/v1/b/{bucket}/o", uploadType="multipart",
                ifGenerationMatch=self._index_info.get("generation", "0"), data=f"{parts}--{INDEX}--".encode(),
                headers={"Content-Type": f'multipart/related; boundary="{INDEX}"'},
            )  # fmt: skip
        else:
            descriptor = lock_file(Path(self.root) / f"{FOLDER_MARKER}-lock")
            if descriptor is None:
                raise lost_race(self.address)
            try:
                if self.index() != before:
                    raise lost_race(self.address)
                write_text(Path(self._index_path), text)
            finally:
                os.close(descriptor)

    def prune(self, index: Index) -> int:
        current = set(map(self._object, _digests(index.text().encode()) | _digests(self._index)))
        now = time.time()
        old = [
            p
            for p, i in self._objects().items()
            if p not in current and now - _modified(i) > MIN_PRUNE_AGE_S
        ]
        with network_errors(self.address):
            if old:
                self.fs.rm(old)
        return len(old)

    def _info(self, path: str) -> dict[str, Any]:
        """Return fsspec's description of a path, empty for a missing one.

        `isfile` and `exists` would also be False for a path without read permission.
        """
        with suppress(FileNotFoundError):
            return dict(self.fs.info(path))
        return {}

    def _transfer(
        self, title: str, function: Callable[..., Any], pairs: list[tuple[str, str]]
    ) -> None:
        """Upload or download (source, destination) pairs with a progress bar."""
        from fsspec.callbacks import Callback

        if pairs:
            with progress_bar(title) as update, network_errors(self.address):
                show = Callback(
                    hooks={"bar": lambda size, value, **_: update(value, size or 0, "")}
                )
                function(*map(list, zip(*pairs, strict=True)), callback=show, batch_size=TRANSFERS)

    def _objects(self) -> dict[str, dict[str, Any]]:
        """Return fsspec's description of every object, by path."""
        with network_errors(self.address):
            return dict(self.fs.find(f"{self.root}/{OBJECTS}", detail=True))

    def _object(self, digest: str) -> str:
        return f"{self.root}/{OBJECTS}/{digest}"


def _options(scheme: str) -> dict[str, Any]:
    """Return arguments of the file system of a scheme."""
    if scheme == "file":
        return {"auto_mkdir": True}
    if scheme == "s3":
        timeouts = dict.fromkeys(("connect_timeout", "read_timeout"), SERVER_TIMEOUT_S[scheme])
        return {"config_kwargs": timeouts | {"retries": {"max_attempts": 1}}}
    from aiohttp import ClientTimeout

    logging.getLogger(MODULES[scheme]).addHandler(
        logging.NullHandler()
    )  # gcsfs logs what it raises, too
    return {
        "requests_timeout": ClientTimeout(
            sock_connect=SERVER_TIMEOUT_S[scheme], sock_read=SERVER_TIMEOUT_S[scheme]
        )
    }


def _digests(index: bytes | None) -> set[str]:
    """Return the hashes in an index, of whatever format."""
    return set(re.findall("[0-9a-f]{64}", (index or b"").decode(errors="replace")))


def _modified(info: dict[str, Any]) -> float:
    """Return the time of an object's last change, Unix s."""
    changed = info.get("LastModified") or info.get("mtime") or 0.0  # s3fs; gcsfs and local files
    return changed.timestamp() if isinstance(changed, datetime) else float(changed)
