"""Means of repeated measurements, and tables of results as plain text, Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gaponet.base.text import escape_markdown


@dataclass(frozen=True)
class MeanStd:
    """Mean and standard deviation of repeated measurements."""

    mean: float
    std: float  # standard deviation of the sample (n − 1); NaN for a single value
    count: int  # number of values

    @classmethod
    def from_values(cls, values: Iterable[float], scale: float = 1.0) -> MeanStd:
        """Summarise the finite values, times `scale` (1e3 turns rad into mrad).

        Without any, the mean is NaN.
        """
        finite = np.array([v for v in values if math.isfinite(v)]) * scale
        mean = float(finite.mean()) if len(finite) else math.nan
        std = float(finite.std(ddof=1)) if len(finite) > 1 else math.nan
        return cls(mean, std, len(finite))

    @property
    def standard_error(self) -> float:
        """Standard error of the mean; NaN for a single value."""
        return self.std / math.sqrt(self.count) if self.count else math.nan


@dataclass(frozen=True)
class ResultTable:
    """Table of results; the first column names the row."""

    name: str
    columns: tuple[str, ...]  # headings with their units, such as "MPJAE, mrad"
    rows: tuple[tuple[Any, ...], ...]  # cells: text, numbers, MeanStd, or None for a blank
    caption: str = ""
    digits: int = 2  # digits behind the decimal point in text; CSV and JSON have full precision

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table '{self.name}': {len(row)} cells under {len(self.columns)} columns: "
                    f"{row}"
                )

    def texts(self) -> list[list[str]]:
        """Return the rows as formatted cells."""
        return [[format_cell(cell, self.digits) for cell in row] for row in self.rows]

    def record(self) -> dict[str, Any]:
        """Return the table as JSON values; a MeanStd becomes an object."""
        rows = []
        for row in self.rows:
            rows.append([asdict(cell) if isinstance(cell, MeanStd) else cell for cell in row])
        return {
            "name": self.name,
            "caption": self.caption,
            "columns": list(self.columns),
            "rows": rows,
            "texts": self.texts(),
        }

    def markdown(self) -> str:
        """Return the table in Markdown, with the caption below."""
        texts = self.texts()
        rules = ["---"]
        for column in range(1, len(self.columns)):
            has_words = any(row[column][:1].isalpha() for row in texts)
            rules.append("---" if has_words else "---:")  # numbers are aligned on the right
        lines = [_markdown_line(self.columns), f"| {' | '.join(rules)} |"]
        lines += [_markdown_line(row) for row in texts]
        if self.caption:
            lines += ["", escape_markdown(self.caption)]
        return "\n".join(lines)

    def csv(self) -> str:
        """Return the table as CSV at full precision.

        A column with MeanStd is followed by its std and count.
        """
        has_std = [self._has_std(i) for i in range(len(self.columns))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        header = []
        for name, with_std in zip(self.columns, has_std, strict=True):
            header.append(name)
            if with_std:
                header += [f"{name}: std", f"{name}: n"]
        writer.writerow(header)
        for row in self.rows:
            line: list[Any] = []
            for cell, with_std in zip(row, has_std, strict=True):
                line += _csv_values(cell, with_std)
            writer.writerow(line)
        return out.getvalue()

    def _has_std(self, column: int) -> bool:
        """Return True if a column has at least one cell with a standard deviation."""
        return any(isinstance(row[column], MeanStd) for row in self.rows)


def _markdown_line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(map(escape_markdown, cells))} |"


def _csv_values(cell: Any, with_std: bool) -> list[Any]:
    """Return the values of a cell: its number or text, and its standard deviation and count where
    the column has them; "" where there is none.
    """
    values = [cell]
    if isinstance(cell, MeanStd):
        values = [cell.mean, cell.std, cell.count]
    elif with_std:
        values = [cell, None, None]
    return [_csv_value(value) for value in values]


def _csv_value(value: Any) -> Any:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return value


def format_cell(cell: Any, digits: int = 2) -> str:
    """Format a cell of a table: 12.28 ± 0.08 (mean ± standard deviation), 1,234, yes, or blank.

    None, NaN and infinity are blank. Whole numbers have no decimals, whatever `digits` says.
    """
    if isinstance(cell, MeanStd):
        mean = format_cell(cell.mean, digits)
        std = format_cell(cell.std, digits)
        return f"{mean} ± {std}" if mean and std else mean
    if cell is None or isinstance(cell, str):
        return cell or ""
    if isinstance(cell, (bool, np.bool_)):
        return "yes" if cell else "no"
    if isinstance(cell, (int, np.integer)):
        return f"{cell:,}"
    return f"{cell:z.{digits}f}" if math.isfinite(cell) else ""
