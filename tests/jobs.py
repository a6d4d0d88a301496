"""Jobs for executors in tests: a worker imports them by name."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from gaponet.base.errors import UsageError


def dies_at_first(job: tuple[Path, int]) -> tuple[int, str]:
    """Leave a file for each attempt; jobs with an even number are killed at the first, job 5 at
    every one, 7 fails.
    """
    folder, number = job
    attempts = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{attempts}").touch()
    if number == 5 or (number % 2 == 0 and not attempts):
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7:
        raise UsageError("seven is refused")
    return number**2, os.environ["OMP_NUM_THREADS"]
