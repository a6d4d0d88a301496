"""Text of tables as programs write it: its encoding, its line ends, and where its header stands."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gaponet.data.describe.dates import is_date

HEAD_BYTES = 1 << 20  # in which header and first rows stand
COMMENT = re.compile(r"\s*(#|%|//)+\s*")
MAX_PREAMBLE_LINES = 100  # before the header
FAR = 10.0  # between a row and the next, of an encoder's steps
MIN_ALIKE_LINES = 5  # with as many cells as the header, from which a text before it is told
EMPTY = ("", "nan", "NaN", "NA", "N/A", "null", "None")  # cells without a number
UTF16 = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}


class Heading(NamedTuple):
    """Where the header of a table stands.

    Attributes:
        names: Of the columns; empty if nothing names them.
        first: Lines before the first row.
        cells: Of the first row.
        delimiter: Of the cells, as the header shows it; as the first row does, if the header is a
            comment or is missing.
        units: The cells of a second line of the header, which holds units; empty if there is none.
    """

    names: list[str]
    first: int
    cells: list[str]
    delimiter: str
    units: list[str]


def decoded(body: bytes) -> bytes:
    r"""Return the text of a file in UTF-8, without a mark of its encoding, and with \n at ends of
    lines.
    """
    encoding = UTF16.get(body[:2])
    if encoding:
        body = str(memoryview(body)[2:], encoding, "replace").encode()  # no copy of the bytes
    body = body.removeprefix(codecs.BOM_UTF8)
    if b"\n" not in body:
        body = body.replace(b"\r", b"\n")
    return body


def beginning(file: Path) -> str:
    """Return the first lines of a file."""
    with file.open("rb") as stream:
        body = decoded(stream.read(HEAD_BYTES))
    lines = body.decode("utf-8", "replace").split("\n")
    return "\n".join(lines[: MAX_PREAMBLE_LINES * 2])


def delimiter_of(line: str) -> str:
    """Return the separator of cells; a space for any white space.

    Cells between semicolons can hold a decimal comma each.
    """
    semicolons = line.count(";")
    if semicolons and semicolons >= line.count(",") - 1:
        return ";"
    if "," in line:
        if _are_decimal_commas(line.split("\t")):
            return "\t"
        if _are_decimal_commas(line.split()):
            return " "
    for delimiter in (",", ";", "\t"):
        if delimiter in line:
            return delimiter
    return " "


def _are_decimal_commas(cells: list[str]) -> bool:
    """Return True if cells are numbers, none of which ends with a comma."""
    if len(cells) < 2 or any(cell.strip().endswith(",") for cell in cells):
        return False
    return is_numeric(cells)


def cells_of(line: str) -> list[str]:
    """Return the cells of a line, by the separator that it shows.

    Raises:
        csv.Error: It is no line of a table.
    """
    line = line.rstrip("\r\n")
    delimiter = delimiter_of(line)
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return line.split() if delimiter == " " else cells


def is_numeric(cells: Sequence[str]) -> bool:
    """Return True if all cells are numbers, with a decimal point or a decimal comma, or dates."""
    numbers = [cell for cell in cells if cell.strip() and not is_date(cell)]
    try:
        for cell in numbers:
            float(cell.replace(",", "."))
    except ValueError:
        return False
    return bool(numbers)


def heading(text: str) -> Heading:
    """Return where the header of a table stands, by the beginning of its text.

    Comments and other lines before it are left out. Without a header, the first row of numbers
    counts.

    Raises:
        csv.Error: It is no table.
    """
    lines = text.split("\n")
    start = _after_comments(lines)
    in_comment = start > 0 and _names_row_after(lines, start)
    if in_comment:
        start -= 1
        header = COMMENT.sub("", lines[start], count=1)
        delimiter = delimiter_of(lines[start + 1])
    else:
        start = _after_preamble(lines, start)
        header = lines[start] if start < len(lines) else ""
        delimiter = delimiter_of(header)
    names = cells_of(header)
    if is_numeric(names):
        below = _row(lines, start + 1)
        if _are_numbers_of_columns(names, below):
            return Heading([], start + 1, below, delimiter, [])
        return Heading([], start, names, delimiter, [])
    units = _units_below(lines, start, len(names))
    first = start + (2 if units else 1)
    row = _row(lines, first)
    if len(row) == len(names) + 1 and not row[-1]:
        names = [*names, ""]  # each row ends with a separator
    names = [name.strip() for name in names]
    return Heading(names, first, row, delimiter, units)


def _are_numbers_of_columns(names: list[str], below: list[str]) -> bool:
    """Return True for 0, 1, 2, … above other numbers, as pandas writes an array; with its numbers
    of rows, the first cell is empty.
    """
    stripped = [name.strip() for name in names]
    counted = [str(number) for number in range(len(names))]
    if len(names) > 1 and stripped == ["", *counted[:-1]]:
        return True
    if len(names) < 2 or stripped != counted:
        return False
    return any("." in cell or "," in cell or _is_far(cell, i) for i, cell in enumerate(below))


def _is_far(cell: str, number: int) -> bool:
    """Return True for a number that does not follow another in the next row."""
    try:
        return abs(float(cell) - number) > FAR
    except ValueError:
        return False


def _units_below(lines: list[str], header: int, columns: int) -> list[str]:
    """Return the cells of the row of units between header and numbers; none if there is none."""
    row = _row(lines, header + 1)
    below = _row(lines, header + 2)
    if len(row) == columns and _holds_no_number(row) and is_numeric(below):
        return row
    return []


def _after_comments(lines: list[str]) -> int:
    """Return the first line that is no comment."""
    for i, line in enumerate(lines):
        if line.strip() and not COMMENT.match(line):
            return i
    return 0


def _names_row_after(lines: list[str], start: int) -> bool:
    """Return True if the comment before the first row names its columns, as numpy.savetxt and
    rostopic echo -p write it. A row begins with a number, or holds numbers and dates alone.
    """
    row = cells_of(lines[start])
    names = cells_of(COMMENT.sub("", lines[start - 1], count=1))
    if len(row) < 2 or len(names) != len(row) or is_numeric(names):
        return False
    return is_numeric(row) or is_numeric(row[:1])


def _after_preamble(lines: list[str], start: int) -> int:
    """Return the line of the header: of text before it, lines have other numbers of cells than the
    rows have.
    """
    counts = [_count(line) for line in lines[start:] if line.strip()]
    if len(counts) <= MIN_ALIKE_LINES:
        return start
    ((usual, alike),) = Counter(counts).most_common(1)
    if alike < MIN_ALIKE_LINES or usual < 2:
        return start
    if counts[0] in (usual, usual - 1):  # a row may end with a separator
        return start
    for i in range(start, min(len(lines), start + MAX_PREAMBLE_LINES)):
        after = [_count(line) for line in lines[i : i + MIN_ALIKE_LINES]]
        if after == [usual] * MIN_ALIKE_LINES:
            return i
    return start


def _row(lines: list[str], at: int) -> list[str]:
    """Return the cells of a line; none if there is no such line, or it is none of a table."""
    if at >= len(lines) or not _count(lines[at]):
        return []
    return cells_of(lines[at])


def _count(line: str) -> int:
    try:
        return len(cells_of(line))
    except csv.Error:  # told with its number when the rows are read
        return 0


def _holds_no_number(cells: list[str]) -> bool:
    words = [cell for cell in cells if cell.strip() not in EMPTY]
    return bool(words) and not any(is_numeric([cell]) for cell in words)
