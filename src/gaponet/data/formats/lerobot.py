"""LeRobotDataset v3.0: one folder, many episodes; what gaponet exports, and stock sets of position-controlled arms.

    meta/info.json                          codebase_version "v3.0", fps, features, data_path
    meta/tasks.parquet                      task, task_index
    meta/episodes/chunk-000/file-000.parquet    one row per episode: length, where its rows are
    data/chunk-000/file-000.parquet         one row per frame: action, observation.state, timestamp, frame_index, …

Stock sets hold positions alone: action is the command, observation.state the joints (row t as in data.sequence). Their
unit is not written in them: SO-101 sets are degrees, older ones −100..100 of the calibrated range; --position-unit says
which. A joint that the robot's log_unit calls a fraction (a gripper) is 0..100 in both. What gaponet.data exported says
its units, periods and metadata itself. Images and videos are left alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.formats import refuse_degrees, to_radians
from gaponet.data.log import Channel, Log
from gaponet.data.sequence import SequenceMeta
from gaponet.errors import JointMismatchError, LogError, UsageError
from gaponet.robot import RobotSpec

Array = np.ndarray

OPTIONS = ("position_unit",)
VERSION = "v3.0"
FEATURES = {
    "ctrl": "action",
    "qpos": "observation.state",
    "qvel": "observation.velocity",
    "qacc": "observation.acceleration",
    "tau": "observation.torque",
    "tau_eq": "observation.equivalent_torque",
    "temperature": "observation.temperature",
}
POSITION_UNITS = ("rad", "deg", "fraction", "signed_percent")
OURS = "gaponet.json"  # beside info.json in an export: dt, and that the episodes' metadata are ours
STATED = tuple(f for f in SequenceMeta.__dataclass_fields__ if f != "robot")  # columns of our meta/episodes
LATER = ("kp", "kd")  # not in the first exports


@dataclass(frozen=True)
class Set:
    """One LeRobot folder: its info.json, the metadata of its episodes, and ours where it is an export."""

    path: Path
    info: dict[str, Any]
    episodes: list[dict[str, Any]]
    ours: dict[str, Any]

    @property
    def dt(self) -> float:
        """s, exact."""
        return float(self.ours.get("dt", 1 / self.info["fps"]))

    def data_file(self, episode: dict[str, Any]) -> Path:
        """Where the frames of an episode are."""
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        return self.path / self.info["data_path"].format(**place)


def find(path: Path) -> list[Path]:
    """The data file of every episode, of every set under the path."""
    return [s.data_file(e) for s in _sets(path) for e in s.episodes]


def read(
    path: Path, robot: RobotSpec, joint_map: dict[str, str] | None = None, position_unit: str | None = None
) -> Iterator[tuple[str, Log]]:
    """Yield (motion name, Log) for every episode.

    Args:
        path: A set, or a folder of sets.
        robot: Whose joint names and ranges apply.
        joint_map: The set's name of a joint → the robot's.
        position_unit: One of POSITION_UNITS; not for what gaponet exported, which says rad itself.
    """
    for part in _sets(path):
        unit = _unit(part, position_unit)
        tasks = _tasks(part)
        open_file, table = Path(), None
        for episode in part.episodes:
            file = part.data_file(episode)
            if file != open_file:
                open_file, table = file, _Frames(part, file, robot, joint_map, unit)
            assert table is not None
            log = table.episode(episode)
            yield _motion(episode, tasks), log if part.ours else refuse_degrees(log, robot)


def _sets(path: Path) -> list[Set]:
    """The set at a path, or those in its folders."""
    infos = [path / "meta" / "info.json"]
    if not infos[0].is_file():
        infos = sorted(path.glob("*/meta/info.json"))
    if not infos:
        raise LogError(f"{path}: no meta/info.json in it; point at a LeRobotDataset v3.0 folder")
    return [_open(info) for info in infos]


def _open(file: Path) -> Set:
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        version, _ = str(info["codebase_version"]), info["features"]
        fps, _ = float(info["fps"]), info["data_path"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"{file}: not a LeRobot info.json ({error}); download or export it again") from None
    if version.split(".")[0] != VERSION.split(".")[0]:
        raise LogError(
            f"{file}: codebase_version is {version}, this reads {VERSION}; convert the set with lerobot's "
            "convert_dataset_v21_to_v30"
        )
    if not 1 <= fps <= 10_000:
        raise LogError(f"{file}: fps is {info['fps']}; expected 1 to 10000")
    root = file.parents[1]
    ours = file.with_name(OURS)
    episodes = [row for f in sorted((root / "meta" / "episodes").glob("*/*.parquet")) for row in _episodes(f)]
    if not episodes:
        raise LogError(f"{root}: meta/episodes lists no episode; download or export it again")
    episodes.sort(key=lambda e: e["episode_index"])
    absent = set(STATED) - set(LATER) - set(episodes[0])
    if ours.is_file() and absent:
        raise LogError(
            f"{root}/meta/episodes: '{min(absent)}' is missing, which {ours.name} promises; "
            f"restore it, or delete {ours.name} to read the set as a stock one"
        )
    return Set(root, info, episodes, json.loads(ours.read_text(encoding="utf-8")) if ours.is_file() else {})


def _episodes(file: Path) -> list[dict[str, Any]]:
    need = ("episode_index", "length", "dataset_from_index", "data/chunk_index", "data/file_index")
    table = _table(file, lambda name: not name.startswith("stats/"))
    for name in need:
        if name not in table.column_names:
            raise LogError(f"{file}: column '{name}' is missing; it has {', '.join(table.column_names[:12])}")
    return table.to_pylist()


def _tasks(part: Set) -> dict[int, str]:
    """{task_index: text}; the text stands in the index of a pandas table, under either name."""
    file = part.path / "meta" / "tasks.parquet"
    if not file.is_file():
        return {}
    table = _table(file)
    text = next((n for n in table.column_names if n != "task_index"), None)
    if text is None or "task_index" not in table.column_names:
        raise LogError(f"{file}: no task and task_index in it; download or export it again")
    return dict(zip(table["task_index"].to_pylist(), map(str, table[text].to_pylist()), strict=True))


def _unit(part: Set, given: str | None) -> str:
    """The unit of positions: stated by an export, else by the user."""
    stated = {part.info["features"][f].get("info", {}).get("unit") for f in ("action", "observation.state")
              if f in part.info["features"]}  # fmt: skip
    if part.ours and stated == {"rad"}:
        if given not in (None, "rad"):
            raise UsageError(f"--position-unit {given}: {part.path}/meta/info.json says rad; leave it out")
        return "rad"
    if given not in POSITION_UNITS:
        said = f"'{given}' is not one of {', '.join(POSITION_UNITS)}" if given else "is not written in the set"
        raise UsageError(
            f"{part.path}: the unit of positions {said}; say --position-unit deg (SO-101 sets), signed_percent (older "
            "ones, −100..100) or rad"
        )
    return given


class _Frames:
    """One data file, read once, cut into episodes."""

    def __init__(self, part: Set, file: Path, robot: RobotSpec, joint_map: dict[str, str] | None, unit: str) -> None:
        self.part, self.file, self.robot = part, file, robot
        features = part.info["features"]
        present = {ours: theirs for ours, theirs in FEATURES.items() if theirs in features}
        for need in ("ctrl", "qpos"):
            if need not in present:
                raise LogError(
                    f"{part.path}/meta/info.json: no feature '{FEATURES[need]}'; it has {', '.join(features)}"
                )
        names = {c: self._joints(f, features[f], joint_map) for c, f in present.items()}
        self.joints = tuple(j for j in robot.joint_names if j in names["ctrl"])
        for channel, theirs in names.items():
            odd = sorted(set(theirs) ^ set(self.joints))
            if odd:
                raise JointMismatchError(
                    f"{part.path}/meta/info.json: joint '{odd[0]}' is not in both action and {FEATURES[channel]}"
                )
        self.units = [self._joint_unit(j, unit) for j in self.joints]
        table = _table(file, {*present.values(), "timestamp", "frame_index", "episode_index"}.__contains__)
        self.columns = {
            c: _matrix(file, table, f)[:, [names[c].index(j) for j in self.joints]] for c, f in present.items()
        }
        self.timestamp, self.frame, self.episodes = (
            table[name].to_numpy() for name in ("timestamp", "frame_index", "episode_index")
        )

    def _joints(self, feature: str, spec: dict[str, Any], joint_map: dict[str, str] | None) -> list[str]:
        """The robot's own joint of each column; names are a list, or a list in a dictionary, often with .pos behind."""
        names, where = spec.get("names"), f"{self.part.path}/meta/info.json: {feature}"
        if isinstance(names, dict):
            names = next((v for v in names.values() if isinstance(v, list)), None)
        if not isinstance(names, list) or len(names) != int(np.prod(spec["shape"])):
            raise LogError(f"{where} does not name its {spec['shape']} values; write the joints' names there")
        found = [self.robot.resolve(str(name).removesuffix(".pos"), where, joint_map) for name in names]
        if len(set(found)) != len(found):
            raise JointMismatchError(f"{where}: two names map to one joint: {', '.join(found)}; mend --map")
        return found

    def _joint_unit(self, joint: str, unit: str) -> str:
        """A gripper is 0..100 of its range wherever the other joints are not SI."""
        share = self.robot.log_units[self.robot.joint_names.index(joint)] == "fraction"
        return "percent" if share and unit in ("deg", "signed_percent") else unit

    def episode(self, row: dict[str, Any]) -> Log:
        """The frames of an episode as a Log, in SI."""
        index, length = int(row["episode_index"]), int(row["length"])
        where = np.flatnonzero(self.episodes == index)
        if len(where) != length or not np.array_equal(self.frame[where], np.arange(length)):
            raise LogError(
                f"{self.file}: episode {index} has {len(where)} frames here, meta/episodes says {length} in a row; "
                "download or export the set again"
            )
        time = self._time(where)
        channels = {c: Channel(time, self._si(c, values[where])) for c, values in self.columns.items()}
        meta: dict[str, Any] = {
            "files": dict.fromkeys(channels, str(self.file)),
            "first_line": int(where[0]) + 1,
            "dt": self.part.dt,
            "converted_from": {j: u for j, u in zip(self.joints, self.units, strict=True) if u != "rad"},
        }
        if self.part.ours:
            meta["stated"] = {name: row[name] for name in STATED if name in row}
            meta["stated"] |= {name: json.loads(row[name]) for name in ("notes", *LATER) if name in row}
            meta["dataset"] = self.part.ours.get("dataset", {})
        return Log(self.robot.name, self.joints, channels, f"{self.file}#{index}", meta)

    def _time(self, where: Array) -> Array:
        """Frames are a period apart; their timestamps, float32, lose digits and are believed only where they differ."""
        regular = np.arange(len(where)) * self.part.dt
        told = self.timestamp[where].astype(float)
        told = told - told[0]
        return regular if np.abs(told - regular).max(initial=0) < max(1e-3, 1e-6 * regular[-1]) else told

    def _si(self, channel: str, values: Array) -> Array:
        """Percentages to fractions, then as for every format."""
        values, units = values.copy(), list(self.units)
        for column, unit in enumerate(self.units):
            if unit in ("percent", "signed_percent") and channel in ("ctrl", "qpos", "qvel"):
                low, span = (0.0, 100.0) if unit == "percent" else (-100.0, 200.0)
                values[:, column] = (values[:, column] - (0.0 if channel == "qvel" else low)) / span
                units[column] = "fraction"
        return to_radians(channel, values, self.joints, units, self.robot)


def _motion(episode: dict[str, Any], tasks: dict[int, str]) -> str:
    """The motion's own name in an export; in a stock set, whose episodes are not repetitions, task and number."""
    if "motion" in episode:
        return str(episode["motion"])
    told = episode.get("tasks") or list(tasks.values())[:1] or ["episode"]
    slug = re.sub(r"[^a-z0-9]+", "_", str(told[0]).lower()).strip("_")[:40] or "episode"
    return f"{slug}-{int(episode['episode_index']):04d}"


def _matrix(file: Path, table: Any, feature: str) -> Array:
    """A column of lists, or of numbers where there is one joint: (frames, n)."""
    import pyarrow as pa

    column = table[feature].combine_chunks()
    if column.null_count:
        raise LogError(f"{file}: {feature} is empty in row {int(np.argmax(column.is_null().to_numpy(False)))}")
    nested = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
    flat = (column.flatten() if nested else column).to_numpy(zero_copy_only=False)
    if len(flat) % max(len(column), 1):
        raise LogError(f"{file}: rows of {feature} differ in length; download or export the set again")
    return flat.reshape(len(column), -1)


def _table(file: Path, wanted: Callable[[str], bool] = lambda name: True) -> Any:
    """The wanted columns of a Parquet file, as a pyarrow table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        parquet = pq.ParquetFile(file)
        return parquet.read(columns=[name for name in parquet.schema_arrow.names if wanted(name)])
    except (pa.ArrowException, OSError) as error:
        reason = str(error).split("\n")[0].rstrip(".")
        raise LogError(f"{file}: not a readable Parquet file ({reason}); download or export the set again") from None
