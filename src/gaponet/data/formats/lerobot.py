"""LeRobotDataset folder, v3.0 or v2.1: meta/info.json.

One folder, many episodes; what gaponet exports, and stock sets of position-controlled arms.

    meta/info.json                              codebase_version "v3.0", fps, features, data_path
    meta/tasks.parquet                          task, task_index
    meta/episodes/chunk-000/file-000.parquet    one row per episode: length, where its rows are
    data/chunk-000/file-000.parquet             one row per frame: action, observation.state,
                                                timestamp, frame_index, …

Of v2.1, one data file an episode and meta/episodes.jsonl, the episodes whose files are there are
read.

Stock sets hold positions alone: action is the command, observation.state the joints (row t as in
data.sequence). Their unit is not written in them: SO-101 sets are degrees, older ones −100..100 of
the calibrated range; --position-unit says which. A joint that the robot's log_unit calls a fraction
(a gripper) is 0..100 in both. What gaponet.data exported says its units, periods and metadata
itself. Images and videos are left alone. Actions that are poses of the hand, steps or speeds are
refused by the names of their values; logs.toml may name other features that hold joint targets.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.base.structure import validated
from gaponet.data.describe.actions import NO_TARGETS, what_it_holds
from gaponet.data.describe.encoders import Encoder, read_encoders
from gaponet.data.describe.joints import ignored, resolve_all
from gaponet.data.describe.plausibility import FULL_PERCENT, not_in_radians, to_radians
from gaponet.data.formats.lerobot_set import (
    AGAIN,
    FEATURES,
    Feature,
    Set,
    Stated,
    read_table,
    sets_under,
    tasks_of,
)
from gaponet.data.log import REQUIRED, Channel, Log
from gaponet.robot.spec import RobotSpec

OPTIONS = ("position_unit", "joints", "ignore", "calibration", "ctrl", "qpos")
POSITION_UNITS = ("rad", "deg", "fraction", "signed_percent", "ticks")
NO_SI = ("deg", "signed_percent", "ticks")  # units beside which a gripper is 0..100
MAX_PERCENT = 101.0  # beyond it, values are no percent
MIN_AT_END = 5  # rows of one joint at exactly ±100
INDEX = ("timestamp", "frame_index", "episode_index")  # columns of data files


def detects(path: Path) -> bool:
    """A folder with meta/info.json, or of such folders."""
    return path.is_dir() and any(
        next(path.glob(name), None) for name in ("meta/info.json", "*/meta/info.json")
    )


def find(path: Path) -> list[Path]:
    """The data file of every episode, of every set under the path."""
    files: list[Path] = []
    for part in sets_under(path):
        files += map(part.data_file, part.episodes)
    return files


@dataclass(frozen=True)
class _Options:
    """What is said of a set.

    Attributes:
        robot: Whose joints its values are.
        joint_map: The set's name of a joint → the robot's.
        unit: Of positions, one of POSITION_UNITS.
        joints: Names of the values, for a set that does not name them.
        ignore: Patterns of names that are no joints of this robot.
        encoders: The arm's calibration.
        features: Channel → feature, for channels that are not in the usual one.
    """

    robot: RobotSpec
    joint_map: dict[str, str] | None
    unit: str
    joints: list[str] | None = None
    ignore: tuple[str, ...] = ()
    encoders: dict[str, Encoder] | None = None
    features: dict[str, str] = field(default_factory=dict)


def read(
    path: Path, robot: RobotSpec, joint_map: dict[str, str] | None = None, **said: Any
) -> Iterator[tuple[str, Callable[[], Log]]]:
    """Yield (motion name, what reads its Log) for every episode.

    Args:
        joint_map: The set's name of a joint → the robot's.
        said: OPTIONS that logs.toml states. position_unit is not for what gaponet exported, which
            says rad itself.
    """
    encoders = None
    if "calibration" in said:
        encoders = read_encoders(Path(said["calibration"]), robot, joint_map)
    for part in sets_under(path):
        options = _Options(
            robot=robot,
            joint_map=joint_map,
            unit=_unit(part, said.get("position_unit")),
            joints=said.get("joints"),
            ignore=tuple(said.get("ignore", ())),
            encoders=encoders,
            features={channel: said[channel] for channel in ("ctrl", "qpos") if channel in said},
        )
        if part.absent:
            logging.getLogger("gaponet").warning(
                "%s: %d episodes that meta/episodes lists are missing", part.path, part.absent
            )
        tasks = tasks_of(part)
        frames = None
        for episode in part.episodes:
            file = part.data_file(episode)
            if frames is None or frames.file != file:
                frames = _Frames(part, file, options)
            yield _motion(episode, tasks), partial(frames.episode, episode)


def read_episodes(part: Set, episodes: list[dict[str, Any]], robot: RobotSpec) -> Iterator[Log]:
    """Yield the Logs of episodes of what gaponet exported; a data file is read once for its
    episodes in a row.
    """
    frames = None
    for episode in episodes:
        file = part.data_file(episode)
        if frames is None or frames.file != file:
            frames = _Frames(part, file, _Options(robot, None, _unit(part, None)))
        yield frames.episode(episode)


def _unit(part: Set, given: str | None) -> str:
    """The unit of positions: stated by an export, else by the user."""
    stated = []
    for name in ("action", "observation.state"):
        if name in part.features:
            stated.append((part.features[name].get("info") or {}).get("unit"))
    if part.ours and stated == ["rad", "rad"]:
        if given not in (None, "rad"):
            raise UsageError(
                f"--position-unit {given}: {part.path}/meta/info.json says rad; leave it out"
            )
        return "rad"
    if given not in POSITION_UNITS:
        explanation = "is not written in the set"
        if given:
            explanation = f"'{given}' is not one of {', '.join(POSITION_UNITS)}"
        raise UsageError(
            f"{part.path}: the unit of positions {explanation}; say --position-unit deg (SO-101 "
            "sets), signed_percent (older ones, −100..100) or rad"
        )
    return given


class _Frames:
    """Reads a data file once and cuts it into episodes."""

    def __init__(self, part: Set, file: Path, options: _Options) -> None:
        self.part = part
        self.file = file
        self.options = options
        robot = options.robot
        self.features = self._chosen_features()  # by channel
        names = {}  # channel → joints of its columns
        for channel, feature in self.features.items():
            names[channel] = self._joints(channel, feature, self._spec(feature))
        self.joints = tuple(joint for joint in robot.joint_names if joint in names["ctrl"])
        self._require_same_joints(names)
        self.units = [self._unit_of(joint) for joint in self.joints]
        table = read_table(file, (*self.features.values(), *INDEX))
        self.columns = {}  # channel → its values, (frames, n)
        for channel, feature in self.features.items():
            of_channel = names[channel]
            order = [of_channel.index(joint) for joint in self.joints]
            self.columns[channel] = _matrix(file, table, feature, len(of_channel))[:, order]
        self._require_unit()
        self.timestamp = _matrix(file, table, "timestamp", 1)[:, 0]
        self.frame = _matrix(file, table, "frame_index", 1)[:, 0]
        self.episodes = _matrix(file, table, "episode_index", 1)[:, 0]

    def _require_same_joints(self, names: dict[str, list[str]]) -> None:
        """Refuse channels with other joints than the command's. names: channel → joints, "" for
        columns that are none.
        """
        for channel, joints in names.items():
            odd = sorted(set(joints) - {""} ^ set(self.joints))
            if odd:
                raise JointMismatchError(
                    f"{self.part.path}/meta/info.json: joint '{odd[0]}' is not in both "
                    f"{self.features['ctrl']} and {self.features[channel]}"
                )

    def _chosen_features(self) -> dict[str, str]:
        """Return the feature of each channel: the usual one, or that of logs.toml."""
        usual = self.part.features
        there = self.part.info["features"]
        chosen = {ours: theirs for ours, theirs in FEATURES.items() if theirs in usual}
        info = f"{self.part.path}/meta/info.json"
        for channel, name in self.options.features.items():
            if name not in there:
                raise LogError(
                    f"{info}: no feature '{name}' (for {channel}); it has {', '.join(there)}"
                )
            chosen[channel] = name
        for need in REQUIRED:
            if need not in chosen:
                raise LogError(
                    f"{info}: no feature '{FEATURES[need]}'; it has {', '.join(there)}. Say "
                    f'{need} = "…" in logs.toml if another one holds it'
                )
        return chosen

    def _spec(self, feature: str) -> Feature:
        """Return what info.json says of a feature."""
        if feature in self.part.features:
            return self.part.features[feature]
        where = f"{self.part.path}/meta/info.json: features.{feature}"
        spec = self.part.info["features"][feature]
        return validated(Feature, spec, where, LogError, AGAIN, allow_extra=True)

    def _unit_of(self, joint: str) -> str:
        """The unit of a joint: a gripper is 0..100 of its range wherever the other joints are not
        SI.
        """
        robot = self.options.robot
        unit = self.options.unit
        in_range = robot.log_joints.units[robot.joint_names.index(joint)] == "fraction"
        calibrated = unit == "ticks" and self.options.encoders is not None
        if in_range and unit in NO_SI and not calibrated:
            return "percent"
        return unit

    def _require_unit(self) -> None:
        """Refuse degrees that are called percent, and percent that are called degrees."""
        for column, joint in enumerate(self.joints):
            unit = self.units[column]
            if unit not in ("deg", "signed_percent"):
                continue
            both = [self.columns["ctrl"][:, column], self.columns["qpos"][:, column]]
            size = np.abs(np.concatenate(both))
            largest = size.max()
            where = f"{self.file}: {joint}"
            if unit == "signed_percent" and largest > MAX_PERCENT:
                raise LogError(
                    f"{where} is up to {largest:.4g}, beyond −100..100 of a range: these are "
                    "degrees or ticks; say --position-unit deg (or ticks)"
                )
            at_end = int((size == FULL_PERCENT).sum())
            if unit == "deg" and at_end >= MIN_AT_END and largest == FULL_PERCENT:
                raise LogError(
                    f"{where} ends at exactly 100 in {at_end} values: these are LeRobot's "
                    "−100..100 of the calibrated range, not degrees; say --position-unit "
                    "signed_percent, and calibration in logs.toml"
                )

    def _joints(self, channel: str, feature: str, spec: Feature) -> list[str]:
        """The robot's own joint of each column, "" where it is said to be none."""
        options = self.options
        where = f"{self.part.path}/meta/info.json: {feature}"
        names = _value_names(spec) or options.joints
        if not names or len(names) != int(np.prod(spec["shape"])):
            raise LogError(
                f"{where} does not name its {spec['shape']} values; write joints = [their names, "
                "in order] into logs.toml beside the set"
            )
        short = [str(name).removesuffix(".pos") for name in names]
        kept = [name for name in short if not ignored(name, options.ignore)]
        if channel in ("ctrl", "qpos"):
            self._require_joints(kept, where)
        joints = resolve_all(kept, options.robot, where, options.joint_map)
        joint_of = dict(zip(kept, joints, strict=True))
        return [joint_of.get(name, "") for name in short]

    def _require_joints(self, names: list[str], where: str) -> None:
        """Refuse poses of the hand, steps and speeds, where no value is a joint; joints among them
        are told.
        """
        joints = []
        strange = []
        for name in names:
            try:
                joints.append(self.options.robot.resolve(name, where, self.options.joint_map))
            except JointMismatchError:
                strange.append(name)
        held = what_it_holds(strange)
        if held is None:
            return
        shown = ", ".join(strange[:4]) + (", …" if len(strange) > 4 else "")
        if len(joints) > 1:
            patterns = ", ".join(f'"{name}"' for name in strange)
            raise LogError(
                f"{where} holds joint positions ({', '.join(joints)}), and {held} ({shown}); "
                f"leave these out: ignore = [{patterns}] in logs.toml"
            )
        named = [name for name in self.part.info["features"] if re.search(r"joint|qpos", name)]
        others = [name for name in named if name not in where]
        hint = f" Features that may hold them: {', '.join(others)}." if others else ""
        raise LogError(f"{where} holds {held} ({shown}), not joint positions. {NO_TARGETS}.{hint}")

    def episode(self, row: dict[str, Any]) -> Log:
        """The frames of an episode as a Log, in SI."""
        index = int(row["episode_index"])
        length = int(row["length"])
        where = np.flatnonzero(self.episodes == index)
        if len(where) != length or not np.array_equal(self.frame[where], np.arange(length)):
            raise LogError(
                f"{self.file}: episode {index} has {len(where)} frames here, meta/episodes says "
                f"{length} in a row; download or export the set again"
            )
        time = self._time(where)
        channels = {}
        for channel, values in self.columns.items():
            channels[channel] = Channel(time, self._si(channel, values[where]))
        meta: dict[str, Any] = {
            "files": dict.fromkeys(channels, str(self.file)),
            "first_line": int(where[0]) + 1,
            "dt": self.part.dt,
            "converted_from": not_in_radians(self.joints, self.units),
        }
        if self.part.ours:
            meta["stated"] = row["stated"]
            meta["dataset"] = {}
            for name, text in self.part.ours["dataset"].items():
                if name in Stated.__annotations__:
                    meta["dataset"][name] = text
        return Log(self.options.robot.name, self.joints, channels, f"{self.file}#{index}", meta)

    def _time(self, where: Array) -> Array:
        """Return the times of an episode's rows, s.

        Frames are a period apart; their timestamps, float32, lose digits and are believed only
        where they differ.
        """
        regular = np.arange(len(where)) * self.part.dt
        since_start: Array = self.timestamp[where] - self.timestamp[where[0]]
        tolerance = max(1e-3, 1e-6 * regular[-1])
        if np.abs(since_start - regular).max(initial=0) < tolerance:
            return regular
        return since_start

    def _si(self, channel: str, values: Array) -> Array:
        """Return values in SI."""
        options = self.options
        return to_radians(
            channel, values.copy(), self.joints, self.units, options.robot, options.encoders
        )


def _value_names(spec: Feature) -> list[Any] | None:
    """Return the names of a feature's values: a list, or one in a list or in a dictionary."""
    names = spec["names"]
    if isinstance(names, dict):
        lists = [value for value in names.values() if isinstance(value, list)]
        names = lists[0] if lists else None
    if names and isinstance(names[0], list):
        return names[0]
    return names


def _motion(episode: dict[str, Any], tasks: dict[int, str]) -> str:
    """The motion's own name in an export; in a stock set, whose episodes are not repetitions, task
    and number.
    """
    if "stated" in episode:
        return str(episode["stated"]["motion"])
    texts = episode.get("tasks") or list(tasks.values()) or ["episode"]
    slug = re.sub(r"[^a-z0-9]+", "_", texts[0].lower()).strip("_")[:40] or "episode"
    return f"{slug}-{episode['episode_index']:04d}"


def _matrix(file: Path, table: Any, feature: str, n: int) -> Array:
    """A column of lists of n numbers, or of numbers where n is 1: (frames, n) float64."""
    import pyarrow as pa

    column = table[feature].combine_chunks()
    kind = table.schema.field(feature).type
    lists = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)
    element = kind.value_type if lists else kind
    numeric = pa.types.is_integer(element) or pa.types.is_floating(element)
    if not numeric or not (lists or n == 1):
        raise LogError(f"{file}: {feature} is {kind}, not {n} numbers a row; {AGAIN}")
    row = _first_wrong_row(column, lists, n)
    if row is not None:
        raise LogError(f"{file}:{row + 1}: {feature} is not {n} numbers; {AGAIN}")
    flat = column.flatten() if lists else column
    values: Array = flat.to_numpy(zero_copy_only=False).astype(float)
    return values.reshape(-1, n)


def _first_wrong_row(column: Any, lists: bool, n: int) -> int | None:
    """Return the first row of a column that is not n numbers; None if all are."""
    import pyarrow.compute as pc

    wrong = column.is_null().to_numpy(False)
    if lists and not wrong.any():
        wrong = pc.list_value_length(column).to_numpy(zero_copy_only=False) != n
    if wrong.any():
        return int(wrong.argmax())
    flat = column.flatten() if lists else column
    if flat.null_count:
        return int(flat.is_null().to_numpy(False).argmax()) // n
    return None
