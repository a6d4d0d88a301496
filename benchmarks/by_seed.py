"""Measurements by seed, a JSON line each in a file, by which a benchmark resumes; and tables of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.sim.metrics import standard_error

Row = dict[str, Any]


def measure_seeds(file: Path, seeds: Iterable[int], measure: Callable[[int], Row]) -> list[Row]:
    """Return the row of each seed, in order: those in the file as they are, others measured and appended.

    Args:
        measure: Returns the row of a seed; "seed" is added to it.
    """
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    stored = {row["seed"]: row for row in map(json.loads, lines)}
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in seeds:
        if seed not in stored:
            stored[seed] = {"seed": seed} | measure(seed)
            with file.open("a", encoding="utf-8") as journal:
                journal.write(json.dumps(stored[seed], default=float) + "\n")
            print(f"seed {seed}: measured", flush=True)
        rows.append(stored[seed])
    return rows


def plus_minus(values: Iterable[float]) -> str:
    """Return "mean ± standard error" with two digits behind the point."""
    array = np.array([*values], float)
    return f"{array.mean():.2f} ± {standard_error(array):.2f}" if len(array) else "–"


def print_table(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a table in Markdown; all columns but the first are numbers."""
    names = [*columns]
    print()
    for cells in (names, ["---", *["---:"] * (len(names) - 1)], *rows):
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
