"""The dataset folder: Parquet files, one per sequence, and a journal that lists them.

    dataset.json                     format version, robot, joint names, units; licence and source
                                     if stated
    robot/                           the nominal robot: robot.toml and a self-contained MJCF
                                     (gaponet.robot.folder)
    sequences.jsonl                  one line per sequence: metadata, hash, delays (data.journal)
    sequences/<id>.parquet           columns time, ctrl, qpos, qvel, … (data.sequence_file)
    offsets.json                     static offsets of each unit as measured at import, not applied
                                     (data.offsets)
    replays/<model>/<id>.parquet     qpos, qvel, tau of the simulator with that model hash
    card.json, CARD.md               counts and ranges (data.card)
    splits/<name>.json               train, validation and test sets (data.split)

A sequence is written to a temporary file, renamed, synced to the disk, and then listed. A file that
is not listed does not count. One process writes at a time (gaponet.base.files). Reading needs no
lock and changes no recording. Recorded data is never rewritten; replays can be computed again.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Any, NotRequired

from annotated_types import Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import atomic_write, lock_folder, require_own_folder, write_json
from gaponet.base.structure import Name, read_format
from gaponet.data.fingerprint import fingerprint
from gaponet.data.journal import FILE as JOURNAL
from gaponet.data.journal import Entry as Entry
from gaponet.data.journal import EntryHeader, Findings, Journal
from gaponet.data.log import UNITS
from gaponet.data.pair import Pair, SimulatedReplay
from gaponet.data.sequence import ARRAYS, OPTIONAL, Sequence, SequenceMeta
from gaponet.data.sequence_file import HINT, read_arrays, write_arrays
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec

FORMAT = 1
KIND = "dataset"
REPLAYS = "replays"


class _Header(TypedDict):
    """dataset.json; fields that are not listed here are kept."""

    format: int
    robot: Name
    joint_names: Annotated[tuple[Name, ...], Len(1, 500)]
    licence: NotRequired[str]
    source: NotRequired[str]


class Dataset:
    """A dataset folder, opened for reading and appending. Opening reads the journal, no samples.

    Attributes:
        path: The folder.
        header: Content of dataset.json.
        entries: The listed sequences, oldest first.
    """

    def __init__(self, path: str | Path) -> None:
        """Open an existing folder.

        Raises:
            DatasetError: It is not a dataset, a newer version wrote it, or a listed file is
                missing.
        """
        self.path = Path(path)
        header = self.path / "dataset.json"
        if not header.is_file():
            raise DatasetError(
                f"{self.path}: not a dataset (no dataset.json); make one with gaponet import, "
                "collect or pull"
            )
        self.header: dict[str, Any] = {**read_format(_Header, header, FORMAT, DatasetError, HINT)}
        self.robot_name: str = self.header["robot"]
        self.joint_names: tuple[str, ...] = self.header["joint_names"]
        self.journal = Journal(self.path)
        self.entries: list[Entry] = []
        self._entry_by_hash: dict[str, Entry] = {}
        self._appending_many = False
        self._replay_root = self.path  # a temporary folder if the dataset is read-only
        self._load()

    def _load(self) -> None:
        self.entries = list(self._read_entries())
        self._entry_by_hash = {entry.hash: entry for entry in self.entries}

    def _read_entries(self) -> Iterator[Entry]:
        folder = self.path / "sequences"
        # one system call, not one per sequence
        files = set(os.listdir(folder)) if folder.is_dir() else set()
        for entry in self.journal.read():
            if f"{entry.id}.parquet" not in files:
                raise DatasetError(
                    f"{entry.where}: {self._file(entry)} is missing; restore it or delete the line"
                )
            yield entry

    @classmethod
    def create(cls, path: str | Path, robot: RobotSpec) -> Dataset:
        """Open the robot's dataset at a path, or create an empty one.

        The nominal robot is stored in it.

        Raises:
            DatasetError: It is another robot's.
            FolderError: The folder holds something else, or another process writes into it.
        """
        dataset = cls.open_existing(path, robot)
        if dataset is not None and has_stored_robot(dataset.path):
            return dataset
        path = Path(path)
        with lock_folder(path, KIND):
            if not (path / "dataset.json").is_file():
                units = {channel: UNITS[channel] for channel in ("time", *ARRAYS)}
                header = {
                    "format": FORMAT,
                    "robot": robot.name,
                    "joint_names": list(robot.joint_names),
                    "units": units,
                }
                write_json(path / "dataset.json", header)
            if not has_stored_robot(path):
                save_robot(robot.nominal or robot, path / STORED_ROBOT)
        return cls.create(path, robot)  # now it exists

    @classmethod
    def open_existing(cls, path: str | Path, robot: RobotSpec) -> Dataset | None:
        """Open the robot's dataset at a path; None if one can be created there. Nothing is written.

        Raises:
            DatasetError, FolderError: As `create`.
        """
        path = Path(path)
        if (path / "dataset.json").is_file():
            dataset = cls(path)
            dataset.require_robot(robot)
            return dataset
        require_own_folder(path, KIND)
        return None

    # ---- locks

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the dataset's lock, after reading what other processes have appended.

        Raises:
            FolderError: Another process writes into it.
        """
        with lock_folder(self.path, KIND):
            if self.journal.changed:
                self._load()
            yield

    @contextmanager
    def appending(self) -> Iterator[None]:
        """Hold the lock for many calls of `append`: the journal is written once a second and at
        the end.

        If the block raises, files that the journal does not list yet are removed.
        """
        with self.writing():
            self._appending_many = True
            try:
                yield
                self.journal.flush()
            except BaseException:
                for entry in self.journal.roll_back():
                    self._file(entry).unlink(missing_ok=True)
                self._load()
                raise
            finally:
                self._appending_many = False

    @property
    def read_only(self) -> bool:
        """True if this user cannot write into the folder."""
        return not os.access(self.path, os.W_OK)

    @contextmanager
    def writing_replays(self) -> Iterator[None]:
        """Hold the lock; replays of a read-only folder go into a temporary folder, deleted with
        this object.
        """
        if not self.read_only:
            with self.writing():
                yield
            return
        if self._replay_root == self.path:
            self._replay_root = Path(mkdtemp(prefix="gaponet-replays-"))
            weakref.finalize(self, shutil.rmtree, self._replay_root, ignore_errors=True)
        with lock_folder(self._replay_root, REPLAYS):
            yield

    # ---- queries

    def require_robot(self, robot: RobotSpec) -> None:
        """Refuse a robot whose name or joints are not the dataset's."""
        if self.robot_name != robot.name or self.joint_names != robot.joint_names:
            raise DatasetError(
                f"{self.path}: holds robot '{self.robot_name}' ({', '.join(self.joint_names)}), "
                f"not '{robot.name}' ({', '.join(robot.joint_names)}); leave --robot out, or give "
                "another dataset folder"
            )

    def require_sequences(self) -> None:
        """Refuse a dataset without sequences."""
        if not self.entries:
            raise DatasetError(f"{self.path}: holds no sequences yet; import or collect some")

    def __len__(self) -> int:
        return len(self.entries)

    def hours(self) -> float:
        """Total recorded time, h."""
        return sum(entry.rows * entry.dt for entry in self.entries) / 3600

    def find(self, content_hash: str) -> Entry | None:
        """Return the entry with this content hash, if any."""
        return self._entry_by_hash.get(content_hash)

    def select(
        self, motions: tuple[str, ...] | str = (), units: tuple[str, ...] | str = ()
    ) -> list[Entry]:
        """Return the entries of some motions and units; all by default.

        Raises:
            DatasetError: The dataset has no such motion or unit, or is empty.
        """
        motions = (motions,) if isinstance(motions, str) else motions
        units = (units,) if isinstance(units, str) else units
        chosen = self.entries
        if motions:
            self._require_present("motion", motions, {entry.meta.motion for entry in self.entries})
            chosen = [entry for entry in chosen if entry.meta.motion in motions]
        if units:
            self._require_present("unit", units, {entry.meta.unit_id for entry in self.entries})
            chosen = [entry for entry in chosen if entry.meta.unit_id in units]
        self.require_sequences()
        return list(chosen)

    def _require_present(self, kind: str, wanted: tuple[str, ...], present: set[str]) -> None:
        """Refuse motions or units (kind) that are not present."""
        missing = sorted(set(wanted) - present)
        if missing:
            available = ", ".join(sorted(present)) or "nothing"
            raise DatasetError(f"{self.path}: no {kind} '{missing[0]}'; it holds: {available}")

    # ---- changes

    def set_provenance(self, **fields: str) -> None:
        """Write licence or source into dataset.json; an empty text removes the field."""
        with self.writing():
            self.header = {k: v for k, v in (self.header | fields).items() if v != ""}
            write_json(self.path / "dataset.json", self.header)

    def append(
        self, sequence: Sequence, findings: Findings | None = None, content_hash: str | None = None
    ) -> Entry:
        """Add a sequence. Its content hash is computed if it is not given.

        Raises:
            DatasetError: A sequence with the same content is in the dataset.
        """
        with self.writing():
            return self._append(sequence, findings or {}, content_hash or sequence.content_hash())

    def _append(self, sequence: Sequence, findings: Findings, content_hash: str) -> Entry:
        meta = sequence.meta
        duplicate = self.find(content_hash)
        if duplicate is not None:
            raise DatasetError(
                f"{meta.source or meta.motion}: already in {self.path} as '{duplicate.id}' "
                "(same samples, unit and payload); nothing to add"
            )
        channels = tuple(c for c in ARRAYS if getattr(sequence, c) is not None)
        header = EntryHeader(
            entry_id(meta, content_hash), content_hash, sequence.dt, len(sequence), channels
        )
        entry = Entry.create(header, meta, findings, fingerprint(sequence.ctrl, sequence.dt))
        self._file(entry).parent.mkdir(exist_ok=True)
        arrays = {c: getattr(sequence, c) for c in channels}
        write_arrays(self._file(entry), arrays, sequence.dt, self.joint_names)
        self.entries.append(entry)
        self._entry_by_hash[content_hash] = entry
        self.journal.append(entry, at_once=not self._appending_many)
        return entry

    def remove(self, patterns: tuple[str, ...]) -> list[Entry]:
        """Remove the sequences whose ids match a pattern, with their replays; return their entries.

        Raises:
            DatasetError: A pattern matches no id. Nothing is removed then.
        """
        with self.writing():
            for pattern in patterns:
                if not any(fnmatchcase(entry.id, pattern) for entry in self.entries):
                    raise DatasetError(
                        f"{self.path}: no sequence '{pattern}'; {JOURNAL} in it lists the ids"
                    )
            removed = []
            kept_lines = []
            for entry in self.entries:
                if any(fnmatchcase(entry.id, pattern) for pattern in patterns):
                    removed.append(entry)
                else:
                    kept_lines.append(entry.line + b"\n")
            with atomic_write(self.path / JOURNAL) as temporary:
                temporary.write_bytes(b"".join(kept_lines))
            for entry in removed:  # if this is cut short, the files that remain are not listed
                self._file(entry).unlink(missing_ok=True)
                for file in self.path.glob(f"{REPLAYS}/*/{entry.id}.*"):
                    file.unlink(missing_ok=True)
            self._load()
        return removed

    # ---- samples

    def read(self, entry: Entry, optional: bool = True) -> Sequence:
        """Load one sequence, with or without its optional channels."""
        names = tuple(c for c in entry.channels if optional or c not in OPTIONAL)
        arrays: dict[str, Any] = dict(self.channels(entry, names))
        return Sequence(entry.meta, self.joint_names, entry.dt, **arrays)

    def channels(self, entry: Entry, names: tuple[str, ...]) -> dict[str, Array]:
        """Load some channels of one sequence, (T, n) float32 each."""
        return read_arrays(self._file(entry), names, entry.rows, len(self.joint_names))

    def sequences(
        self, entries: list[Entry] | None = None, optional: bool = True
    ) -> list[Sequence]:
        """Load sequences, all by default; each as `read`."""
        chosen = self.entries if entries is None else entries
        return [self.read(entry, optional) for entry in chosen]

    def has_replay(self, entry: Entry, model: str) -> bool:
        """True if a replay of the sequence by the simulator with this model hash is stored."""
        return self._replay_file(entry, model).is_file()

    def write_replay(self, entry: Entry, replay: SimulatedReplay) -> None:
        """Store a simulated replay of a sequence; an earlier one by the same model is replaced."""
        columns = {"qpos": replay.qpos, "qvel": replay.qvel, "tau": replay.tau}
        with self.writing_replays():
            file = self._replay_root / REPLAYS / replay.model_hash / f"{entry.id}.parquet"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_arrays(file, columns, entry.dt, self.joint_names)

    def pair(self, entry: Entry, model: str) -> Pair:
        """Load a sequence with its simulated replay."""
        file = self._replay_file(entry, model)
        if not file.is_file():
            raise DatasetError(
                f"{self.path}: '{entry.id}' has no replay by simulator {model}; run gaponet gap "
                f"{self.path}"
            )
        arrays = read_arrays(file, ("qpos", "qvel", "tau"), entry.rows, len(self.joint_names))
        return Pair(self.read(entry), SimulatedReplay(model, **arrays))

    def _file(self, entry: Entry) -> Path:
        return self.path / "sequences" / f"{entry.id}.parquet"

    def _replay_file(self, entry: Entry, model: str) -> Path:
        """Where the replay of a sequence is, or would be written."""
        place = Path(REPLAYS) / model / f"{entry.id}.parquet"
        written = self._replay_root / place
        stored = self.path / place
        return stored if stored.is_file() and not written.is_file() else written


def entry_id(meta: SequenceMeta, content_hash: str) -> str:
    """Return a sequence's name in its dataset: its labels in letters that any disk takes, and 8
    digits of its hash.
    """
    name = f"{meta.motion}-{meta.unit_id}-{meta.payload_mass:g}kg-r{meta.repetition}"
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:150] + f"-{content_hash[:8]}"


def dataset_hash(entries: list[Entry]) -> str:
    """Return the identity of a set of recordings in any order, 12 hex digits."""
    hashes = sorted(entry.hash for entry in entries)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()[:12]
