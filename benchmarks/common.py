"""What benchmarks share: a command line, rows by seed in a file, and tables."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.files import write_text
from gaponet.sim.metrics import standard_error

NORMAL_90 = 1.645  # standard errors on each side that hold 90 % of a normal distribution
Row = dict[str, Any]


def command_line(docstring: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is a script's docstring as it stands."""
    return argparse.ArgumentParser(
        description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def read_rows(file: Path) -> list[Row]:
    """Return the complete lines of a file of JSON lines; none if there is no file."""
    if not file.is_file():
        return []
    complete, _, _ = file.read_text(encoding="utf-8").rpartition("\n")
    return [json.loads(line) for line in complete.splitlines()]


def append_row(file: Path, row: Row) -> None:
    """Append a line; the file and its folder are made if they are missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as journal:
        journal.write(json.dumps(row, default=float) + "\n")


def drop_cut_line(file: Path) -> None:
    """Remove a last line that an interrupt cut short, so that rows can be appended again."""
    if not file.is_file():
        return
    text = file.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        complete, end, _ = text.rpartition("\n")
        write_text(file, complete + end)


def measure_seeds(file: Path, seeds: Iterable[int], measure: Callable[[int], Row]) -> list[Row]:
    """Return the row of each seed, in order: those in the file as they are, others measured.

    Args:
        file: To which a measured row is appended.
        measure: Returns the row of a seed; "seed" is added to it.
    """
    drop_cut_line(file)
    stored = {row["seed"]: row for row in read_rows(file)}
    rows = []
    for seed in seeds:
        if seed not in stored:
            stored[seed] = {"seed": seed} | measure(seed)
            append_row(file, stored[seed])
            print(f"seed {seed}: measured", flush=True)
        rows.append(stored[seed])
    return rows


def plus_minus(values: Iterable[float]) -> str:
    """Return "mean ± standard error" with two digits behind the point."""
    array = np.array([*values], float)
    if not len(array):
        return "–"
    return f"{array.mean():.2f} ± {standard_error(array):.2f}"


def share_inside(intervals: Iterable[tuple[float, float, float]]) -> str:
    """Return "k of n" of the 90 % intervals that hold the truth.

    Args:
        intervals: Estimate, truth and standard error of each.
    """
    found = [abs(estimate - truth) <= NORMAL_90 * std for estimate, truth, std in intervals]
    return f"{sum(found)} of {len(found)}"


def print_table(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a table in Markdown; all columns but the first are numbers."""
    names = [*columns]
    print()
    for cells in (names, ["---", *["---:"] * (len(names) - 1)], *rows):
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
