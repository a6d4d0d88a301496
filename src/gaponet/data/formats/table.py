"""CSV, text or Parquet, a file or a folder of files: a column per signal.

Columns are called `time`, `ctrl.<joint>`, `qpos.<joint>` and, where the robot says more,
`qvel.<joint>`, `tau.<joint>`, `temperature.<joint>`; others are left alone. A logs.toml
(data.describe.logs_file) says other names, the units, and the names of the columns where the file
has none. A column with the number of the episode (formats.episodes) makes several recordings of a
file. Torques are N·m and temperatures °C. Units have no default: a wrong guess looks like a sim-to-
real gap. Only the Parquet file of a run of gaponet states its own. A table with a column `joint`
has a row per joint and time (formats.joint_rows).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.structure import MAX_ARRAYS_BYTES, read_limited
from gaponet.data.describe.clocks import with_whole_seconds
from gaponet.data.describe.dates import is_date, to_seconds
from gaponet.data.describe.logs_file import LogsFile
from gaponet.data.describe.raw_recording import (
    GIT_LFS_POINTER,
    RawRecording,
    Signal,
    require_content,
)
from gaponet.data.formats import files_under, joint_rows, parquet, text
from gaponet.data.formats.episodes import episodes
from gaponet.data.log import skipped_rows

if TYPE_CHECKING:
    import pyarrow as pa

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".parquet")
NOT_OURS = ("control.csv", "state_motor.csv", "event.csv", "joint_list.txt")  # of SAGE folders
# metadata of a table that is no data, and why (hw/control/recording.py)
NOT_OBEYED = "gaponet.not_obeyed"
# metadata of a table of gaponet itself: its times are in s and its positions in rad
SI_UNITS = "gaponet.si_units"
# Cells of the first row of a table that can be transposed; where no row is named, there are also so
# many times as many cells as rows.
MIN_TRANSPOSED_CELLS = 20
HEAD_BYTES = 1 << 20  # in which a clock of dates has a first cell
DECIMAL_SAMPLE_BYTES = 20_000  # of the first rows, by which decimal commas are told
DATES = re.compile(rb"\d\d?\.\d\d?\.\d{4}|:\d\d[.,]\d+")  # whose points and commas are no decimals
THOUSANDS = re.compile(r"[-+]?\d{1,3}([., ']\d{3})+([.,]\d*)?|[-+]?\d+,\d+")  # as 1,234.5
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
    """The file, or the tables directly in the folder; those below it if there are none."""
    if path.is_file():
        return files_under(path, SUFFIXES)
    below = [file for file in files_under(path, SUFFIXES) if file.name not in NOT_OURS]
    directly = [file for file in below if file.parent == path and _is_table(file)]
    if directly:
        return directly
    return [file for file in below if not _is_in_dataset(file, path) and _is_table(file)]


def _is_in_dataset(file: Path, root: Path) -> bool:
    """Return True if a file below a root lies in a dataset of gaponet."""
    folders = [folder for folder in file.parents if folder.is_relative_to(root)]
    return any(_is_dataset(folder) for folder in folders)


def _is_dataset(folder: Path) -> bool:
    return (folder / "dataset.json").is_file()


def recordings(path: Path, specified: LogsFile) -> Iterator[RawRecording]:
    """Every table, except the manifest."""
    files = [f for f in find(path) if f.name != specified.get("manifest")]
    if not files:
        raise LogError(
            f"{path}: no .csv, .txt or .parquet file in it; point at a table or a folder of tables"
        )
    stems = [file.stem for file in files]
    for file in files:
        name = file.stem
        if stems.count(name) > 1:  # day1/run.csv and day2/run.csv
            name = "-".join(file.relative_to(path).with_suffix("").parts)
        table = _opened(file, specified)
        ours = [column for column in table.names if column.split(".")[0] in DEFAULT]
        _refuse_twice(file, table.names, ours)
        joint = joint_rows.joint_column(table.names, specified)
        if joint:
            yield from episodes(joint_rows.recording(file, table.names, joint, specified))
            continue
        signals = dict.fromkeys(table.names, ()) | table.lists
        load = partial(_load_once, file, table.names, table.load)
        signals, load_joined = with_whole_seconds(signals, load)
        recording = RawRecording(
            name,
            str(file),
            signals,
            load_joined,
            where=f"{file}:1",
            files=(str(file),),
            first_line=table.first_line,
            meta=table.meta,
            default=table.default,
        )
        yield from episodes(recording)


class _Table(NamedTuple):
    """What the beginning of a file says, and what reads the rest."""

    names: list[str]  # of its columns
    load: Callable[[list[str]], dict[str, Signal]]
    lists: dict[str, tuple[str, ...]]  # column whose cells are lists → names of their numbers
    first_line: int  # where its rows begin
    meta: dict[str, Any]  # as in RawRecording
    default: LogsFile  # what the file states itself


def _opened(file: Path, specified: LogsFile) -> _Table:
    """Read the beginning of a file."""
    if file.suffix.lower() == ".parquet":
        names, default = _parquet_header(file)
        lists = {}
        for column, width in parquet.list_widths(file).items():
            lists[column] = tuple(str(i) for i in range(width))
        return _Table(names, partial(_read_parquet, file), lists, 1, {}, default)
    heading = _heading(file, specified.get("header"))
    meta: dict[str, Any] = {}
    if heading.units:
        units = dict(zip(heading.names, heading.units, strict=False))
        meta = {"notes": {"units": units}}
    load = partial(_read_csv, file, heading)
    return _Table(heading.names, load, {}, heading.first + 1, meta, LogsFile())


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
    beginning = text.beginning(file)
    if file.suffix.lower() not in (".txt", ".dat"):
        return not beginning.startswith("file,")
    if beginning.encode().startswith(GIT_LFS_POINTER):
        return True  # refused by name when it is read
    try:
        cells = text.heading(beginning).cells
    except csv.Error:
        return False
    return len(beginning.splitlines()) > 1 and bool(cells) and text.is_numeric(cells)


def _has_decimal_commas(body: bytes, delimiter: str) -> bool:
    """Return True if the numbers of a table have decimal commas, as spreadsheets of many countries
    write them.
    """
    if delimiter == ",":
        return False
    first_rows = DATES.sub(b"", body[:DECIMAL_SAMPLE_BYTES])
    return b"," in first_rows and not re.search(rb"\d\.\d", first_rows)


def _heading(file: Path, given: list[str] | None) -> text.Heading:
    """Where the header stands; `given` names the columns of a table without one."""
    require_content(file)
    try:
        found = text.heading(text.beginning(file))
    except csv.Error as error:
        raise LogError(
            f"{file}:1: not a header of a table ({error}); is it the right file?"
        ) from None
    first = found.names or found.cells
    if not any(first):
        raise LogError(f"{file}: empty; a table needs a header line and rows")
    _refuse_transposed(file, first)
    if found.names:
        return found
    if given is None:
        return found._replace(names=[str(i) for i in range(len(first))])
    if len(given) != len(first):
        raise LogError(
            f"{file}:{found.first + 1}: {len(first)} cells, header in logs.toml names "
            f"{len(given)}; name each"
        )
    return found._replace(names=given)


def _refuse_transposed(file: Path, first: list[str]) -> None:
    """Refuse a table with a row per signal, whose first row has these cells."""
    if len(first) < MIN_TRANSPOSED_CELLS or not text.is_numeric(first[1:]):
        return
    with file.open("rb") as lines:
        rows = sum(1 for _ in lines)
    named = not text.is_numeric(first[:1])  # the first cell of each row
    if not named and rows * MIN_TRANSPOSED_CELLS >= len(first):
        return
    read = f"pandas.read_csv('{file.name}', header=None, index_col={0 if named else None})"
    header = "" if named else ", header=False"
    write = f".T.to_csv('{file.name}', index=False{header})"
    raise LogError(
        f"{file}:1: the table is transposed: {rows} rows with a signal each, and {len(first)} "
        "columns with an instant each. A row must be an instant. Turn it: "
        f'python -c "import pandas; {read}{write}"'
    )


def _read_csv(file: Path, heading: text.Heading, wanted: list[str]) -> dict[str, Signal]:
    """Return columns by name, (k,) each; an empty cell is NaN, a short row or an unreadable cell
    too where rows are cut, else refused.
    """
    import pyarrow as pa
    import pyarrow.csv as pc

    body = read_limited(file, LogError, "cut the log into shorter ones", MAX_ARRAYS_BYTES)
    body = _rows(text.decoded(body), heading.first)
    if not body:
        raise LogError(f"{file}: holds a header and no rows; delete it or record again")
    delimiter = heading.delimiter
    if delimiter == " ":
        body = _with_commas(body)
        delimiter = ","
    dates = _date_columns(body, heading.names, wanted, delimiter)
    types = dict.fromkeys(wanted, pa.float64()) | dict.fromkeys(dates, pa.string())
    decimal_point = "," if _has_decimal_commas(body, delimiter) else "."
    try:
        table = pc.read_csv(
            pa.py_buffer(body),
            read_options=pc.ReadOptions(column_names=heading.names, use_threads=False),
            parse_options=pc.ParseOptions(ignore_empty_lines=False, delimiter=delimiter),
            convert_options=pc.ConvertOptions(
                include_columns=wanted,
                column_types=types,
                null_values=list(text.EMPTY),
                decimal_point=decimal_point,
            ),
        )
        return {name: _signal(file, table.column(name), name in dates) for name in wanted}
    except pa.ArrowInvalid as error:
        reason = str(error)
    lines = body.decode("utf-8", "replace")
    rows = _read_slowly(file, lines, heading._replace(delimiter=delimiter), wanted)
    if not rows:
        raise LogError(f"{file}: not a readable CSV file ({reason}); export it again")
    columns = np.array(rows, float).T  # (columns, k)
    return {name: Signal(column) for name, column in zip(wanted, columns, strict=True)}


def _with_commas(body: bytes) -> bytes:
    """Return rows whose cells are apart by white space with commas instead, and decimal points."""
    if _has_decimal_commas(body, " "):
        body = body.replace(b",", b".")
    without_margins = re.sub(rb"(?m)^[ \t]+|[ \t\r]+$", b"", body)
    return re.sub(rb"[ \t]+", b",", without_margins)


def _rows(body: bytes, first: int) -> bytes:
    """Return the text behind so many lines."""
    start = 0
    for _ in range(first):
        start = body.find(b"\n", start) + 1
        if not start:
            return b""
    return body[start:].rstrip(b"\r\n ")  # tabs may be empty cells


def _date_columns(body: bytes, names: list[str], wanted: list[str], delimiter: str) -> list[str]:
    """Return the wanted columns whose first cell that is not empty is a date and time."""
    dates = []
    undecided = set(wanted)
    for line in body[:HEAD_BYTES].split(b"\n"):
        cells = next(csv.reader([line.decode("utf-8", "replace")], delimiter=delimiter), [])
        if len(cells) != len(names):
            continue
        stated = {name for name in undecided if cells[names.index(name)].strip()}
        dates += [name for name in stated if is_date(cells[names.index(name)])]
        undecided -= stated
        if not undecided:
            break
    return [name for name in wanted if name in dates]


def _signal(file: Path, column: pa.ChunkedArray, dates: bool) -> Signal:
    if dates:
        return Signal(to_seconds(column.to_pylist(), str(file)), in_seconds=True)
    return Signal(column.to_numpy())


def _read_slowly(
    file: Path, body: str, heading: text.Heading, wanted: list[str]
) -> list[list[float]]:
    """Return the wanted cells of each row, read line by line.

    Raises for the first row with too few cells, or with a cell that is no number; where bad rows
    are cut, it is NaN.
    """
    names = heading.names
    places = {name: names.index(name) for name in wanted}
    bad = skipped_rows()
    numbers: list[list[float]] = []
    if _has_decimal_commas(body.encode(), heading.delimiter):
        body = body.replace(",", ".")
    rows = csv.reader(body.split("\n"), delimiter=heading.delimiter)
    while True:
        where = f"{file}:{rows.line_num + heading.first + 1}"
        try:
            row = next(rows)
            values = [_number(row, place, names, name) for name, place in places.items()]
        except StopIteration:
            return numbers
        except (csv.Error, ValueError) as error:
            if bad is None:
                raise LogError(f"{where}: {error}; repair or cut the row") from None
            values = [np.nan] * len(places)
        numbers.append(values)


def _number(row: list[str], place: int, names: list[str], name: str) -> float:
    """Return the number in a cell, NaN for an empty one; raise ValueError for what is none."""
    if len(row) != len(names):
        raise ValueError(
            f"{len(row)} cells, the header has {len(names)}; the file may be cut short"
        )
    if row[place].strip() in text.EMPTY:
        return np.nan
    try:
        return float(row[place])
    except ValueError:
        raise ValueError(_no_number(name, row[place].strip()[:60])) from None


def _no_number(name: str, cell: str) -> str:
    """Say why the cell of a column is no number."""
    if THOUSANDS.fullmatch(cell):
        return (
            f"column '{name}' is '{cell}': a number with separators between thousands; export "
            "the table without them"
        )
    if cell.startswith(("[", "(", "{")):
        return (
            f"column '{name}' holds lists ({cell}); write a column per joint, or Parquet with lists"
        )
    return f"column '{name}' is '{cell}', not a number"


def _parquet_header(file: Path) -> tuple[list[str], LogsFile]:
    """Return the names of the columns, and the units that the file states."""
    names, metadata = parquet.header(file)
    if reason := metadata.get(NOT_OBEYED):
        raise LogError(
            f"{file}: no data, the robot did not do what it was told ({reason[:300]}); leave it "
            "out, or --skip-bad does"
        )
    if SI_UNITS in metadata:
        return names, LogsFile(time_unit="s", position_unit="rad")
    return names, LogsFile()


def _read_parquet(file: Path, wanted: list[str]) -> dict[str, Signal]:
    """Return columns by name, (k,) each, or (k, width) of lists; an empty cell is NaN."""
    table = parquet.read(file, wanted)
    widths = parquet.list_widths(file)
    return {name: _cells(file, name, table.column(name), widths.get(name)) for name in wanted}


def _cells(file: Path, name: str, column: pa.ChunkedArray, width: int | None) -> Signal:
    """Return a column of a Parquet file.

    Args:
        width: Of the lists in its cells; None where they are none.
    """
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        at_ns = column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy()
        return Signal(1e-9 * at_ns, in_seconds=True)
    if pa.types.is_string(column.type) and is_date(_first_text(column)):
        return _signal(file, column, dates=True)
    if width is not None:
        return Signal(_matrix(file, name, column, width))
    if pa.types.is_struct(column.type):
        raise LogError(
            f"{file}: cells of '{name}' hold named values ({column.type}); make a column of each: "
            "pyarrow.Table.flatten() does"
        )
    if not joint_rows.is_number(column.type):
        raise LogError(
            f"{file}: column '{name}' is {column.type}, not numbers; export it as float64"
        )
    return Signal(column.to_numpy().astype(float))


def _first_text(column: pa.ChunkedArray) -> str:
    """Return the first cell of a column of text that is not empty; "" if all are."""
    for cell in column.drop_null():
        text = str(cell.as_py())
        if text.strip():
            return text
    return ""


def _matrix(file: Path, name: str, column: pa.ChunkedArray, width: int) -> Array:
    """Return a column of lists as (k, width), NaN for an empty cell; refuses lists of other
    lengths.
    """
    lists = column.combine_chunks()
    present = np.asarray(lists.is_valid())
    lists = lists.drop_null()
    if any(len(cell) != width for cell in lists):
        raise LogError(
            f"{file}: the lists in column '{name}' are not all {width} numbers long; repair or "
            "cut the rows"
        )
    values = np.full((len(present), width), np.nan)
    numbers = lists.flatten().to_numpy(zero_copy_only=False)
    values[present] = np.asarray(numbers, float).reshape(-1, width)
    return values
