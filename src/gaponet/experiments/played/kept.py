"""Parts of an experiment, kept as they are done, so that one that was interrupted goes on where it was."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gaponet import __version__
from gaponet.base.files import json_compatible, write_json
from gaponet.experiments.kept import read_kept

T = TypeVar("T")


class KeptParts:
    """Answers of calls by everything that they depend on, a JSON file each; without a folder, nothing is kept."""

    def __init__(self, folder: Path | None, *facts: Any) -> None:
        """
        Args:
            folder: Where; made when there is something to keep.
            facts: What all parts depend on: numbers, arrays, text, dataclasses of them.
        """
        self.folder, self.facts = folder, facts

    def __call__(self, *facts: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What make() gives, or gave before with the same facts, as JSON gives it back: lists, and None for NaN.

        Args:
            facts: What this part depends on besides; functions are called for theirs, when something is kept.
        """
        if self.folder is None:
            return json.loads(json.dumps(json_compatible(make())))
        known = [f() if callable(f) else f for f in facts]
        file = self.folder / f"{_digest([self._common, known])[:16]}.json"
        if not file.is_file():
            found = make()
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(file, found)
        return read_kept(file)

    @cached_property
    def _common(self) -> str:
        """Digest of what all parts depend on, which may be long: every motion, say."""
        return _digest([__version__, self.facts])


def _digest(facts: Any) -> str:
    return hashlib.sha256(json.dumps(json_compatible(facts), sort_keys=True).encode()).hexdigest()


def revived(kind: type[T], record: dict[str, Any]) -> T:
    """A dataclass of numbers, text and arrays from what JSON made of it."""
    number = {f.name for f in dataclasses.fields(kind) if f.type in ("float", float)}  # type: ignore[arg-type]
    values = {k: np.array(v) if isinstance(v, list) else v for k, v in record.items()}
    return kind(**{k: np.nan if v is None and k in number else v for k, v in values.items()})
