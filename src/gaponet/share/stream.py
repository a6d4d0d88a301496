"""A dataset that was pushed, read from its files, here or where it lies: a recording when it is asked for.

A recording is a row group of a file of some megabytes, and its rows alone are read or fetched: memory holds one,
however many there are. Twins are made in a folder that goes with the object; nothing is written to the place.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError, GAPONetError
from gaponet.base.sandbox import inside
from gaponet.base.structure import LARGEST_ARRAYS
from gaponet.data.formats.lerobot import read_episode
from gaponet.data.formats.lerobot_set import FEATURES, Set, Stated, sets_under
from gaponet.data.sequence import ARRAYS, OPTIONAL, Sequence, SequenceMeta, to_sequence
from gaponet.data.store import Dataset, Entry, entry_id
from gaponet.share import dataset as datasets
from gaponet.share.bucket import Bucket
from gaponet.share.errors import RemoteError
from gaponet.share.target import INDEX, Index, download, reaching, read_index, written

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

LARGE = re.compile(r"(?:.*/)?data/.*")  # files of a LeRobot set that hold recordings
AGAIN = "push it again"


class Pushed(Dataset):
    """A dataset only to be read; whatever is read is compared with the content hash that was pushed."""

    def __init__(self, place: str, index: Index, folder: Path) -> None:
        """Read the list of recordings, the robot and the splits.

        Args:
            place: Its address, for errors.
            folder: The files of the index lie in its folder `files`, those that are LARGE where they are needed.

        Raises:
            RemoteError: It does not hold what it says.
        """
        self._place, self._index, self._files = place, index, folder / "files"
        self._where: dict[str, tuple[Set, dict[str, Any], int]] = {}  # content hash → set, episode, first row
        with self._told():
            self.robot, self._sets = datasets.pushed_robot(self._files), sets_under(self._files)
            state = hashlib.sha256(written(index)).hexdigest()[
                :16
            ]  # what a pull of another one left is not gone on with
            (folder / state).mkdir(exist_ok=True)
            made = Dataset.create(folder / state / index.name, self.robot)
            for part in self._sets:
                if part.ours is None:
                    raise RemoteError(f"{part.path}: gaponet did not write this set")
                made.state(**{k: str(v) for k, v in part.ours["dataset"].items() if k in Stated.__annotations__})
            super().__init__(made.path)
            if sorted(entry.hash for entry in self.entries) != sorted(index.contents):
                raise RemoteError(f"the sequences listed are not those of {INDEX}; {AGAIN}")
            datasets.bring(self._files / datasets.BESIDE, self.path, self)

    def places(self, entries: list[Entry]) -> set[str]:
        """The files that hold these recordings."""
        with self._told():
            return {self._file_of(entry).relative_to(self._files).as_posix() for entry in entries}

    def read(self, entry: Entry, optional: bool = True) -> Sequence:
        """Fetch one sequence; all of it is fetched and checked.

        Raises:
            RemoteError: It cannot be reached, or is not the one that was pushed.
        """
        part, episode, first = self._where[entry.hash]
        with self._told():
            table = self._fetch(self._file_of(entry), first, entry.rows)
            sequence = to_sequence(read_episode(part, episode, self.robot, table), self.robot, entry.meta)
            sequence = replace(sequence, meta=entry.meta)  # how it was first recorded, not how it was read here
            if sequence.content_hash() != entry.hash:
                raise RemoteError(f"'{entry.id}' is not what was pushed, by its content hash; {AGAIN}")
        none: dict[str, Any] = {} if optional else dict.fromkeys(OPTIONAL)
        return replace(sequence, **none)

    def channels(self, entry: Entry, names: tuple[str, ...]) -> dict[str, Array]:
        """Some channels of one sequence, (T, n) float32 each."""
        sequence = self.read(entry)
        return {name: getattr(sequence, name) for name in names}

    def _append(self, sequence: Sequence, findings: dict[str, Any], digest: str) -> Entry:
        raise self._read_only()

    def state(self, **fields: str) -> None:
        """Refused."""
        raise self._read_only()

    def _read_only(self) -> DatasetError:
        return DatasetError(f"{self._place}: is only read; to change it, gaponet pull it and push it again")

    def _journal(self) -> Iterator[Entry]:
        for part in self._sets:
            rows: dict[Path, int] = {}  # of a data file, before the next episode
            for episode in part.episodes:
                file = part.data_file(episode)
                meta = SequenceMeta(**(episode["stated"] | {"robot": self.robot.name}))
                digest, first = str(episode.get("content_hash")), rows.get(file, 0)
                channels = tuple(c for c in ARRAYS if FEATURES[c] in part.features)
                found = episode["findings"]
                entry = Entry(entry_id(meta, digest), digest, part.dt, episode["length"], channels, meta, found)
                self._where[digest], rows[file] = (part, episode, first), first + entry.rows
                yield entry

    def _file_of(self, entry: Entry) -> Path:
        part, episode, _ = self._where[entry.hash]
        file = part.data_file(episode)
        if file.relative_to(self._files).as_posix() not in self._index.files:
            raise RemoteError(f"{file} is not among the files of {INDEX}; {AGAIN}")
        return file

    def _fetch(self, file: Path, first: int, rows: int) -> pa.Table:
        """Rows of a data file."""
        return _rows_of(file, first, rows)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Errors name the address, and not where files are read from."""
        from pyarrow import ArrowException

        try:
            with reaching(self._place, ArrowException):
                yield
        except GAPONetError as error:
            text = str(error).replace(f"{self._files}/", "").removeprefix(f"{self._place}: ")
            raise RemoteError(f"{self._place}: {text}") from None


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


@inside(RemoteError, "pyarrow.parquet")
def _rows_of(file: Path, first: int, rows: int) -> pa.Table:
    import pyarrow.parquet as pq

    return rows_of(pq.ParquetFile(file), file, first, rows)


def rows_of(parquet: pq.ParquetFile, file: Path, first: int, rows: int) -> pa.Table:
    """Rows of a data file; they fill whole row groups, and no others are read."""
    ends = np.cumsum([parquet.metadata.row_group(i).num_rows for i in range(parquet.num_row_groups)])
    groups = np.flatnonzero((ends > first) & (ends <= first + rows)).tolist()
    parts = [parquet.metadata.row_group(i) for i in groups]
    if 8 * sum(part.column(k).num_values for part in parts for k in range(part.num_columns)) > LARGEST_ARRAYS:
        raise RemoteError(f"{file}: a recording in it has more than {LARGEST_ARRAYS >> 20} MiB")
    table = parquet.read_row_groups(groups, use_threads=False)
    if len(table) != rows:
        raise RemoteError(f"{file}: rows {first} to {first + rows} are not whole row groups; {AGAIN}")
    return table
