"""The dataset folder: Parquet files, one per sequence, and a journal that lists them.

    dataset.json            format version, robot, joint names, units; licence and source where they were said
    robot/                  the nominal robot: robot.toml and an MJCF that needs nothing else (robot_folder)
    sequences.jsonl         one line per sequence: metadata, hash, delays; appended, never changed in place
    offsets.json            static offsets of each unit as fitted at import (data.offsets); recorded, never applied
    sequences/<id>.parquet  columns time, ctrl, qpos, qvel, …: each row a list of n float32, joints in dataset order
    twins/<model>/<id>.parquet  qpos, qvel, tau of the nominal simulator with that model hash
    surveys/<id>            what the doctor found in each (data.checks.looked)
    card.json, CARD.md      what is in it (data.card)
    splits/<name>.json      which sequences are for training, validation, test (data.split)

A sequence is written to a temporary file, renamed, on the disk, and only then listed (of many, once a second): a file
that is not listed does not exist, nor does a line cut short by a crash. One process writes at a time
(gaponet.base.files); reading needs no lock and changes no recording. Real data is never rewritten; twins can be
computed again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated, Any, NotRequired

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError
from gaponet.base.files import atomic_write, flush_to_disk, lock_folder, require_own_folder, write_text
from gaponet.base.structure import Name, parse_json, read_format
from gaponet.data.commands import Sketch, sketch
from gaponet.data.log import UNITS
from gaponet.data.pair import Pair, Twin
from gaponet.data.sequence import ARRAYS, OPTIONAL, Sequence, SequenceMeta
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot, save_robot
from gaponet.robot.spec import RobotSpec

FORMAT = 1
MEND = "restore the file or import the log again"
MEND_LINE = "delete the line and import that log again"
KIND, JOURNAL, SURVEYS = "dataset", "sequences.jsonl", "surveys"
LIST_S = 1.0  # of many recordings that are appended
LARGEST_TABLE = 1 << 30  # bytes of what is read of one sequence at once


class _Header(TypedDict):
    """dataset.json, and whatever else stands there."""

    format: int
    robot: Name
    joint_names: Annotated[tuple[Name, ...], Len(1, 500)]
    licence: NotRequired[str]
    source: NotRequired[str]


@dataclass(frozen=True)
class _Begin:
    id: Name
    hash: Annotated[str, Len(8, 64)]
    dt: Annotated[float, Interval(ge=1e-4, le=1)]
    rows: Annotated[int, Interval(ge=1, le=10**8)]
    channels: tuple[str, ...]

    def __post_init__(self) -> None:
        if not {"ctrl", "qpos", "qvel"} <= set(self.channels) <= set(ARRAYS):
            raise DatasetError(f"channels: {self.channels!r:.80} lack ctrl, qpos or qvel, or hold an unknown one")


@dataclass(frozen=True)
class Entry(_Begin):
    """One line of the journal; what stands in it from `meta` on is parsed and checked when it is first asked for."""

    meta: SequenceMeta
    findings: dict[str, dict[str, float | None]]
    command: Sketch | None = field(default_factory=lambda: None)  # in journals from before it was kept

    @classmethod
    def of(cls, line: bytes, where: str) -> Entry:
        """The entry that a line holds; one that does not begin as `line` has it is parsed at once."""
        head, _, _ = line.partition(b', "meta": {')
        try:
            entry, begin = object.__new__(cls), parse_json(_Begin, head + b"}", where, DatasetError)
        except DatasetError:
            entry = begin = parse_json(cls, line, where, DatasetError, MEND_LINE)
        entry.__dict__.update(vars(begin), _line=(line, where))
        return entry

    @property
    def line(self) -> bytes:
        """The bytes of it that stand, or will stand, in the journal."""
        there: tuple[bytes, str] | None = self.__dict__.get("_line")
        return there[0] if there else json.dumps(asdict(self), ensure_ascii=False, allow_nan=False).encode()

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in ("meta", "findings", "command"):
                raise AttributeError(name)
            self.__dict__.update(vars(parse_json(Entry, *self._line, DatasetError, MEND_LINE)))
            return self.__dict__[name]


class Dataset:
    """A dataset folder opened for reading and appending. Opening reads the journal only, no samples."""

    _many = False  # whether what is appended is listed every LIST_S
    address = ""
    """What opens one again that lies in a bucket (share/stream.py)."""

    def __init__(self, path: str | Path) -> None:
        """Open an existing folder.

        Raises:
            DatasetError: Not a dataset, written by a newer version, or a listed file is missing.
        """
        self.path = self.twins = Path(path)  # twins lie elsewhere where the folder can only be read
        header = self.path / "dataset.json"
        if not header.is_file():
            raise DatasetError(
                f"{self.path}: not a dataset (no dataset.json); make one with gaponet import, collect or pull"
            )
        self.header: dict[str, Any] = {**read_format(_Header, header, FORMAT, DatasetError, MEND)}
        self.robot_name: str = self.header["robot"]
        self.joint_names: tuple[str, ...] = self.header["joint_names"]
        self._load()

    def _load(self) -> None:
        """Read the journal."""
        self._end, self._lines, self._due = 0, b"", 0.0  # of the last whole line, bytes; not listed yet, until when
        self.entries = list(self._journal())
        self._by_hash = {entry.hash: entry for entry in self.entries}

    @classmethod
    def create(cls, path: str | Path, robot: RobotSpec) -> Dataset:
        """Open the dataset at path, making an empty one where there is none; refuses another robot's.

        The nominal robot is kept in it, if none is yet.
        """
        dataset = cls.peek(path, robot)
        if dataset is not None and has_stored_robot(dataset.path):
            return dataset
        path = Path(path)
        with lock_folder(path, KIND):
            if not (path / "dataset.json").is_file():
                header = {"format": FORMAT, "robot": robot.name, "joint_names": list(robot.joint_names), "units": UNITS}
                write_text(path / "dataset.json", json.dumps(header, indent=1, ensure_ascii=False) + "\n")
            if not has_stored_robot(path):
                save_robot(robot.nominal or robot, path / STORED_ROBOT)
        return cls.create(path, robot)

    @classmethod
    def peek(cls, path: str | Path, robot: RobotSpec) -> Dataset | None:
        """The robot's dataset at path, or None where one can be made; refuses anything else and changes nothing."""
        path = Path(path)
        if (path / "dataset.json").is_file():
            dataset = cls(path)
            dataset.require_robot(robot)
            return dataset
        require_own_folder(path, KIND)
        return None

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Be the only writer, with all that other processes have appended; FolderError while another one is."""
        with lock_folder(self.path, KIND):
            journal = self.path / JOURNAL
            if (journal.stat().st_size if journal.is_file() else 0) != self._end:
                self._load()
            yield

    @contextmanager
    def appending(self) -> Iterator[None]:
        """The same as `writing`, for many: what is appended is listed once a second and at the end, not one by one.

        If the block raises, the files that are not listed yet are removed.
        """
        with self.writing():
            self._many = True
            try:
                yield
                self._list()
            except BaseException:
                self._remove_unlisted()
                raise
            finally:
                self._many = False

    @property
    def read_only(self) -> bool:
        """Whether this user, or the disk, lets nothing be written into the folder."""
        return not os.access(self.path, os.W_OK)

    @contextmanager
    def making_twins(self) -> Iterator[None]:
        """The same as `writing`; twins of a folder that can only be read go into a temporary one, and this object."""
        if not self.read_only:
            with self.writing():
                yield
            return
        if self.twins == self.path:
            self.twins = Path(mkdtemp(prefix="gaponet-twins-"))
            weakref.finalize(self, shutil.rmtree, self.twins, ignore_errors=True)
        with lock_folder(self.twins, "twins"):
            yield

    def require_robot(self, robot: RobotSpec) -> None:
        """Refuse a robot whose joints are not the dataset's."""
        if self.robot_name != robot.name or self.joint_names != robot.joint_names:
            raise DatasetError(
                f"{self.path}: holds robot '{self.robot_name}' ({', '.join(self.joint_names)}), not '{robot.name}' "
                f"({', '.join(robot.joint_names)}); use --robot {self.robot_name} or another dataset folder"
            )

    def __len__(self) -> int:
        return len(self.entries)

    def hours(self) -> float:
        """Recorded time in all, h."""
        return sum(e.rows * e.dt for e in self.entries) / 3600

    def find(self, content_hash: str) -> Entry | None:
        """The entry with this content, if any."""
        return self._by_hash.get(content_hash)

    def select(self, motions: tuple[str, ...] = (), units: tuple[str, ...] = ()) -> list[Entry]:
        """Entries of these motions and units, all by default; refuses one that is not there."""
        for what, field_, wanted in (("motion", "motion", motions), ("unit", "unit_id", units)):
            present = {getattr(e.meta, field_) for e in self.entries} if wanted else set()
            if strange := sorted(set(wanted) - present):
                held = ", ".join(sorted(present)) or "nothing"
                raise DatasetError(f"{self.path}: no {what} '{strange[0]}'; it holds: {held}")
        if not self.entries:
            raise DatasetError(f"{self.path}: holds no sequences yet; import or collect some")
        chosen = [e for e in self.entries if not motions or e.meta.motion in motions]
        return [e for e in chosen if not units or e.meta.unit_id in units]

    def state(self, **fields: str) -> None:
        """Write what only a person can say (licence, source) into dataset.json; an empty text takes it away."""
        with self.writing():
            self.header = {k: v for k, v in (self.header | fields).items() if v != ""}
            write_text(self.path / "dataset.json", json.dumps(self.header, indent=1, ensure_ascii=False) + "\n")

    def append(
        self, sequence: Sequence, findings: dict[str, Any] | None = None, content_hash: str | None = None
    ) -> Entry:
        """Add a sequence; one with the same content is refused with its name. Its hash is computed if not given."""
        with self.writing():
            return self._append(sequence, findings or {}, content_hash or sequence.content_hash())

    def _append(self, sequence: Sequence, findings: dict[str, Any], digest: str) -> Entry:
        twin = self.find(digest)
        if twin is not None:
            raise DatasetError(
                f"{sequence.meta.source or sequence.meta.motion}: already in {self.path} as '{twin.id}' "
                "(same samples, unit and payload); nothing to add"
            )
        m = sequence.meta
        entry = Entry(
            id=entry_id(m, digest),
            hash=digest,
            dt=sequence.dt,
            rows=len(sequence),
            channels=tuple(c for c in ARRAYS if getattr(sequence, c) is not None),
            meta=m,
            findings=findings,
            command=sketch(sequence.ctrl, sequence.dt),
        )
        columns, line = {c: getattr(sequence, c) for c in entry.channels}, entry.line + b"\n"
        self._file(entry).parent.mkdir(exist_ok=True)
        _write_table(self._file(entry), columns, sequence.dt, self.joint_names)
        self._lines += line
        self.entries.append(entry)
        self._by_hash[digest] = entry
        if not self._many or time.monotonic() > self._due:
            self._list()
        return entry

    def _list(self) -> None:
        """List what was appended, once its files' names are on the disk."""
        if not self._lines:
            return
        flush_to_disk(self.path / "sequences")
        with (self.path / JOURNAL).open("ab") as journal:
            journal.truncate(self._end)  # a line cut short by a crash or a full disk goes
            journal.write(self._lines)
            journal.flush()
            os.fsync(journal.fileno())
        if not self._end:
            flush_to_disk(self.path)
        self._end, self._lines, self._due = self._end + len(self._lines), b"", time.monotonic() + LIST_S

    def _remove_unlisted(self) -> None:
        """Remove the files of sequences that the journal does not list, and forget them."""
        count = self._lines.count(b"\n")
        if not count:
            return
        journal = self.path / JOURNAL
        if journal.is_file():  # listing may have failed halfway: no line may outlive its file
            os.truncate(journal, self._end)
            flush_to_disk(journal)
        for entry in self.entries[-count:]:
            self._file(entry).unlink(missing_ok=True)
        self._load()

    def remove(self, patterns: tuple[str, ...]) -> list[Entry]:
        """Take out the sequences whose ids match, with their twins; refuses a pattern that matches none."""
        with self.writing():
            for pattern in patterns:
                if not any(fnmatchcase(e.id, pattern) for e in self.entries):
                    raise DatasetError(f"{self.path}: no sequence '{pattern}'; {JOURNAL} in it lists the ids")
            gone = {e.id: e for e in self.entries if any(fnmatchcase(e.id, p) for p in patterns)}
            kept = [e.line + b"\n" for e in self.entries if e.id not in gone]
            with atomic_write(self.path / JOURNAL) as temporary:
                temporary.write_bytes(b"".join(kept))
            for entry in gone.values():  # unlisted files are none of the dataset's, should this be cut short
                for file in (
                    self._file(entry),
                    self.path / SURVEYS / entry.id,
                    *self.path.glob(f"twins/*/{entry.id}.parquet"),
                ):
                    file.unlink(missing_ok=True)
            self._load()
        return list(gone.values())

    def read(self, entry: Entry, optional: bool = True) -> Sequence:
        """Load one sequence, without its optional channels where they are not asked for."""
        names = tuple(c for c in entry.channels if optional or c not in OPTIONAL)
        return Sequence(entry.meta, self.joint_names, entry.dt, **self.channels(entry, names))

    def channels(self, entry: Entry, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Some channels of one sequence, (T, n) float32 each, without reading the others."""
        return _read_table(self._file(entry), names, entry.rows, len(self.joint_names))

    def sequences(self, entries: list[Entry] | None = None, optional: bool = True) -> list[Sequence]:
        """Load sequences, all by default; each as `read`."""
        return [self.read(e, optional) for e in (self.entries if entries is None else entries)]

    def has_twin(self, entry: Entry, model: str) -> bool:
        """Whether the sequence has been paired with the simulator of this model hash."""
        return self._twin_file(entry, model).is_file()

    def write_twin(self, entry: Entry, twin: Twin) -> None:
        """Store the simulated twin of a sequence, replacing an earlier one of the same model."""
        columns = {"qpos": twin.qpos, "qvel": twin.qvel, "tau": twin.tau}
        with self.making_twins():
            file = self.twins / "twins" / twin.model_hash / f"{entry.id}.parquet"
            file.parent.mkdir(parents=True, exist_ok=True)
            _write_table(file, columns, entry.dt, self.joint_names)

    def pair(self, entry: Entry, model: str) -> Pair:
        """A sequence with its simulated twin."""
        file = self._twin_file(entry, model)
        if not file.is_file():
            raise DatasetError(
                f"{self.path}: '{entry.id}' has no twin for simulator {model}; run gaponet gap {self.path}"
            )
        arrays = _read_table(file, ("qpos", "qvel", "tau"), entry.rows, len(self.joint_names))
        return Pair(self.read(entry), Twin(model, **arrays))

    def _file(self, entry: Entry) -> Path:
        return self.path / "sequences" / f"{entry.id}.parquet"

    def _twin_file(self, entry: Entry, model: str) -> Path:
        made = self.twins / "twins" / model / f"{entry.id}.parquet"
        return made if made.is_file() else self.path / "twins" / model / f"{entry.id}.parquet"

    def _journal(self) -> Iterator[Entry]:
        journal = self.path / JOURNAL
        if not journal.is_file():
            return
        content = journal.read_bytes()
        self._end = content.rfind(b"\n") + 1  # what follows is being written, or was cut short by a crash
        folder = self.path / "sequences"
        files = set(os.listdir(folder)) if folder.is_dir() else set()  # one look, not one for each of 11,000 files
        listed: dict[str, str] = {}  # content hash → id
        for number, line in enumerate(content[: self._end].split(b"\n")[:-1], 1):
            where = f"{journal}:{number}"
            entry = Entry.of(line, where)
            if f"{entry.id}.parquet" not in files:
                raise DatasetError(f"{where}: {self._file(entry)} is missing; restore it or delete the line")
            if listed.setdefault(entry.hash, entry.id) != entry.id or len(listed) < number:
                raise DatasetError(f"{where}: '{listed[entry.hash]}' is listed already; delete this line")
            yield entry


def entry_id(meta: SequenceMeta, digest: str) -> str:
    """A sequence's name in its dataset: what it is, as letters that any disk takes, and how its content hash begins."""
    name = f"{meta.motion}-{meta.unit_id}-{meta.payload_mass:g}kg-r{meta.repetition}"
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:150] + f"-{digest[:8]}"


def dataset_hash(entries: list[Entry]) -> str:
    """Identity of a set of recordings, in any order; 12 hex digits."""
    return hashlib.sha256("".join(sorted(e.hash for e in entries)).encode()).hexdigest()[:12]


def _write_table(path: Path, columns: dict[str, np.ndarray], dt: float, joint_names: tuple[str, ...]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    n = len(joint_names)
    rows = len(next(iter(columns.values())))
    vector = pa.list_(pa.field("element", pa.float32(), nullable=False), n)
    fields = [pa.field("time", pa.float64(), nullable=False), *(pa.field(c, vector, nullable=False) for c in columns)]
    arrays = [pa.array(np.arange(rows) * dt, pa.float64())]
    for values in columns.values():
        flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
        arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=vector))
    units = json.dumps({c: UNITS[c] for c in ["time", *columns]})
    table = pa.table(arrays, schema=pa.schema(fields, {"joint_names": ",".join(joint_names), "units": units}))
    with atomic_write(path, named=False) as temporary:
        # Against zstd alone: 6 % larger, read in half the time (552 rows of 27 joints, 7 channels: 1.5 ms).
        pq.write_table(table, temporary, compression="lz4", use_dictionary=False, use_byte_stream_split=True)


def _read_table(path: Path, columns: tuple[str, ...], rows: int, n: int) -> dict[str, np.ndarray]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
        if file.metadata.num_rows != rows:
            raise DatasetError(f"{path}: holds {file.metadata.num_rows} rows, the journal says {rows}; {MEND}")
        for column in columns:
            kind = file.schema_arrow.field(column).type
            if not pa.types.is_fixed_size_list(kind) or kind.list_size != n or kind.value_type != pa.float32():
                raise DatasetError(f"{path}: {column} is {kind}, not {n} joints' float32; {MEND}")
        if 4 * rows * n * len(columns) > LARGEST_TABLE:
            raise DatasetError(f"{path}: {rows:,} rows of {n} joints are more than {LARGEST_TABLE >> 20} MiB; {MEND}")
        table = file.read(columns=list(columns), use_threads=False)
        arrays = {c: table.column(c).combine_chunks().flatten().to_numpy(zero_copy_only=False) for c in columns}
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        reason = str(error).split("\n")[0].rstrip(".")
        raise DatasetError(f"{path}: not a readable Parquet file ({reason}); {MEND}") from None
    for column, values in arrays.items():
        if len(values) != rows * n or not np.isfinite(values).all():
            raise DatasetError(f"{path}: {column} lacks values or holds NaN; {MEND}")
    return {c: values.reshape(rows, n) for c, values in arrays.items()}
