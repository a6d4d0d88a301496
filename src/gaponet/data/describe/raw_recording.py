"""A recording as it lies in a file: named signals, of which logs.toml says what they are.

`to_log` is the way on.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as ListOf
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError, UsageError
from gaponet.data.describe.clocks import (
    COMMAND,
    TIME,
    clock_periods,
    named_like_a_clock,
    require_one_rate,
)
from gaponet.data.describe.encoders import Encoder, read_encoders
from gaponet.data.describe.joints import ignored, resolve_all
from gaponet.data.describe.logs_file import HINT, LogsFile
from gaponet.data.describe.plausibility import not_in_radians, to_radians
from gaponet.data.describe.repeats import repeats_row_before
from gaponet.data.describe.slow_channels import sampled_channels
from gaponet.data.log import CHANNELS, COMMANDS, DERIVED, FEEDFORWARD, REQUIRED, Channel, Log
from gaponet.robot.log_joints import LOG_UNITS
from gaponet.robot.spec import RobotSpec

WIDEST = 500  # columns of an array that may be joints
MIN_WIDTHS = 10  # columns over rows, from which an array is taken to have a column per sample
MAX_RATE_ERROR = 0.1  # of the rate that is stated beside a clock
MAX_GAIN_CHANGE = 1e-3  # of a gain, while it is recorded
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SAY_UNITS = "--position-unit rad --time-unit s (or position_unit and time_unit in logs.toml)"
MOST_ROWS_APART = 2  # of channels without a clock: the state before the first command, and the last
NO_COMMANDS = (
    "without commanded positions there is no gap to measure. Record the position controller's "
    "targets beside the state, or play the recorded positions again (gaponet run) and record "
    "both. If torque or current is the command: docs/logs.md, 'Driven by torque or current'"
)


class Signal(NamedTuple):
    """One signal of a recording."""

    values: Array  # (k,) or (k, n)
    time: Array | None = None  # (k,) s, where the signal has a clock of its own
    in_seconds: bool = False  # a clock that was written as dates: nobody has to state its unit


class Column(NamedTuple):
    """One column of a recording."""

    signal: str
    number: int | None  # in the signal; None for a signal of one column

    def of(self, loaded: dict[str, Signal]) -> Array:
        """Return its values, (k,)."""
        values = loaded[self.signal].values
        return values if self.number is None else values[:, self.number]


Columns = dict[str, Column]  # of one channel, by the robot's own joint
Chosen = dict[str, Columns]  # by channel


@dataclass(frozen=True)
class RawRecording:
    """One recording.

    A signal (k, n) has n names of columns, which are "0", "1", … where the file does not name them;
    a signal (k,) has none: ().
    """

    name: str  # motion, unless logs.toml states another
    source: str  # file or folder, with #part where a file holds several
    signals: dict[str, tuple[str, ...]]  # name → names of its columns
    load: Callable[[list[str]], dict[str, Signal]]  # reads the signals of these names
    where: str = ""  # place of the names, for errors
    files: tuple[str, ...] = ()  # of which it was read, for the hash
    first_line: int = 1  # line in the file where its rows begin
    meta: dict[str, Any] = field(default_factory=dict)  # stated, dt, notes, as in Log.meta
    default: LogsFile = field(default_factory=lambda: LogsFile())  # unless something else is stated

    @property
    def place(self) -> str:
        """File and line, or what else an error about names points at."""
        return self.where or self.source

    @property
    def columns(self) -> dict[str, Column]:
        """Every column by the name that logs.toml may call it: "signal" or "signal[label]"."""
        columns = {}
        for name, labels in self.signals.items():
            if not labels:
                columns[name] = Column(name, None)
            for i, label in enumerate(labels):
                columns[f"{name}[{label}]"] = Column(name, i)
        return columns

    def shown(self, most: int = 12) -> str:
        """The signals, for an error."""
        names = []
        for name, labels in self.signals.items():
            names.append(f"{name}[{len(labels)}]" if labels else name)
        return ", ".join(names[:most]) + (", …" if len(names) > most else "")

    def beside(self, other: RawRecording, prefix: str = COMMAND) -> RawRecording:
        """This recording with the signals of another file, whose names begin with the prefix
        here.
        """

        def load(names: list[str]) -> dict[str, Signal]:
            ours = []
            theirs = []
            for name in names:
                if name.startswith(prefix):
                    theirs.append(name.removeprefix(prefix))
                else:
                    ours.append(name)
            loaded = self.load(ours)
            if theirs:
                loaded |= {prefix + name: signal for name, signal in other.load(theirs).items()}
            return loaded

        signals = dict(self.signals)
        for name, labels in other.signals.items():
            signals[prefix + name] = labels
        return replace(self, signals=signals, load=load, files=self.files + other.files)

    @classmethod
    def of_arrays(
        cls,
        file: Path,
        arrays: dict[str, Any],
        names: tuple[str, ...] = (),
        name: str = "",
        part: str = "",
        **more: Any,
    ) -> RawRecording:
        """Return a recording of arrays in memory, (k,) or (k, n) of numbers; others are left alone.

        Arrays with a column per sample are turned, which is noted.

        Args:
            arrays: By the name that logs.toml may call them.
            names: The names of columns, for arrays that have so many.
            name: Default the file's.
            part: Which of several in the file.
            more: meta, default.
        """
        arrays, turned = rows_first(arrays)
        if turned:
            meta = more.get("meta", {})
            notes = meta.get("notes", {}) | {"transposed": turned}
            more["meta"] = meta | {"notes": notes}
        numeric = {name: array for name, array in arrays.items() if _is_signal(array)}
        if not numeric:
            _refuse_three_axes(file, arrays)
        signals = {name: _column_names(array, names) for name, array in numeric.items()}
        source = f"{file}#{part}" if part else str(file)

        def load(wanted: list[str]) -> dict[str, Signal]:
            return {name: Signal(numeric[name].astype(float)) for name in wanted}

        return RawRecording(name or file.stem, source, signals, load, source, (str(file),), **more)

    def to_log(self, robot: RobotSpec, stated: LogsFile, joint_map: dict[str, str] | None) -> Log:
        """Return the columns that logs.toml calls ctrl, qpos, … as channels in SI, each with its
        clock; all clocks begin at 0 together.

        Args:
            stated: logs.toml, which wins over `default`.
            joint_map: The log's joint → the robot's.
        """
        specified = self.default | stated
        chosen = _choose(self, robot, specified, joint_map)
        if FEEDFORWARD in stated and FEEDFORWARD not in chosen:
            raise LogError(
                f"{self.place}: no column holds {FEEDFORWARD}; there are: {self.shown()}"
            )
        clocks = _clocks(specified, chosen)
        self._require_one_clock(clocks, specified)
        gains = _gain_columns(self, specified, chosen["ctrl"])
        loaded = self._load_columns([*chosen.values(), *gains.values()], clocks)
        if _is_in_seconds(clocks, loaded):
            specified = LogsFile(time_unit="s") | specified
        _require_one_length(chosen, loaded, specified, self.place)
        units = _units(robot, specified, list(chosen["ctrl"]), joint_map)
        joints = tuple(name for name in robot.joint_names if name in chosen["ctrl"])
        encoders = _encoders(robot, specified, joint_map)
        units_in_order = [units[joint] for joint in joints]
        in_si = _Conversion(robot, joints, units_in_order, specified, encoders)
        channels = {}
        for channel, columns in chosen.items():
            time = _time(self, specified, loaded, clocks[channel], channel, columns)
            channels[channel] = Channel(time, in_si.values(channel, columns, loaded))
        kept = {name: ~repeats_row_before(channel) for name, channel in channels.items()}
        repeated = _note_of_repeated(kept)
        channels = _rows_of(channels, kept)
        channels, sampled, empty = sampled_channels(channels, joints, self.place)
        channels = _from_zero(channels)
        meta = self._meta(channels, specified)
        meta["rows"] = {name: np.flatnonzero(kept[name])[rows] for name, rows in sampled.items()}
        meta["notes"] = meta.get("notes", {}) | empty | repeated
        for name, columns in gains.items():
            meta[name] = [_constant(self, name, columns[joint].of(loaded)) for joint in joints]
        meta["converted_from"] = not_in_radians(joints, units_in_order)
        return Log(robot.name, joints, channels, self.source, meta)

    def _meta(self, channels: Iterable[str], specified: LogsFile) -> dict[str, Any]:
        """Log.meta of what the recording and logs.toml say of its files and its period."""
        meta = dict(self.meta)
        if "rate" in specified:
            meta["dt"] = 1 / specified["rate"]
        meta["files"] = dict.fromkeys(channels, self.files[0] if self.files else self.source)
        meta["all_files"] = self.files
        meta["first_line"] = self.first_line
        return meta

    def _load_columns(
        self, columns: list[Columns], clocks: dict[str, str | None]
    ) -> dict[str, Signal]:
        """Load the signals of some columns, and those that are clocks."""
        names = set[str]()
        for of_channel in columns:
            names.update(column.signal for column in of_channel.values())
        of_time = {clock for clock in clocks.values() if clock in self.signals} - names
        return self.load([*names, *of_time])

    def _require_one_clock(self, clocks: dict[str, str | None], specified: LogsFile) -> None:
        """Refuse clocks of channels that another column contradicts."""
        chosen = {clock for clock in clocks.values() if clock in self.signals}
        rivals = [name for name in self.signals if named_like_a_clock(name)]
        if "rate" in specified or not chosen or len(rivals) < 2:
            return
        periods = clock_periods(self.signals, self.load)
        used = [*specified.get("clock", {}).values(), specified.get("time", "")]
        for clock in sorted(filter(None, chosen)):
            require_one_rate(periods, clock, used, specified.get("ignore", ()), self.place)


def rows_first(arrays: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return arrays with a row per sample, and the names of those that had a column per sample, as
    MATLAB writes them.

    The longest array of one axis, such as the clock, tells the number of samples. An array that is
    no longer than the tables are high, such as a list of gains, turns none. Without an array of one
    axis, tables are taken as transposed if all are far wider than high. A clock (1, k) or (k, 1)
    becomes (k,).
    """
    tables = {}
    for name, array in arrays.items():
        if isinstance(array, np.ndarray) and array.ndim == 2:
            tables[name] = array
    clocks = {name: table.ravel() for name, table in tables.items() if _is_clock(name, table)}
    arrays = arrays | clocks
    samples = _samples(arrays, list(tables.values()))
    if samples < 2:
        return arrays, []
    turned = []
    for name, table in tables.items():
        rows, columns = table.shape
        if name not in clocks and columns == samples and rows < samples:
            turned.append(name)
    return arrays | {name: tables[name].T for name in turned}, turned


def _is_clock(name: str, table: Array) -> bool:
    """Return True for a single row or column that is called like a clock."""
    return 1 in table.shape and named_like_a_clock(name)


def _samples(arrays: dict[str, Any], tables: list[Array]) -> int:
    """Return the number of samples: the length of the longest array of one axis that is longer than
    the tables are high, else the width of the tables; 0 if there is neither, or a table is not far
    wider than high.
    """
    height = min((len(table) for table in tables), default=1)
    samples = 0
    for array in arrays.values():
        if isinstance(array, np.ndarray) and array.ndim == 1:
            samples = max(samples, len(array))
    if samples > height:
        return samples
    widest = 0
    for table in tables:
        rows, columns = table.shape
        if rows * MIN_WIDTHS > columns:
            return 0
        widest = max(widest, columns)
    return widest


def _is_signal(array: Any) -> bool:
    """Return True for an array of numbers with a row per sample."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        return False
    if array.ndim not in (1, 2) or len(array) < 2:
        return False
    return array.ndim == 1 or 0 < array.shape[1] <= WIDEST


def _column_names(array: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of an array's columns: none of a single one, else these, or digits."""
    if array.ndim == 1:
        return ()
    columns = array.shape[1]
    if columns == len(names):
        return names
    return tuple(str(i) for i in range(columns))


GIT_LFS_POINTER = b"version https://git-lfs"  # how such a file begins


def require_content(file: Path) -> None:
    """Refuse a file that git put in the place of a large one.

    Raises:
        LogError: It is a Git LFS pointer.
    """
    if not file.is_file():
        return
    with file.open("rb") as stream:
        beginning = stream.read(len(GIT_LFS_POINTER))
    if beginning == GIT_LFS_POINTER:
        raise LogError(
            f"{file}: is a Git LFS pointer of some bytes, not the recording; run 'git lfs pull' "
            "in its repository, or download the file itself"
        )


@contextmanager
def reading(file: Path, what: str) -> Iterator[None]:
    """Turn any error of a library on a damaged file into one error with the file name."""
    require_content(file)
    try:
        yield
    except (LogError, MemoryError, ImportError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        hint = "is it the right file?"
        if _cut_short(file, error):
            hint = "it is cut short: copy or record it again"
        raise LogError(f"{file}: not a readable {what} ({reason}); {hint}") from None


# MCAP and Parquet files begin with these bytes, and end with them if they are whole.
ENDS = (b"\x89MCAP0\r\n", b"PAR1")
CUT_SHORT = re.compile(r"truncated|unexpected(ly)? end|end.of.file")  # in messages of libraries


def _cut_short(file: Path, error: Exception) -> bool:
    """Return True if the end of a file is missing, by the error or by its last bytes."""
    if isinstance(error, EOFError) or CUT_SHORT.search(str(error).lower()):
        return True
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        start = stream.read(8)
        stream.seek(max(0, file.stat().st_size - 8))
        stop = stream.read(8)
    if start.startswith(b"PK\x03\x04"):
        return not zipfile.is_zipfile(file)
    for mark in ENDS:
        if start == mark[: len(start)]:  # nothing but the beginning is there
            return True
        if start.startswith(mark) and not stop.endswith(mark):
            return True
    return False


def _refuse_three_axes(file: Path, arrays: dict[str, Any]) -> None:
    """Refuse arrays of several recordings."""
    deep = [name for name, array in arrays.items() if getattr(array, "ndim", 0) == 3]
    if deep:
        raise LogError(
            f"{file}: {', '.join(deep)} have three axes, {arrays[deep[0]].shape}: several "
            "recordings in one array; write each into a file of its own, with a row per sample"
        )


def by_place(recordings: ListOf[RawRecording]) -> dict[str, RawRecording]:
    """Return recordings by their files, relative to the folder that holds all of them."""
    files = [Path(recording.source) for recording in recordings]
    if not files:
        return {}
    root = os.path.commonpath([file.parent for file in files])
    places = [file.relative_to(root).as_posix() for file in files]
    return dict(zip(places, recordings, strict=True))


@dataclass(frozen=True)
class _Conversion:
    """How columns of a log become SI.

    Attributes:
        joints: The robot's own names, (n).
        units: Of their positions, (n).
        specified: logs.toml with all defaults.
        encoders: The arm's calibration, if one is given.
    """

    robot: RobotSpec
    joints: tuple[str, ...]
    units: list[str]
    specified: LogsFile
    encoders: dict[str, Encoder] | None

    def values(self, channel: str, columns: Columns, loaded: dict[str, Signal]) -> Array:
        """Return the values of a channel, (k, n) in SI."""
        logged = [columns[joint].of(loaded) for joint in self.joints]
        values = np.stack(logged, axis=1).astype(float)
        if channel == "ctrl" and "action_scale" in self.specified:
            home = self.robot.qpos_home[self.robot.index(self.joints)]
            values = home + self.specified["action_scale"] * values
        return to_radians(channel, values, self.joints, self.units, self.robot, self.encoders)


def _require_one_length(
    chosen: Chosen, loaded: dict[str, Signal], specified: LogsFile, where: str
) -> None:
    """Refuse channels without clocks that have different numbers of rows: they have other rates."""
    if "rate" not in specified:
        return
    rows = {}
    for channel, columns in chosen.items():
        signal = _first_signal(columns, loaded)
        if signal.time is None:
            rows[channel] = len(signal.values)
    if max(rows.values(), default=0) - min(rows.values(), default=0) <= MOST_ROWS_APART:
        return
    counted = ", ".join(f"{name} {count}" for name, count in rows.items())
    raise LogError(
        f"{where}: at rate = {specified['rate']:g} Hz all channels must have equally many rows; "
        f"these have {counted}. They were logged at different rates, or parts are missing: give "
        "each its clock (time, time_file, [clock] in logs.toml), or write them with one row per "
        "instant"
    )


def _rows_of(channels: dict[str, Channel], kept: dict[str, Array]) -> dict[str, Channel]:
    """Return channels with the kept rows; channels of one clock that lose none still share it."""
    left = {}
    for name, channel in channels.items():
        keep = kept[name]
        left[name] = channel
        if not keep.all():
            left[name] = Channel(channel.time[keep], channel.values[keep])
    return left


def _note_of_repeated(kept: dict[str, Array]) -> dict[str, Any]:
    """Return a note of the rows that were written twice at one instant; empty if none was."""
    most = max(int((~keep).sum()) for keep in kept.values())
    return {"repeated": {"rows": most}} if most else {}


def _encoders(
    robot: RobotSpec, specified: LogsFile, joint_map: dict[str, str] | None
) -> dict[str, Encoder] | None:
    if "calibration" not in specified:
        return None
    return read_encoders(Path(specified["calibration"]), robot, joint_map)


def _clocks(specified: LogsFile, chosen: Chosen) -> dict[str, str | None]:
    """Return channel → column of its clock; None where none is named."""
    own: dict[Any, str] = specified.get("clock", {})
    common = specified.get("time")
    return {channel: own.get(channel) or common for channel in chosen}


def _is_in_seconds(clocks: dict[str, str | None], loaded: dict[str, Signal]) -> bool:
    """Return True if a clock of a channel was written as dates."""
    return any(loaded[clock].in_seconds for clock in clocks.values() if clock in loaded)


def _from_zero(channels: dict[str, Channel]) -> dict[str, Channel]:
    """Return channels whose time starts at 0: nanoseconds since 1970 would lose their digits."""
    starts = []
    for channel in channels.values():
        starts += channel.time[np.isfinite(channel.time)][:1].tolist()
    start = min(starts, default=0.0)
    shifted: dict[int, Array] = {}  # a clock that channels share stays shared
    from_zero = {}
    for name, (time, values) in channels.items():
        if id(time) not in shifted:
            shifted[id(time)] = time - start
        from_zero[name] = Channel(shifted[id(time)], values)
    return from_zero


def _choose(
    recording: RawRecording, robot: RobotSpec, specified: LogsFile, joint_map: dict[str, str] | None
) -> Chosen:
    """Return the columns of each channel, by joint."""
    columns = recording.columns
    single = specified.get("columns", {})
    _require_columns(recording, single)
    clocks = specified.get("clock", {}).values()
    taken = {*single.values(), specified.get("time", ""), *clocks}  # not to be found by a pattern
    chosen: Chosen = {}
    for channel in (*CHANNELS, *DERIVED):
        found = _matching(recording, specified, channel, taken)
        for ours, theirs in single.items():
            kind, _, joint = ours.partition(".")
            if kind == channel:
                found.append((joint, theirs))
        names = []  # of joints in the log
        chosen_columns = []
        for name, column in found:
            if not ignored(name, specified.get("ignore", ())):
                names.append(name)
                chosen_columns.append(columns[column])
        if names:
            joints = resolve_all(names, robot, recording.place, joint_map)
            chosen[channel] = dict(zip(joints, chosen_columns, strict=True))
    _require_complete(chosen, recording, specified)
    return chosen


def _require_columns(recording: RawRecording, single: dict[str, str]) -> None:
    """Refuse single columns that are not there, or that stand for nothing. single: ours → the
    log's.
    """
    for ours, theirs in single.items():
        channel, dot, _ = ours.partition(".")
        if channel not in CHANNELS or not dot:
            raise UsageError(
                f"logs.toml: '{ours}' is neither time nor {'.<joint>, '.join(CHANNELS)}.<joint>"
            )
        if theirs not in recording.columns:
            raise LogError(
                f"{recording.place}: column '{theirs}' (for {ours}) is missing; there are: "
                f"{recording.shown()}"
            )


def _matching(
    recording: RawRecording, specified: LogsFile, channel: str, taken: set[str]
) -> list[tuple[str, str]]:
    """Return (joint, column) of each column that holds a channel, by the names in the log.

    logs.toml calls either an array whose columns are joints, or a pattern such as "{joint}_des".

    Args:
        taken: Columns that are known to hold something else: a pattern does not find them.
    """
    stated = specified.get(channel)
    if not isinstance(stated, str):
        return []
    if stated in recording.signals and "{joint}" not in stated:
        return _columns_of_array(recording, stated, specified.get("joints"))
    if stated.count("{joint}") != 1:
        return []  # an array that this recording does not have
    pattern = _column_pattern(stated)
    longer = [_column_pattern(other) for other in _longer_patterns(specified, stated)]
    found = []
    for column in recording.columns:
        if column in taken or not _may_hold(column, channel):
            continue
        match = pattern.fullmatch(column)
        if match and not _fits_any(column, longer):
            found.append((match["joint"], column))
    return found


def _fits_any(column: str, patterns: list[re.Pattern[str]]) -> bool:
    return any(pattern.fullmatch(column) for pattern in patterns)


def _may_hold(column: str, channel: str) -> bool:
    """Return False for columns of a time_file, and of a command_file if the channel is a state."""
    if column.startswith(TIME):
        return False
    return channel in COMMANDS or not column.startswith(COMMAND)


def _columns_of_array(
    recording: RawRecording, array: str, given: list[str] | None
) -> list[tuple[str, str]]:
    """Return (joint, column) of each column of an array.

    Args:
        given: Names of its columns, where the file does not name them.
    """
    own = recording.signals[array]
    labels = own or ("0",)
    names: ListOf[str] = labels
    if all(label.isdigit() for label in labels):
        if given is None or len(given) != len(labels):
            explanation = f"joints has {len(given)}" if given else "nothing names them"
            raise LogError(
                f"{recording.place}: {array} has {len(labels)} columns and "
                f"{explanation}; write joints = [{len(labels)} names, in its order] into logs.toml"
            )
        names = given
    columns = [f"{array}[{label}]" for label in own] or [array]
    return list(zip(names, columns, strict=True))


def _longer_patterns(specified: LogsFile, pattern: str) -> list[str]:
    """Return patterns of other channels that say more of a column's name, and win over this one:
    q_{joint} fits q_des_1 as well, which is q_des_{joint}'s.
    """
    longer = []
    for channel in CHANNELS:
        other = str(specified.get(channel, ""))
        if other.count("{joint}") == 1 and len(other) > len(pattern):
            longer.append(other)
    return longer


def _column_pattern(pattern: str) -> re.Pattern[str]:
    """Return the regular expression of "{joint}_des", with a group `joint`."""
    before, after = map(re.escape, pattern.split("{joint}"))
    return re.compile(f"{before}(?P<joint>.+?){after}")


def _gain_columns(recording: RawRecording, specified: LogsFile, ctrl: Columns) -> Chosen:
    """kp and kd → joint → column, where logs.toml says that an array holds them; it has the columns
    of the command's.
    """
    widths = {len(recording.signals[column.signal]) for column in ctrl.values()}
    gains: Chosen = {}
    for name in ("kp", "kd"):
        array = specified.get(name)
        if isinstance(array, dict):  # of some joints; the recording may hold those of the others
            array = recording.default.get(name)
        if not isinstance(array, str):
            continue
        if array not in recording.signals or widths != {len(recording.signals[array])}:
            raise LogError(
                f'{recording.place}: {name} = "{array}" is no array like the command\'s; there '
                f"are: {recording.shown()}"
            )
        gains[name] = {joint: Column(array, column.number) for joint, column in ctrl.items()}
    return gains


def _constant(recording: RawRecording, name: str, values: Array) -> float:
    """A gain that stood still."""
    if np.ptp(values) > MAX_GAIN_CHANGE * max(abs(float(values[0])), 1e-9):
        raise LogError(
            f"{recording.source}: {name} changes from {values.min():g} to {values.max():g} while "
            "it is recorded; cut the log where it does"
        )
    return float(values[0])


def _require_complete(chosen: Chosen, recording: RawRecording, specified: LogsFile) -> None:
    """Refuse a recording without commands or positions, or with other joints in some channel."""
    where = recording.place
    for need in REQUIRED:
        if need in chosen:
            continue
        explanation = f' (expected "{specified.get(need)}")' if need in specified else ""
        why = f": {NO_COMMANDS}" if need == "ctrl" else ""
        raise LogError(
            f"{where}: no column holds {need}.<joint>{explanation}; there are: "
            f'{recording.shown()}. Say {need} = "…" in logs.toml ({HINT}){why}'
        )
    for channel in chosen:
        odd = sorted(chosen["ctrl"].keys() ^ chosen[channel].keys())
        if odd:
            lacking = channel if odd[0] in chosen["ctrl"] else "ctrl"
            raise LogError(
                f"{where}: column '{lacking}.{odd[0]}' is missing: every channel needs the same "
                "joints"
            )


def _units(
    robot: RobotSpec, specified: LogsFile, joints: list[str], joint_map: dict[str, str] | None
) -> dict[str, str]:
    """The unit of each joint's positions; refuses one that nobody specified."""
    single = {}
    for name, unit in specified.get("joint_units", {}).items():
        single[robot.resolve(name, "[joint_units] of logs.toml", joint_map)] = unit
    time_unit = specified.get("time_unit", "s" if "rate" in specified else "")
    _require_unit("time unit", time_unit, tuple(SECONDS))
    _require_unit("position unit", specified.get("position_unit", ""), LOG_UNITS)
    for joint, unit in single.items():
        _require_unit(f"unit of {joint}", unit, LOG_UNITS)
    return {joint: single.get(joint, specified["position_unit"]) for joint in joints}


def _require_unit(what: str, unit: str, known: ListOf[str]) -> None:
    """Refuse a unit that is not known, or not given."""
    if unit not in known:
        given = f"'{unit}' is not one of {', '.join(known)}" if unit else "is not given"
        raise UsageError(f"the log's {what} {given}; say it with {SAY_UNITS}")


def _time(
    recording: RawRecording,
    specified: LogsFile,
    loaded: dict[str, Signal],
    clock: str | None,
    channel: str,
    columns: Columns,
) -> Array:
    """The time stamps of a channel, s, from any start."""
    where = recording.place
    own = _first_signal(columns, loaded)
    if channel not in specified.get("clock", {}) and own.time is not None:
        return own.time
    if "rate" in specified:
        if clock in loaded and not _has_rate(loaded[clock].values, specified["rate"]):
            raise LogError(
                f"{where}: '{clock}' is not at rate = {specified['rate']:g} Hz; leave out one of "
                "them"
            )
        return np.arange(len(own.values)) / specified["rate"]
    if clock not in recording.signals:
        raise LogError(
            f"{where}: column '{clock or 'time'}' (the clock of {channel}) is missing; there are: "
            f'{recording.shown()}. Say time = "…" in logs.toml, or rate = 50.0 (Hz) where the log '
            f"has no clock ({HINT})"
        )
    time = np.asarray(loaded[clock].values, float)
    if time.shape != (len(own.values),):
        raise LogError(
            f"{where}: its clock '{clock}' has {len(time)} rows and {channel} {len(own.values)}; "
            "cut or mend one of them"
        )
    if loaded[clock].in_seconds:
        return time
    return time * SECONDS[specified.get("time_unit", "s")]


def _has_rate(stamps: Array, rate: float) -> bool:
    """Return True if a clock that runs has this rate, Hz, in some unit of time."""
    periods = rate * float(np.median(np.diff(stamps)))
    if not periods > 0:
        return True
    return min(abs(periods * unit - 1) for unit in SECONDS.values()) <= MAX_RATE_ERROR


def _first_signal(columns: Columns, loaded: dict[str, Signal]) -> Signal:
    """Return the signal of a channel's first column, whose clock and length are the channel's."""
    first = next(iter(columns.values()))
    return loaded[first.signal]
