"""The result of an experiment: tables, figures, sentences, and the facts that are needed to repeat it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.base.result_table import ResultTable
from gaponet.data.store import Dataset, dataset_hash

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VERSIONS = ("gaponet", "mujoco", "numpy", "torch")


@dataclass(frozen=True)
class Result:
    """The result of one experiment."""

    name: str  # stem of the names of its files
    title: str
    virtual: str  # provenance of the recordings, a sentence (report.provenance)
    facts: Mapping[str, Any]  # what is needed to repeat the experiment (`facts`)
    tables: tuple[ResultTable, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)  # figures by name
    sentences: tuple[str, ...] = ()  # conclusions, made from the numbers


def facts(dataset: Dataset, seeds: Iterable[int] = (), **more: Any) -> dict[str, Any]:
    """Return what is needed to repeat an experiment: command, date, versions, data, seeds, and `more`."""
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
    """Return the command with the last names of its files and folders, so that no private path is published."""
    return shlex.join(["gaponet", *(Path(w).name if "/" in w else w for w in words)])


def fact_rows(facts: Mapping[str, Any]) -> list[list[str]]:
    """Return facts as two columns of text."""

    def words(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{k} {v}" for k, v in value.items())
        return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)

    return [[key.replace("_", " "), words(value)] for key, value in facts.items()]
