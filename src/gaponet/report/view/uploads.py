"""Files that the page uploads: written below one folder; archives are unpacked within limits."""

from __future__ import annotations

import io
import re
import shutil
import zipfile
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write

MAX_BYTES, MAX_FILES = 2 << 30, 5000  # of an archive's content
NAME = re.compile(r"[^./\\:\x00-\x1f][^/\\:\x00-\x1f]*")


def store_upload(name: str, content: bytes, folder: Path) -> list[Path]:
    """Write an uploaded file, or the files of a .zip, below a folder. Return the files.

    Raises:
        UsageError: A name leads out of the folder or is hidden, the archive is damaged or too large, or a file exists.
    """
    if not name.lower().endswith(".zip"):
        return [_write(name, content, folder)]
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = [item for item in archive.infolist() if not item.is_dir() and "__MACOSX" not in item.filename]
            if len(files) > MAX_FILES or sum(item.file_size for item in files) > MAX_BYTES:
                raise UsageError(
                    f"{name}: holds more than {MAX_FILES} files or {MAX_BYTES >> 30} GiB; give it in parts"
                )
            if shutil.disk_usage(folder.parent).free < 2 * sum(item.file_size for item in files):
                raise UsageError(f"{name}: the disk has no room for it")
            return [_write(item.filename, archive.read(item), folder) for item in files]
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError) as error:
        raise UsageError(f"{name}: is not readable ({error}); pack it again, without a password") from None


def _write(name: str, content: bytes, folder: Path) -> Path:
    """Write one file that does not exist, or is the same."""
    parts = name.split("/")
    path = folder.joinpath(*parts)
    if not all(map(NAME.fullmatch, parts)) or not path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(f"{name}: is no name of a file here; rename it, without .. and without a dot in front")
    if path.exists() and path.read_bytes() != content:
        raise UsageError(f"{path}: another file of this name is there; move it away or rename the new one")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return path
