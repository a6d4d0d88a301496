"""Read a pushed dataset without a pull: a file is downloaded when one of its recordings is read.

A recording is a row group, so that memory holds one recording. Nothing is written to the remote place.
"""

from __future__ import annotations

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
from gaponet.base.errors import DatasetError
from gaponet.base.sandbox import sandboxed
from gaponet.base.structure import MAX_ARRAYS_BYTES
from gaponet.data.formats.lerobot import read_episode
from gaponet.data.formats.lerobot_set import FEATURES, Set, Stated, sets_under
from gaponet.data.journal import Entry, EntryHeader
from gaponet.data.sequence import ARRAYS, SequenceMeta, to_sequence
from gaponet.data.store import Dataset, entry_id
from gaponet.share import dataset as datasets
from gaponet.share.remote import (
    INDEX,
    Index,
    Remote,
    RemoteError,
    download,
    file_errors,
    read_index,
)

if TYPE_CHECKING:
    import pyarrow as pa

AGAIN = "push it again"


def open_remote(address: str) -> Remote:
    """Return the place at an address: USER/NAME or hf://USER/NAME of the Hub, or s3://, gs:// or file:// and a folder.

    Raises:
        RemoteError: The address is not valid.
    """
    if "://" in address and not address.startswith("hf://"):
        from gaponet.share.bucket import Bucket

        return Bucket(address)
    from gaponet.share.hub import Hub

    return Hub(address)


class RemoteDataset(Dataset):
    """A read-only dataset at a remote place; every recording is compared with the content hash that was pushed."""

    def __init__(self, remote: Remote, index: Index, folder: Path) -> None:
        """Download and read the list of recordings, the robot and the splits.

        Args:
            folder: Working folder; the files of the index go into its folder `files`.

        Raises:
            RemoteError: The place cannot be reached, or its content differs from its index.
        """
        if index.kind != "dataset":
            raise RemoteError(f"{remote.address}: holds a run, not a dataset")
        self._remote, self._index, self.files, self.address = (
            remote,
            index,
            folder / "files",
            remote.address,
        )
        self._locations: dict[
            str, tuple[Set, dict[str, Any], int]
        ] = {}  # content hash → set, episode, first row
        self._present = {path for path in index.files if "data" not in path.split("/")[:-1]}
        download(remote, index, sorted(self._present), self.files)
        with file_errors(self.address, self.files):
            self.robot, self._sets = datasets.downloaded_robot(self.files), sets_under(self.files)
            made = Dataset.create(Path(mkdtemp(dir=folder)) / index.name, self.robot)
            for part in self._sets:
                if part.ours is None:
                    raise RemoteError(f"{part.path}: gaponet did not write this set")
                stated = {
                    k: str(v)
                    for k, v in part.ours["dataset"].items()
                    if k in Stated.__annotations__
                }
                made.set_provenance(**stated)
            super().__init__(made.path, remote.address)
            if sorted(entry.hash for entry in self.entries) != sorted(index.contents):
                raise RemoteError(f"the sequences listed are not those of {INDEX}; {AGAIN}")
            datasets.copy_sidecars(self.files / datasets.SIDECAR, self.path, self)

    def fetch(self, entries: list[Entry]) -> list[str]:
        """Download the missing files with these recordings; return all files that are on this machine."""
        with file_errors(self.address, self.files):
            files = {
                part.data_file(episode)
                for part, episode, _ in (self._locations[entry.hash] for entry in entries)
            }
            wanted = {file.relative_to(self.files).as_posix() for file in files} - self._present
            if unlisted := wanted - self._index.files.keys():
                raise RemoteError(f"{min(unlisted)} is not in {INDEX}; {AGAIN}")
        if wanted:
            download(self._remote, self._index, sorted(wanted), self.files)
            self._present |= wanted
        return sorted(self._present)

    def channels(self, entry: Entry, names: tuple[str, ...]) -> dict[str, Array]:
        """Return some channels of one sequence, (T, n) float32 each; the whole sequence is downloaded and checked.

        Raises:
            RemoteError: The sequence cannot be reached, or is not the one that was pushed.
        """
        self.fetch([entry])
        part, episode, first = self._locations[entry.hash]
        with file_errors(self.address, self.files):
            table = _rows_of(part.data_file(episode), first, entry.rows)
            sequence = to_sequence(
                read_episode(part, episode, self.robot, table), self.robot, entry.meta
            )
            # motion and unit as recorded
            if replace(sequence, meta=entry.meta).content_hash() != entry.hash:
                raise RemoteError(
                    f"'{entry.id}' is not what was pushed, by its content hash; {AGAIN}"
                )
        return {name: getattr(sequence, name) for name in names}

    @property
    def read_only(self) -> bool:
        """True: a remote dataset cannot be changed."""
        return True

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Raise DatasetError: a remote dataset cannot be changed."""
        raise DatasetError(
            f"{self.address}: is only read; to change it, gaponet pull it and push it again"
        )
        yield

    def _read_entries(self) -> Iterator[Entry]:
        for part in self._sets:
            rows: dict[Path, int] = {}  # of each data file, before the next episode
            for episode in part.episodes:
                file = part.data_file(episode)
                meta = SequenceMeta(**(episode["stated"] | {"robot": self.robot.name}))
                digest, first = str(episode.get("content_hash")), rows.get(file, 0)
                channels = tuple(c for c in ARRAYS if FEATURES[c] in part.features)
                findings = episode["findings"]
                header = EntryHeader(
                    entry_id(meta, digest), digest, part.dt, episode["length"], channels
                )
                entry = Entry.create(header, meta, findings)
                self._locations[digest], rows[file] = (part, episode, first), first + entry.rows
                yield entry


def open_remote_dataset(address: str) -> RemoteDataset:
    """Open a pushed dataset; downloaded files are deleted with the object.

    Raises:
        RemoteError: The place cannot be reached, or its content differs from its index.
    """
    remote = open_remote(address)
    index = read_index(remote, remote.index())
    folder = Path(mkdtemp(prefix="gaponet-"))
    try:
        pushed = RemoteDataset(remote, index, folder)
    except BaseException:
        shutil.rmtree(folder)
        raise
    weakref.finalize(pushed, shutil.rmtree, folder, ignore_errors=True)
    return pushed


@sandboxed(RemoteError, "pyarrow.parquet")
def _rows_of(file: Path, first: int, rows: int) -> pa.Table:
    """Read rows of a data file that fill whole row groups; no other row group is read."""
    import pyarrow.parquet as pq

    parquet = pq.ParquetFile(file)
    ends = np.cumsum(
        [parquet.metadata.row_group(i).num_rows for i in range(parquet.num_row_groups)]
    )
    groups = np.flatnonzero((ends > first) & (ends <= first + rows)).tolist()
    parts = [parquet.metadata.row_group(i) for i in groups]
    if (
        8 * sum(part.column(k).num_values for part in parts for k in range(part.num_columns))
        > MAX_ARRAYS_BYTES
    ):
        raise RemoteError(f"{file}: a recording in it has more than {MAX_ARRAYS_BYTES >> 20} MiB")
    table = parquet.read_row_groups(groups, use_threads=False)
    if len(table) != rows:
        raise RemoteError(
            f"{file}: rows {first} to {first + rows} are not whole row groups; {AGAIN}"
        )
    return table
