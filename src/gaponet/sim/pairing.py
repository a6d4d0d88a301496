"""Give every sequence of a dataset its simulated twin."""

from __future__ import annotations

from gaponet.data.store import Dataset, Entry
from gaponet.robot import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Progress, replay

BATCH = 64  # sequences replayed together; what an interruption can cost


def pair_dataset(
    dataset: Dataset,
    robot: RobotSpec,
    progress: Progress | None = None,
    entries: list[Entry] | None = None,
    lock_idle: bool = False,
) -> int:
    """Replay the sequences that have no twin for this simulator yet, and store the twins; returns how many.

    All sequences, or only some; `lock_idle` as in replay.
    Twins are kept per simulator hash: changing a gain makes new ones and leaves the old.
    """
    dataset.require_robot(robot)
    digest = model_hash(robot)
    todo = sorted((e for e in entries or dataset.entries if not dataset.has_twin(e, digest)), key=lambda e: e.rows)
    if not todo:
        return 0
    with dataset.writing():
        _pair(dataset, robot, todo, progress, lock_idle)
    return len(todo)


def _pair(dataset: Dataset, robot: RobotSpec, todo: list[Entry], progress: Progress | None, lock_idle: bool) -> None:
    total, done = sum(e.rows - 1 for e in todo), 0
    for start in range(0, len(todo), BATCH):
        part = todo[start : start + BATCH]

        def tell(k: int, of: int, before: int = done) -> None:
            if progress is not None:
                progress(before + k, total)

        twins = replay(dataset.sequences(part), robot, progress=tell, lock_idle=lock_idle)
        for entry, twin in zip(part, twins, strict=True):
            dataset.write_twin(entry, twin)
        done += sum(e.rows - 1 for e in part)
