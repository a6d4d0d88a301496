"""Record a recipe on a virtual fleet into a dataset, on all cores, and go on where a killed run stopped.

Every sequence is a function of seed, fleet, motion, unit, payload, rate and repetition alone: a recipe that was
interrupted is continued by running it again, and ends with the same samples as one that was not.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gaponet.base.errors import DatasetError, UsageError
from gaponet.base.executor import LOCAL, MAX_WORKERS, Pool, open_pool
from gaponet.base.files import lock_folder, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.base.structure import read_json, validated
from gaponet.data.pair import Twin
from gaponet.data.sequence import Sequence
from gaponet.data.store import KIND, Dataset
from gaponet.robot.folder import MOVE_STORED_ROBOT
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import require_stored_robot
from gaponet.sim.replay import pair_dataset, replay
from gaponet.sysid.motion.files import read_motion
from gaponet.sysid.motion.recipe import Recipe, Take, load_recipe, takes
from gaponet.testing.fleet import Fleet
from gaponet.testing.play import Job, library, play

__all__ = ["Collected", "Recipe", "collect", "load_recipe"]

CLAIM, HARD = "collect.json", "hard"
ROWS = (36, 144)  # takes recorded together: enough to make numpy's share small, few enough to lose little when killed


@dataclass(frozen=True)
class Collected:
    dataset: str
    written: int
    present: int  # takes that were there before
    hours: float  # recorded now
    wall_s: float

    @property
    def times_real_time(self) -> float:
        """Recorded time over wall time."""
        return self.hours * 3600 / self.wall_s if self.wall_s > 0 else 0.0


def collect(
    robot: RobotSpec,
    fleet: Fleet,
    recipe: Recipe,
    out: str | Path,
    seed: int = 0,
    nproc: int = 0,
    progress: Progress = no_progress,
    twins: bool = True,
    executor: str | Executor = LOCAL,
) -> Collected:
    """Record every take of a recipe that the dataset at `out` does not hold yet, with the gains that the fleet sets.

    Args:
        seed: Seed of motions and of everything random in a take.
        nproc: Processes; 0 for one per core, 1 for none beside this one. More than one starts fresh interpreters: a
            script that calls this needs `if __name__ == "__main__":`.
        twins: Store the nominal twin of each sequence beside it, limbs that stand still locked in both.
        executor: Where it is played (gaponet.base.executor); recordings come back by themselves, no folder is shared.

    Raises:
        UsageError: The recipe names a motion, unit or file that does not exist.
        DatasetError: `out` is another robot's, or holds what something else recorded.
        FolderError: `out` is something else, or another process writes into it.
    """
    start = time.monotonic()
    robot = robot.with_gain_scale(fleet.gain_scale or robot.gain_scale)
    recipe = validated(Recipe, asdict(recipe), "recipe", UsageError)  # options may have changed it
    if not 0 <= nproc <= MAX_WORKERS or not 0 <= seed < 2**63:
        raise UsageError(f"--nproc {nproc}, --seed {seed}: up to {MAX_WORKERS} processes, 0 for one per core; seed ≥ 0")
    for unit in recipe.units:
        fleet.unit(unit)
    files = tuple(read_motion(file, robot) for file in recipe.files)
    wanted = takes(recipe, library(robot, seed, recipe, files).names(recipe.variants))
    with lock_folder(Path(out), KIND):
        dataset = Dataset.create(out, robot)
        require_stored_robot(dataset.path, robot, DatasetError, MOVE_STORED_ROBOT)
        _claim(dataset, robot, fleet, recipe, seed)
        present = {
            _key(e.meta.motion, e.meta.unit_id, e.meta.payload_mass, e.dt, e.meta.repetition) for e in dataset.entries
        }
        missing = [t for t in wanted if _key(t.motion, t.unit, t.payload, 1 / t.rate, t.repetition) not in present]
        written, seconds = 0, 0.0
        jobs = [Job(robot, fleet, recipe, files, seed, tuple(part)) for part in _parts(missing, nproc or Pool.cores(1))]
        if twins:
            pair_dataset(dataset, robot, lock_idle=True)  # those that a killed run had no time for
        for sequence, twin in _record(jobs, nproc, twins, executor):
            entry = dataset.append(sequence)
            if twin is not None:
                dataset.write_twin(entry, twin)
            written += 1
            seconds += sequence.duration
            progress(written, len(missing), f"{written} of {len(missing)}, {seconds / 3600:.2f} h recorded")
    return Collected(str(out), written, len(wanted) - len(missing), seconds / 3600, time.monotonic() - start)


def fleet_of(dataset: Dataset) -> str:
    """Name of the fleet that a dataset was collected from; `hard` where it was not collected here."""
    path = dataset.path / CLAIM
    return str(_claimed(path).get("fleet", HARD)) if path.is_file() else HARD


def _claimed(path: Path) -> dict[str, Any]:
    return read_json(dict[str, Any], path, DatasetError, "restore it or collect into another folder")


def _key(motion: str, unit: str, payload: float, dt: float, repetition: int) -> tuple[object, ...]:
    """What a sequence is, apart from its samples; two of the same key would be the same recording."""
    return motion, unit, payload, round(dt * 1e9), repetition


def _claim(dataset: Dataset, robot: RobotSpec, fleet: Fleet, recipe: Recipe, seed: int) -> None:
    """Write beside the data what made it; refuse to mix it with what something else made."""
    path = dataset.path / CLAIM
    mine = {
        "virtual": True,
        "robot": robot.name,
        "fleet": fleet.name,
        "fleet_sha256": fleet.digest(),
        "seed": seed,
        "max_payload": max(recipe.payloads),
        "payload_side": recipe.payload_side,
    }
    if path.is_file():
        theirs = _claimed(path)
        for key, value in mine.items():
            if theirs.get(key) != value:
                raise DatasetError(
                    f"{dataset.path}: was collected with {key} {theirs.get(key)!r}, not {value!r} (collect.json); "
                    "choose another folder"
                )
    elif len(dataset):
        raise DatasetError(f"{dataset.path}: holds sequences that were not collected here; choose another folder")
    else:
        write_text(path, json.dumps(mine, indent=1) + "\n")


def _parts(missing: list[Take], nproc: int) -> Iterator[list[Take]]:
    """Whole motions at one rate together; fewer of them towards the end, so that no process waits long for the last."""
    by_rate: dict[float, dict[str, list[Take]]] = {}
    for take in missing:
        by_rate.setdefault(take.rate, {}).setdefault(take.motion, []).append(take)
    left = len(missing)
    for _, motions in sorted(by_rate.items()):  # by rate, so that a resumed run keeps the order
        part: list[Take] = []
        for group in motions.values():
            if part and len(part) + len(group) > min(max(left // (2 * nproc), ROWS[0]), ROWS[1]):
                yield part
                left -= len(part)
                part = []
            part = part + group
        if part:
            yield part
            left -= len(part)


def _record(
    jobs: list[Job], nproc: int, twins: bool, executor: str | Executor
) -> Iterator[tuple[Sequence, Twin | None]]:
    """Sequences in the jobs' order, whichever worker is first."""
    work = partial(_played, twins=twins)
    if executor == LOCAL and (len(jobs) < 2 or (nproc or Pool.cores(1)) == 1):
        for job in jobs:
            yield from work(job)
        return
    with open_pool(executor, nproc, 1) as pool:
        for played in pool.map(work, jobs):
            yield from played


def _played(job: Job, twins: bool) -> list[tuple[Sequence, Twin | None]]:
    """The takes of a job and their twins, on one core."""
    sequences = play(job)
    if not twins:
        return [(s, None) for s in sequences]
    return list(zip(sequences, replay(sequences, job.robot, nthread=1, lock_idle=True), strict=True))
