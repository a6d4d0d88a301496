"""Tables with a row per joint and time: columns `time`, `joint` (names), and one column per
signal.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.structure import MAX_ARRAYS_BYTES, read_limited
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording
from gaponet.data.formats import episodes, parquet, text

if TYPE_CHECKING:
    import pyarrow as pa

JOINT_COLUMNS = ("joint", "joint_name", "joint_names")
NUMBERS = (*episodes.COLUMNS, *episodes.FRAME_COLUMNS)
TIME_COLUMNS = ("time", "t", "timestamp", "stamp")


def joint_column(names: list[str], logs: LogsFile) -> str | None:
    """Return the column with the joints' names; None if the table has none, or has a column of
    commands per joint.
    """
    before, pattern, after = str(logs.get("ctrl", "ctrl.{joint}")).partition("{joint}")
    if pattern:
        for name in names:
            longer = len(name) > len(before + after)
            if longer and name.startswith(before) and name.endswith(after):
                return None
    return next((name for name in names if name.lower() in JOINT_COLUMNS), None)


def recording(file: Path, names: list[str], joint: str, logs: LogsFile) -> RawRecording:
    """Return a table with a row per joint and time as a recording whose signals have a column per
    joint.

    Args:
        joint: The column with the joints' names.
        logs: Content of logs.toml, or the defaults.

    Raises:
        LogError: The time column is not known, or a joint is missing at a time.
    """
    time = _time_column(names, logs)
    if time is None:
        raise LogError(
            f"{file}:1: a row per joint, and no column of times; name it in logs.toml: time = …"
        )
    table = _table(file, names)
    of_row = np.array([str(name) for name in table.column(joint).to_pylist()], dtype=object)
    rows_of = {}  # joint → its rows
    for name in dict.fromkeys(of_row.tolist()):
        rows_of[name] = np.flatnonzero(of_row == name)
    stamps = _numbers(file, table, time)
    arrays = {time: _common_times(file, stamps, rows_of)}
    for name in names:
        if name in (joint, time):
            continue
        column = table.column(name)
        is_used = name in logs.values() or not column.null_count
        if is_used and is_number(column.type):
            numbers = _numbers(file, table, name)
            values = np.stack([numbers[rows] for rows in rows_of.values()], axis=1)
            if name.lower() in NUMBERS and (values == values[:, :1]).all():
                values = values[:, 0]  # numbers of episodes belong to all joints
            arrays[name] = values
    recording = RawRecording.of_arrays(file, arrays, tuple(rows_of), default={"time": time})
    return replace(recording, where=f"{file}:1")


def _time_column(names: list[str], logs: LogsFile) -> str | None:
    """Return the column of times: that of logs.toml, else the first that is called like one."""
    stated = logs.get("time")
    if stated in names:
        return stated
    return next((name for name in names if name.lower() in TIME_COLUMNS), None)


def _common_times(file: Path, stamps: Array, rows_of: dict[str, Array]) -> Array:
    """Return the times of the first joint; refuse joints with others.

    Args:
        stamps: Of all rows.
        rows_of: Joint → its rows.
    """
    times: list[Array] = [stamps[rows] for rows in rows_of.values()]
    if not all(np.array_equal(of_joint, times[0]) for of_joint in times):
        counts = ", ".join(f"{name} {len(rows)}" for name, rows in rows_of.items())
        raise LogError(
            f"{file}: joints have different times ({counts} rows); write every joint at every time"
        )
    return times[0]


def _table(file: Path, names: list[str]) -> pa.Table:
    if file.suffix.lower() == ".parquet":
        return parquet.read(file, names)
    import pyarrow as pa
    import pyarrow.csv as pc

    found = text.heading(text.beginning(file))
    body = text.decoded(
        read_limited(file, LogError, "cut the log into shorter ones", MAX_ARRAYS_BYTES)
    )
    try:
        return pc.read_csv(
            pa.py_buffer(body),
            pc.ReadOptions(use_threads=False, column_names=names, skip_rows=found.first),
            pc.ParseOptions(delimiter=found.delimiter),
        )
    except pa.ArrowInvalid as error:
        raise LogError(f"{file}: not a readable CSV file ({error}); export it again") from None


def is_number(kind: pa.DataType) -> bool:
    """Return True for integers and floating-point numbers."""
    import pyarrow as pa

    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def _numbers(file: Path, table: pa.Table, name: str) -> Array:
    column = table.column(name)
    if not is_number(column.type) or column.null_count:
        raise LogError(
            f"{file}: column '{name}' holds cells that are no numbers; repair or cut these rows"
        )
    return np.asarray(column.to_numpy(), float)
