"""A dataset that was pushed, read where it lies: what is small comes at once, a recording when it is asked for.

A recording is a row group of a file of some megabytes, and its rows alone are fetched: memory holds one recording,
however many there are. Twins are made in a folder that goes with the object; nothing is written to the place.
"""

from __future__ import annotations

import re
import shutil
import weakref
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

from gaponet_interop.share.bucket import Bucket
from gaponet_interop.share.errors import RemoteError
from gaponet_interop.share.move import download, read_index
from gaponet_interop.share.pushed import LARGE, Pushed, rows_of

if TYPE_CHECKING:
    import pyarrow as pa


class Streamed(Pushed):
    """A dataset in a bucket."""

    def __init__(self, address: str) -> None:
        """Fetch the list of recordings, the robot and the splits.

        Raises:
            RemoteError: The place cannot be reached, or does not hold what it says.
        """
        self.bucket = Bucket(address)
        index = read_index(self.bucket, "dataset")
        if index is None or index.kind != "dataset":
            raise RemoteError(f"{self.bucket.address}: holds {'a run' if index else 'nothing'}, not a dataset")
        folder = Path(mkdtemp(prefix="gaponet-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self._opened: tuple[Path, Any] = Path(), None  # the data file that was read last
        small = {place: part for place, part in index.files.items() if not LARGE.fullmatch(place)}
        download(self.bucket, small, folder / "files")
        super().__init__(self.bucket.address, index, folder)
        self.address = re.sub("//[^/@:]*:[^/@]*@", "//", address)  # without keys: those are in the environment

    def _fetch(self, file: Path, first: int, rows: int) -> pa.Table:
        import pyarrow.parquet as pq

        if file != self._opened[0]:
            place = file.relative_to(self._files).as_posix()
            self._opened = file, pq.ParquetFile(self.bucket.open(place, self._index.files[place]))
        return rows_of(self._opened[1], file, first, rows)
