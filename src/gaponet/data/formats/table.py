"""CSV, text or Parquet, a file or a folder of files: a column per signal.

Columns are called `time`, `ctrl.<joint>`, `qpos.<joint>` and, where the robot says more,
`qvel.<joint>`, `tau.<joint>`, `temperature.<joint>`; others are left alone. A logs.toml
(data.describe.logs_file) says other names, the units, and the names of the columns where the file
has none. A column with the number of the episode (formats.episodes) makes several recordings of a
file. Torques are N·m and temperatures °C. Units have no default: a wrong guess looks like a
sim-to-real gap. A table with a column `joint` has a row per joint and time (formats.joint_rows).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.structure import MAX_ARRAYS_BYTES, read_limited
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import RawRecording, Signal, require_content
from gaponet.data.formats import files_under, joint_rows, parquet
from gaponet.data.formats.dates import is_date, to_seconds
from gaponet.data.formats.episodes import episodes
from gaponet.data.log import skipped_rows

if TYPE_CHECKING:
    import pyarrow as pa

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".parquet")
NOT_OURS = ("control.csv", "state_motor.csv", "event.csv", "joint_list.txt")  # of SAGE folders
# metadata of a table that is no data, and why (hw/control/recording.py)
NOT_OBEYED = "gaponet.not_obeyed"
MIN_TRANSPOSED_CELLS = (
    20  # of the first row of a table that can be transposed; times the rows, where nothing is named
)
DECIMAL_SAMPLE_BYTES = 20_000  # of the first rows, by which decimal commas are told
EMPTY = ("", "nan", "NaN", "NA", "N/A", "null", "None")  # cells without a number
DEFAULT: LogsFile = {
    "time": "time",
    "ctrl": "ctrl.{joint}",
    "qpos": "qpos.{joint}",
    "qvel": "qvel.{joint}",
    "tau": "tau.{joint}",
    "temperature": "temperature.{joint}",
    "feedforward_torque": "feedforward_torque.{joint}",
}


def detects(path: Path) -> bool:
    """A table, or a folder with tables directly in it (text files only if asked for: a folder may
    have a readme).
    """
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return any(f.suffix.lower() in (".csv", ".tsv", ".parquet") for f in find(path))


def find(path: Path) -> list[Path]:
    """The file, or the tables directly in the folder."""
    if path.is_file():
        return files_under(path, SUFFIXES)
    tables = [
        f
        for f in path.iterdir()
        if f.is_file() and f.suffix.lower() in SUFFIXES and f.name not in NOT_OURS
    ]
    return sorted(f for f in tables if not f.name.startswith(".") and _is_table(f))


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every table, except the manifest."""
    files = [f for f in find(path) if f.name != specified.get("manifest")]
    if not files:
        raise LogError(
            f"{path}: no .csv, .txt or .parquet file in it; point at a table or a folder of tables"
        )
    for file in files:
        line = 1
        signals: dict[str, tuple[str, ...]] = {}
        if file.suffix.lower() == ".parquet":
            names = _parquet_header(file)
            load = partial(_read_parquet, file)
            lists = parquet.list_widths(file).items()
            signals = {name: tuple(map(str, range(width))) for name, width in lists}
        else:
            names, first = _csv_header(file, specified.get("header"))
            load = partial(_read_csv, file, names, first)
            line = first + 1
        _refuse_twice(file, names, [name for name in names if name.split(".")[0] in DEFAULT])
        load = partial(_load_once, file, names, load)
        if joint := joint_rows.joint_column(names, specified):
            yield joint_rows.recording(file, names, joint, specified)
            continue
        whole = RawRecording(
            file.stem,
            str(file),
            dict.fromkeys(names, ()) | signals,
            load,
            f"{file}:1",
            (str(file),),
            line,
        )
        yield from episodes(whole)


def _refuse_twice(file: Path, names: list[str], wanted: list[str]) -> None:
    """Refuse wanted columns whose name another column has too. Others may stand there twice."""
    for name in wanted:
        if names.count(name) > 1:
            raise LogError(f"{file}:1: column '{name}' stands twice; rename one")


def _load_once(
    file: Path, names: list[str], load: Callable[[list[str]], dict[str, Signal]], wanted: list[str]
) -> dict[str, Signal]:
    """Load columns that stand in the file once."""
    _refuse_twice(file, names, wanted)
    return load(wanted)


def _is_table(file: Path) -> bool:
    """A manifest is none, and a text file counts when its second line is made of numbers."""
    with file.open("rb") as stream:
        lines = stream.read(1 << 16).decode("utf-8", "replace").splitlines()
    if file.suffix.lower() not in (".txt", ".dat"):
        return not (lines and lines[0].lstrip("\ufeff").startswith("file,"))
    return len(lines) > 1 and _numeric(lines[1].split(_delimiter(lines[1]).strip() or None))


def _delimiter(line: str) -> str:
    """Return the separator of cells; a space for any white space.

    Cells between semicolons can hold a decimal comma each.
    """
    semicolons = line.count(";")
    if semicolons and semicolons >= line.count(",") - 1:
        return ";"
    return next((d for d in (",", ";", "\t") if d in line), " ")


def _has_decimal_commas(body: bytes, delimiter: str) -> bool:
    """Return True if the numbers of a table have decimal commas, as spreadsheets of many countries
    write them.
    """
    if delimiter == ",":
        return False
    first_rows = body[:DECIMAL_SAMPLE_BYTES]
    return b"," in first_rows and not re.search(rb"\d\.\d", first_rows)


def _numeric(cells: list[str]) -> bool:
    """Return True if all cells are numbers, with a decimal point or a decimal comma."""
    try:
        numbers = [cell for cell in cells if cell.strip() and not is_date(cell)]
        return bool([float(cell.replace(",", ".")) for cell in numbers])
    except ValueError:
        return False


def _csv_header(file: Path, given: list[str] | None) -> tuple[list[str], int]:
    """Names of the columns, and how many lines stand before the first row."""
    require_content(file)
    with file.open(encoding="utf-8-sig", errors="replace", newline="") as lines:
        try:
            line = lines.readline(1 << 20)
            header = next(csv.reader([line], delimiter=_delimiter(line), skipinitialspace=True), [])
        except csv.Error as error:
            raise LogError(
                f"{file}:1: not a header of a table ({error}); is it the right file?"
            ) from None
    header = line.split() if _delimiter(line) == " " else header
    if not any(header):
        raise LogError(f"{file}: empty; a table needs a header line and rows")
    _refuse_transposed(file, header)
    if not _numeric(header):
        return [name.strip() for name in header], 1
    if given is None:
        return [str(i) for i in range(len(header))], 0
    if len(given) != len(header):
        raise LogError(
            f"{file}:1: {len(header)} cells, header in logs.toml names {len(given)}; name each"
        )
    return given, 0


def _refuse_transposed(file: Path, first: list[str]) -> None:
    """Refuse a table with a row per signal, whose first row has these cells."""
    if len(first) < MIN_TRANSPOSED_CELLS or not _numeric(first[1:]):
        return
    named = not _numeric(first[:1])
    with file.open("rb") as lines:
        rows = sum(1 for _ in lines)
    if named or rows * MIN_TRANSPOSED_CELLS < len(first):
        raise LogError(
            f"{file}:1: the table is transposed: {rows} rows with a signal each, and {len(first)} "
            "columns with an "
            'instant each. A row must be an instant. Turn it: python -c "import pandas; '
            "pandas.read_csv("
            f"'{file.name}', header=None, "
            f"index_col={0 if named else None}).T.to_csv('{file.name}', index=False"
            f'{"" if named else ", header=False"})"'
        )


def _read_csv(file: Path, names: list[str], first: int, wanted: list[str]) -> dict[str, Signal]:
    """{column: (k,)}; an empty cell is NaN, a short row or an unreadable cell too where rows are
    cut, else refused.
    """
    import pyarrow as pa
    import pyarrow.csv as pc

    body = read_limited(file, LogError, "cut the log into shorter ones", MAX_ARRAYS_BYTES)
    line = _first_line(body)
    delimiter = _delimiter(line.decode("utf-8", "replace"))
    before = len(line) + 1 if first else 0
    body = body[before:].removeprefix(b"\xef\xbb\xbf").rstrip()
    if not body:
        raise LogError(f"{file}: holds a header and no rows; delete it or record again")
    if delimiter == " ":
        if _has_decimal_commas(body, delimiter):
            body = body.replace(b",", b".")
        without_margins = re.sub(rb"(?m)^[ \t]+|[ \t\r]+$", b"", body)
        body = re.sub(rb"[ \t]+", b",", without_margins)
        delimiter = ","
    dates = _date_columns(body, names, wanted, delimiter)
    try:
        table = pc.read_csv(
            pa.py_buffer(body),
            read_options=pc.ReadOptions(column_names=names, use_threads=False),
            parse_options=pc.ParseOptions(ignore_empty_lines=False, delimiter=delimiter),
            convert_options=pc.ConvertOptions(
                include_columns=wanted,
                column_types=dict.fromkeys(wanted, pa.float64())
                | dict.fromkeys(dates, pa.string()),
                null_values=list(EMPTY),
                decimal_point="," if _has_decimal_commas(body, delimiter) else ".",
            ),
        )
        return {name: _signal(file, table.column(name), name in dates) for name in wanted}
    except pa.ArrowInvalid as error:
        reason = str(error)
    rows = _read_slowly(file, body.decode("utf-8", "replace"), names, wanted, delimiter, first)
    if not rows:
        raise LogError(f"{file}: not a readable CSV file ({reason}); export it again")
    return {
        name: Signal(column) for name, column in zip(wanted, np.array(rows, float).T, strict=True)
    }


def _first_line(body: bytes) -> bytes:
    """Return the first line, without its end."""
    end = body.find(b"\n")
    return body if end < 0 else body[:end]


def _date_columns(body: bytes, names: list[str], wanted: list[str], delimiter: str) -> list[str]:
    """Return the wanted columns whose first cell is a date and time."""
    line = _first_line(body).decode("utf-8", "replace")
    cells = next(csv.reader([line], delimiter=delimiter), [])
    if len(cells) != len(names):
        return []
    return [name for name in wanted if is_date(cells[names.index(name)])]


def _signal(file: Path, column: pa.ChunkedArray, dates: bool) -> Signal:
    if dates:
        return Signal(to_seconds(column.to_pylist(), str(file)), in_seconds=True)
    return Signal(column.to_numpy())


def _read_slowly(
    file: Path, body: str, names: list[str], wanted: list[str], delimiter: str, first: int
) -> list[list[float]]:
    """Line by line: raises for the first with too few cells or a cell that is no number; NaN where
    rows are cut.
    """
    places = {name: names.index(name) for name in wanted}
    bad = skipped_rows()
    numbers: list[list[float]] = []
    if _has_decimal_commas(body.encode(), delimiter):
        body = body.replace(",", ".")
    rows = csv.reader(body.split("\n"), delimiter=delimiter)
    while True:
        where = f"{file}:{rows.line_num + first + 1}"
        try:
            row = next(rows)
            values = {name: _number(row, place, names, name) for name, place in places.items()}
        except StopIteration:
            return numbers
        except (csv.Error, ValueError) as error:
            if bad is None:
                raise LogError(f"{where}: {error}; repair or cut the row") from None
            values = dict.fromkeys(places, np.nan)
        numbers.append(list(values.values()))


def _number(row: list[str], place: int, names: list[str], name: str) -> float:
    if len(row) != len(names):
        raise ValueError(
            f"{len(row)} cells, the header has {len(names)}; the file may be cut short"
        )
    try:
        return np.nan if row[place].strip() in EMPTY else float(row[place])
    except ValueError:
        raise ValueError(f"column '{name}' is '{row[place][:60]}', not a number") from None


def _parquet_header(file: Path) -> list[str]:
    names, metadata = parquet.header(file)
    if reason := metadata.get(NOT_OBEYED):
        raise LogError(
            f"{file}: no data, the robot did not do what it was told ({reason[:300]}); leave it "
            "out, or --skip-bad does"
        )
    return names


def _read_parquet(file: Path, wanted: list[str]) -> dict[str, Signal]:
    """{column: (k,)}; an empty cell is NaN."""
    import pyarrow as pa

    table = parquet.read(file, wanted)
    widths = parquet.list_widths(file)
    data: dict[str, Signal] = {}
    for name in wanted:
        column = table.column(name)
        if pa.types.is_timestamp(column.type):
            at_ns = column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy()
            data[name] = Signal(1e-9 * (at_ns - at_ns[0]), in_seconds=True)
            continue
        if pa.types.is_string(column.type) and is_date(column[0].as_py() or ""):
            data[name] = _signal(file, column, dates=True)
            continue
        if name in widths:
            data[name] = Signal(_matrix(file, name, column, widths[name]))
            continue
        if not joint_rows.is_number(column.type):
            raise LogError(
                f"{file}: column '{name}' is {column.type}, not numbers; export it as float64"
            )
        data[name] = Signal(column.to_numpy().astype(float))
    return data


def _matrix(file: Path, name: str, column: pa.ChunkedArray, width: int) -> Array:
    """Return a column of lists as (k, width); refuses lists of other lengths."""
    lists = column.combine_chunks()
    if lists.null_count or any(len(cell) != width for cell in lists):
        raise LogError(
            f"{file}: the lists in column '{name}' are not all {width} numbers long; repair or "
            "cut the rows"
        )
    return np.asarray(lists.flatten().to_numpy(zero_copy_only=False), float).reshape(-1, width)
