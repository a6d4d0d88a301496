"""Results as JSON that every reader takes."""

from __future__ import annotations

import json
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from gaponet.base.files import write_text


def finite(value: Any) -> Any:
    """The same value as valid JSON: NaN and infinities as None, numpy's as Python's, dataclasses as dicts."""
    if isinstance(value, str):  # a file's name may hold bytes that are no letters
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {finite(str(k)): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if is_dataclass(value) and not isinstance(value, type):
        return finite(vars(value))
    if hasattr(value, "tolist"):
        return finite(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path, value: Any) -> None:
    """Write a file whole or not at all."""
    write_text(path, json.dumps(finite(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
