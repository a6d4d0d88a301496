"""The process of one command of the page. It ends with the page's server, however that ends.

The server holds the writing end of a pipe, and never writes. The system closes this end when the
server ends, also by `kill -9`. The command then ends itself and everything that it started:

- Linux, macOS: it is the first process of a group of its own, and kills the group.
- Windows: it ends itself, and its worker processes end because they look after their parent.

    python -m gaponet.report.view.run_job JOB_FOLDER WORDS OF THE COMMAND …
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from gaponet.base.files import LOCK_RETRY_S, WINDOWS, lock_file, write_json

LOCK = "lock"  # file of a job, locked while its process lives
ENDED = "ended.json"  # file of a job, written when it ends
BY_ITSELF = "exit"
CANCELLED = "cancelled"
WITH_SERVER = "server"


def write_ending(folder: Path, how: str, code: int = 0) -> None:
    """Store how a job ended: BY_ITSELF with its exit code, CANCELLED or WITH_SERVER."""
    write_json(folder / ENDED, {"how": how, "code": code})


def main() -> None:
    """Run the command line of this process as a job of the page."""
    run(Path(sys.argv.pop(1)), _gaponet)


def run(folder: Path, command: Callable[[], object]) -> None:
    """Run a command as the job of a folder, and store how it ended."""
    _lock = _lock_job(folder / LOCK)  # the system releases it at the end
    server = _take_standard_input()
    threading.Thread(target=_end_with_server, args=(server, folder), daemon=True).start()
    code = 1  # of an exception that nobody expected
    try:
        command()
        code = 0
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else code
        raise
    finally:
        write_ending(folder, BY_ITSELF, code)


def _gaponet() -> None:
    """Do what `python -m gaponet` does."""
    runpy.run_module("gaponet", run_name="__main__", alter_sys=True)


def _lock_job(path: Path) -> int:
    """Lock a job's file; a page that looks whether the job lives may hold it for a moment."""
    while True:
        descriptor = lock_file(path)
        if descriptor is not None:
            return descriptor
        time.sleep(LOCK_RETRY_S)


def _take_standard_input() -> int:
    """Return a descriptor of the server's pipe.

    The command itself finds an empty standard input.
    """
    pipe = os.dup(0)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    return pipe


def _end_with_server(pipe: int, folder: Path) -> None:
    """Wait until the server ends, then end this process and its children."""
    os.read(pipe, 1)
    try:
        write_ending(folder, WITH_SERVER)
    finally:
        if not WINDOWS and os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os._exit(1)


if __name__ == "__main__":
    main()
