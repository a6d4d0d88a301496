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
from gaponet.data.formats import parquet

if TYPE_CHECKING:
    import pyarrow as pa

JOINT_COLUMNS = ("joint", "joint_name", "joint_names")
TIME_COLUMNS = ("time", "t", "timestamp", "stamp")


def joint_column(names: list[str], logs: LogsFile) -> str | None:
    """Return the column with the joints' names; None if the table has none, or has a column of
    commands per joint.
    """
    before, pattern, after = str(logs.get("ctrl", "ctrl.{joint}")).partition("{joint}")
    if pattern and any(
        n.startswith(before) and n.endswith(after) and len(n) > len(before + after) for n in names
    ):
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
    times = [n for n in names if n == logs.get("time") or n.lower() in TIME_COLUMNS]
    time = logs.get("time") if logs.get("time") in times else next(iter(times), None)
    if time is None:
        raise LogError(
            f"{file}:1: a row per joint, and no column of times; name it in logs.toml: time = …"
        )
    table = _table(file, names)
    of_row = np.array([str(name) for name in table.column(joint).to_pylist()], dtype=object)
    joints = tuple(dict.fromkeys(of_row.tolist()))
    order = [np.flatnonzero(of_row == name) for name in joints]
    stamps = _numbers(file, table, time)
    if len({len(rows) for rows in order}) > 1 or any(
        (stamps[rows] != stamps[order[0]]).any() for rows in order
    ):
        counts = ", ".join(f"{name} {len(rows)}" for name, rows in zip(joints, order, strict=True))
        raise LogError(
            f"{file}: joints have different times ({counts} rows); write every joint at every time"
        )
    used = {n for n in names if n in logs.values() or not table.column(n).null_count} - {
        joint,
        time,
    }
    numbers = [n for n in names if n in used and is_number(table.column(n).type)]
    arrays = {
        n: np.stack([_numbers(file, table, n)[rows] for rows in order], axis=1) for n in numbers
    }
    recording = RawRecording.of_arrays(
        file, {time: stamps[order[0]]} | arrays, joints, default={"time": time}
    )
    return replace(recording, where=f"{file}:1")


def _table(file: Path, names: list[str]) -> pa.Table:
    if file.suffix.lower() == ".parquet":
        return parquet.read(file, names)
    import pyarrow as pa
    import pyarrow.csv as pc

    body = read_limited(file, LogError, "cut the log into shorter ones", MAX_ARRAYS_BYTES)
    header = body.partition(b"\n")[0]
    delimiter = next((d for d in ",;\t" if d.encode() in header), " ")
    try:
        return pc.read_csv(
            pa.py_buffer(body),
            pc.ReadOptions(use_threads=False),
            pc.ParseOptions(delimiter=delimiter),
        ).rename_columns(names)
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
