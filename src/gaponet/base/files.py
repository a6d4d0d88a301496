"""Writing where a user said: files whole or not at all, one writer to a folder, nothing into somebody else's folder.

A folder that gaponet writes into holds `.gaponet`: its first line says what the folder is, and the file is the lock of
whoever writes (it ends with its process, whatever ends that). A file being written is `.gaponet-PROCESS-NAME`
beside its place; those of a killed process are removed by the next that writes there. Nothing else is ever removed.
What Windows does otherwise is here and in `deploy/stop.py` alone.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gaponet.base.errors import FolderError

WINDOWS = os.name == "nt"
MARK = ".gaponet"
# What tells folders that were written before there was a mark.
EARLIER = {
    "dataset": ("dataset.json",),
    "run": ("split.json",),
    "experiments": tuple(f"{place}cells/*/setup.json" for place in ("", "rehearsal/", "without-*/")),
    "model": ("card.json",),
}

_held: set[tuple[str, int]] = set()  # folders of this process's threads


@contextmanager
def whole(path: Path, named: bool = True) -> Iterator[Path]:
    """Give a name beside path to write to; what is there when the block ends well takes path's place, on the disk.

    Where it is not `named`, its name is not on the disk before `sync(path.parent)`, once for many files.

    Raises:
        OSError: It could not be written; path is as it was.
    """
    temporary = path.with_name(f"{MARK}-{os.getpid()}-{path.name}")
    try:
        yield temporary
        sync(temporary)
        os.replace(temporary, path)
        if named:
            sync(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def sync(path: Path) -> None:
    """Return when a file's content, or a folder's list of names, is on the disk (on Windows, files only)."""
    if WINDOWS and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if WINDOWS else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def require_ours(folder: Path, kind: str) -> None:
    """Refuse a folder that holds anything, dot files too, and was not written by gaponet as this kind of folder.

    Raises:
        FolderError: It is somebody else's, another kind of folder, or a file.
    """
    if not folder.is_dir():
        if folder.exists() or folder.is_symlink():
            raise FolderError(f"{folder}: is no folder; choose another place")
        return
    mark = folder / MARK
    found = mark.read_text(encoding="utf-8", errors="replace").split()[:1] if mark.is_file() else []
    if found and found[0] != kind:
        raise FolderError(f"{folder}: holds gaponet's {found[0]}, not {kind}; choose another folder")
    if found or any(any(folder.glob(sign)) for sign in EARLIER.get(kind, (MARK,))):
        return
    strangers = sorted(child.name for child in folder.iterdir() if not child.name.startswith(MARK))
    if strangers:
        more = f" and {len(strangers) - 3} more" if len(strangers) > 3 else ""
        raise FolderError(
            f"{folder}: holds {', '.join(strangers[:3])}{more}, so it is no {kind} of gaponet; choose an empty folder"
        )


@contextmanager
def writing(folder: Path, kind: str, wait: float = 0.0) -> Iterator[None]:
    """Be the only one that writes into a folder, which is made if missing; again within itself, it changes nothing.

    A folder or mark made here goes again if the block fails before anything was written into it.

    Args:
        folder: The user's.
        kind: What the folder is, in one word: dataset, run, model, …
        wait: For another writer to end, s.

    Raises:
        FolderError: It is somebody else's, or another process writes into it.
    """
    key = (os.path.realpath(folder), threading.get_ident())
    if key in _held:
        yield
        return
    made = [p for p in (folder, *folder.parents) if not p.exists()]
    new, line = not (folder / MARK).exists(), f"{kind}\n".encode()
    descriptor = _sole(folder, kind, wait)
    _held.add(key)
    done = False
    try:
        if not os.fstat(descriptor).st_size:
            _write(descriptor, 0, line)
        elif os.fstat(descriptor).st_size > len(line):  # the second line says who writes: that one was killed
            _clear(folder)
        _write(descriptor, len(line), f"{os.getpid()}\n".encode())
        yield
        done = True
    finally:
        if not done and new and [p.name for p in folder.iterdir()] == [MARK]:
            with suppress(OSError):  # somebody else put something there; Windows keeps what is open
                (folder / MARK).unlink()
                for path in made:
                    path.rmdir()
        elif os.fstat(descriptor).st_size > len(line):
            os.ftruncate(descriptor, len(line))
        _held.discard(key)
        os.close(descriptor)


def _write(descriptor: int, at: int, line: bytes) -> None:
    os.lseek(descriptor, at, os.SEEK_SET)
    os.write(descriptor, line)


def _sole(folder: Path, kind: str, wait: float) -> int:
    """Lock the folder's mark; returns the file descriptor that holds the lock."""
    deadline = time.monotonic() + wait
    while True:
        require_ours(folder, kind)
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = lock(folder / MARK)
        if descriptor is not None:
            return descriptor
        if time.monotonic() >= deadline:
            who = (folder / MARK).read_text(encoding="utf-8", errors="replace").split()[1:2]
            process = f" (process {who[0]})" if who else ""
            raise FolderError(f"{folder}: another gaponet{process} is writing here; wait for it or stop it")
        time.sleep(0.05)


def lock(path: Path, opened: Callable[[Path], int] | None = None) -> int | None:
    """Lock a file, made if missing, against other processes; returns its descriptor, None where another has it.

    Args:
        opened: Opens it, for a file that may be another user's; by default it is opened for writing.
    """
    while True:
        binary = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
        descriptor = opened(path) if opened else os.open(path, binary, 0o666)
        try:
            _take(descriptor)
            if WINDOWS or os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        except (BlockingIOError, PermissionError):  # POSIX's word for it and Windows'
            os.close(descriptor)
            return None
        except FileNotFoundError:
            pass
        os.close(descriptor)  # the file that was locked has been removed meanwhile


def _take(descriptor: int) -> None:
    """Lock an open file or raise OSError."""
    try:
        import fcntl
    except ImportError:  # Windows, where a byte that is locked cannot be read: one far behind the end
        import msvcrt

        os.lseek(descriptor, 1 << 30, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _clear(folder: Path) -> None:
    """Remove what a killed writer had half written, here and below; not what another process is still writing."""
    for path in folder.rglob(f"{MARK}-*"):
        owner = path.name.removeprefix(f"{MARK}-").split("-")[0]
        if owner.isdigit() and not _alive(int(owner)):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    if WINDOWS:  # where os.kill ends a process, whatever the signal
        import ctypes

        kernel = ctypes.windll.kernel32  # type: ignore[attr-defined]
        handle = kernel.OpenProcess(0x100000, False, process)  # the right to wait for its end
        try:
            return bool(handle) and kernel.WaitForSingleObject(handle, 0) == 0x102  # not yet
        finally:
            kernel.CloseHandle(handle)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True
