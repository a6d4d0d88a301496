"""A logs.toml for strange logs, filled in as far as names and numbers show it; what is a guess is
marked as one.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import JointMismatchError, LogError
from gaponet.data.describe.actions import HAND_WORDS, words_of
from gaponet.data.describe.clocks import (
    MAX_RATE_DIFFERENCE,
    clock_periods,
    named_like_a_clock,
    rate_ratio,
)
from gaponet.data.describe.plausibility import look_like_percent, look_like_ticks
from gaponet.data.describe.raw_recording import SECONDS, RawRecording, by_place
from gaponet.data.log import FEEDFORWARD, REQUIRED
from gaponet.robot.spec import RobotSpec

# Words by which the world calls them; a name with a word of an earlier line is not looked for in a
# later one.
WORDS = {
    FEEDFORWARD: ("ff", "feedforward", "ffwd"),
    "ctrl": ("ctrl", "cmd", "command", "commands", "commanded", "des", "desired", "d", "target",
             "targets", "goal", "goals", "ref", "reference", "action", "actions", "qaction",
             "setpoint", "sp"),
    "qvel": ("qvel", "vel", "velocity", "velocities", "dq", "qd", "speed", "dof_vel"),
    "tau": ("tau", "torque", "torques", "effort", "trq", "tau_est", "current"),
    "temperature": ("temperature", "temp"),
    "qpos": ("qpos", "pos", "position", "positions", "q", "meas", "measured", "actual", "act",
             "state", "states", "present", "angle", "enc"),
}  # fmt: skip
# Of positions, as names of columns say them.
UNIT_WORDS = {
    "deg": ("deg", "degs", "degree", "degrees", "°"),
    "rad": ("rad", "rads", "radian", "radians"),
    "ticks": ("ticks", "tick", "counts"),
    "turns": ("turns", "turn", "rev", "revs", "revolutions", "rotations"),
}
LARGEST_RAD = 7.0  # larger positions are degrees, unless they look like ticks or percent
CLOCKS = (
    "time",
    "t",
    "timestamp",
    "stamp",
    "time_s",
    "time_ms",
    "time_us",
    "time_ns",
    "clock",
    "ts",
)
FILLERS = ("joint", "joints", "data", "log")  # of files' names
NOT_POSITIONS = ("qvel", "tau", "temperature")
NOT_TORQUES = ("qpos", "qvel", "temperature")
USUAL_PERIODS_S = (5e-4, 0.2)  # of logs
ROWS = 4000  # that are looked at
MAX_APART_SHARE = 0.8  # of the positions' own motion, by which commands are apart from them
MAX_SPEED_CORRELATION = 0.9  # of commands with the speed; speeds have more
MAX_REPETITION_SHARE = 0.5  # of a command's own motion, by which repetitions of it differ
MAX_NAMES_SHOWN = 5  # of recordings, in a comment
QUESTION = "# Lines with a ? are guesses: look at them."


def guess_logs(
    recordings: list[RawRecording], robot: RobotSpec, fmt: str, known: dict[str, Any]
) -> str:
    """The text of a logs.toml.

    Args:
        recordings: Some of one kind; the first is looked at, and what the names of all have in
            common.
        known: What is said already (a logs.toml, the format's own), which is kept.
    """
    if not recordings:
        raise LogError("no recording found")
    family = _family(list(by_place(recordings)))
    by_kind = {kind: _first_of(recordings, pattern) for kind, pattern in family.items()}
    pair = _state_and_command(recordings)
    if pair and not family:
        family = {kind: Path(recording.source).name for kind, recording in pair.items()}
        by_kind = pair
    if not family:
        return _guess_one_file(recordings, robot, fmt, known)
    names_columns = "qpos" in _channels(by_kind["qpos"], robot)
    if names_columns and "ctrl" in family:
        return _guess_two_files(by_kind, family, robot, fmt, known)
    return _guess_family(by_kind, family, robot, fmt)


def _guess_one_file(
    recordings: list[RawRecording], robot: RobotSpec, fmt: str, known: dict[str, Any]
) -> str:
    """The text of a logs.toml for recordings whose signals are in one file each."""
    first = recordings[0]
    specified: dict[str, Any] = dict(first.default) | known
    channels = _channels(first, robot)
    for channel in WORDS:
        if channel in specified and _values(first, specified[channel]) is not None:
            channels[channel] = specified[channel]
    joints = _joints(first, channels)
    _refuse_file_per_joint(recordings, joints, robot)
    _tell_desired_from_velocity(first, channels)
    lines = [
        f"# {fmt}; the first recording: {first.place}",
        f"# its columns: {first.shown(40)}",
        QUESTION,
        "",
    ]
    lines += _clock(first, specified)
    lines += _positions(first, channels, robot, specified.get("position_unit"))
    for channel, name in channels.items():
        lines.append(_channel_line(channel, name, lines) + _others_alike(first, channel, name))
    lines += _missing_channels(channels)
    names = _names(channels, joints, robot)
    commands = _joints(first, channels, "ctrl")
    in_array = "ctrl" in channels and "{joint}" not in channels["ctrl"]
    names += _names_of_commands(commands, joints, robot, in_array, names)
    tables = []  # the tables of TOML come last
    for line in names:
        if line.startswith(("joints =", "ignore =")):
            lines.append(line)
        else:
            tables.append(line)
    repeated = _repeated(recordings, channels.get("ctrl", ""))
    lines += _labels([recording.name for recording in recordings], repeated)
    return "\n".join([*lines, *tables]) + "\n"


def _missing_channels(channels: dict[str, str]) -> list[str]:
    """Lines that ask for command and position where no name looks like them."""
    lines = []
    for need in REQUIRED:
        if need not in channels:
            lines.append(f'# {need} = "…"          ? none of the names looks like it')
    if "ctrl" not in channels and {"tau", "qpos"} <= channels.keys():
        lines.append("# driven by torque? then the position's name also for ctrl: docs/logs.md")
    return lines


def _refuse_file_per_joint(
    recordings: list[RawRecording], joints: list[str], robot: RobotSpec
) -> None:
    """Refuse files that hold one joint each and are called like it: they are one recording."""
    names = [recording.name for recording in recordings]
    nameless = len(joints) == 1 and joints[0].isdigit()
    if len(names) < 2 or not nameless or not all(_is_joint(name, robot) for name in names):
        return
    raise LogError(
        f"{recordings[0].place}: a file per joint ({', '.join(names[:5])}): a robot moves all its "
        "joints at once. Write one table per motion, with columns such as "
        f"ctrl.{names[0]} and qpos.{names[0]} of every joint"
    )


def _tell_desired_from_velocity(recording: RawRecording, channels: dict[str, str]) -> None:
    """Call an array such as qd a command, where no other is one and it is near the positions
    instead of their derivative.
    """
    if "ctrl" in channels or not {"qvel", "qpos"} <= channels.keys():
        return
    values = _values(recording, channels["qvel"])
    qpos = _values(recording, channels["qpos"])
    if values is None or qpos is None or values.shape != qpos.shape or len(qpos) < 3:
        return
    if _look_like_targets(values, qpos):
        channels["ctrl"] = channels.pop("qvel")


def _look_like_targets(values: Array, qpos: Array) -> bool:
    """Return True if values (T, n) are near positions (T, n), and unlike their speeds."""
    apart = np.abs(values - qpos).mean()
    own_motion = np.abs(qpos - qpos.mean(axis=0)).mean()
    correlations = []  # with the speed of each joint
    for angle, of_joint in zip(qpos.T, values.T, strict=True):
        correlations.append(np.corrcoef(np.gradient(angle), of_joint)[0, 1])
    near = apart < MAX_APART_SHARE * own_motion
    unlike_speed = np.nanmean(np.abs(correlations)) < MAX_SPEED_CORRELATION
    return bool(near and unlike_speed)


def _labels(names: list[str], repeated: bool) -> list[str]:
    """Lines of what the names of the recordings say.

    Args:
        repeated: A final number in the names counts repetitions.
    """
    more = ", …" if len(names) > MAX_NAMES_SHOWN else ""
    return [
        "",
        "# What the names of the recordings say, or a sheet (file, motion, payload, unit, rep):",
        f"# names here: {', '.join(names[:MAX_NAMES_SHOWN])}{more}",
        f"motion = {_text(_pattern(names, repeated))}",
        '# manifest = "sheet.csv"',
        '# unit = "…"',
        "# payload = 0.0        # kg",
        "# kp = …               # N·m/rad while recording; default: robot.toml's",
    ]


def _family(files: list[str]) -> dict[str, str]:
    """Return channel or "time" → pattern of its files, where each recording has a file for each:
    {name}_desired.csv.

    Empty where files are recordings of their own.
    """
    by_name: dict[str, dict[str, str]] = defaultdict(dict)  # {name} → kind → pattern
    for file in files:
        stem, _, suffix = file.rpartition(".")
        name = _without_kind(stem)
        if name is None:
            return {}
        pattern = stem.replace(name, "{name}", 1) if name else stem
        by_name[name][_kind(stem) or "time"] = f"{pattern}.{suffix}"
    families = list(by_name.values())
    kinds = families[0]
    if "qpos" not in kinds or len(kinds) < 2:
        return {}
    # the last may be cut off
    alike = all(family.keys() == kinds.keys() for family in families[:-1])
    return kinds if alike else {}


def _without_kind(stem: str) -> str | None:
    """Return what is left of a file's name without words for channels and clocks; None if it has no
    such word.
    """
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", stem)
    known = [word for word in words if _kind(word) or word.lower() in CLOCKS]
    if not known:
        return None
    fillers = [word for word in words if word.lower() in FILLERS]
    name = stem
    for word in known + fillers:
        name = re.sub(rf"[-_. ]?{word}", "", name, count=1)
    return name.strip("-_. /")


def _guess_family(
    by_kind: dict[str, RawRecording], family: dict[str, str], robot: RobotSpec, fmt: str
) -> str:
    """The text of a logs.toml for signals in files of their own, without names of columns.

    Args:
        by_kind: The first recording of each kind.
        family: Of _family.
    """
    state = by_kind["qpos"]
    clocks = clock_periods(state.signals, state.load)
    joints = [column for column in state.columns if column not in clocks]
    loaded = state.load([name for name in state.signals if name not in clocks])
    values = np.concatenate([signal.values[:ROWS].ravel() for signal in loaded.values()])
    lines = [
        f"# {fmt}; files that belong together: {', '.join(family.values())}",
        QUESTION,
        "",
        f"state_file = {_text(family['qpos'])}  # ?",
    ]
    if "ctrl" in family:
        lines.append(f"command_file = {_text(family['ctrl'])}  # ?")
    if "time" in family:
        clock = by_kind["time"]
        column = next(iter(clock.signals))
        lines += [
            f"time_file = {_text(family['time'])}  # ?",
            _time_unit(clock.load([column])[column].values),
        ]
    elif clocks:
        lines += _clock(state, {})
    else:
        lines.append("rate = 50.0  # ? Hz: no file holds times")
    lines += [
        _unit_line(values),
        'ctrl = "{joint}"',
        'qpos = "{joint}"',
    ]
    others = [p for kind, p in family.items() if kind not in ("qpos", "ctrl", "time")]
    if others:
        lines.append(f"# not read: {', '.join(others)}")
    lines += _names({"qpos": "{joint}"}, joints, robot)
    return "\n".join(lines) + "\n"


def _channel_line(channel: str, name: str, lines: list[str]) -> str:
    """The line of a channel; velocities and currents in units of a servo are left out."""
    line = f"{channel} = {_text(name)}"
    if channel == "tau" and "current" in name.lower():
        return f"# {line}  # ? a current is no torque: only for gaponet identify --current"
    if channel == "qvel" and any(text.startswith('position_unit = "ticks"') for text in lines):
        return f"# {line}  # ? its unit is not known; velocities are computed without it"
    return line


def _others_alike(recording: RawRecording, channel: str, name: str) -> str:
    """A question where other arrays could be this channel, as those of a second arm; "" if none."""
    if channel not in REQUIRED:
        return ""
    if "{joint}" in name:
        return ""
    alike = []
    for array, labels in recording.signals.items():
        if labels and array != name and _kind(array) == channel:
            alike.append(array)
    return f"  # ? also: {', '.join(alike)}" if alike else ""


def _state_and_command(recordings: list[RawRecording]) -> dict[str, RawRecording] | None:
    """Return state and command where there are two files, called like joint_states.csv and
    command.csv.
    """
    by_kind = {_kind(Path(recording.source).stem) or "": recording for recording in recordings}
    if len(recordings) != 2 or by_kind.keys() != {"qpos", "ctrl"}:
        return None
    return by_kind


def _guess_two_files(
    by_kind: dict[str, RawRecording],
    files: dict[str, str],
    robot: RobotSpec,
    fmt: str,
    known: dict[str, Any],
) -> str:
    """The text of a logs.toml for recordings whose commands lie in files of their own.

    Args:
        by_kind: A state and its command, as qpos and ctrl.
        files: Their names, or patterns of these with {name}.
    """
    state = by_kind["qpos"]
    command = by_kind["ctrl"]
    channels = _channels(state, robot)
    channels.pop("ctrl", None)
    commands = _channels(command, robot)
    told = commands.get("ctrl") or commands.get("qpos") or _numbered(command)
    lines = [
        f"# {fmt}; each recording in two files",
        f"# columns of the state: {state.shown(20)}",
        f"# columns of the command: {command.shown(20)}",
        QUESTION,
        "",
        f"state_file = {_text(files['qpos'])}",
        f"command_file = {_text(files['ctrl'])}",
    ]
    lines += _clock(state, dict(known))
    lines += _positions(state, channels, robot)
    lines += [_channel_line(channel, name, lines) for channel, name in channels.items()]
    lines.append(f"ctrl = {_text(told)}  # ? of the command's file")
    joints = _joints(state, channels)
    lines += _names(channels, joints, robot)
    return "\n".join(lines) + "\n"


def _numbered(recording: RawRecording) -> str:
    """The pattern of most numbered columns: field.data0, field.data1 → field.data{joint}."""
    counts: dict[str, int] = defaultdict(int)
    for name in recording.signals:
        if not named_like_a_clock(name):
            counts[re.sub(r"\d+(?=\D*$)", "{joint}", name)] += 1
    numbered = {pattern: count for pattern, count in counts.items() if "{joint}" in pattern}
    return max(numbered, key=lambda pattern: numbered[pattern], default="…")


def _first_of(recordings: list[RawRecording], pattern: str) -> RawRecording:
    """Return the first recording whose file fits a pattern of _family for these recordings."""
    before, _, after = pattern.partition("{name}")
    files = by_place(recordings)
    return next(files[file] for file in files if file.startswith(before) and file.endswith(after))


def _time_unit(stamps: Array) -> str:
    """The line of time_unit for a clock."""
    if len(stamps) < 2:
        return 'time_unit = "s"  # ? a single row has no period'
    low, period, high = np.percentile(np.diff(stamps[:ROWS]), [5, 50, 95])
    unit = "s"
    for name, seconds in SECONDS.items():
        if USUAL_PERIODS_S[0] <= period * seconds <= USUAL_PERIODS_S[1]:
            unit = name
            break
    in_seconds = SECONDS[unit]
    uneven = ""
    if high - low > 0.2 * period:
        uneven = f"; uneven: {low * in_seconds:.3g} to {high * in_seconds:.3g} s"
    return f'time_unit = "{unit}"  # the median period is {period * in_seconds:.6g} s{uneven}'


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _kind(name: str) -> str | None:
    """Return which channel a name speaks of; None for none, a commanded velocity or torque, and a
    feed-forward of something else than a torque.
    """
    parts = re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    parts += [part.rstrip("0123456789") for part in parts]  # q1, cmd2
    matches = [channel for channel, words in WORDS.items() if not set(words).isdisjoint(parts)]
    if not matches:
        return None
    first, *others = matches
    excluded: tuple[str, ...] = ()
    if first == "ctrl":
        excluded = NOT_POSITIONS
    elif first == FEEDFORWARD:
        excluded = NOT_TORQUES
    return first if set(excluded).isdisjoint(others) else None


def _channels(recording: RawRecording, robot: RobotSpec) -> dict[str, str]:
    """channel → array, or pattern of columns with {joint}."""
    channels = _arrays_of_channels(recording)
    patterns = _patterns_of_channels(recording)
    joints: set[str] = set()
    qpos_first = sorted(patterns, key=lambda channel: channel != "qpos")
    for channel in qpos_first:  # the others have the joints of qpos
        pattern = _best_pattern(patterns[channel], joints, robot)
        joints = joints or patterns[channel][pattern]
        channels.setdefault(channel, pattern)
    return channels


def _arrays_of_channels(recording: RawRecording) -> dict[str, str]:
    """channel → the widest array that is called like it."""
    channels: dict[str, str] = {}
    arrays = [name for name, labels in recording.signals.items() if labels]
    for name in sorted(arrays, key=lambda array: -len(recording.signals[array])):
        channel = _kind(name)
        if channel is None or (channel == "qpos" and _is_of_hand(name)):
            continue
        channels.setdefault(channel, name)
    return channels


def _patterns_of_channels(recording: RawRecording) -> dict[str, dict[str, set[str]]]:
    """channel → pattern with {joint} → joints, of the columns that are no arrays."""
    patterns: dict[str, dict[str, set[str]]] = defaultdict(dict)
    for name, labels in recording.signals.items():
        channel = _kind(name)
        if channel is None or labels or name.lower() in CLOCKS:
            continue
        for pattern, joint in _readings(name):
            patterns[channel].setdefault(pattern, set()).add(joint)
    return patterns


def _is_of_hand(name: str) -> bool:
    """Return True for poses of the end effector: obs/robot0_eef_pos."""
    return bool(HAND_WORDS & words_of(name))


def _best_pattern(joints_of: dict[str, set[str]], joints: set[str], robot: RobotSpec) -> str:
    """Return the pattern with these joints, with most joints, with those of the robot, and that
    says most.

    Args:
        joints_of: Pattern → joints of the columns that fit.
        joints: Of the positions; empty if they are not known.
    """

    def score(pattern: str) -> tuple[bool, int, int, int]:
        found = joints_of[pattern]
        known = sum(_is_joint(joint, robot) for joint in found)
        return found == joints, len(found), known, len(pattern)

    return max(joints_of, key=score)


def _is_joint(name: str, robot: RobotSpec) -> bool:
    try:
        robot.resolve(name, "")
    except JointMismatchError:
        return False
    return True


def _readings(name: str) -> list[tuple[str, str]]:
    """Return each way to read a name as a joint and words of a channel: (pattern, joint).

    shoulder_pan_des → {joint}_des; q_des_1 → q_des_{joint}; tau_J[0] → tau_J[{joint}]; q1_ref →
    q{joint}_ref.
    """
    readings = []
    words = list(re.finditer(r"[A-Za-z0-9]+", name))
    for is_channel, run in groupby(words, lambda word: _is_word(word[0])):
        if not is_channel:
            continue
        first, *others = run
        last = others[-1] if others else first
        if last.end() < len(name):  # the joint stands behind the channel
            start = last.end() + 1
            joint = re.sub(r"[^A-Za-z0-9]*$", "", name[start:])
            closing = name[start + len(joint) :]
            if joint:
                readings.append((name[:start] + "{joint}" + closing, joint))
        if first.start():  # the joint stands before it
            end = first.start() - 1
            readings.append(("{joint}" + name[end:], name[:end]))
    numbers = list(re.finditer(r"\d+", name))
    if numbers:
        place = numbers[-1]
        readings.append((name[: place.start()] + "{joint}" + name[place.end() :], place[0]))
    return readings or [(name, "0")]


def _is_word(text: str) -> bool:
    return any(text.lower() in words for words in WORDS.values())


def _joints(recording: RawRecording, channels: dict[str, str], channel: str = "qpos") -> list[str]:
    """Names of the joints as a channel has them, or the command if there is no such channel, in its
    order; digits where it has none.
    """
    if channel not in channels:
        channel = "ctrl"
    pattern = channels.get(channel)
    if pattern is None:
        return []
    if "{joint}" not in pattern:
        return list(recording.signals.get(pattern) or ("0",))
    joints = []
    for column, joint in _joint_of_column(recording, pattern).items():
        if _kind(column) == channel:  # q_{joint} fits q_des_1 as well
            joints.append(joint)
    return joints


def _joint_of_column(recording: RawRecording, pattern: str) -> dict[str, str]:
    """Return column → joint, of the columns that fit a pattern with {joint}."""
    before, after = map(re.escape, pattern.split("{joint}"))
    fits = re.compile(f"{before}(.+?){after}")
    joint_of = {}
    for column in recording.columns:
        match = fits.fullmatch(column)
        if match:
            joint_of[column] = match[1]
    return joint_of


def _names(channels: dict[str, str], joints: list[str], robot: RobotSpec) -> list[str]:
    """Lines that say which joints the columns of the positions are: joints, ignore or [names]."""
    if not joints:
        return []
    pattern = channels.get("qpos") or channels["ctrl"]
    if "{joint}" not in pattern and all(joint.isdigit() for joint in joints):
        return [_joints_in_order(len(joints), robot)]
    strange = [joint for joint in joints if not _is_joint(joint, robot)]
    if not strange:
        return []
    free = [joint for joint in robot.joint_names if joint not in joints]
    if not free:
        return [f"ignore = {json.dumps(strange)}  # ? no joints of this robot"]
    if len(free) == len(strange):
        heading = "[names]  # ? the log's = the robot's, in the order of both"
        return ["", heading, *_equal_names(strange, free)]
    unknown = ["…"] * len(strange)
    return ["", "[names]  # ? the log's = the robot's", *_equal_names(strange, unknown)]


def _equal_names(theirs: list[str], ours: list[str]) -> list[str]:
    """Lines of [names]: the log's joint = the robot's."""
    pairs = zip(theirs, ours, strict=True)
    return [f"{_text(in_log)} = {_text(joint)}" for in_log, joint in pairs]


def _joints_in_order(n: int, robot: RobotSpec) -> str:
    """The line of joints for n columns without names."""
    given = list(robot.joint_names[:n])
    missing = n - len(given)
    question = "the robot's order: is it the log's?"
    if n < len(robot.joint_names):
        question = "which joints are these?"
    return f"joints = {json.dumps(given + [''] * missing)}  # ? {question}"


def _names_of_commands(
    commands: list[str],
    joints: list[str],
    robot: RobotSpec,
    in_array: bool,
    written: list[str],
) -> list[str]:
    """Lines for commands that call their joints otherwise than the positions do: `joints` for an
    array without names, else [names].

    Args:
        commands: Names of the joints, as the commands have them; digits where they have none.
        joints: The same of the positions.
        in_array: The commands are one array, not a column per joint.
        written: Lines of _names, which these follow.
    """
    strange = [name for name in commands if name not in joints and not _is_joint(name, robot)]
    if not strange:
        return []
    if "0" in joints:  # positions have no names either: their line `joints` is for both
        return []
    if in_array and all(name.isdigit() for name in strange):
        return [f"{_joints_in_order(len(strange), robot)} (of the commands)"]
    ours = ["…"] * len(strange)
    if len(strange) == len(robot.joint_names):
        ours = list(robot.joint_names)
    lines = []
    if not any(line.startswith("[names]") for line in written):
        lines += ["", "[names]"]
    lines.append("# of the commands  ? in the robot's order: is it theirs?")
    return lines + _equal_names(strange, ours)


def _clock(recording: RawRecording, specified: dict[str, Any]) -> list[str]:
    """Lines of time or rate, and of time_unit."""
    if "rate" in specified:
        return [f"rate = {specified['rate']:g}  # Hz"]
    periods = clock_periods(recording.signals, recording.load)
    clock = _likely_clock(recording, specified.get("time"), periods)
    if clock is None:
        return [] if _has_own_clock(recording) else ["rate = 50.0  # ? Hz: the log has no clock"]
    lines = [] if clock == "time" else [f"time = {_text(clock)}"]
    others = {name: other for name, other in periods.items() if name != clock}
    if others and clock in periods:
        lines = _which_clock(clock, periods[clock], others)
    return [*lines, _time_unit(recording.load([clock])[clock].values)]


def _likely_clock(
    recording: RawRecording, stated: str | None, periods: dict[str, float]
) -> str | None:
    """Return the column that is most likely the clock: the first that is stated or called like
    one, else the first that runs like one (periods).
    """
    for name, labels in recording.signals.items():
        if not labels and (name == stated or name.lower() in CLOCKS):
            return name
    return next(iter(periods), None)


def _has_own_clock(recording: RawRecording) -> bool:
    """Return True if the signals of a recording have clocks of their own, as topics of a bag."""
    first = next(iter(recording.signals), None)
    if first is None:
        return False
    return recording.load([first])[first].time is not None


def _which_clock(clock: str, period: float, others: dict[str, float]) -> list[str]:
    """Ask which of several columns is the clock. others: name → its distance of rows."""
    ratios = {name: rate_ratio(period, other) for name, other in others.items()}
    apart = [name for name, ratio in ratios.items() if abs(ratio - 1) > MAX_RATE_DIFFERENCE]
    rates = "; ".join(f"{name} {other:.4g} a row" for name, other in others.items())
    line = f"time = {_text(clock)}  # ? {period:.4g} a row; also like clocks: {rates}"
    if not apart:
        return [line]
    factors = ", ".join(f"{ratios[name]:.3g}" for name in apart)
    return [
        f"# {clock} and {', '.join(apart)} run like clocks and differ by a factor of {factors}: "
        "choose one",
        f"# for time, and leave the other out: ignore = {json.dumps(apart)}",
        line,
    ]


def _values(recording: RawRecording, pattern: str, robot: RobotSpec | None = None) -> Array | None:
    """(rows, joints) of a channel, in the log's own order; of a robot, its joints where any are."""
    if pattern in recording.signals:
        values = recording.load([pattern])[pattern].values[:ROWS]
        if values.ndim == 1:
            return values[:, None]
        labels = recording.signals[pattern]
        of_robot = [i for i, label in enumerate(labels) if robot and _is_joint(label, robot)]
        return values[:, of_robot] if of_robot else values
    names = _columns_of(recording, pattern, robot)
    if not names:
        return None
    loaded = recording.load(names)
    return np.stack([loaded[n].values[:ROWS] for n in names], axis=1)


def _columns_of(recording: RawRecording, pattern: str, robot: RobotSpec | None) -> list[str]:
    """Return the columns that fit a pattern with {joint}; of a robot, its joints where any are."""
    if "{joint}" not in pattern:
        return []
    columns = []
    of_robot = []
    for column, joint in _joint_of_column(recording, pattern).items():
        if column not in recording.signals:
            continue
        columns.append(column)
        if robot and _is_joint(joint, robot):
            of_robot.append(column)
    return of_robot or columns


def _positions(
    recording: RawRecording,
    channels: dict[str, str],
    robot: RobotSpec,
    stated: str | None = None,
) -> list[str]:
    """The line of position_unit: as names or a row of units say it, or by the size of the values.

    Values of the robot's joints count; a gripper or a wheel beside them has another unit.
    """
    pattern = channels.get("qpos") or channels.get("ctrl") or ""
    named = stated or _named_unit(recording, pattern)
    if named:
        return [f'position_unit = "{named}"']
    values = _values(recording, pattern, robot)
    return [_unit_line(np.zeros(0) if values is None else values)]


def _unit_line(values: Array) -> str:
    """The line of position_unit by the size of positions of any shape."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 'position_unit = "rad"  # ?'
    largest = float(np.abs(finite).max())
    unit = "rad" if largest <= LARGEST_RAD else "deg"
    if look_like_ticks(finite):
        unit = "ticks"
    elif look_like_percent(finite):
        unit = "signed_percent"
    return f'position_unit = "{unit}"  # ? values up to {largest:.3g}'


def _named_unit(recording: RawRecording, pattern: str) -> str | None:
    """The unit of positions that their names say, or a second line of the header."""
    units = recording.meta.get("notes", {}).get("units", {})
    before, _, after = pattern.partition("{joint}")
    texts = [before, after]
    for column, unit in units.items():
        if column.startswith(before) and column.endswith(after):
            texts.append(unit)
    for text in texts:
        for word in re.split(r"[^a-z°]+", text.lower()):
            for unit, words in UNIT_WORDS.items():
                if word in words:
                    return unit
    return None


def _repeated(recordings: list[RawRecording], ctrl: str) -> bool:
    """Return True if the first two recordings have equal commands: a final number in their names
    counts repetitions.
    """
    if len(recordings) < 2:
        return True
    first = _values(recordings[0], ctrl)
    second = _values(recordings[1], ctrl)
    if first is None or second is None:
        return True
    rows = min(len(first), len(second))
    first = np.nan_to_num(first[:rows])
    second = np.nan_to_num(second[:rows])
    own_motion = np.abs(first - first.mean(axis=0)).mean()
    return bool(np.abs(first - second).mean() <= MAX_REPETITION_SHARE * own_motion)


def _pattern(names: list[str], repeated: bool) -> str:
    """Return the pattern of the names: a payload with its unit, and a final number."""
    pattern = "{motion}"
    if all(re.search(r"_\d+(?:[.p]\d+)?kg", name) for name in names):
        pattern += "_{payload:g}kg"
    numbers = [re.search(r"_(rep|r|run|take)?\d+$", name) for name in names]
    if not (repeated and all(numbers)):
        return pattern
    first = numbers[0] if numbers else None
    word = first[1] if first and first[1] else ""
    return f"{pattern}_{word}{{rep}}"
