"""Files and folders of the user: atomic writes, one writer per folder, no writes into other
people's folders.

Each folder that gaponet writes into holds a marker file `.gaponet`. Its first line is the kind of
folder. The file is also the lock of the writer: the system releases it when the process ends,
however that happens. Its second line, the number of the writing process, is there only while a
writer runs, or after one was killed.

A file is written as `.gaponet-PROCESS-NAME` beside its place and then renamed. The next writer
removes such temporary files of killed processes. Differences of Windows are handled here and in
`deploy/stop.py` only.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from gaponet.base.errors import FolderError

WINDOWS = os.name == "nt"
FOLDER_MARKER = ".gaponet"
LOCK_RETRY_S = 0.05
# Windows: a locked byte cannot be read, so it lies far behind the end of the file
LOCKED_BYTE = 1 << 30
# Kind → file by which a folder without a marker is recognised: older versions wrote no marker.
UNMARKED_FOLDERS = {
    "dataset": "dataset.json",
    "run": "split.json",
    "model": "card.json",
}
# Of the Windows API: the right to wait for the end of a process, and the answer that it still runs.
SYNCHRONIZE = 0x100000
WAIT_TIMEOUT = 0x102

_locked_here: set[tuple[str, int]] = set()  # (folder, thread) of this process


@contextmanager
def atomic_write(path: Path, named: bool = True) -> Iterator[Path]:
    """Yield a temporary path; when the block succeeds, its file replaces `path` and is flushed to
    the disk.

    Args:
        named: Flush the folder's entry too. For many files, pass False and call
            `flush_to_disk(path.parent)` once.

    Raises:
        OSError: It could not be written; `path` is unchanged.
    """
    temporary = path.with_name(f"{FOLDER_MARKER}-{os.getpid()}-{path.name}")
    try:
        yield temporary
        flush_to_disk(temporary)
        os.replace(temporary, path)
        if named:
            flush_to_disk(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, with the conversions of `json_compatible`."""
    text = json.dumps(json_compatible(value), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def json_compatible(value: Any) -> Any:
    """Convert to valid JSON values: NaN and infinity to None, numpy to Python, dataclasses to
    dicts.
    """
    if isinstance(value, str):  # a file name may hold bytes that are no characters
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {json_compatible(str(k)): json_compatible(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_compatible(v) for v in value]
    if is_dataclass(value) and not isinstance(value, type):
        return json_compatible(vars(value))
    if hasattr(value, "tolist"):
        return json_compatible(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def flush_to_disk(path: Path) -> None:
    """Return when the content of a file, or the entries of a folder, are on the disk (on Windows,
    files only).
    """
    if WINDOWS and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if WINDOWS else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def require_own_folder(folder: Path, kind: str) -> None:
    """Refuse a folder that is not empty and was not written by gaponet as this kind.

    A missing folder is accepted, and is not created.

    Raises:
        FolderError: It is somebody else's, another kind of folder, or a file.
    """
    if not folder.is_dir():
        if folder.exists() or folder.is_symlink():
            raise FolderError(f"{folder}: is no folder; choose another place")
        return
    stated_kind, _ = _read_marker(folder)
    if stated_kind == kind:
        return
    if stated_kind:
        raise FolderError(
            f"{folder}: holds gaponet's {stated_kind}, not {kind}; choose another folder"
        )
    # All other kinds always had a marker; a writer that was killed at once leaves an empty one.
    sign = UNMARKED_FOLDERS.get(kind, FOLDER_MARKER)
    if (folder / sign).exists():
        return
    names = sorted(child.name for child in folder.iterdir())
    others = [name for name in names if not name.startswith(FOLDER_MARKER)]
    if others:
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        raise FolderError(
            f"{folder}: holds {', '.join(others[:3])}{more}, so it is no {kind} of gaponet; "
            "choose an empty folder"
        )


def _read_marker(folder: Path) -> tuple[str, str]:
    """Return the kind of a folder, and the process that writes into it; "" where the marker does
    not state them.
    """
    marker = folder / FOLDER_MARKER
    if not marker.is_file():
        return "", ""
    # A third word is the rest of a killed writer's number that was longer than the next one's.
    words = marker.read_text(encoding="utf-8", errors="replace").split()
    kind = words[0] if words else ""
    process = words[1] if len(words) > 1 else ""
    return kind, process


@contextmanager
def lock_folder(folder: Path, kind: str, wait: float = 0.0) -> Iterator[None]:
    """Lock a folder for this thread, the only writer; the folder is created if missing.

    A call within the block of another one, for the same folder, does nothing.

    If the block fails before it wrote anything, a folder or marker that was created here is
    removed.

    Args:
        kind: One word: dataset, run, model, …
        wait: Time to wait for another writer, s.

    Raises:
        FolderError: The folder is somebody else's, or another process writes into it.
    """
    key = (os.path.realpath(folder), threading.get_ident())
    if key in _locked_here:
        yield
        return
    created = [path for path in (folder, *folder.parents) if not path.exists()]  # deepest first
    marker_is_new = not (folder / FOLDER_MARKER).exists()
    descriptor = _lock_marker(folder, kind, wait)
    _locked_here.add(key)
    succeeded = False
    try:
        _name_writer(descriptor, folder, kind)
        yield
        succeeded = True
    finally:
        if not succeeded and marker_is_new and _holds_marker_alone(folder):
            _remove_created(folder, created)
        else:
            _erase_writer(descriptor, kind)
        _locked_here.discard(key)
        os.close(descriptor)


@contextmanager
def whole_folder(
    folder: Path, kind: str, last: str, obsolete: tuple[str, ...] = ()
) -> Iterator[Path]:
    """Lock a folder and yield an empty temporary folder inside it, for the new files.

    When the block succeeds, the new files replace those of `folder`. If the block fails, or the
    process is killed in it, `folder` stays as it was.

    The folder is complete if `last` is there: the replacement removes this file first and puts it
    back last.

    Args:
        kind: As of `lock_folder`.
        last: Name of the file without which the folder is incomplete.
        obsolete: Names of files in `folder` that are removed, since the new files make them wrong.

    Raises:
        FolderError: The folder is somebody else's, or another process writes into it.
        OSError: A file could not be written.
    """
    with lock_folder(folder, kind):
        temporary = folder / f"{FOLDER_MARKER}-{os.getpid()}-new"
        # In a container every process has the same number, so that it may be a killed one's.
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        try:
            yield temporary
            _replace_files(temporary, folder, last, obsolete)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _replace_files(source: Path, target: Path, last: str, obsolete: tuple[str, ...]) -> None:
    """Move the files of a folder, markers aside, into another one, `last` as the last one."""
    names = []
    for path in sorted(source.rglob("*")):
        if path.is_file() and path.name != FOLDER_MARKER:
            flush_to_disk(path)
            names.append(path.relative_to(source))
    names.remove(Path(last))
    for name in (last, *obsolete):
        (target / name).unlink(missing_ok=True)
    for path in (*names, Path(last)):
        (target / path).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / path, target / path)
    flush_to_disk(target)


def clear_folder(folder: Path, keep: str = "") -> None:
    """Delete the content of a folder, except its marker and one child."""
    for child in folder.iterdir():
        if child.name not in (FOLDER_MARKER, keep):
            shutil.rmtree(child) if child.is_dir() else child.unlink()


def _holds_marker_alone(folder: Path) -> bool:
    if not folder.is_dir():  # another program removed it
        return False
    return [path.name for path in folder.iterdir()] == [FOLDER_MARKER]


def _kind_line(kind: str) -> bytes:
    """Return the first line of a marker."""
    return f"{kind}\n".encode()


def _name_writer(descriptor: int, folder: Path, kind: str) -> None:
    """Write this process into the second line of a locked marker, and the kind where it is new.

    If a killed writer is named there, its temporary files are removed.
    """
    kind_line = _kind_line(kind)
    size = os.fstat(descriptor).st_size
    if size == 0:
        _write_at(descriptor, 0, kind_line)
    elif size > len(kind_line):
        _remove_unfinished(folder)
    _write_at(descriptor, len(kind_line), f"{os.getpid()}\n".encode())


def _erase_writer(descriptor: int, kind: str) -> None:
    """Remove the second line of a marker."""
    kind_line = _kind_line(kind)
    if os.fstat(descriptor).st_size > len(kind_line):
        os.ftruncate(descriptor, len(kind_line))


def _remove_created(folder: Path, created: list[Path]) -> None:
    """Remove the marker of a folder, and the folders that were created for it, deepest first."""
    with suppress(OSError):  # another program wrote into it; Windows keeps open files
        (folder / FOLDER_MARKER).unlink()
        for path in created:
            path.rmdir()


def _write_at(descriptor: int, offset: int, line: bytes) -> None:
    os.lseek(descriptor, offset, os.SEEK_SET)
    os.write(descriptor, line)


def _lock_marker(folder: Path, kind: str, wait: float) -> int:
    """Lock the marker of a folder; returns the file descriptor that holds the lock.

    Waits up to `wait` s for another writer, whose folder is checked again at each try.
    """
    deadline = time.monotonic() + wait
    while True:
        require_own_folder(folder, kind)
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = lock_file(folder / FOLDER_MARKER)
        if descriptor is not None:
            return descriptor
        if time.monotonic() >= deadline:
            _, process = _read_marker(folder)
            writer = f" (process {process})" if process else ""
            raise FolderError(
                f"{folder}: another gaponet{writer} is writing here; wait for it or stop it"
            )
        time.sleep(LOCK_RETRY_S)


def lock_file(path: Path, opener: Callable[[Path], int] | None = None) -> int | None:
    """Lock a file against other processes; the file is created if missing.

    A descriptor, unlike the locks of libraries, may be inherited by a child and may be of another
    user's file. If the file is removed while it is being locked, its successor is locked.

    Args:
        opener: Opens the file; by default it is opened for reading and writing.

    Returns:
        The descriptor that holds the lock, or None if another process holds it.
    """
    if opener is None:
        opener = _open_or_create
    while True:
        descriptor = opener(path)
        try:
            _lock_descriptor(descriptor)
            if WINDOWS or os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        except (BlockingIOError, PermissionError):  # POSIX, Windows: locked by another process
            os.close(descriptor)
            return None
        except FileNotFoundError:  # of os.stat: no file has this name now
            pass
        os.close(descriptor)  # the locked file was removed meanwhile


def _open_or_create(path: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
    return os.open(path, flags, 0o666)


def _lock_descriptor(descriptor: int) -> None:
    """Lock an open file or raise OSError."""
    try:
        import fcntl
    except ImportError:
        import msvcrt

        os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_unfinished(folder: Path) -> None:
    """Remove temporary files of processes that have ended, in the folder and below."""
    for path in folder.rglob(f"{FOLDER_MARKER}-*"):
        owner = path.name.removeprefix(f"{FOLDER_MARKER}-").split("-")[0]
        if owner.isdigit() and not _process_runs(int(owner)):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _process_runs(process: int) -> bool:
    if WINDOWS:  # where os.kill ends a process, whatever the signal
        import ctypes

        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined]
        handle = kernel.OpenProcess(SYNCHRONIZE, False, process)
        try:
            return bool(handle) and kernel.WaitForSingleObject(handle, 0) == WAIT_TIMEOUT
        finally:
            kernel.CloseHandle(handle)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is another user's
        pass
    return True
