"""A logs.toml for strange logs, filled in as far as names and numbers show it; what is a guess is marked as one."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import JointMismatchError, LogError
from gaponet.data.describe.clocks import MAX_RATE_DIFFERENCE, clock_periods, rate_ratio
from gaponet.data.describe.plausibility import look_like_percent, look_like_ticks
from gaponet.data.describe.raw_recording import SECONDS, RawRecording
from gaponet.data.log import FEEDFORWARD
from gaponet.robot.spec import RobotSpec

# Words by which the world calls them; a name with a word of an earlier line is not looked for in a later one.
WORDS = {
    FEEDFORWARD: ("ff", "feedforward", "ffwd"),
    "ctrl": ("ctrl", "cmd", "command", "commanded", "des", "desired", "target", "goal", "ref", "reference", "action",
             "setpoint", "sp"),
    "qvel": ("qvel", "vel", "velocity", "velocities", "dq", "qd", "speed", "dof_vel"),
    "tau": ("tau", "torque", "torques", "effort", "trq", "tau_est", "current"),
    "temperature": ("temperature", "temp"),
    "qpos": ("qpos", "pos", "position", "positions", "q", "meas", "measured", "actual", "act", "state", "angle", "enc"),
}  # fmt: skip
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
NOT_POSITIONS = ("qvel", "tau", "temperature")
ROWS = 4000  # that are looked at
APART = 0.5  # of a command's own motion by which repetitions of it differ at the most


def guess_logs(
    recordings: list[RawRecording], robot: RobotSpec, fmt: str, known: dict[str, Any]
) -> str:
    """The text of a logs.toml.

    Args:
        recordings: Some of one kind; the first is looked at, and what the names of all have in common.
        known: What is said already (a logs.toml, the format's own), which is kept.
    """
    if not recordings:
        raise LogError("no recording found")
    family = _family([Path(r.source).name for r in recordings])
    if family:
        return _guess_family(recordings, robot, fmt, family)
    first = recordings[0]
    specified = dict(known) | {k: v for k, v in first.default.items() if k not in known}
    lines = [f"# {fmt}; the first recording: {first.where or first.source}",
             f"# its columns: {first.shown(40)}", "# Lines with a ? are guesses: look at them.", ""]  # fmt: skip
    stated = {
        c: specified[c]
        for c in WORDS
        if c in specified and _values(first, specified[c]) is not None
    }
    channels = _channels(first) | stated
    joints = _joints(first, channels)
    lines += _clock(first, specified)
    lines += _positions(first, channels)
    lines += [f"{channel} = {_text(name)}" for channel, name in channels.items()]
    for need in ("ctrl", "qpos"):
        if need not in channels:
            lines.append(f'# {need} = "…"          ? none of the names looks like it')
    lines += _names(channels, joints, robot)
    repeated = _repeated(recordings, channels.get("ctrl", ""))
    lines += ["", "# What the names of the recordings say, or a sheet (file, motion, payload, unit, rep):",
              f"# names here: {', '.join(r.name for r in recordings[:5])}{', …' if len(recordings) > 5 else ''}",
              f"motion = {_text(_pattern([r.name for r in recordings], repeated))}",
              '# manifest = "sheet.csv"', '# unit = "…"', "# payload = 0.0        # kg",
              "# kp = …               # N·m/rad while recording; default: robot.toml's"]  # fmt: skip
    return "\n".join(lines) + "\n"


def _family(files: list[str]) -> dict[str, str]:
    """Return channel or "time" → pattern of its files, where each recording has a file for each: {name}_desired.csv.

    Empty where files are recordings of their own.
    """
    names: dict[str, dict[str, str]] = defaultdict(dict)  # {name} → kind → pattern
    for file in files:
        stem, _, suffix = file.rpartition(".")
        words = [m[0] for m in re.finditer(r"[A-Z]?[a-z]+|[A-Z]+", stem)]
        known = [w for w in words if _kind(w) or w.lower() in CLOCKS]
        if not known:
            return {}
        name = stem
        for word in known:
            name = re.sub(rf"[-_. ]?{word}", "", name, count=1)
        name = name.strip("-_. ")
        kind = _kind(stem) or "time"
        pattern = stem.replace(name, "{name}", 1) if name else stem
        names[name][kind] = f"{pattern}.{suffix}"
    families = list(names.values())
    kinds = families[0]
    alike = all(
        family.keys() == kinds.keys() for family in families[:-1]
    )  # the last may be cut off
    return kinds if alike and "qpos" in kinds and len(kinds) > 1 else {}


def _guess_family(
    recordings: list[RawRecording], robot: RobotSpec, fmt: str, family: dict[str, str]
) -> str:
    """The text of a logs.toml for signals in files of their own. family: of _family."""
    by_kind = {
        kind: next(r for r in recordings if _fits(Path(r.source).name, pattern))
        for kind, pattern in family.items()
    }
    state = by_kind["qpos"]
    joints = list(state.columns)
    values = np.stack([state.load([c])[c].values[:ROWS] for c in state.signals], axis=1)
    span = float(np.nanmax(np.abs(values)))
    lines = [f"# {fmt}; files that belong together: {', '.join(family.values())}",
             "# Lines with a ? are guesses: look at them.", "",
             f"state_file = {_text(family['qpos'])}  # ?"]  # fmt: skip
    if "ctrl" in family:
        lines.append(f"command_file = {_text(family['ctrl'])}  # ?")
    if "time" in family:
        clock = by_kind["time"]
        column = next(iter(clock.signals))
        lines += [
            f"time_file = {_text(family['time'])}  # ?",
            _time_unit(clock.load([column])[column].values),
        ]
    else:
        lines.append("rate = 50.0  # ? Hz: no file holds times")
    unit = "rad" if span <= 7 else "ticks" if look_like_ticks(values) else "deg"
    lines += [
        f'position_unit = "{unit}"  # ? values up to {span:.3g}',
        'ctrl = "{joint}"',
        'qpos = "{joint}"',
    ]
    others = [p for kind, p in family.items() if kind not in ("qpos", "ctrl", "time")]
    if others:
        lines.append(f"# not read: {', '.join(others)}")
    lines += _names({"qpos": "{joint}"}, joints, robot)
    return "\n".join(lines) + "\n"


def _fits(file: str, pattern: str) -> bool:
    before, _, after = pattern.partition("{name}")
    return file.startswith(before) and file.endswith(after)


def _time_unit(stamps: Array) -> str:
    """The line of time_unit for a clock."""
    low, period, high = np.percentile(np.diff(stamps[:ROWS]), [5, 50, 95])
    units = [u for u, s in SECONDS.items() if 5e-4 <= period * s <= 0.2]
    unit = units[0] if units else "s"
    uneven = ""
    if high - low > 0.2 * period:
        uneven = f"; uneven: {low * SECONDS[unit]:.3g} to {high * SECONDS[unit]:.3g} s"
    return f'time_unit = "{unit}"  # the median period is {period * SECONDS[unit]:.6g} s{uneven}'


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def _kind(name: str) -> str | None:
    """Which channel a name speaks of; of a command's, positions only."""
    parts = re.split(r"[^a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    matches = [channel for channel, words in WORDS.items() if any(part in words for part in parts)]
    excluded = {"ctrl": NOT_POSITIONS, FEEDFORWARD: ("qpos", "qvel", "temperature")}.get(
        matches[0] if matches else ""
    )
    if excluded and any(c in matches for c in excluded):
        return None  # a commanded velocity or torque; a feed-forward of something else
    return matches[0] if matches else None


def _channels(recording: RawRecording) -> dict[str, str]:
    """channel → array, or pattern of columns with {joint}."""
    matches: dict[str, str] = {}
    arrays = [n for n, labels in recording.signals.items() if labels]
    for name in sorted(arrays, key=lambda n: -len(recording.signals[n])):
        if kind := _kind(name):
            matches.setdefault(kind, name)
    singles = [
        n for n, labels in recording.signals.items() if not labels and n.lower() not in CLOCKS
    ]
    shapes = defaultdict[str, Counter[str]](Counter)
    for name in singles:
        if kind := _kind(name):
            shapes[kind].update(_patterns(name))
    best = {kind: max(counts, key=lambda p: (counts[p], len(p))) for kind, counts in shapes.items()}
    return matches | {kind: pattern for kind, pattern in best.items() if kind not in matches}


def _patterns(name: str) -> list[str]:
    """Each way to read a name as joint and words: shoulder_pan_des → {joint}_des; q_des_1 → q_des_{joint}."""
    words = list(re.finditer(r"[A-Za-z0-9]+", name))
    matches = []
    for known, run in groupby(
        words, lambda m: any(m[0].lower() in words for words in WORDS.values())
    ):
        first, *_, last = *(together := list(run)), together[-1]
        if known and last.end() < len(name):
            matches.append(name[: last.end() + 1] + "{joint}")
        if known and first.start():
            matches.append("{joint}" + name[first.start() - 1 :])
    return matches or [name]


def _joints(recording: RawRecording, channels: dict[str, str]) -> list[str]:
    """Names of the joints as the log has them, in its order; digits where it has none."""
    pattern = channels.get("qpos") or channels.get("ctrl")
    if pattern is None:
        return []
    if "{joint}" not in pattern:
        return list(recording.signals.get(pattern) or ("0",))
    before, after = map(re.escape, pattern.split("{joint}"))
    kind = "qpos" if "qpos" in channels else "ctrl"
    return [
        m[1]
        for c in recording.columns
        if (m := re.fullmatch(f"{before}(.+?){after}", c)) and _kind(c) == kind
    ]


def _names(channels: dict[str, str], joints: list[str], robot: RobotSpec) -> list[str]:
    """joints and [names]."""
    if not joints:
        return []
    if all(j.isdigit() for j in joints) and "{joint}" not in (
        channels.get("qpos") or channels["ctrl"]
    ):
        n = len(joints)
        own = list(robot.joint_names[:n]) + [""] * (n - len(robot.joint_names))
        question = (
            "the robot's order: is it the log's?"
            if n >= len(robot.joint_names)
            else "which joints are these?"
        )
        return [f"joints = {json.dumps(own)}  # ? {question}"]
    strange = []
    for joint in joints:
        try:
            robot.resolve(joint, "")
        except JointMismatchError:
            strange.append(joint)
    if not strange:
        return []
    left = [j for j in robot.joint_names if j not in joints]
    in_order = len(left) == len(strange)
    lines = [
        "",
        "[names]  # ? the log's = the robot's" + (", in the order of both" if in_order else ""),
    ]
    for i, joint in enumerate(strange):
        lines.append(f"{_text(joint)} = {_text(left[i] if in_order else '…')}")
    return lines


def _clock(recording: RawRecording, specified: dict[str, Any]) -> list[str]:
    """time or rate, and time_unit."""
    if "rate" in specified:
        return [f"rate = {specified['rate']:g}  # Hz"]
    named = [n for n, labels in recording.signals.items() if not labels]
    periods = clock_periods(recording.signals, recording.load)
    known = [n for n in named if n == specified.get("time") or n.lower() in CLOCKS]
    clock = next(iter([*known, *periods]), None)
    if clock is None:
        own = [n for n in list(recording.signals)[:1] if recording.load([n])[n].time is not None]
        return [] if own else ["rate = 50.0  # ? Hz: the log has no clock"]
    lines = [] if clock == "time" else [f"time = {_text(clock)}"]
    others = {name: other for name, other in periods.items() if name != clock}
    if others and clock in periods:
        lines = _which_clock(clock, periods[clock], others)
    return [*lines, _time_unit(recording.load([clock])[clock].values)]


def _which_clock(clock: str, period: float, others: dict[str, float]) -> list[str]:
    """Ask which of several columns is the clock. others: name → its distance of rows."""
    apart = [
        name
        for name, other in others.items()
        if abs(rate_ratio(period, other) - 1) > MAX_RATE_DIFFERENCE
    ]
    rates = "; ".join(f"{name} {other:.4g} a row" for name, other in others.items())
    line = f"time = {_text(clock)}  # ? {period:.4g} a row; also like clocks: {rates}"
    if not apart:
        return [line]
    factors = ", ".join(f"{rate_ratio(period, others[name]):.3g}" for name in apart)
    return [
        f"# {clock} and {', '.join(apart)} run like clocks and differ by a factor of {factors}: choose one",
        f"# for time, and leave the other out: ignore = {json.dumps(apart)}",
        line,
    ]


def _values(recording: RawRecording, pattern: str) -> Array | None:
    """(rows, joints) of a channel, in the log's own order."""
    if pattern in recording.signals:
        values = recording.load([pattern])[pattern].values[:ROWS]
        return values if values.ndim == 2 else values[:, None]
    if "{joint}" not in pattern:
        return None
    before, after = map(re.escape, pattern.split("{joint}"))
    names = [
        c
        for c in recording.columns
        if re.fullmatch(f"{before}(.+?){after}", c) and c in recording.signals
    ]
    if not names:
        return None
    loaded = recording.load(names)
    return np.stack([loaded[n].values[:ROWS] for n in names], axis=1)


def _positions(recording: RawRecording, channels: dict[str, str]) -> list[str]:
    values = _values(recording, channels.get("qpos") or channels.get("ctrl") or "")
    if values is None or not np.isfinite(values).any():
        return ['position_unit = "rad"  # ?']
    span = float(np.nanmax(np.abs(values)))
    unit = "rad" if span <= 7 else "deg"
    finite = values[np.isfinite(values)]
    if look_like_ticks(finite):
        unit = "ticks"
    elif look_like_percent(finite):
        unit = "signed_percent"
    return [f'position_unit = "{unit}"  # ? values up to {span:.3g}']


def _repeated(recordings: list[RawRecording], ctrl: str) -> bool:
    """Return True if the first two recordings have equal commands: a final number in their names counts repetitions."""
    commands = [_values(recording, ctrl) for recording in recordings[:2]]
    if len(commands) < 2 or any(x is None for x in commands):
        return True
    a, b = (np.nan_to_num(x[: min(map(len, commands))]) for x in commands)  # type: ignore[arg-type, index]
    return bool(np.abs(a - b).mean() <= APART * np.abs(a - a.mean(axis=0)).mean())


def _pattern(names: list[str], repeated: bool) -> str:
    """Return the pattern of the names: a payload with its unit, and a final number."""
    pattern = "{motion}"
    if all(re.search(r"_\d+(?:[.p]\d+)?kg", n) for n in names):
        pattern += "_{payload:g}kg"
    if repeated and all(re.search(r"_(?:rep|r|run|take)?\d+$", n) for n in names):
        word = re.search(r"_(rep|r|run|take)?\d+$", names[0])
        pattern += f"_{word[1] or '' if word else ''}" + "{rep}"
    return pattern
