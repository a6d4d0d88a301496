"""Dataset → LeRobotDataset v3.0, so that it comes back from data.formats.lerobot with the same content hashes.

A LeRobot set has one rate and the same features in every frame; a dataset with several rates or choices of channels
becomes several sets, in folders of their own. One Parquet row group per episode. Where a file ends, the content hash
of its last episode says, so that a dataset that grew has its earlier files again, byte by byte, and a push sends the
last one and what is new: files of 2 MB in the mean, of a 2,000th of what lies before them where that is more.

    beyond the standard     features observation.velocity, .acceleration, .torque, .equivalent_torque, .temperature
                            features.<name>.info.unit: SI
                            columns of meta/episodes: unit_id, payload_mass, level, repetition, virtual, …
                            meta/gaponet.json: exact period, robot, joint names, licence, source

A reader that knows none of these finds an ordinary set. Not in it: twins and findings, which can be made again.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.arrays import Array
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry, dataset_hash
from gaponet.data.writers import Tell, Written
from gaponet.robot import RobotSpec
from gaponet_interop.formats.lerobot_set import FEATURES, GAINS, OURS, STATED, VERSION
from gaponet_interop.writers.lerobot_stats import EpisodeStats, episode_stats, pool

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

Group = tuple[float, tuple[str, ...]]  # dt, channels

FILE_MB, CHUNK_FILES = 100, 1000  # LeRobot's own defaults, at most
USUAL_MB, SHARE = 2.0, 1 / 2000  # of a file, and of all bytes before it
ROWS = 200  # episodes in a row group of meta/episodes
INDEX = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
         "task_index": "int64"}  # fmt: skip
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def write(dataset: Dataset, robot: RobotSpec, folder: Path, tell: Tell) -> list[Written]:
    """Write LeRobot sets: into the folder itself where one will do, else into folders named after rate."""
    groups: dict[Group, list[Entry]] = {}
    for entry in dataset.entries:
        groups.setdefault((entry.dt, entry.channels), []).append(entry)
    written = []
    for (dt, channels), entries in groups.items():
        part = "" if len(groups) == 1 else _folder(dt, channels, list(groups))
        frames = _Set(dataset, folder / part, dt, channels).write(entries, tell)
        written.append(Written(Path(part), len(entries), frames, _fps(dt)))
    return written


def _folder(dt: float, channels: tuple[str, ...], groups: list[Group]) -> str:
    """ "50hz"; with the channels behind it where they are what differs."""
    same_rate = [c for other, c in groups if other == dt]
    return f"{_fps(dt):.6g}hz" + ("-" + "-".join(channels) if len(same_rate) > 1 else "")


def _fps(dt: float) -> float:
    """A whole number where it is one, as LeRobot expects; 49.85 Hz stays 49.85 Hz."""
    return round(1 / dt) if abs(round(1 / dt) * dt - 1) < 1e-9 else 1 / dt


class _Set:
    """One LeRobot set being written: data files as it goes, everything in meta at the end."""

    def __init__(self, dataset: Dataset, root: Path, dt: float, channels: tuple[str, ...]) -> None:
        self.dataset, self.root, self.dt, self.channels = dataset, root, dt, channels
        self.n = len(dataset.joint_names)
        self.tasks: dict[str, int] = {}
        self.rows: list[dict[str, Any]] = []  # of meta/episodes, not yet written
        self.meta: pq.ParquetWriter | None = None
        self.stats: EpisodeStats = {}
        self.episodes = self.frames = self.chunk = self.file = 0

    def write(self, entries: list[Entry], tell: Tell) -> int:
        """Write all episodes and the metadata; returns the number of frames."""
        writer, size, total, ended = None, 0, 0, False
        try:
            for entry in entries:
                sequence = self.dataset.read(entry)
                columns = self._columns(sequence)
                bytes_now = sum(x.nbytes for x in columns.values())
                if writer is not None and (ended or size + bytes_now > FILE_MB * 1e6):
                    writer.close()
                    writer, size = None, 0
                    self._next_file()
                if writer is None:
                    writer = self._open()
                writer.write_table(self._table(columns))
                size, total = size + bytes_now, total + bytes_now
                ended = int(entry.hash[:8], 16) / 2**32 < bytes_now / max(USUAL_MB * 1e6, SHARE * total)
                self._note(entry, columns)
                tell(entry.meta.motion)
            self._flush()
        finally:
            for open_file in (writer, self.meta):
                if open_file is not None:
                    open_file.close()
        self._write_meta(entries)
        return self.frames

    def _next_file(self) -> None:
        self.file += 1
        if self.file == CHUNK_FILES:
            self.chunk, self.file = self.chunk + 1, 0

    def _open(self) -> pq.ParquetWriter:
        import pyarrow.parquet as pq

        path = self.root / "data" / PLACE.format(chunk_index=self.chunk, file_index=self.file)
        path.parent.mkdir(parents=True, exist_ok=True)
        return pq.ParquetWriter(path, self._schema(), compression="snappy", use_dictionary=False)

    def _schema(self) -> pa.Schema:
        import pyarrow as pa

        vector = pa.list_(pa.float32(), self.n) if self.n > 1 else pa.float32()  # one value is no list in LeRobot
        fields = [(FEATURES[c], vector) for c in self.channels]
        return pa.schema(fields + [(name, pa.type_for_alias(kind)) for name, kind in INDEX.items()])

    def _columns(self, sequence: Sequence) -> dict[str, Array]:
        rows = np.arange(len(sequence))
        task = self.tasks.setdefault(sequence.meta.motion, len(self.tasks))
        return {FEATURES[c]: getattr(sequence, c) for c in self.channels} | {
            "timestamp": (rows * self.dt).astype(np.float32),
            "frame_index": rows,
            "episode_index": np.full(len(rows), self.episodes),
            "index": self.frames + rows,
            "task_index": np.full(len(rows), task),
        }

    def _table(self, columns: dict[str, Array]) -> pa.Table:
        import pyarrow as pa

        schema = self._schema()
        arrays = [
            pa.FixedSizeListArray.from_arrays(pa.array(x.ravel()), type=field.type)
            if pa.types.is_fixed_size_list(field.type) else pa.array(x.ravel(), field.type)
            for field, x in zip(schema, columns.values(), strict=True)
        ]  # fmt: skip
        return pa.table(arrays, schema=schema)

    def _note(self, entry: Entry, columns: dict[str, Array]) -> None:
        """The episode's row in meta/episodes."""
        meta, stats = asdict(entry.meta), episode_stats(columns)
        self.rows.append({
            "episode_index": self.episodes, "tasks": [entry.meta.motion], "length": entry.rows,
            "dataset_from_index": self.frames, "dataset_to_index": self.frames + entry.rows,
            "data/chunk_index": self.chunk, "data/file_index": self.file,
            "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
            **{name: meta[name] for name in STATED},
            **{name: json.dumps(meta[name], ensure_ascii=False) for name in ("notes", *GAINS)},
            "content_hash": entry.hash,
            **{f"stats/{f}/{k}": v.tolist() for f, values in stats.items() for k, v in values.items()},
        })  # fmt: skip
        self.stats = pool([self.stats, stats]) if self.stats else stats
        self.frames += entry.rows
        self.episodes += 1
        if len(self.rows) == ROWS:
            self._flush()

    def _flush(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self.meta is None:
            path = self.root / "meta" / "episodes" / PLACE.format(chunk_index=0, file_index=0)
            path.parent.mkdir(parents=True)
            self.meta = pq.ParquetWriter(path, pa.Table.from_pylist(self.rows).schema, compression="snappy")
        if self.rows:
            self.meta.write_table(pa.Table.from_pylist(self.rows, self.meta.schema))
        self.rows = []

    def _write_meta(self, entries: list[Entry]) -> None:
        import pyarrow.parquet as pq

        meta = self.root / "meta"
        pq.write_table(_task_table(self.tasks), meta / "tasks.parquet")
        _write_json(meta / "info.json", self._info())
        _write_json(meta / "stats.json", {
            f: {k: v.tolist() for k, v in values.items()} for f, values in self.stats.items()
        })  # fmt: skip
        header = {k: self.dataset.header[k] for k in ("licence", "source") if k in self.dataset.header}
        _write_json(meta / OURS, {
            "format": 1, "robot": self.dataset.robot_name, "joint_names": self.dataset.joint_names, "dt": self.dt,
            "dataset_hash": dataset_hash(entries), "virtual": any(e.meta.virtual for e in entries), "dataset": header,
        })  # fmt: skip

    def _info(self) -> dict[str, Any]:
        names = list(self.dataset.joint_names)
        features: dict[str, Any] = {
            FEATURES[c]: {"dtype": "float32", "shape": [self.n], "names": names, "info": {"unit": UNITS[c]}}
            for c in self.channels
        }
        features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in INDEX.items()}
        return {
            "codebase_version": VERSION, "robot_type": self.dataset.robot_name,
            "total_episodes": self.episodes, "total_frames": self.frames, "total_tasks": len(self.tasks),
            "chunks_size": CHUNK_FILES, "data_files_size_in_mb": FILE_MB, "video_files_size_in_mb": 200,
            "fps": _fps(self.dt), "splits": {"train": f"0:{self.episodes}"},
            "data_path": "data/" + PLACE, "video_path": None, "features": features,
        }  # fmt: skip


def _task_table(tasks: dict[str, int]) -> pa.Table:
    """task_index by task; the metadata make pandas take the text for the index, as LeRobot expects."""
    import pyarrow as pa

    column = {"metadata": None, "numpy_type": "int64", "pandas_type": "int64"}
    text = {"metadata": None, "numpy_type": "object", "pandas_type": "unicode"}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index"} | column,
            {"name": "task", "field_name": "task"} | text,
        ],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
