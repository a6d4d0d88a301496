"""Work for cells of a comparison in tests: a spawned process imports it by name."""

from __future__ import annotations

import errno
import os
import time

from gaponet.base.errors import ModelError
from gaponet.experiments.cells import Cell, Report


def note_threads(cell: Cell, report: Report) -> None:
    """Leave a file that says how many threads this process was given; seed 1 fails, seed 2 is a bug, seed 3
    dies, seed 4 meets a full disk, seed 5 lacks a package."""
    if cell.seed == 1:
        raise ModelError("no such thing")
    if cell.seed == 2:
        raise ZeroDivisionError("a bug")
    if cell.seed == 3:
        os._exit(9)
    if cell.seed == 4:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "checkpoint.pt")
    if cell.seed == 5:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    report(0.5, "half")
    cell.folder.mkdir(parents=True)
    (cell.folder / "threads").write_text(os.environ["OMP_NUM_THREADS"])


def wait_for_the_end(cell: Cell, report: Report) -> None:
    """Work until interrupted, then keep what was reached."""
    cell.folder.mkdir(parents=True)
    try:
        while True:
            report(0.1, "busy")
            time.sleep(0.01)
    except KeyboardInterrupt:
        (cell.folder / "kept").touch()
        raise
