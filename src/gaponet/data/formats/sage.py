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
from gaponet.data.describe.plausibility import to_radians
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
    folders = sorted({f.parent for f in files_below(path) if f.name in FILES})
    return [f for f in folders if f.relative_to(path).parts[:1] != ("sim",)]


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
        yield (
            os.path.basename(os.path.abspath(folder)),
            partial(_read_motion, folder, robot, joint_map),
        )


def _read_motion(folder: Path, robot: RobotSpec, joint_map: dict[str, str] | None) -> Log:
    list_file = folder / "joint_list.txt"
    if not list_file.is_file():
        raise LogError(f"{list_file}: missing; one joint name a line, in the order of the columns")
    try:
        lines = read_limited(list_file, LogError).decode().splitlines()
    except UnicodeDecodeError as error:
        raise LogError(
            f"{list_file}: not UTF-8 text ({error.reason} at byte {error.start}); is it this file?"
        ) from None
    raw_names = [line.strip() for line in lines if line.strip()]
    if not raw_names:
        raise LogError(f"{list_file}: empty; one joint name a line, in the order of the columns")
    names = tuple(resolve_all(raw_names, robot, str(list_file), joint_map))
    control = folder / "control.csv"
    state = folder / "state_motor.csv"
    ctrl_time, ctrl = _read_csv(control, len(names), "control")
    state_time, values = _read_csv(state, len(names), "state_motor")
    units = [robot.log_joints.units[robot.joint_names.index(name)] for name in names]
    channels = {COLUMNS[k]: Channel(state_time, v) for k, v in values.items() if k in COLUMNS}
    channels["ctrl"] = Channel(ctrl_time, ctrl["positions"])
    return Log(
        robot.name,
        names,
        {
            k: Channel(c.time, to_radians(k, c.values, names, units, robot))
            for k, c in channels.items()
        },
        str(folder),
        {
            "files": dict.fromkeys(channels, str(state)) | {"ctrl": str(control)},
            "first_line": 2,
            "converted_from": {n: u for n, u in zip(names, units, strict=True) if u != "rad"},
        },
    )


def _read_csv(file: Path, n: int, kind: str) -> tuple[Array, dict[str, Array]]:
    """Time (k,) in seconds and {column: (k, n)}."""
    needed = "a SAGE motion needs control.csv and state_motor.csv, each of one recording"
    first, _, body = read_limited(file, LogError, needed, MAX_ARRAYS_BYTES).partition(b"\n")
    header = first.decode("utf-8", errors="replace").strip().lstrip("\ufeff")
    columns = [c.strip().lower() for c in header.split(",")]
    lists = columns[2:]
    if columns[:2] != ["type", "timestamp"]:
        raise LogError(
            f"{file}:1: header is '{header[:60]}', expected type,timestamp,positions,..."
        )
    if len(set(columns)) != len(columns):
        raise LogError(
            f"{file}:1: a column stands twice in the header {', '.join(columns)}; delete or "
            "rename one"
        )
    if "positions" not in lists:
        raise LogError(
            f"{file}:1: column 'positions' is missing; the header has: {', '.join(columns)}"
        )
    body = body.rstrip()
    if not body:
        raise LogError(f"{file}: holds no rows; delete the motion folder or record it again")
    table = _parse(file, body, n, len(lists), kind)
    time = table[:, 0] * _seconds(file, table[:, 0])
    return time, {name: table[:, 1 + i * n : 1 + (i + 1) * n] for i, name in enumerate(lists)}


def _parse(file: Path, body: bytes, n: int, k: int, kind: str) -> Array:
    """Numbers of all rows, (rows, 1 + k n).

    The whole body is looked at once; lines singly only to name a bad one.
    """
    import pyarrow as pa
    import pyarrow.csv as csv

    skeletons = set(body.translate(None, DIGITS).lower().split(b"\n"))
    numbers = b'"[' + b"," * (n - 1) + b']"'
    if skeletons != {b",".join([kind.encode().translate(None, DIGITS), b"", *[numbers] * k])}:
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
    for i, line in enumerate(body.decode("utf-8", errors="replace").split("\n")):
        if (match := row.fullmatch(line.rstrip("\r"))) and match[1].lower() != kind:
            raise LogError(
                f"{file}:{i + 2}: a row of type '{match[1]}', not {kind.upper()}: are the files "
                "swapped or mixed?"
            )
        if not match:
            shown = line if len(line) < 60 else line[:57] + "..."
            raise LogError(
                f"{file}:{i + 2}: expected TYPE,timestamp and {k} list(s) of {n} numbers, got "
                f"'{shown}'; the file may be cut short: remove the row or record the motion again"
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
