"""Numbers measured several times, and tables of them: for people, for Markdown, for CSV, for JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gaponet.base.text import markdown


@dataclass(frozen=True)
class Spread:
    """One number measured several times."""

    mean: float
    std: float
    """Standard deviation of the sample (n − 1); NaN for a single value."""
    count: int

    @classmethod
    def of(cls, values: Iterable[float], scale: float = 1.0) -> Spread:
        """The spread over seeds, units or motions; scale 1e3 makes mrad of rad. No values at all give a blank cell."""
        found = np.array([v for v in values if math.isfinite(v)]) * scale
        std = float(found.std(ddof=1)) if len(found) > 1 else math.nan
        return cls(float(found.mean()) if len(found) else math.nan, std, len(found))

    def over(self, value: float) -> Spread:
        """The same in units of a number that is known exactly."""
        return Spread(self.mean / value, self.std / value, self.count)

    @property
    def error(self) -> float:
        """Standard error of the mean; NaN for a single value."""
        return self.std / math.sqrt(self.count) if self.count else math.nan


@dataclass(frozen=True)
class Table:
    """Rows under columns. The first column names the row."""

    name: str
    columns: tuple[str, ...]
    """Heading with its unit: "MPJAE, mrad"."""
    rows: tuple[tuple[Any, ...], ...]
    """Text, whole numbers, numbers, Spread; None is blank."""
    caption: str = ""
    digits: int = 2
    """Behind the point, where people read it; files hold what was measured."""
    shown: bool = True
    """Whether people read it; else it is in its CSV alone."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.name}': {len(row)} cells under {len(self.columns)} columns: {row}")

    def texts(self) -> list[list[str]]:
        """Rows as people read them."""
        return [[text(cell, self.digits) for cell in row] for row in self.rows]

    def record(self) -> dict[str, Any]:
        """The table as JSON: a spread is an object."""
        rows = [[asdict(c) if isinstance(c, Spread) else c for c in row] for row in self.rows]
        return {"name": self.name, "caption": self.caption, "columns": list(self.columns), "rows": rows,
                "texts": self.texts()}  # fmt: skip

    def markdown(self) -> str:
        """The table as people read it, its caption below."""
        ruler = ["---", *["---:"] * (len(self.columns) - 1)]
        lines = [map(markdown, self.columns), ruler, *(map(markdown, row) for row in self.texts())]
        found = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"{found}\n\n{markdown(self.caption)}" if self.caption else found

    def csv(self) -> str:
        """All that was measured, at full precision; a column with spreads is followed by its std and count."""
        spread = [any(isinstance(row[i], Spread) for row in self.rows) for i in range(len(self.columns))]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        head: list[str] = []
        for column, wide in zip(self.columns, spread, strict=True):
            head += [column, f"{column}: std", f"{column}: n"] if wide else [column]
        writer.writerow(head)
        for row in self.rows:
            line: list[Any] = []
            for cell, wide in zip(row, spread, strict=True):
                parts = [cell.mean, cell.std, cell.count] if isinstance(cell, Spread) else [cell, None, None]
                line += parts if wide else parts[:1]
            writer.writerow(["" if v is None or (isinstance(v, float) and not math.isfinite(v)) else v for v in line])
        return out.getvalue()


def text(cell: Any, digits: int = 2) -> str:
    """A cell as people read it: 12.28 ± 0.08, 1,234, blank."""
    if isinstance(cell, Spread):
        mean, std = text(cell.mean, digits), text(cell.std, digits)
        return f"{mean} ± {std}" if mean and std else mean
    if cell is None or isinstance(cell, str):
        return cell or ""
    if isinstance(cell, (bool, np.bool_)):
        return "yes" if cell else "no"
    if isinstance(cell, (int, np.integer)):
        return f"{cell:,}"
    return f"{cell:.{digits}f}" if math.isfinite(cell) else ""
