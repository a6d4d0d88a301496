"""What studies keep for themselves, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gaponet.base.errors import DatasetError
from gaponet.base.structure import read_json


def read_kept(path: Path) -> dict[str, Any]:
    """A JSON object that gaponet kept for itself.

    Raises:
        DatasetError: Missing or damaged.
    """
    return read_json(dict[str, Any], path, DatasetError, "delete it and run the same command again")
