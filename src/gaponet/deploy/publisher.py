"""One controller per robot on this machine: a lock that ends with its holder, whatever ends it."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gaponet.errors import UsageError


@contextmanager
def sole_publisher(address: str) -> Iterator[int]:
    """Hold the lock of an address; gives its file descriptor, to be kept open by a guard process.

    Raises:
        UsageError: Another process on this machine commands this robot.
    """
    name = re.sub(r"[^A-Za-z0-9]+", "-", address).strip("-")
    path = Path(tempfile.gettempdir()) / f"gaponet-{name}.lock"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{address}: another process commands this robot ({path}); stop it first") from None
        yield descriptor
    finally:
        os.close(descriptor)
