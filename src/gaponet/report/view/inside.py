"""Files and folders that somebody else may have put into the page's folder: only what lies inside
is read.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath

from gaponet.base.errors import UsageError
from gaponet.base.structure import read_limited

MAX_FILE_BYTES = 64 << 20  # of a picture, a result or an output; gaponet's own have megabytes


def require_inside_name(name: str) -> str:
    """Return the name of a file or folder below another folder, as it was given.

    Both kinds of paths are examined on every system: a folder may come from another one.

    Raises:
        UsageError: It is empty or absolute, or holds "..", a drive or a control character.
    """
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if not path.parts or path.drive or path.root or ".." in path.parts:
            raise UsageError(f"'{name}' leads out of the folder; it may name only what is inside")
    if not name.isprintable():
        raise UsageError(f"'{name}' holds a control character; rename it")
    return name


def path_inside(folder: Path, name: str) -> Path:
    """Return folder / name.

    Raises:
        UsageError: The name, or a symbolic link on the way, leads out of the folder.
    """
    path = folder / require_inside_name(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(f"{path}: a link leads out of {folder}; put a copy in its place")
    return path


def read_inside(folder: Path, name: str) -> bytes:
    """Read a file below a folder.

    Raises:
        UsageError: It leads out of the folder, is missing, is no ordinary file, or is too large.
    """
    return read_limited(path_inside(folder, name), UsageError, max_bytes=MAX_FILE_BYTES)
