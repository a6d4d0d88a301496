"""What an experiment found: tables, figures and sentences, written to a folder in every form that someone may want.

    NAME.md            for people            NAME.json   everything, exact
    NAME[-TABLE].csv   one per table         NAME[-FIGURE].svg, .png
    report.html        one offline page over all experiments of the folder (experiment.report)

The first table and the first figure are NAME.csv and NAME.svg, the others carry their own names.
"""

from __future__ import annotations

import csv
import io
import math
import shlex
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.data.json_file import write_json
from gaponet.data.store import Dataset, dataset_hash, write_text
from gaponet.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "gaponet experiment 1"
VERSIONS = ("gaponet", "mujoco", "numpy", "torch")


@dataclass(frozen=True)
class Spread:
    """One number measured several times."""

    mean: float
    std: float
    """Of the sample (n − 1); NaN for a single value."""
    count: int

    @classmethod
    def of(cls, values: Iterable[float], scale: float = 1.0) -> Spread:
        """Of seeds, units or motions; scale 1e3 makes mrad of rad. No values at all give a blank cell."""
        found = np.array([v for v in values if math.isfinite(v)]) * scale
        std = float(found.std(ddof=1)) if len(found) > 1 else math.nan
        return cls(float(found.mean()) if len(found) else math.nan, std, len(found))

    @property
    def error(self) -> float:
        """Standard error of the mean; NaN for a single value."""
        return self.std / math.sqrt(self.count) if self.count else math.nan


Cell = str | int | float | Spread | None


@dataclass(frozen=True)
class Table:
    """Rows under columns. The first column names the row."""

    name: str
    columns: tuple[str, ...]
    """With units: "MPJAE, mrad"."""
    rows: tuple[tuple[Cell, ...], ...]
    """Text, whole numbers, numbers, Spread; None is blank."""
    caption: str = ""
    digits: int = 2
    """Behind the point, where people read it; files hold what was measured."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.name}': {len(row)} cells under {len(self.columns)} columns: {row}")

    def texts(self) -> list[list[str]]:
        """Rows as people read them."""
        return [[text(cell, self.digits) for cell in row] for row in self.rows]

    def records(self) -> list[list[Any]]:
        """Rows as JSON: a spread is an object."""
        return [[asdict(c) if isinstance(c, Spread) else c for c in row] for row in self.rows]


@dataclass(frozen=True)
class Result:
    """Of one experiment."""

    name: str
    """Of its files."""
    title: str
    virtual: str
    """Whose numbers these are, as a sentence (label())."""
    facts: Mapping[str, Any]
    """What it takes to repeat it (facts())."""
    tables: tuple[Table, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """By name."""
    sentences: tuple[str, ...] = ()
    """What the numbers say, made from them."""


def text(cell: Cell, digits: int = 2) -> str:
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


def compared(name: str, value: Spread, base: Spread, to: str, unit: str = "") -> str:
    """Whether a value differs from another by more than seeds do, in words."""
    change, margin = value.mean - base.mean, noise(value, base)
    known = "" if margin == margin else " (one seed)"
    if abs(change) <= margin:
        return f"{name} {value.mean:.2f}{unit}, no different from {to} within the spread of seeds"
    way = "more" if change > 0 else "less"
    return f"{name} {value.mean:.2f}{unit}, {100 * abs(change) / abs(base.mean):.0f} % {way} than {to}{known}"


def compared_by_seed(name: str, ratio: Spread, to: str) -> str:
    """Whether a ratio of two values, seed by seed, differs from one by more than two standard errors, in words."""
    change = ratio.mean - 1
    if abs(change) <= 2 * ratio.error:
        return f"{name} no different from {to} ({100 * change:+.0f} %, seeds ± {100 * ratio.std:.0f} %)"
    known = f"seeds ± {100 * ratio.std:.0f} %" if ratio.count > 1 else "one seed"
    return f"{name} {100 * abs(change):.0f} % {'more' if change > 0 else 'less'} than {to} ({known})"


def noise(a: Spread, b: Spread) -> float:
    """Two standard errors of a difference of means; where one has a single value, with the other's std; else NaN."""
    std = [s for s in (a.std, b.std) if s == s]
    if not std:
        return math.nan
    first, second = (s if s == s else std[0] for s in (a.std, b.std))
    return 2 * math.sqrt(first**2 / max(a.count, 1) + second**2 / max(b.count, 1))


def label(dataset: Dataset) -> str:
    """Whose recordings these are."""
    virtual = [e.meta.virtual for e in dataset.entries]
    if not any(virtual):
        return f"Recordings of a real {dataset.robot_name}."
    some = "" if all(virtual) else "Partly "
    return f"{some}VIRTUAL {dataset.robot_name}: these numbers say nothing about real hardware."


def facts(dataset: Dataset, seeds: Iterable[int] = (), **more: Any) -> dict[str, Any]:
    """What it takes to repeat an experiment: command, date, versions, data, seeds, and what else is to be said."""
    entries = dataset.entries
    seeds = list(seeds)
    return {
        "command": command_line(sys.argv[1:]),
        "date": date.today().isoformat(),
        "dataset": f"{dataset.path.name} ({dataset_hash(entries)})",
        "recorded_hours": round(sum(e.rows * e.dt for e in entries) / 3600, 3),
        "units": sorted({e.meta.unit_id for e in entries}),
        **({"seeds": seeds} if seeds else {}),
        **more,
        "versions": {p: version(p) for p in VERSIONS},
    }


def command_line(words: list[str]) -> str:
    """The command as typed, files and folders by their last name: where they lay is nobody's business."""
    return shlex.join(["gaponet", *(Path(w).name if "/" in w else w for w in words)])


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.md, .json, .csv, .svg and .png and renew report.html; each file whole or not at all.

    Returns:
        All files written, the report last.

    Raises:
        UsageError: folder is a file.
    """
    from gaponet.eval.draw_dataset import save
    from gaponet.experiment.report import write_report

    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file; choose a folder for the results")
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for table, stem in zip(result.tables, stems(result.name, [t.name for t in result.tables]), strict=True):
        files.append(folder / f"{stem}.csv")
        write_text(files[-1], _csv(table))
    pictures = stems(result.name, list(result.figures))
    for figure, stem in zip(result.figures.values(), pictures, strict=True):
        files += save(figure, folder / f"{stem}.svg")
    files += [folder / f"{result.name}.md", folder / f"{result.name}.json"]
    write_text(files[-2], _markdown(result, pictures))
    figures = dict(zip(result.figures, pictures, strict=True))
    record = {
        "format": FORMAT, "name": result.name, "title": result.title, "virtual": result.virtual,
        "facts": dict(result.facts), "sentences": list(result.sentences),
        "tables": [_table_record(t) for t in result.tables], "figures": figures,
    }  # fmt: skip
    write_json(files[-1], record)
    return [*files, write_report(folder)]


def stems(name: str, parts: list[str]) -> list[str]:
    """File names without suffix: NAME, then NAME-PART."""
    return [name if i == 0 else f"{name}-{part}" for i, part in enumerate(parts)]


def fact_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Facts as two columns of text."""

    def words(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{k} {v}" for k, v in value.items())
        return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)

    return [[key.replace("_", " "), words(value)] for key, value in found.items()]


def _table_record(table: Table) -> dict[str, Any]:
    return {"name": table.name, "caption": table.caption, "columns": list(table.columns), "rows": table.records(),
            "texts": table.texts()}  # fmt: skip


def _csv(table: Table) -> str:
    """Full precision; a column with spreads is followed by its std and count."""
    spread = [any(isinstance(row[i], Spread) for row in table.rows) for i in range(len(table.columns))]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head: list[str] = []
    for column, wide in zip(table.columns, spread, strict=True):
        head += [column, f"{column}: std", f"{column}: n"] if wide else [column]
    writer.writerow(head)
    for row in table.rows:
        line: list[Any] = []
        for cell, wide in zip(row, spread, strict=True):
            parts = [cell.mean, cell.std, cell.count] if isinstance(cell, Spread) else [cell, None, None]
            line += parts if wide else parts[:1]
        writer.writerow(["" if v is None or (isinstance(v, float) and not math.isfinite(v)) else v for v in line])
    return out.getvalue()


def _markdown(result: Result, pictures: list[str]) -> str:
    parts = [f"# {result.title}", f"**{result.virtual}**"]
    if result.sentences:
        parts.append("\n".join(f"- {s}" for s in result.sentences))
    for table in result.tables:
        ruler = ["---", *["---:"] * (len(table.columns) - 1)]
        lines = [list(table.columns), ruler, *table.texts()]
        parts.append("\n".join("| " + " | ".join(c.replace("|", "\\|") for c in line) + " |" for line in lines))
        if table.caption:
            parts.append(table.caption)
    parts += [f"![]({stem}.svg)" for stem in pictures]
    parts.append("\n".join(f"- {key}: {value}" for key, value in fact_rows(result.facts)))
    return "\n\n".join(parts) + "\n"
