"""Results as JSON that every reader takes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from gaponet.files import write_text


def finite(value: Any) -> Any:
    """The same value with NaN and infinities as None and numpy scalars as Python's, so that it is valid JSON."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if hasattr(value, "tolist"):
        return finite(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path, value: Any) -> None:
    """Write a file whole or not at all."""
    write_text(path, json.dumps(finite(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
