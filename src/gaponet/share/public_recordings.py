"""Public recordings over HTTPS: the files of a pinned commit, each checked by its size and SHA-256.

They come into the cache, in the folders that the data folder of benchmarks/real_robots has. A file
gets its name when it is complete and right, so that an interrupted download goes on with the files
that are missing.
"""

from __future__ import annotations

import gzip
import http.client
import os
import urllib.error
import urllib.request
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from annotated_types import Len

from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write, lock_folder
from gaponet.base.network import RemoteError
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_toml
from gaponet.share.remote import FileRecord

DATA_VARIABLE = "GAPONET_DATA"  # environment variable: folder of the data sets
SO101_FILES = Path(__file__).with_name("so101_files.toml")
FOLDER_KIND = "download"
PARALLEL_DOWNLOADS = 8  # GitHub serves small files slowly, one after the other
TIMEOUT_S = 20.0  # without a byte
NETWORK_ERRORS = (OSError, http.client.HTTPException, EOFError, zlib.error)


@dataclass(frozen=True)
class PublicFiles:
    """Files of a public data set at one place.

    Attributes:
        folder: Folder of the recordings, below the data folder.
        address: Address in front of the path of each file.
        origin: What they are, whose, and under which licence: a sentence without its full stop.
        files: Path below the folder → size and SHA-256.
    """

    folder: str
    address: str
    origin: str
    files: Annotated[dict[str, FileRecord], Len(1)]

    @classmethod
    def read(cls, file: Path = SO101_FILES) -> PublicFiles:
        """Read a list of files."""
        return read_toml(cls, file, UsageError)

    def missing_in(self, folder: Path) -> list[str]:
        """Return the files that a folder lacks, or has with another content."""
        missing = []
        for path, record in self.files.items():
            file = folder / path
            if not file.is_file() or FileRecord.of(file) != record:
                missing.append(path)
        return missing

    def provide(self, progress: Progress = no_progress) -> Path:
        """Return the folder of the recordings: below GAPONET_DATA, or else in the cache after a
        download.

        Args:
            progress: Called with the bytes done, all bytes, and the name of a file.

        Raises:
            UsageError: The folder that GAPONET_DATA names lacks files, or has others.
            RemoteError: The network fails, or a file there is not the one that is listed here.
        """
        given = os.environ.get(DATA_VARIABLE)
        if given:
            return self._require_given(Path(given) / self.folder)
        folder = cache_folder() / self.folder
        with lock_folder(folder, FOLDER_KIND):
            self._download(self.missing_in(folder), folder, progress)
        return folder

    def _require_given(self, folder: Path) -> Path:
        missing = self.missing_in(folder)
        if missing:
            raise UsageError(
                f"{folder}: {len(missing)} of {len(self.files)} files are missing or have another "
                f"content, such as {missing[0]}; unset {DATA_VARIABLE}, and they are downloaded"
            )
        return folder

    def _download(self, paths: list[str], folder: Path, progress: Progress) -> None:
        """Download files into a folder, several at a time; the first error ends it."""
        total = sum(record.size for record in self.files.values())
        done = total - sum(self.files[path].size for path in paths)
        pool = ThreadPoolExecutor(PARALLEL_DOWNLOADS)
        try:
            for path in pool.map(lambda path: self._download_file(path, folder), paths):
                done += self.files[path].size
                progress(done, total, path)
        finally:
            pool.shutdown(cancel_futures=True)

    def _download_file(self, path: str, folder: Path) -> str:
        url = f"{self.address}/{quote(path)}"
        record = self.files[path]
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary:
            temporary.write_bytes(_read(url, record.size))
            if FileRecord.of(temporary) != record:
                raise RemoteError(
                    f"{url}: is not the file that this gaponet knows, by its size or SHA-256, and "
                    "was not kept; give the same command again, and if it persists update gaponet"
                )
        return path


def cache_folder() -> Path:
    """Return the folder for downloaded files: gaponet in XDG_CACHE_HOME, which is by default
    ~/.cache.
    """
    given = os.environ.get("XDG_CACHE_HOME")
    return (Path(given) if given else Path.home() / ".cache") / "gaponet"


def _read(url: str, size: int) -> bytes:
    """Return at most size + 1 bytes from an address.

    Raises:
        RemoteError: It cannot be read; the message is one line.
    """
    request = urllib.request.Request(url, headers={"Accept-Encoding": "gzip"})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as response:
            content: Any = response
            if response.headers.get("Content-Encoding") == "gzip":
                content = gzip.GzipFile(fileobj=response)
            data: bytes = content.read(size + 1)
            return data
    except NETWORK_ERRORS as error:
        reason = getattr(error, "reason", None) or error or type(error).__name__
        raise RemoteError(
            f"{url}: not read ({reason}); the same command goes on where it stopped. Without a "
            f"network, name a folder that has these recordings with {DATA_VARIABLE}"
        ) from None
