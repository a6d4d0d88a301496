"""Tables: CSV or Parquet with named columns, one motion per file.

Columns are called `time`, `ctrl.<joint>`, `qpos.<joint>` and, where the robot says more, `qvel.<joint>`, `tau.<joint>`,
`temperature.<joint>`; others are left alone. A TOML file maps other names, and says the units:

    time_unit = "ms"                       # s, ms, us, ns
    position_unit = "deg"                  # rad, deg, fraction (0..1 of the joint's range); qvel is that per second
    time = "t"                             # short for [columns] time = "t"
    [columns]
    "ctrl.shoulder_pan" = "cmd_1"          # ours = the file's
    [joint_units]
    gripper = "fraction"                   # where one joint differs

Torques are N·m and temperatures °C. Units have no default: a wrong guess looks like a sim-to-real gap.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from typing_extensions import TypedDict

from gaponet.arrays import Array
from gaponet.data.formats import TABLES, refuse_absurd, to_radians
from gaponet.data.log import CHANNELS, REQUIRED, Channel, Log
from gaponet.errors import LogError, UsageError
from gaponet.robot import LOG_UNITS, RobotSpec
from gaponet.structure import read_toml

OPTIONS = ("columns", "position_unit", "time_unit")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SAY_UNITS = "--position-unit rad --time-unit s (or position_unit and time_unit in the file given with --columns)"


@dataclass(frozen=True)
class ColumnMap:
    """How to read a table: its name for each of our columns, and its units."""

    time_unit: str
    position_unit: str
    columns: dict[str, str] = field(default_factory=dict)
    joint_units: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for what, unit, known in (
            ("time unit", self.time_unit, tuple(SECONDS)),
            ("position unit", self.position_unit, LOG_UNITS),
            *((f"unit of {joint}", unit, LOG_UNITS) for joint, unit in self.joint_units.items()),
        ):
            if unit not in known:
                given = f"'{unit}' is not one of {', '.join(known)}" if unit else "is not given"
                raise UsageError(f"the table's {what} {given}; say it with {SAY_UNITS}")


class ColumnFile(TypedDict, total=False):
    """The TOML file of a column map."""

    time: str
    time_unit: str
    position_unit: str
    columns: dict[str, str]
    joint_units: dict[str, str]


def find(path: Path) -> list[Path]:
    """The file, or the tables directly in the folder."""
    if path.is_file():
        return [path]
    tables = (f for f in path.iterdir() if f.is_file() and f.suffix.lower() in TABLES)
    return sorted(f for f in tables if not f.name.startswith("."))


def read(
    path: Path,
    robot: RobotSpec,
    joint_map: dict[str, str] | None = None,
    columns: str | Path | None = None,
    position_unit: str | None = None,
    time_unit: str | None = None,
) -> Iterator[tuple[str, Log]]:
    """Yield (file stem, Log) for every table.

    Args:
        joint_map: The table's name of a joint → the robot's.
        position_unit, time_unit: Win over what the TOML file says.
    """
    mapping = _column_map(robot, columns, position_unit, time_unit)
    files = find(path)
    if not files:
        raise LogError(f"{path}: no .csv or .parquet file in it; point at a table or a folder of tables")
    for file in files:
        yield file.stem, refuse_absurd(_read_table(file, robot, joint_map, mapping), robot)


def _column_map(
    robot: RobotSpec, toml: str | Path | None, position_unit: str | None, time_unit: str | None
) -> ColumnMap:
    where = f"--columns {toml}"
    hint = "use time, time_unit, position_unit, [columns], [joint_units]"
    table = read_toml(ColumnFile, Path(toml), UsageError, hint) if toml is not None else ColumnFile()
    names = table.get("columns", {}) | ({"time": table["time"]} if "time" in table else {})
    for ours in names:
        if ours != "time" and ours.partition(".")[0] not in CHANNELS:
            raise UsageError(f"{where}: '{ours}' is neither time nor {'.<joint>, '.join(CHANNELS)}.<joint>")
    return ColumnMap(
        time_unit or table.get("time_unit", ""),
        position_unit or table.get("position_unit", ""),
        names,
        {robot.resolve(joint, where): unit for joint, unit in table.get("joint_units", {}).items()},
    )


def _read_table(file: Path, robot: RobotSpec, joint_map: dict[str, str] | None, mapping: ColumnMap) -> Log:
    header = _parquet_header(file) if _is_parquet(file) else _csv_header(file)
    theirs = _choose(file, header, robot, joint_map, mapping)  # {channel: {joint: column}}, "time" beside
    wanted = [theirs["time"][""], *(c for name in CHANNELS for c in theirs.get(name, {}).values())]
    data = (_read_parquet if _is_parquet(file) else _read_csv)(file, wanted)
    joints = tuple(name for name in robot.joint_names if name in theirs["ctrl"])
    units = [mapping.joint_units.get(j, mapping.position_unit) for j in joints]
    time = data[theirs["time"][""]] * SECONDS[mapping.time_unit]
    time = time - time[0] if len(time) else time  # epoch nanoseconds would lose their digits
    channels = {}
    for name in CHANNELS:
        if name in theirs:
            values = np.stack([data[theirs[name][j]] for j in joints], axis=1)
            channels[name] = Channel(time, to_radians(name, values, joints, units, robot))
    return Log(robot.name, joints, channels, str(file), {
        "files": dict.fromkeys(channels, str(file)),
        "first_line": 1 if _is_parquet(file) else 2,
        "converted_from": {j: u for j, u in zip(joints, units, strict=True) if u != "rad"},
    })  # fmt: skip


def _choose(
    file: Path, header: list[str], robot: RobotSpec, joint_map: dict[str, str] | None, mapping: ColumnMap
) -> dict[str, dict[str, str]]:
    """Which column of the file holds what: {"time": {"": column}, channel: {joint: column}}."""
    shown = ", ".join(header[:12]) + (", …" if len(header) > 12 else "")
    for name in header:
        if header.count(name) > 1:
            raise LogError(f"{file}:1: column '{name}' stands twice; rename one")
    for ours, column in mapping.columns.items():
        if column not in header:
            raise LogError(f"{file}:1: column '{column}' (for {ours}) is missing; the header has: {shown}")
    ours_of = {column: ours for ours, column in mapping.columns.items()}
    theirs: dict[str, dict[str, str]] = {}
    for column in header:
        kind, _, joint = ours_of.get(column, column).partition(".")
        if kind == "time" and not joint:
            theirs["time"] = {"": column}
        elif kind in CHANNELS and joint:
            name = robot.resolve(joint, f"{file}:1", joint_map)
            if name in theirs.setdefault(kind, {}):
                raise LogError(
                    f"{file}:1: columns '{theirs[kind][name]}' and '{column}' both mean {kind}.{name}; drop one"
                )
            theirs[kind][name] = column
    _require_complete(file, theirs, shown)
    return theirs


def _require_complete(file: Path, theirs: dict[str, dict[str, str]], shown: str) -> None:
    for need in ("time", *REQUIRED):
        if need not in theirs:
            column = need if need == "time" else f"{need}.<joint>"
            raise LogError(
                f"{file}:1: column '{column}' is missing; the header has: {shown}. Name it in a --columns file"
            )
    for kind in theirs.keys() - {"time"}:
        odd = sorted(theirs["ctrl"].keys() ^ theirs[kind].keys())
        if odd:
            other = kind if odd[0] in theirs["ctrl"] else "ctrl"
            raise LogError(f"{file}:1: column '{other}.{odd[0]}' is missing: every channel needs the same joints")


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() == ".parquet"


def _csv_header(file: Path) -> list[str]:
    with file.open(encoding="utf-8-sig", errors="replace", newline="") as lines:
        try:
            header = next(csv.reader(lines), [])
        except csv.Error as error:
            raise LogError(f"{file}:1: not a header of a table ({error}); is it the right file?") from None
    if not any(header):
        raise LogError(f"{file}: empty; a table needs a header line and rows")
    return [name.strip() for name in header]


def _read_csv(file: Path, wanted: list[str]) -> dict[str, Array]:
    """{column: (k,)}; a short, empty or unreadable cell is refused with its line."""
    import pyarrow as pa
    import pyarrow.csv as pc

    header = _csv_header(file)
    body = file.read_bytes().partition(b"\n")[2].rstrip()
    if not body:
        raise LogError(f"{file}: holds a header and no rows; delete it or record again")
    try:
        table = pc.read_csv(
            pa.py_buffer(body),
            read_options=pc.ReadOptions(column_names=header, use_threads=False),
            parse_options=pc.ParseOptions(ignore_empty_lines=False),
            convert_options=pc.ConvertOptions(
                include_columns=wanted, column_types=dict.fromkeys(wanted, pa.float64()), null_values=[""]
            ),
        )
    except pa.ArrowInvalid as error:
        _refuse_line(file, header, wanted)
        raise LogError(f"{file}: not a readable CSV file ({error}); export it again") from None
    if any(table.column(name).null_count for name in wanted):
        _refuse_line(file, header, wanted)
    return {name: table.column(name).to_numpy() for name in wanted}


def _refuse_line(file: Path, header: list[str], wanted: list[str]) -> None:
    """Raise for the first line with too few cells or a cell that is no number."""
    places = {name: header.index(name) for name in wanted}
    with file.open(encoding="utf-8-sig", errors="replace", newline="") as lines:
        rows = csv.reader(lines)
        while True:
            try:
                row = next(rows)
            except StopIteration:
                return
            except csv.Error as error:
                raise LogError(f"{file}:{rows.line_num}: {error}; repair or cut the row") from None
            where = f"{file}:{rows.line_num}"
            if rows.line_num == 1:
                continue
            if len(row) != len(header):
                raise LogError(
                    f"{where}: {len(row)} cells, the header has {len(header)}; the file may be cut short: remove the "
                    "line or export it again"
                )
            for name, place in places.items():
                try:
                    float(row[place])
                except ValueError:
                    raise LogError(
                        f"{where}: column '{name}' is '{row[place]}', not a number; repair or cut the row"
                    ) from None


def _parquet_header(file: Path) -> list[str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(file).names
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(_unreadable(file, error)) from None


def _read_parquet(file: Path, wanted: list[str]) -> dict[str, Array]:
    """{column: (k,)}; an empty cell is refused with its row, counted from 1."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.ParquetFile(file).read(columns=wanted)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise LogError(_unreadable(file, error)) from None
    data = {}
    for name in wanted:
        column = table.column(name)
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            raise LogError(f"{file}: column '{name}' is {column.type}, not numbers; export it as float64")
        if column.null_count:
            row = int(column.is_null().to_numpy().argmax()) + 1
            raise LogError(f"{file}:{row}: column '{name}' is empty; repair or cut the row")
        data[name] = column.to_numpy().astype(float)
    return data


def _unreadable(file: Path, error: Exception) -> str:
    reason = str(error).split("\n")[0].rstrip(".")
    return f"{file}: not a readable Parquet file ({reason}); it may be half-written: export it again"
