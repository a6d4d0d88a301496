"""Record a recipe on a virtual fleet into a dataset, on all cores.

A sequence depends only on seed, fleet, motion, unit, payload, rate and repetition. An interrupted
recording continues if it is started again, and gives the same samples.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.executor import LOCAL, MAX_WORKERS, open_pool
from gaponet.base.files import lock_folder, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json, validated
from gaponet.data.pair import SimulatedReplay
from gaponet.data.sequence import Sequence
from gaponet.data.store import KIND, Dataset
from gaponet.motion.files import read_motion
from gaponet.motion.recipe import Recipe, Take, load_recipe, takes
from gaponet.robot.folder import MOVE_STORED_ROBOT
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import require_stored_robot
from gaponet.sim.replay import pair_dataset, replay
from gaponet.virtual.fleet import Fleet
from gaponet.virtual.play import Job, library, play

__all__ = ["CollectResult", "Recipe", "collect", "load_recipe"]

COLLECT_FILE = "collect.json"  # fleet, seed and payloads of a collected dataset
MIN_TAKES_PER_JOB = 36  # fewer spend more time in numpy
MAX_TAKES_PER_JOB = 144  # more lose more when killed


@dataclass(frozen=True)
class CollectResult:
    """Recordings of virtual robots.

    Attributes:
        written: Recordings made now.
        present: Recordings that were there before.
        hours: Recorded time of `written`, h.
        seconds: Wall time.
    """

    dataset: Path
    written: int
    present: int
    hours: float
    seconds: float

    @property
    def times_real_time(self) -> float:
        """Recorded time over wall time."""
        return self.hours * 3600 / self.seconds if self.seconds > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {
            "virtual": True,
            "times_real_time": self.times_real_time,
            "dataset": str(self.dataset),
            "written": self.written,
            "present": self.present,
            "hours": self.hours,
            "wall_s": self.seconds,
        }


def collect(
    robot: RobotSpec,
    fleet: Fleet,
    recipe: Recipe,
    out: str | Path,
    seed: int = 0,
    nproc: int = 0,
    progress: Progress = no_progress,
    executor: str | Executor = LOCAL,
) -> CollectResult:
    """Record every take of a recipe that the dataset at `out` lacks, with its simulated replay and
    the fleet's gains.

    Arguments and errors as of gaponet.api.collect. No folder is shared with the executor.
    """
    start = time.monotonic()
    robot = robot.with_gain_scale(fleet.gain_scale or robot.servo.gain_scale)
    # Options of the command line may have changed the recipe.
    recipe = validated(Recipe, asdict(recipe), "recipe", UsageError)
    if not 0 <= nproc <= MAX_WORKERS or not 0 <= seed < 2**63:
        raise UsageError(
            f"--nproc {nproc}, --seed {seed}: up to {MAX_WORKERS} processes, 0 for one per core; "
            "seed ≥ 0"
        )
    for unit in recipe.units:
        fleet.unit(unit)  # refuses an unknown one
    files = tuple(read_motion(file, robot) for file in recipe.files)
    wanted = takes(recipe, library(robot, seed, recipe, files).names(recipe.variants))
    with lock_folder(Path(out), KIND):
        dataset = Dataset.create(out, robot)
        require_stored_robot(dataset.path, robot, DatasetError, MOVE_STORED_ROBOT)
        _require_same_source(dataset, robot, fleet, recipe, seed)
        missing = _missing(wanted, dataset)
        batches = _batches(missing, nproc or os.cpu_count() or 1)
        jobs = [Job(robot, fleet, recipe, files, seed, tuple(batch)) for batch in batches]
        # A run that was killed may have stored sequences without their replays.
        pair_dataset(dataset, robot, lock_idle=True)
        written = 0
        hours = 0.0
        recorded_s = 0.0
        for sequence, simulated in _play_jobs(jobs, nproc, executor):
            dataset.write_replay(dataset.append(sequence), simulated)
            written += 1
            recorded_s += sequence.duration
            hours = recorded_s / 3600
            note = f"{written} of {len(missing)}, {hours:.2f} h recorded"
            progress(written, len(missing), note)
    return CollectResult(
        dataset=Path(out),
        written=written,
        present=len(wanted) - len(missing),
        hours=hours,
        seconds=time.monotonic() - start,
    )


def fleet_name(dataset: Dataset) -> str:
    """Return the name of the fleet that a dataset was collected from.

    It is "hard" for a dataset that was not collected.
    """
    path = dataset.path / COLLECT_FILE
    if not path.is_file():
        return "hard"
    return str(_read_source(path).get("fleet", "hard"))


def _read_source(path: Path) -> dict[str, Any]:
    return read_json(
        dict[str, Any], path, DatasetError, "restore it or collect into another folder"
    )


class _Identity(NamedTuple):
    """What tells a take from the others of a dataset."""

    motion: str
    unit: str
    payload: float
    dt_ns: int
    repetition: int


def _missing(wanted: list[Take], dataset: Dataset) -> list[Take]:
    """Return the takes that a dataset lacks."""
    present = set()
    for entry in dataset.entries:
        meta = entry.meta
        dt_ns = round(entry.dt * 1e9)
        present.add(_Identity(meta.motion, meta.unit_id, meta.payload_mass, dt_ns, meta.repetition))
    missing = []
    for take in wanted:
        dt_ns = round(1 / take.rate * 1e9)
        identity = _Identity(take.motion, take.unit, take.payload, dt_ns, take.repetition)
        if identity not in present:
            missing.append(take)
    return missing


def _require_same_source(
    dataset: Dataset, robot: RobotSpec, fleet: Fleet, recipe: Recipe, seed: int
) -> None:
    """Write fleet, seed and payloads into a new dataset.

    Refuse a dataset that was recorded with others.
    """
    path = dataset.path / COLLECT_FILE
    source = {
        "virtual": True,
        "robot": robot.name,
        "fleet": fleet.name,
        "fleet_sha256": fleet.digest(),
        "seed": seed,
        "max_payload": max(recipe.payloads),
        "payload_side": recipe.payload_side,
    }
    if path.is_file():
        stored = _read_source(path)
        for key, value in source.items():
            if stored.get(key) != value:
                raise DatasetError(
                    f"{dataset.path}: was collected with {key} {stored.get(key)!r}, not {value!r} "
                    "(collect.json); choose another folder"
                )
    elif len(dataset):
        raise DatasetError(
            f"{dataset.path}: holds sequences that were not collected here; choose another folder"
        )
    else:
        write_text(path, json.dumps(source, indent=1) + "\n")


def _batches(missing: list[Take], nproc: int) -> Iterator[list[Take]]:
    """Yield takes of whole motions at one rate; a resumed run keeps their order."""
    groups: dict[tuple[float, str], list[Take]] = {}
    for take in missing:
        groups.setdefault((take.rate, take.motion), []).append(take)
    size = min(max(len(missing) // (4 * nproc), MIN_TAKES_PER_JOB), MAX_TAKES_PER_JOB)
    part: list[Take] = []
    for (rate, _), group in sorted(groups.items(), key=lambda item: item[0][0]):
        if part and (part[0].rate != rate or len(part) + len(group) > size):
            yield part
            part = []
        part = part + group
    if part:
        yield part


def _play_jobs(
    jobs: list[Job], nproc: int, executor: str | Executor
) -> Iterator[tuple[Sequence, SimulatedReplay]]:
    """Yield sequences and their replays in the order of the jobs."""
    if executor == LOCAL and (len(jobs) < 2 or (nproc or os.cpu_count() or 1) == 1):
        for job in jobs:
            yield from _play_job(job)
        return
    with open_pool(executor, nproc) as pool:
        for played in pool.map(_play_job, jobs):
            yield from played


def _play_job(job: Job) -> list[tuple[Sequence, SimulatedReplay]]:
    """Return the takes of a job and their replays with resting joints locked, on one core."""
    sequences = play(job)
    return list(
        zip(sequences, replay(sequences, job.robot, nthread=1, lock_idle=True), strict=True)
    )
