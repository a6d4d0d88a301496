"""SAGE folder: control.csv and state_motor.csv beside each other.

{real,sim}/{robot}/{source}/{motion}/{control,state_motor}.csv and joint_list.txt; event.csv is not
read. Rows are TYPE,timestamp,"[...]"; the case of TYPE differs between recordings. Real timestamps
are microseconds, simulated ones seconds; the reader decides by the period and refuses one that is
neither. Joints stand in the unit that the robot's `log_unit` says (SO-101's gripper: 0..1 of its
range).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.structure import MAX_ARRAYS_BYTES, read_limited
from gaponet.data.describe.joints import resolve_all
from gaponet.data.describe.plausibility import not_in_radians, to_radians
from gaponet.data.formats import files_below
from gaponet.data.log import Channel, Log
from gaponet.robot.spec import RobotSpec

COLUMNS = {"positions": "qpos", "velocities": "qvel", "torques": "tau"}
FILES = ("control.csv", "state_motor.csv")
DIGITS = b"0123456789.+-eE \r"  # what numbers are made of; the rest of a row is its skeleton
NUMBER = r" *(?:[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?nan|[-+]?inf) *"


def detects(path: Path) -> bool:
    """A folder with motion folders at or below it."""
    return path.is_dir() and any(f.name in FILES for f in files_below(path))


def find(path: Path) -> list[Path]:
    """Real motion folders under path; simulated ones are skipped."""
    folders = sorted({file.parent for file in files_below(path) if file.name in FILES})
    return [folder for folder in folders if folder.relative_to(path).parts[:1] != ("sim",)]


def read(
    path: Path, robot: RobotSpec, joint_map: dict[str, str] | None = None
) -> Iterator[tuple[str, Callable[[], Log]]]:
    """Yield (motion, what reads its Log) for every real motion folder under path."""
    folders = find(path)
    if not folders:
        raise LogError(
            f"{path}: no folder with control.csv and state_motor.csv; point at a SAGE folder"
        )
    for folder in folders:
        motion = os.path.basename(os.path.abspath(folder))
        yield motion, partial(_read_motion, folder, robot, joint_map)


def _read_motion(folder: Path, robot: RobotSpec, joint_map: dict[str, str] | None) -> Log:
    list_file = folder / "joint_list.txt"
    names = tuple(resolve_all(_joint_names(list_file), robot, str(list_file), joint_map))
    control = folder / "control.csv"
    state = folder / "state_motor.csv"
    command_time, commands = _read_csv(control, len(names), "control")
    state_time, states = _read_csv(state, len(names), "state_motor")
    units = [robot.log_joints.units[robot.joint_names.index(name)] for name in names]
    channels = {}
    for column, values in states.items():
        if column in COLUMNS:
            channel = COLUMNS[column]
            in_si = to_radians(channel, values, names, units, robot)
            channels[channel] = Channel(state_time, in_si)
    targets = to_radians("ctrl", commands["positions"], names, units, robot)
    channels["ctrl"] = Channel(command_time, targets)
    meta = {
        "files": dict.fromkeys(channels, str(state)) | {"ctrl": str(control)},
        "first_line": 2,
        "converted_from": not_in_radians(names, units),
    }
    return Log(robot.name, names, channels, str(folder), meta)


def _joint_names(file: Path) -> list[str]:
    """Return the names in a joint_list.txt."""
    if not file.is_file():
        raise LogError(f"{file}: missing; one joint name a line, in the order of the columns")
    try:
        lines = read_limited(file, LogError).decode().splitlines()
    except UnicodeDecodeError as error:
        raise LogError(
            f"{file}: not UTF-8 text ({error.reason} at byte {error.start}); is it this file?"
        ) from None
    names = [line.strip() for line in lines if line.strip()]
    if not names:
        raise LogError(f"{file}: empty; one joint name a line, in the order of the columns")
    return names


def _read_csv(file: Path, n: int, kind: str) -> tuple[Array, dict[str, Array]]:
    """Return the time of each row, (k) s, and the lists of n numbers by name, (k, n) each.

    Args:
        kind: TYPE of its rows.
    """
    needed = "a SAGE motion needs control.csv and state_motor.csv, each of one recording"
    first, _, body = read_limited(file, LogError, needed, MAX_ARRAYS_BYTES).partition(b"\n")
    lists = _lists(file, first)
    body = body.rstrip()
    if not body:
        raise LogError(f"{file}: holds no rows; delete the motion folder or record it again")
    table = _parse(file, body, n, len(lists), kind)  # (k, 1 + lists · n)
    stamps = table[:, 0]
    numbers = table[:, 1:]
    by_name = {}
    for i, name in enumerate(lists):
        by_name[name] = numbers[:, i * n : (i + 1) * n]
    return stamps * _seconds(file, stamps), by_name


def _lists(file: Path, first: bytes) -> list[str]:
    """Return the names of the lists that the header of a file names."""
    header = first.decode("utf-8", errors="replace").strip().lstrip("\ufeff")
    columns = [column.strip().lower() for column in header.split(",")]
    if columns[:2] != ["type", "timestamp"]:
        raise LogError(
            f"{file}:1: header is '{header[:60]}', expected type,timestamp,positions,..."
        )
    if len(set(columns)) != len(columns):
        raise LogError(
            f"{file}:1: a column stands twice in the header {', '.join(columns)}; delete or "
            "rename one"
        )
    if "positions" not in columns:
        raise LogError(
            f"{file}:1: column 'positions' is missing; the header has: {', '.join(columns)}"
        )
    return columns[2:]


def _parse(file: Path, body: bytes, n: int, k: int, kind: str) -> Array:
    """Return the numbers of all rows, (rows, 1 + k n).

    The whole body is looked at once; lines singly only to name a bad one.

    Args:
        n: Joints.
        k: Lists in a row.
        kind: TYPE of the rows.
    """
    import pyarrow as pa
    import pyarrow.csv as csv

    list_skeleton = b'"[' + b"," * (n - 1) + b']"'
    skeleton = b",".join([kind.encode().translate(None, DIGITS), b"", *[list_skeleton] * k])
    if set(body.translate(None, DIGITS).lower().split(b"\n")) != {skeleton}:
        _refuse_row(file, body, n, k, kind)
    names = [str(i) for i in range(2 + n * k)]
    try:
        table = csv.read_csv(
            pa.py_buffer(body.translate(None, b'"[]\r')),
            read_options=csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=csv.ParseOptions(ignore_empty_lines=False),
            convert_options=csv.ConvertOptions(
                include_columns=names[1:],
                column_types=dict.fromkeys(names[1:], pa.float64()),
                null_values=[""],
            ),
        )
    except pa.ArrowInvalid as error:
        _refuse_row(file, body, n, k, kind)
        raise LogError(f"{file}: not readable: {error}; record the motion again") from None
    if any(column.null_count for column in table.columns):
        _refuse_row(file, body, n, k, kind)
    return np.column_stack([column.to_numpy() for column in table.columns])


def _refuse_row(file: Path, body: bytes, n: int, k: int, kind: str) -> None:
    """Raise for the first line that is not TYPE,time and k lists of n numbers, or of another type
    than `kind`.
    """
    row = re.compile(
        rf'([A-Za-z_]+),{NUMBER}(?:,"\[{NUMBER}(?:,{NUMBER}){{{n - 1}}}\]"){{{k}}}', re.IGNORECASE
    )
    for number, line in enumerate(body.decode("utf-8", errors="replace").split("\n"), 2):
        match = row.fullmatch(line.rstrip("\r"))
        if match is None:
            shown = line if len(line) < 60 else line[:57] + "..."
            raise LogError(
                f"{file}:{number}: expected TYPE,timestamp and {k} list(s) of {n} numbers, got "
                f"'{shown}'; the file may be cut short: remove the row or record the motion again"
            )
        if match[1].lower() != kind:
            raise LogError(
                f"{file}:{number}: a row of type '{match[1]}', not {kind.upper()}: are the files "
                "swapped or mixed?"
            )


def _seconds(file: Path, time: Array) -> float:
    """Factor from the file's time unit to seconds."""
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if 1e-4 <= period <= 1.0:
        return 1.0
    if 1e2 <= period <= 1e6:
        return 1e-6
    if not period > 0:
        return 1e-6  # Log refuses the row where time goes back or is not a number
    raise LogError(
        f"{file}: the median period is {period:g}, neither microseconds nor seconds; mend the "
        "timestamps"
    )
