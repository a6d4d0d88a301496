"""Cells of a comparison: each (model, seed) is a job, on the cores of this machine or on a cluster.

Each cell simulates and learns on threads of its own. Trainings that share a thread pool wait for each other: two at
once with two threads each took three times as long as one after the other.
"""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gaponet.base.errors import DatasetError, GAPONetError, UsageError, missing_extra
from gaponet.base.executor import POLL_INTERVAL_S, Pool
from gaponet.base.files import FOLDER_MARKER, write_text
from gaponet.base.progress import Running
from gaponet.base.structure import read_json
from gaponet.data.store import Dataset, dataset_hash
from gaponet.experiments.variant import Variant
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import model_hash

Report = Callable[[float, str], None]  # share done, note
Work = Callable[["Cell", Report], None]

SETUP_FILE, RESULT_FILE = "setup.json", "cell.json"
PARENT_TIMEOUT_S = (
    180.0  # without a heartbeat of the parent; a shared folder may show it a minute late
)


def read_record(path: Path) -> dict[str, Any]:
    """Read a JSON object that an experiment stored for itself.

    Raises:
        DatasetError: Missing or damaged.
    """
    return read_json(dict[str, Any], path, DatasetError, "delete it and run the same command again")


@dataclass(frozen=True)
class Cell:
    """One model and seed: a run folder with its set-up (setup.json) and its outcome (cell.json)."""

    variant: Variant
    seed: int
    folder: Path
    dataset: str  # folder or address
    robot: RobotSpec  # the simulator that the model corrects
    budget: str
    holdout_units: tuple[str, ...]
    threads: int

    @property
    def name(self) -> str:
        """Model and seed, for people."""
        return f"{self.variant.name} seed {self.seed}"

    @property
    def done(self) -> bool:
        """True if the cell is trained and evaluated."""
        return (self.folder / RESULT_FILE).is_file()

    def setup(self, data: Dataset) -> dict[str, Any]:
        """Return the settings in which an existing cell must agree; threads change only the time."""
        config = replace(self.variant.config, seed=self.seed, threads=0).sized()
        return json.loads(json.dumps({
            "config": asdict(config), "budget": self.budget, "holdout_units": list(self.holdout_units),
            "dataset": dataset_hash(data.entries), "simulator": model_hash(self.robot),
        }))  # fmt: skip

    def require_same_setup(self, data: Dataset) -> None:
        """Refuse an existing folder that was set up differently, or that is no cell.

        Raises:
            UsageError: It names what differs.
        """
        if not self.folder.exists():
            return
        file, wanted = self.folder / SETUP_FILE, self.setup(data)
        if not file.is_file():
            raise UsageError(
                f"{self.folder}: is there but is no part of a comparison; choose another --out"
            )
        stored = read_record(file)
        if stored != wanted:
            changed = ", ".join(k for k in wanted if stored.get(k) != wanted[k])
            raise UsageError(
                f"{self.folder}: belongs to a comparison with another {changed}; choose another --out"
            )


@dataclass
class _ProgressFile:
    """Report of a cell in its worker, through two files that the parent process sees too.

    The worker writes its progress. The parent touches the heartbeat file and removes it when it ends; a worker without
    a heartbeat interrupts itself.
    """

    progress: Path
    heartbeat: Path
    written: float = 0.0
    beat: float = 0.0
    beat_seen: float = 0.0

    def __call__(self, share: float, note: str) -> None:
        now = time.monotonic()
        if now - self.written < POLL_INTERVAL_S:
            return
        self.written = now
        try:
            beat = self.heartbeat.stat().st_mtime
        except FileNotFoundError:
            raise KeyboardInterrupt from None
        if beat != self.beat:
            self.beat, self.beat_seen = beat, now
        elif now - self.beat_seen > PARENT_TIMEOUT_S:
            raise KeyboardInterrupt
        self.progress.write_text(json.dumps([share, note]), encoding="utf-8")

    def read(self) -> tuple[float, str] | None:
        """Return the share done and the note written last, if any."""
        try:
            share, note = json.loads(self.progress.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):  # not yet, or just being written
            return None
        return float(share), str(note)


def run_cells(
    cells: ListOf[Cell],
    work: Work,
    pool: Pool,
    show: Callable[[Running, int], None] = lambda running, done: None,
) -> dict[str, str]:
    """Do the work of each cell in a pool. Return the failures, name → reason.

    Args:
        work: A module's function.
        pool: Its workers see the cells' folders and the dataset under the same paths.
        show: Called with the running cells and the number of finished ones whenever they change.

    Raises:
        KeyboardInterrupt: After every running cell has written its checkpoint.
    """
    failed, done, own = dict[str, str](), 0, f"{FOLDER_MARKER}-{os.getpid()}-"
    cells = [replace(c, folder=c.folder.absolute()) for c in cells]
    shown: tuple[Running, int] = {}, 0
    heartbeat = cells[0].folder.with_name(f"{own}alive")
    files = {
        c.name: _ProgressFile(c.folder.with_name(own + c.folder.name), heartbeat) for c in cells
    }

    def beat() -> None:
        nonlocal shown
        os.utime(heartbeat)
        now = {name: progress for name, file in files.items() if (progress := file.read())}, done
        if now != shown:
            shown = now
            show(*now)

    def stop(job: tuple[Cell, _ProgressFile]) -> bool:
        heartbeat.unlink(missing_ok=True)
        return job[1].progress.exists()

    for cell in cells:
        cell.folder.parent.mkdir(parents=True, exist_ok=True)
    heartbeat.touch()
    try:
        for outcome in pool.run(
            partial(_work_in_worker, work), ((c, files[c.name]) for c in cells), beat, stop
        ):
            cell, file = outcome.job
            reason = outcome.value if outcome.error is None else str(outcome.error)
            failed |= {cell.name: reason} if reason else {}
            file.progress.unlink(missing_ok=True)
            done += 1
            beat()
    finally:
        for path in (heartbeat, *(file.progress for file in files.values())):
            path.unlink(missing_ok=True)
    return failed


def _work_in_worker(work: Work, job: tuple[Cell, _ProgressFile]) -> str | None:
    """Do the work of a cell. Return the reason of its failure, if it failed."""
    cell, report = job
    file = cell.folder.with_name(cell.folder.name + ".error.txt")
    try:
        report(0.0, "starting")
        file.unlink(missing_ok=True)
        work(cell, report)
    except KeyboardInterrupt:
        return "the comparison ended before it; its checkpoint is resumed the next time"
    except (GAPONetError, OSError) as error:  # a full disk is no bug
        return str(error)
    except Exception as error:
        missing = missing_extra(error) if isinstance(error, ModuleNotFoundError) else None
        if missing is None:
            write_text(file, traceback.format_exc())
        return missing or f"{type(error).__name__}: {error} (see {file})"
    return None
