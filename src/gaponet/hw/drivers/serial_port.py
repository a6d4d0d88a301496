"""Who else has a serial port open: two programs that command one arm must not happen."""

from __future__ import annotations

import os
from pathlib import Path

PROCESSES = Path("/proc")


def other_programs(port: str) -> list[str]:
    """Return the programs that have a port open, in words, beside this process and its children.

    Linux shows the files of the same user's processes alone; root sees all. Elsewhere the list is
    empty. The program at the other end of a pseudo-terminal (a virtual arm) is the arm, and is left
    out.
    """
    device = os.path.realpath(port)
    programs = []
    for folder in PROCESSES.glob("[0-9]*"):
        if int(folder.name) == os.getpid():
            continue
        try:
            if _has_open(folder, device) and not _is_child_or_arm(folder, device):
                name = (folder / "comm").read_text().strip()
                programs.append(f"{name} (process {folder.name})")
        except OSError:  # it has ended, or is another user's
            continue
    return sorted(programs)


def _has_open(folder: Path, device: str) -> bool:
    return any(os.readlink(link) == device for link in (folder / "fd").iterdir())


def _is_child_or_arm(folder: Path, device: str) -> bool:
    """Return True for a child of this process, as its watchdog, and for the other end of a
    pseudo-terminal.
    """
    status = (folder / "status").read_text()
    if f"PPid:\t{os.getpid()}\n" in status:
        return True
    number = device.removeprefix("/dev/pts/")
    if number == device:
        return False
    return any(
        f"tty-index:\t{number}\n" in file.read_text() for file in (folder / "fdinfo").iterdir()
    )
