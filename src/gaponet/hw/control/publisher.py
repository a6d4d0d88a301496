"""One controller per robot on this machine: a lock that ends with its holder, whatever ends it."""

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

LOCKS = Path("/tmp")  # the same for all users of the computer, whatever TMPDIR says


@contextmanager
def sole_publisher(address: str) -> Iterator[int]:
    """Hold the lock of an address; gives its file descriptor, to be kept open by a watchdog.

    A port has one lock, whatever links and names lead to it: that of its device number.

    Raises:
        UsageError: Another process on this machine commands this robot, or its lock cannot be used.
    """
    name = re.sub(r"[^A-Za-z0-9]+", "-", _device(address)).strip("-")
    path = LOCKS / f"gaponet-{name}.lock"
    try:
        descriptor = lock_file(path, _opened)
    except OSError as error:
        raise UsageError(f"{address}: its lock {path} cannot be opened ({error.strerror}); ask its owner") from None
    if descriptor is None:
        raise UsageError(f"{address}: another process commands this robot ({path}); stop it first")
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _device(address: str) -> str:
    """The number of the device that an address names, as a word; else the address itself."""
    try:
        found = os.stat(address)
    except (OSError, ValueError):
        return address
    if not stat.S_ISCHR(found.st_mode):
        return address
    return f"device {os.major(found.st_rdev)} {os.minor(found.st_rdev)}"


def _opened(path: Path) -> int:
    """Its descriptor; the file is made where it is missing. Reading is enough for a lock, and is all that the next user
    of the computer may do with this user's file."""
    for _ in range(3):
        try:
            # Any user of the computer may have put something there. Opening a pipe for reading would wait for a writer.
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
        os.fchmod(descriptor, 0o644)  # whatever the umask says
        return descriptor
    raise FileNotFoundError(2, "it comes and goes")
