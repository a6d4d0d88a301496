"""Dataset → LeRobotDataset v3.0, so that it comes back from data.formats.lerobot with the same
content hashes.

A LeRobot set has one rate and the same features in every frame; a dataset with several rates or
choices of channels becomes several sets, in folders of their own. One Parquet row group per
episode. Where a file ends, the content hash of its last episode says: files of 2 MB in the mean, of
a 2,000th of what lies before them where that is more. Some data files share a file of
meta/episodes. No file depends on episodes that come after it, so that a dataset that grew has its
earlier files again, byte by byte, and a push sends the others only (share/push_pull.py).

Beyond the standard are

    features                    observation.velocity, .acceleration, .torque, .equivalent_torque,
                                .temperature
    features.<name>.info.unit   SI
    columns of meta/episodes    unit_id, payload_mass, level, repetition, virtual, findings, …
    meta/gaponet.json           exact period, robot, joint names, licence, source

A reader that knows none of these finds an ordinary set. Simulated replays are not in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.files import write_json
from gaponet.data.formats.lerobot_set import FEATURES, GAINS, OURS, STATED, VERSION
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence
from gaponet.data.statistics import Statistics, pool, statistics
from gaponet.data.store import Dataset, Entry, dataset_hash

if TYPE_CHECKING:
    import pyarrow as pa

Group = tuple[float, tuple[str, ...]]  # dt, channels
Tell = Callable[[str], None]  # called with the motion of each recording
FeatureStatistics = dict[str, Statistics]  # feature → of its samples

# LeRobot's own limits:
MAX_FILE_MB = 100
CHUNK_FILES = 1000
# A data file is so large in the mean, and at least so much of all before it.
USUAL_MB = 2.0
USUAL_SHARE = 1 / 2000
# A block ends with a file, once it holds so much of both together.
BLOCK_MB = 32.0
BLOCK_EPISODES = 64
INDEX = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


@dataclass(frozen=True)
class _Placed:
    """An episode, its number, that of its first frame, of its task and of its data file."""

    entry: Entry
    index: int
    first: int
    task: int
    file: int


@dataclass(frozen=True)
class Written:
    """One set of an export."""

    path: Path
    episodes: int
    frames: int
    fps: float


def write(dataset: Dataset, folder: Path, tell: Tell) -> list[Written]:
    """Write LeRobot sets: into the folder itself where one will do, else into folders named after
    rate.

    Raises:
        DatasetError: A recording is damaged.
    """
    groups: dict[Group, list[Entry]] = {}
    for entry in dataset.entries:
        groups.setdefault((entry.dt, entry.channels), []).append(entry)
    written = []
    for group, name in _folders(list(groups)).items():
        entries = groups[group]
        part = _Set(dataset, folder / name, *group, entries)
        part.write(tell)
        written.append(Written(Path(name), len(entries), part.frames, _fps(part.dt)))
    return written


def _folders(groups: list[Group]) -> dict[Group, str]:
    """Return a name of its own for each group: "" for a single one, else such as 50hz; with the
    channels behind it where they are what differs, and a number where rates differ by less than
    six digits show.
    """
    if len(groups) == 1:
        return {groups[0]: ""}
    folders: dict[Group, str] = {}
    for dt, channels in groups:
        name = f"{_fps(dt):.6g}hz"
        if sum(group[0] == dt for group in groups) > 1:
            name = "-".join([name, *channels])
        others = set(folders.values())
        number = 2
        unique = name
        while unique in others:
            unique = f"{name}-{number}"
            number += 1
        folders[dt, channels] = unique
    return folders


def _fps(dt: float) -> float:
    """A whole number where it is one, as LeRobot expects; 49.85 Hz stays 49.85 Hz."""
    whole = round(1 / dt)
    return whole if abs(whole * dt - 1) < 1e-9 else 1 / dt


class _Set:
    """One LeRobot set, and the writing of it."""

    def __init__(
        self,
        dataset: Dataset,
        folder: Path,
        dt: float,
        channels: tuple[str, ...],
        entries: list[Entry],
    ) -> None:
        self.dataset = dataset
        self.folder = folder
        self.dt = dt
        self.channels = channels
        self.entries = entries
        self.n = len(dataset.joint_names)
        self.tasks: dict[str, int] = {}
        self.frames = 0

    def write(self, tell: Tell) -> None:
        """Write all files."""
        stats = []
        for number, block in enumerate(self._blocks()):
            stats.append(self._write_block(number, block, tell))
        self._write_meta(_pooled(stats))

    def _blocks(self) -> Iterator[list[_Placed]]:
        """Episodes of whole data files that one file of meta/episodes lists; the journal alone
        decides the ends.
        """
        index_bytes = sum(np.dtype(kind).itemsize for kind in INDEX.values())
        row_bytes = 4 * self.n * len(self.channels) + index_bytes
        block: list[_Placed] = []
        file = 0
        file_bytes = 0
        all_bytes = 0
        fill = 0.0  # of the block
        ended = False  # a file, with the last episode
        for index, entry in enumerate(self.entries):
            more = entry.rows * row_bytes
            if ended or (file_bytes and file_bytes + more > MAX_FILE_MB * 1e6):
                file += 1
                file_bytes = 0
                if fill >= 1:
                    yield block
                    block = []
                    fill = 0.0
            task = self.tasks.setdefault(entry.meta.motion, len(self.tasks))
            block.append(_Placed(entry, index, self.frames, task, file))
            file_bytes += more
            all_bytes += more
            fill = fill + more / (BLOCK_MB * 1e6) + 1 / BLOCK_EPISODES
            self.frames += entry.rows
            chance = int(entry.hash[:8], 16) / 2**32  # from 0 to 1, the same each time
            ended = chance < more / max(USUAL_MB * 1e6, USUAL_SHARE * all_bytes)
        yield block

    def _place(self, what: str, number: int) -> Path:
        chunk, file = divmod(number, CHUNK_FILES)
        place = self.folder / what / PLACE.format(chunk_index=chunk, file_index=file)
        place.parent.mkdir(parents=True, exist_ok=True)
        return place

    def _write_block(self, number: int, episodes: list[_Placed], tell: Tell) -> FeatureStatistics:
        """Write data files and the file of meta/episodes; returns the statistics of their
        frames.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows: list[dict[str, Any]] = []
        stats = []
        writer = None
        file = -1
        try:
            for episode in episodes:
                columns = self._columns(self._read(episode.entry), episode)
                if episode.file != file:
                    if writer is not None:
                        writer.close()
                    file = episode.file
                    writer = pq.ParquetWriter(
                        self._place("data", file),
                        self._schema(),
                        compression="snappy",
                        use_dictionary=False,
                    )
                assert writer is not None
                writer.write_table(self._table(columns))
                stats.append({name: statistics(values) for name, values in columns.items()})
                rows.append(_row(episode, number, stats[-1]))
                tell(episode.entry.meta.motion)
        finally:
            if writer is not None:
                writer.close()
        pq.write_table(
            pa.Table.from_pylist(rows), self._place("meta/episodes", number), compression="snappy"
        )
        return _pooled(stats)

    def _read(self, entry: Entry) -> Sequence:
        sequence = self.dataset.read(entry)
        if sequence.content_hash() != entry.hash:
            raise DatasetError(
                f"{self.dataset.path}: '{entry.id}' is not what was recorded, by its hash; "
                "restore it first"
            )
        return sequence

    def _schema(self) -> pa.Schema:
        import pyarrow as pa

        # one value is no list in LeRobot
        vector = pa.list_(pa.float32(), self.n) if self.n > 1 else pa.float32()
        fields = [(FEATURES[channel], vector) for channel in self.channels]
        for name, kind in INDEX.items():
            fields.append((name, pa.type_for_alias(kind)))
        return pa.schema(fields)

    def _columns(self, sequence: Sequence, episode: _Placed) -> dict[str, Array]:
        columns = {FEATURES[channel]: getattr(sequence, channel) for channel in self.channels}
        rows = np.arange(len(sequence))
        columns["timestamp"] = (rows * self.dt).astype(np.float32)
        columns["frame_index"] = rows
        columns["episode_index"] = np.full(len(rows), episode.index)
        columns["index"] = episode.first + rows
        columns["task_index"] = np.full(len(rows), episode.task)
        return columns

    def _table(self, columns: dict[str, Array]) -> pa.Table:
        import pyarrow as pa

        schema = self._schema()
        arrays = []
        for field, values in zip(schema, columns.values(), strict=True):
            flat = values.ravel()
            if pa.types.is_fixed_size_list(field.type):
                array = pa.FixedSizeListArray.from_arrays(pa.array(flat), type=field.type)
            else:
                array = pa.array(flat, field.type)
            arrays.append(array)
        return pa.table(arrays, schema=schema)

    def _write_meta(self, stats: FeatureStatistics) -> None:
        """Write what is of the whole set, with the statistics of all frames."""
        import pyarrow.parquet as pq

        meta = self.folder / "meta"
        pq.write_table(_task_table(self.tasks), meta / "tasks.parquet")
        write_json(meta / "info.json", self._info())
        write_json(meta / "stats.json", stats)
        stated = self.dataset.header
        header = {name: stated[name] for name in ("licence", "source") if name in stated}
        write_json(
            meta / OURS,
            {
                "format": 1,
                "robot": self.dataset.robot_name,
                "joint_names": self.dataset.joint_names,
                "dt": self.dt,
                "dataset_hash": dataset_hash(self.entries),
                "virtual": any(e.meta.virtual for e in self.entries),
                "dataset": header,
            },
        )

    def _info(self) -> dict[str, Any]:
        names = list(self.dataset.joint_names)
        features: dict[str, Any] = {}
        for channel in self.channels:
            features[FEATURES[channel]] = {
                "dtype": "float32",
                "shape": [self.n],
                "names": names,
                "info": {"unit": UNITS[channel]},
            }
        for name, kind in INDEX.items():
            features[name] = {"dtype": kind, "shape": [1], "names": None}
        return {
            "codebase_version": VERSION,
            "robot_type": self.dataset.robot_name,
            "total_episodes": len(self.entries),
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": MAX_FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": _fps(self.dt),
            "splits": {"train": f"0:{len(self.entries)}"},
            "data_path": "data/" + PLACE,
            "video_path": None,
            "features": features,
        }


def _pooled(parts: list[FeatureStatistics]) -> FeatureStatistics:
    return {name: pool([part[name] for part in parts]) for name in parts[0]}


def _row(episode: _Placed, number: int, stats: FeatureStatistics) -> dict[str, Any]:
    """The episode's row in the file of meta/episodes that has this number."""
    entry = episode.entry
    meta = asdict(episode.entry.meta)
    columns = {
        "episode_index": episode.index,
        "tasks": [entry.meta.motion],
        "length": entry.rows,
        "dataset_from_index": episode.first,
        "dataset_to_index": episode.first + entry.rows,
        "data/chunk_index": episode.file // CHUNK_FILES,
        "data/file_index": episode.file % CHUNK_FILES,
        "meta/episodes/chunk_index": number // CHUNK_FILES,
        "meta/episodes/file_index": number % CHUNK_FILES,
        **{name: meta[name] for name in STATED},
        "payload_mass": float(entry.meta.payload_mass),
        **{name: json.dumps(meta[name], ensure_ascii=False) for name in ("notes", *GAINS)},
        "findings": json.dumps(entry.findings, ensure_ascii=False),
        "content_hash": entry.hash,
    }
    for feature, of_feature in stats.items():
        for name, values in of_feature.items():
            columns[f"stats/{feature}/{name}"] = values.tolist()
    return columns


def _task_table(tasks: dict[str, int]) -> pa.Table:
    """Return task_index by task; the metadata make pandas take the text for the index, as LeRobot
    expects.
    """
    import pyarrow as pa

    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = []
    for name, (pandas, numpy) in kinds.items():
        column = {
            "name": name,
            "field_name": name,
            "pandas_type": pandas,
            "numpy_type": numpy,
            "metadata": None,
        }
        columns.append(column)
    header = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    table = pa.table(
        {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(header)})
