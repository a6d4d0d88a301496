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
from typing import TYPE_CHECKING, Any

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
MIN_TRANSPOSED_CELLS = (
    20  # of the first row of a table that can be transposed; times the rows, where nothing is named
)
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
    folders = {folder for file in below for folder in file.parents}
    inside = [folder for folder in folders if folder.is_relative_to(path)]
    datasets = {folder for folder in inside if _is_dataset(folder)}
    return [file for file in below if not datasets & {*file.parents} and _is_table(file)]


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
        line = 1
        meta: dict[str, Any] = {}
        signals: dict[str, tuple[str, ...]] = {}
        if file.suffix.lower() == ".parquet":
            names = _parquet_header(file)
            load = partial(_read_parquet, file)
            lists = parquet.list_widths(file).items()
            signals = {column: tuple(map(str, range(width))) for column, width in lists}
        else:
            found = _heading(file, specified.get("header"))
            names = found.names
            load = partial(_read_csv, file, found)
            line = found.first + 1
            if found.units:
                meta = {"notes": {"units": dict(zip(names, found.units, strict=False))}}
        _refuse_twice(file, names, [name for name in names if name.split(".")[0] in DEFAULT])
        load = partial(_load_once, file, names, load)
        if joint := joint_rows.joint_column(names, specified):
            yield joint_rows.recording(file, names, joint, specified)
            continue
        signals = dict.fromkeys(names, ()) | signals
        signals, load_joined = with_whole_seconds(signals, load)
        whole = RawRecording(
            name,
            str(file),
            signals,
            load_joined,
            f"{file}:1",
            (str(file),),
            line,
            meta,
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
    named = not text.is_numeric(first[:1])
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


def _read_csv(file: Path, found: text.Heading, wanted: list[str]) -> dict[str, Signal]:
    """{column: (k,)}; an empty cell is NaN, a short row or an unreadable cell too where rows are
    cut, else refused.
    """
    import pyarrow as pa
    import pyarrow.csv as pc

    body = read_limited(file, LogError, "cut the log into shorter ones", MAX_ARRAYS_BYTES)
    names = found.names
    delimiter = found.delimiter
    body = _rows(text.decoded(body), found.first)
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
                null_values=list(text.EMPTY),
                decimal_point="," if _has_decimal_commas(body, delimiter) else ".",
            ),
        )
        return {name: _signal(file, table.column(name), name in dates) for name in wanted}
    except pa.ArrowInvalid as error:
        reason = str(error)
    rows = _read_slowly(
        file, body.decode("utf-8", "replace"), names, wanted, delimiter, found.first
    )
    if not rows:
        raise LogError(f"{file}: not a readable CSV file ({reason}); export it again")
    return {
        name: Signal(column) for name, column in zip(wanted, np.array(rows, float).T, strict=True)
    }


def _rows(body: bytes, first: int) -> bytes:
    """Return the text behind so many lines."""
    start = 0
    for _ in range(first):
        start = body.find(b"\n", start) + 1
        if not start:
            return b""
    return body[start:].rstrip()


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
        return np.nan if row[place].strip() in text.EMPTY else float(row[place])
    except ValueError:
        cell = row[place].strip()[:60]
        if THOUSANDS.fullmatch(cell):
            raise ValueError(
                f"column '{name}' is '{cell}': a number with separators between thousands; export "
                "the table without them"
            ) from None
        if cell.startswith(("[", "(", "{")):
            raise ValueError(
                f"column '{name}' holds lists ({cell}); write a column per joint, or Parquet "
                "with lists"
            ) from None
        raise ValueError(f"column '{name}' is '{cell}', not a number") from None


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
        if pa.types.is_struct(column.type):
            raise LogError(
                f"{file}: cells of '{name}' hold named values ({column.type}); make a column of "
                "each: pyarrow.Table.flatten() does"
            )
        if not joint_rows.is_number(column.type):
            raise LogError(
                f"{file}: column '{name}' is {column.type}, not numbers; export it as float64"
            )
        data[name] = Signal(column.to_numpy().astype(float))
    return data


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
