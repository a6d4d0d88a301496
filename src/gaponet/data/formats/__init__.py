"""Log formats: one module each, imported when its format is asked for; heavy libraries are
imported when it reads.

The first paragraph of a format's docstring says what the format is; `gaponet import --formats`
prints it. A format whose columns logs.toml explains has

- `recordings(path, specified)`: yields RawRecordings (data.describe.raw_recording).
- `DEFAULT`: content of logs.toml unless the recording or the user states something else; default:
  nothing.

A format that says itself what its columns are has

- `read(path, robot, joint_map, **options)`: yields a motion's name and a function that reads its
  Log, in the order of `find`.
- `OPTIONS`: fields of logs.toml that it acts on beside ALWAYS; default: none.

Both have `SUFFIXES`, the ends of names of files that are recordings, at or below a folder. If that
is not enough, they have

- `detects(path)`: whether a file, or the files directly in a folder, look like the format; default:
  `find` returns any.
- `find(path)`: the recordings under a path, files or folders, sorted; default: files with SUFFIXES.

A format that needs an extra of the package names it in `EXTRA`.

A field of logs.toml that is neither in ALWAYS nor in OPTIONS is refused: the format fixes it.

A path that two formats detect is refused, so that another layout of .npz is a case of npz.py, not a
format beside it; only a `table` gives way. A new suffix stands in data.describe.logs_file.SUFFIX
too. The shortest readers to copy are pace.py (`recordings`) and bam.py (`read`). JSON has one
suffix for many layouts: bam.py knows its own by the first bytes of a file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, cast

import numpy as np

from gaponet.base import plugins
from gaponet.base.arrays import Array
from gaponet.base.errors import LogError, UsageError
from gaponet.base.plugins import attempt
from gaponet.data.describe.clocks import COMMAND, TIME
from gaponet.data.describe.logs_file import LogsFile, Naming, read_logs_file
from gaponet.data.describe.plausibility import require_plausible
from gaponet.data.describe.raw_recording import RawRecording, by_place
from gaponet.data.describe.repeats import without_repeated_rows
from gaponet.data.describe.turns import continued_turns, within_range
from gaponet.data.describe.unread import what_address, why_unread
from gaponet.data.log import COMMANDS, Channel, Log, skipped_rows
from gaponet.data.sequence import recorded_gains
from gaponet.robot.spec import RobotSpec

FORMATS = {
    name: f"gaponet.data.formats.{name}"
    for name in ("sage", "table", "npz", "lerobot", "bam", "rosbag", "hdf5", "mat", "pace", "asap")
}
FILES = {"state_file", "command_file", "time_file"}
MAX_LOOKED_AT = 20  # recordings, before they are described
ALWAYS = (
    "names",
    "ignore",
    "signs",
    "offsets",
    "posture",
    "motion",
    "manifest",
    "unit",
    "payload",
    "side",
    "kp",
    "kd",
    "format",
)
DESCRIBED = tuple(k for k in LogsFile.__annotations__ if k not in ALWAYS)


def formats() -> dict[str, str]:
    """Every format that this installation reads → its reader's module."""
    return plugins.registry(plugins.FORMATS, FORMATS)


def module(fmt: str) -> ModuleType:
    """The reader of a format."""
    known = formats()
    if fmt not in known:
        raise LogError(f"unknown format '{fmt}'; use one of {', '.join(known)}")
    reader: ModuleType = plugins.load(known[fmt])
    return reader


def about(fmt: str) -> str:
    """Return the description of a format, the first paragraph of its docstring, in one line."""
    doc = attempt(formats()[fmt], lambda: module(fmt).__doc__, None)
    paragraph = (doc or "").strip().split("\n\n")[0]
    return " ".join(paragraph.split()).rstrip(".")


def extra_of(fmt: str) -> str | None:
    """Return the extra of the package that a format needs, "" for none; None if its module cannot
    be loaded.
    """
    return attempt(formats()[fmt], lambda: str(getattr(module(fmt), "EXTRA", "")), None)


def _options(reader: ModuleType) -> tuple[str, ...]:
    """The fields of logs.toml that a format acts on, beside ALWAYS."""
    if hasattr(reader, "recordings"):
        return DESCRIBED
    return getattr(reader, "OPTIONS", ())


def files_under(path: Path, suffixes: Iterable[str]) -> list[Path]:
    """The file, or those with these suffixes in a folder and below it; hidden ones are left
    alone.
    """
    files = [path] if path.is_file() else files_below(path)
    return sorted(file for file in files if file.suffix.lower() in suffixes)


def files_below(folder: Path) -> Iterator[Path]:
    """The files in a folder and below it, also behind links; hidden ones are left alone."""
    seen = set[str]()  # folders: a link may lead back to one
    for place, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            file = Path(place) / name
            if not name.startswith(".") and file.is_file():
                yield file


def detect(path: Path) -> str:
    """The format of a file or folder; refuses one that could be several."""
    matches = []
    for fmt, where in formats().items():
        if attempt(where, partial(_detects, fmt, path), False):
            matches.append(fmt)
    if "table" in matches and _tables_belong_to_others(path, matches):
        matches.remove("table")
    if len(matches) == 1:
        return matches[0]
    if matches:
        kinds = " and ".join(f"{fmt} ({about(fmt)})" for fmt in matches)
        ways = " or ".join(f"--format {fmt}" for fmt in matches)
        raise LogError(f"{path}: could be {kinds}; say {ways}")
    raise _no_log(path)


def _no_log(path: Path) -> LogError:
    """Return the error that nothing at a path is a log, with what to do."""
    if (path / "dataset.json").is_file():
        return LogError(
            f"{path}: is a dataset of gaponet, not logs; go on with gaponet doctor {path}"
        )
    files = [path] if path.is_file() else list(files_below(path))
    return LogError(
        f"{path}: no log of {', '.join(formats())} (gaponet import --formats explains "
        f"them){why_unread(path, files)}"
    )


def _tables_belong_to_others(path: Path, matches: list[str]) -> bool:
    """Return True if the tables at a path are parts of recordings of another format: each is
    detected by it, or none lies directly in the folder.

    Args:
        matches: The formats that the path looks like.
    """
    others = [fmt for fmt in matches if fmt != "table"]
    if not others:
        return False
    tables = module("table").find(path)
    if all(file.parent != path for file in tables):
        return True
    return all(any(_detects(fmt, file) for fmt in others) for file in tables)


def _detects(fmt: str, path: Path) -> bool:
    reader = module(fmt)
    if hasattr(reader, "detects"):
        return bool(reader.detects(path))
    return bool(_find(reader, path))


def _find(reader: ModuleType, path: Path) -> list[Path]:
    if hasattr(reader, "find"):
        return cast("list[Path]", reader.find(path))
    return files_under(path, reader.SUFFIXES)


def find_logs(path: Path, fmt: str | None = None) -> list[Path]:
    """The recordings under a path, without reading them."""
    return _find(_reader(path, fmt or read_logs_file(path)[0].get("format")), path)


PositionUnit = Literal["rad", "deg", "turns", "fraction", "percent", "ticks", "signed_percent"]
TimeUnit = Literal["s", "ms", "us", "ns"]


@dataclass(frozen=True)
class ReadOptions:
    """What is said of logs beside logs.toml, and what is allowed.

    joint_map, position_unit, time_unit and rate win over logs.toml; the last three are refused
    where the format itself fixes them.
    """

    format: str | None = None
    """Format of the logs; gaponet import --formats lists all. Default: recognised from the
    files."""
    joint_map: Mapping[str, str] | None = None
    """Joint name in the logs → joint name of the robot."""
    logs: str | Path | None = None
    """A logs.toml, which says what columns, names, units, signs and clocks mean. Default: the one
    in the folder of the logs."""
    position_unit: PositionUnit | None = None
    """Unit of the positions. Needed if neither the format nor logs.toml states it."""
    time_unit: TimeUnit | None = None
    """Unit of the clock. Needed if neither the format nor logs.toml states it."""
    rate: float | None = None
    """Rows per second, Hz, of logs that have no clock."""
    strict: bool = False
    """Refuse logs with impossible velocities, torques or temperatures. By default such values are
    replaced."""
    allow_pickle: bool = False
    """Open pickled files (ASAP). The unpickler makes only arrays, numbers and text, and runs no
    code of the file."""

    def as_logs_file(self) -> LogsFile:
        """Return what is said here of fields of logs.toml."""
        said = LogsFile()
        if self.position_unit is not None:
            said["position_unit"] = self.position_unit
        if self.time_unit is not None:
            said["time_unit"] = self.time_unit
        if self.rate is not None:
            said["rate"] = self.rate
        return said


DEFAULT_OPTIONS = ReadOptions()


def read_logs(
    path: Path, robot: RobotSpec, options: ReadOptions = DEFAULT_OPTIONS
) -> Iterator[tuple[str, Log]]:
    """Yield (motion name, Log) for every recording under a path; errors as of
    gaponet.api.import_logs.

    While data.log.skip_bad_rows is open, bad rows are cut, recordings that cannot be read are left
    out, and both are listed there.
    """
    specified, file = read_logs_file(path, options.logs)
    reader = _reader(path, options.format or specified.get("format"))
    _require_allowed(reader, path, options.allow_pickle)
    by_hand = options.as_logs_file()
    specified = specified | by_hand
    _require_known_fields(reader, specified, by_hand, file)
    joint_map = _JointMap(specified.get("names", {}) | dict(options.joint_map or {}))
    naming = Naming(specified, file)
    root = path if path.is_dir() else path.parent
    bad = skipped_rows()
    for name, load in _loaders(reader, path, robot, specified, joint_map):
        try:
            log = _mended(load(), robot, specified, joint_map, options.strict)
        except LogError as error:
            if bad is None:
                raise
            bad.append(f"left out: {error}")
            continue
        facts = naming.of(name, _place_below(root, log.source))
        if facts.pop("leave_out", False):
            continue
        motion = str(facts.pop("motion", name))
        yield motion, _labelled(log, facts, robot, joint_map)
    naming.require_all_used()
    for name in options.joint_map or ():
        if name not in joint_map.used:
            raise UsageError(f"--map {name}: no log under {path} names a joint so; correct it")


class _JointMap(dict[str, str]):
    """The user's names of joints: name in the logs → the robot's.

    Attributes:
        used: Names that a log has.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        super().__init__(names)
        self.used: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        if name in self:
            self.used.add(name)
        return super().get(name, default)


def _require_known_fields(
    reader: ModuleType, specified: LogsFile, by_hand: LogsFile, file: Path | None
) -> None:
    """Refuse fields that a format does not act on.

    Args:
        specified: logs.toml (file) and what is said by hand.
    """
    for field in specified:
        if field in (*ALWAYS, *_options(reader)):
            continue
        option = f"--{field.replace('_', '-')}" if field in by_hand else f"{file}: {field}"
        raise UsageError(
            f"{option} means nothing to the {_format_of(reader)} format, which fixes it itself; "
            "leave it out"
        )


def _mended(
    log: Log, robot: RobotSpec, specified: LogsFile, joint_map: dict[str, str], strict: bool
) -> Log:
    """Return a log with what loggers do to it undone: angles that wrap at a turn, nonsense, rows
    that are written twice, and signs and offsets of logs.toml.

    Raises:
        LogError: It is implausible beyond repair, or with `strict` at all.
    """
    log = within_range(log, robot)
    log = require_plausible(log, robot, strict)
    log = _corrected(log, robot, specified, joint_map)
    log = without_repeated_rows(log)  # after the checks, which name lines of the file
    return continued_turns(log, robot)


def _place_below(root: Path, source: str) -> str:
    """Return a source relative to a folder; a #part stays behind it."""
    file, mark, part = source.partition("#")
    return Path(file).relative_to(root).as_posix() + mark + part


def look(
    path: Path, options: ReadOptions = DEFAULT_OPTIONS
) -> tuple[str, LogsFile, list[RawRecording]]:
    """The format, what is said of it already, and the first recordings as they lie there;
    arguments as of read_logs.
    """
    specified, _ = read_logs_file(path, options.logs)
    reader = _reader(path, options.format or specified.get("format"))
    _require_allowed(reader, path, options.allow_pickle)
    kind = _format_of(reader)
    if not hasattr(reader, "recordings"):
        raise UsageError(f"{path}: {about(kind)}: the format says itself what its columns are")
    return kind, specified, list(islice(_recordings(reader, path, specified), MAX_LOOKED_AT))


def _require_allowed(reader: ModuleType, path: Path, allow_pickle: bool) -> None:
    """Refuse pickled files unless they were allowed."""
    if getattr(reader, "PICKLED", False) and not allow_pickle:
        raise UsageError(
            f"{path}: {_format_of(reader)} files are Python pickles, which can hold anything; add "
            "--allow-pickle to open them with an unpickler that makes arrays, numbers and text only"
        )


def _format_of(reader: ModuleType) -> str:
    """Return the name of the format that a module reads."""
    return reader.__name__.rsplit(".", 1)[-1]


def _reader(path: Path, fmt: str | None) -> ModuleType:
    """Return the module that reads a path: of the format that is given, else by inspection."""
    if not path.exists():
        raise LogError(f"{path}{what_address(path) or ': does not exist'}")
    return module(fmt or detect(path))


def _loaders(
    reader: ModuleType, path: Path, robot: RobotSpec, specified: LogsFile, joint_map: dict[str, str]
) -> Iterator[tuple[str, Callable[[], Log]]]:
    """Yield (name, what reads its Log) of every recording."""
    if not hasattr(reader, "recordings"):
        known = getattr(reader, "OPTIONS", ())
        options = {field: value for field, value in specified.items() if field in known}
        yield from reader.read(path, robot, joint_map or None, **options)
        return
    recordings = _recordings(reader, path, specified)
    if FILES & specified.keys():
        recordings = _with_files(list(recordings), specified)
        specified = _with_prefixes(_defaults(reader) | specified, specified)
    for recording in recordings:
        yield recording.name, partial(recording.to_log, robot, specified, joint_map or None)


def _recordings(reader: ModuleType, path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Read the logs.

    Values of the format apply unless the recording or `specified` states others.
    """
    for recording in reader.recordings(path, _defaults(reader) | specified):
        yield replace(recording, default=_defaults(reader) | recording.default)


def _defaults(reader: ModuleType) -> LogsFile:
    return getattr(reader, "DEFAULT", LogsFile())


def _with_prefixes(full: LogsFile, specified: LogsFile) -> LogsFile:
    """Return logs.toml with the prefixes of signals in a command_file or time_file.

    Args:
        full: It with the defaults of the format, which name the commands if it does not.
    """
    changes: dict[str, Any] = {}
    if "command_file" in specified:
        commands = tuple(name for name in COMMANDS if name == "ctrl" or name in specified)
        changes = {name: COMMAND + str(full.get(name, "")) for name in commands}
        if "time_file" not in specified:
            changes["clock"] = _beside_clock(full, commands)
    if "time_file" in specified and "time" in specified:
        changes["time"] = TIME + specified["time"]
    return cast("LogsFile", specified | changes)


def _with_files(recordings: list[RawRecording], specified: LogsFile) -> Iterator[RawRecording]:
    """Join each state file with its command_file and time_file, which are then no recordings of
    their own.
    """
    by_file = by_place(recordings)
    states = {file: Path(file).stem for file in by_file}
    if "state_file" in specified:
        states = _named_by(specified["state_file"], by_file)
    commands = _files_beside(states, specified.get("command_file"))
    clocks = _files_beside(states, specified.get("time_file"))
    no_states = {*commands.values(), *clocks.values()}
    for file, name in states.items():
        if file in no_states:
            continue
        recording = replace(by_file[file], name=name)
        if file in commands:
            command = _require_beside(recording, "command_file", commands[file], by_file)
            recording = recording.beside(command, COMMAND)
        if file in clocks:
            clock = _require_beside(recording, "time_file", clocks[file], by_file)
            recording = recording.beside(clock, TIME)
            if len(clock.signals) == 1:
                only = TIME + next(iter(clock.signals))
                recording = replace(recording, default=recording.default | {"time": only})
        yield recording


def _require_beside(
    recording: RawRecording, what: str, file: str, by_file: dict[str, RawRecording]
) -> RawRecording:
    """Return the command_file or time_file (what) of a recording, which is missing if by_file does
    not have it.
    """
    if file not in by_file:
        raise LogError(f'{recording.source}: its {what} "{file}" is not beside it')
    return by_file[file]


def _files_beside(states: dict[str, str], pattern: str | None) -> dict[str, str]:
    """Return state file → file of the pattern for its name. states: state file → name."""
    if pattern is None:
        return {}
    return {file: pattern.replace("{name}", name) for file, name in states.items()}


def _named_by(pattern: str, files: Iterable[str]) -> dict[str, str]:
    """Return the files that fit a pattern → {name} in it, or the file's stem where it has none."""
    before, _, after = pattern.partition("{name}")
    named = {}
    for file in files:
        if file == pattern:
            named[file] = Path(file).stem
        elif "{name}" in pattern and file.startswith(before) and file.endswith(after):
            named[file] = file[len(before) : len(file) - len(after)] or Path(file).stem
    if not named:
        raise LogError(
            f'no file looks like state_file = "{pattern}"; there are: {", ".join(files)}'
        )
    return named


def _beside_clock(specified: LogsFile, commands: tuple[str, ...]) -> dict[str, str]:
    """Return channel → column of its clock, where the commands lie in a file with its own clock."""
    clocks = cast("dict[str, str]", dict(specified.get("clock", {})))
    of_commands = clocks.get("ctrl") or specified.get("time")
    if of_commands:
        clocks |= dict.fromkeys(commands, COMMAND + of_commands)
    return clocks


def _corrected(log: Log, robot: RobotSpec, specified: LogsFile, joint_map: dict[str, str]) -> Log:
    """Return the log with signs and offsets, where logs.toml says some, noted; and where joints
    stood that it does not hold.
    """
    posture = _by_joint("posture", specified.get("posture", {}), robot, joint_map)
    if posture:
        log = replace(log, meta=log.meta | {"posture": posture})
    signs = _by_joint("signs", specified.get("signs", {}), robot, joint_map)
    offsets = _by_joint("offsets", specified.get("offsets", {}), robot, joint_map)
    if not signs and not offsets:
        return log
    if 0 in signs.values():
        raise UsageError("[signs] of logs.toml: a sign is 1 or -1")
    sign = np.array([signs.get(joint, 1) for joint in log.joint_names], float)  # (n)
    offset = np.array([offsets.get(joint, 0.0) for joint in log.joint_names])  # (n) rad
    channels = {}
    for name, (time, values) in log.channels.items():
        channels[name] = Channel(time, _turned(name, values, sign, offset))
    notes = dict(log.meta.get("notes", {}))
    if signs:
        notes["signs"] = signs
    if offsets:
        notes["offsets"] = offsets
    corrected = replace(log, channels=channels, meta=log.meta | {"notes": notes})
    return require_plausible(corrected, robot)


def _turned(channel: str, values: Array, sign: Array, offset: Array) -> Array:
    """Return the values (k, n) of a channel with other signs, and positions with an offset."""
    if channel == "temperature":
        return values
    if channel not in ("ctrl", "qpos"):
        offset = np.zeros_like(offset)
    return np.asarray(sign * values + offset)


def _by_joint(
    section: str, stated: Mapping[str, float], robot: RobotSpec, joint_map: dict[str, str]
) -> dict[str, float]:
    """Return what a section of logs.toml says, by the robot's own joint."""
    where = f"[{section}] of logs.toml"
    return {robot.resolve(joint, where, joint_map): value for joint, value in stated.items()}


def _labelled(log: Log, facts: dict[str, Any], robot: RobotSpec, joint_map: dict[str, str]) -> Log:
    """Return the log with what its name and logs.toml say of it; what the format itself says must
    not contradict.
    """
    meta = dict(log.meta)
    stated = dict(log.meta.get("stated", {}))
    for name in ("kp", "kd"):
        if name in facts:
            meta[name] = _gains(name, facts.pop(name), log, robot, joint_map)
    if "estimated" in facts:
        meta["notes"] = meta.get("notes", {}) | {"estimated": facts.pop("estimated")}
    for name, value in facts.items():
        if stated.get(name) not in (None, value):
            raise UsageError(
                f"{log.source}: {name} is {stated[name]} in the file and {value} in logs.toml; "
                "mend one"
            )
        stated[name] = value
    if stated:
        meta["stated"] = stated
    return replace(log, meta=meta)


def _gains(
    name: str, stated: Any, log: Log, robot: RobotSpec, joint_map: dict[str, str]
) -> list[float]:
    """Return the gains of the log's joints.

    Args:
        name: kp or kd.
        stated: One number for all joints, or {joint: number}; "" stands for all others, which
            else have what the recording itself says, or the robot's own.
    """
    if not isinstance(stated, dict):
        return [stated] * len(log.joint_names)
    by_joint: dict[str, float] = {}
    for joint, gain in stated.items():
        if joint:
            by_joint[robot.resolve(joint, f"{name} of logs.toml", joint_map)] = gain
    own = recorded_gains(name, log, robot)
    gains: list[float] = []
    for joint in log.joint_names:
        of_others = stated[""] if "" in stated else own[robot.joint_names.index(joint)]
        gains.append(by_joint.get(joint, of_others))
    return gains
