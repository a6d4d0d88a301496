"""Lock that admits one controller per robot on this machine.

The system releases it when its holder ends.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.files import lock_file

LOCK_FOLDER = Path("/tmp")  # the same for all users of the computer, whatever TMPDIR is


@contextmanager
def sole_publisher(address: str) -> Iterator[int]:
    """Hold the lock of an address; yield its file descriptor, which a watchdog keeps open.

    A port has one lock, whatever links and names lead to it: that of its device number.

    Raises:
        UsageError: Another process on this machine commands this robot, or its lock cannot be used.
    """
    name = re.sub(r"[^A-Za-z0-9]+", "-", _device(address)).strip("-")
    path = LOCK_FOLDER / f"gaponet-{name}.lock"
    try:
        descriptor = lock_file(path, _open_lock)
    except OSError as error:
        raise UsageError(
            f"{address}: its lock {path} cannot be opened ({error.strerror}); ask its owner"
        ) from None
    if descriptor is None:
        raise UsageError(f"{address}: another process commands this robot ({path}); stop it first")
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _device(address: str) -> str:
    """Return the number of the device at an address, as a word.

    The address itself if it is no device.
    """
    try:
        status = os.stat(address)
    except (OSError, ValueError):
        return address
    if not stat.S_ISCHR(status.st_mode):
        return address
    return f"device {os.major(status.st_rdev)} {os.minor(status.st_rdev)}"


def _open_lock(path: Path) -> int:
    """Return the descriptor of a lock file, which is made if it is missing.

    It is opened for reading only: that suffices for a lock, and other users may only read this
    user's file.
    """
    for _ in range(3):
        try:
            # Any user of the computer may have put something there. Opening a pipe for reading
            # would wait for a writer.
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            pass
        else:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                os.close(descriptor)
                raise OSError(errno.EINVAL, "it is not a regular file")
            return descriptor
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:  # another process was faster
            continue
        os.fchmod(descriptor, 0o644)  # whatever the umask is
        return descriptor
    raise FileNotFoundError(errno.ENOENT, "other processes remove it again and again")
