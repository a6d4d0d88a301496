"""TOML files that the package ships by name and a user may give by path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gaponet.errors import UsageError
from gaponet.structure import read_toml


def load_toml(kind: str, folder: Path, name_or_path: str | Path) -> tuple[Path, dict[str, Any]]:
    """folder/NAME.toml, or the file at a path; its path and its table.

    Args:
        kind: What it is, for messages: "recipe".
        folder: Where the package keeps them.
        name_or_path: Name without ".toml", or a path.

    Raises:
        UsageError: No such file, or not TOML.
    """
    path = folder / f"{name_or_path}.toml"
    if not path.is_file():
        path = Path(name_or_path)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise UsageError(f"no {kind} '{name_or_path}': in the package are {known}; or give a .toml file")
    return path, read_toml(dict[str, Any], path, UsageError)
