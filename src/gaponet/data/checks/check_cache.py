"""Surveys of a dataset's sequences: measured once, in several processes if there are many, and stored beside the data.

surveys/<id>.npz holds one structured array with the fields of `Survey`, and a key: the hash of the recording, the robot
and this code. A file with another key, or a damaged one, is replaced. If the dataset is read-only, the files are in a
temporary folder. No lock is needed, because every writer writes the same content.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.base.executor import LOCAL, open_pool
from gaponet.base.files import FOLDER_MARKER
from gaponet.base.progress import Progress
from gaponet.base.structure import read_npz
from gaponet.data.checks.survey import Survey, Torque
from gaponet.data.sequence import Sequence
from gaponet.data.signals import Response
from gaponet.data.static_poses import StaticPoses
from gaponet.data.store import SURVEYS, Dataset, Entry
from gaponet.robot.spec import RobotSpec

OVERHEAD_ROWS = 1500  # rows that take as long as the fixed costs of a recording
JOB_ROWS, MIN_PARALLEL_ROWS = 40_000, 600_000  # of one job; from which starting processes pays
PLACES = ("mjcf", "folder", "description", "nominal")  # fields of a robot that do not change a survey
NESTED = {"torque": Torque, "static_poses": StaticPoses, "response": Response}


class CheckCache:
    """Reads stored surveys of a dataset, and measures and stores the others."""

    def __init__(self, dataset: Dataset, robot: RobotSpec) -> None:
        """Nothing is read yet."""
        self.dataset, self.robot = dataset, robot
        code = [p.read_bytes() for p in sorted(Path(__file__).parents[1].rglob("*.py"))]
        values = [np.asarray(getattr(robot, f.name)).tolist() for f in fields(robot) if f.name not in PLACES]
        self._version = hashlib.sha256(b"\0".join([*code, np.__version__.encode(), repr(values).encode()]))
        self._folder = dataset.path / SURVEYS
        self._temporary: TemporaryDirectory[str] | None = None  # if the folder is read-only

    def surveys(self, progress: Progress, executor: str | Executor) -> list[Survey]:
        """Return one survey per sequence, in the order of the dataset's entries.

        Args:
            executor: Measures new sequences, if there are many.

        Raises:
            WorkerError: Workers of the executor died.
        """
        entries = self.dataset.entries
        surveys = {e.id: survey for e in entries if (survey := self._read(e)) is not None}
        progress(len(surveys), len(entries), "")
        for entry, survey in self._measure([e for e in entries if e.id not in surveys], executor):
            self._write(entry, survey)
            surveys[entry.id] = survey
            progress(len(surveys), len(entries), entry.meta.motion)
        return [surveys[e.id] for e in entries]

    def _measure(self, entries: list[Entry], executor: str | Executor) -> Iterator[tuple[Entry, Survey]]:
        jobs, rows = list[list[Entry]](), JOB_ROWS
        for entry in entries:
            if rows + entry.rows > JOB_ROWS:
                jobs, rows = [*jobs, []], 0
            jobs[-1].append(entry)
            rows += entry.rows + OVERHEAD_ROWS
        loaded = (list(zip(job, map(self.dataset.read, job), strict=True)) for job in jobs)
        measure = partial(_survey_all, robot=self.robot)
        if executor == LOCAL and (len(jobs) < 2 or sum(e.rows + OVERHEAD_ROWS for e in entries) < MIN_PARALLEL_ROWS):
            for entry in entries:
                yield entry, Survey.of(entry, self.dataset.read(entry), self.robot)
            return
        with open_pool(executor, 0, 1) as pool:
            for job, surveys in zip(jobs, pool.map(measure, loaded), strict=True):
                yield from zip(job, surveys, strict=True)

    def _key(self, entry: Entry) -> str:
        file, digest = self.dataset.path / "sequences" / f"{entry.id}.parquet", self._version.copy()
        state = os.stat(file) if file.is_file() else None  # a dataset in a bucket has no file
        digest.update(entry.line + repr(state and (state.st_size, state.st_mtime_ns)).encode())
        return digest.hexdigest()

    def _read(self, entry: Entry) -> Survey | None:
        with suppress(DatasetError, OSError):
            record = read_npz(self._folder / f"{entry.id}.npz", DatasetError)["survey"]
            if record["key"] == self._key(entry):
                return _survey_from(entry, record)
        return None

    def _write(self, entry: Entry, survey: Survey) -> None:
        """Store a survey without syncing: a file that a power cut damages has a wrong checksum."""
        temporary = self._folder / f"{FOLDER_MARKER}-{os.getpid()}-{entry.id}.npz"
        try:
            self._folder.mkdir(exist_ok=True)
            np.savez(temporary, survey=_record(survey, self._key(entry)))
            os.replace(temporary, self._folder / f"{entry.id}.npz")
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            if self._temporary is not None:
                raise
            self._temporary = TemporaryDirectory(prefix="gaponet-surveys-")
            self._folder = Path(self._temporary.name)
            self._write(entry, survey)


def _survey_all(part: list[tuple[Entry, Sequence]], robot: RobotSpec) -> list[Survey]:
    return [Survey.of(entry, sequence, robot) for entry, sequence in part]


def _record(survey: Survey, key: str) -> Array:
    """Return a survey as a structured array; fields of nested classes are called class.field."""
    values: dict[str, Array] = {"key": np.array(key)}
    for name, value in vars(survey).items():
        nested = {f"{name}.{k}": v for k, v in vars(value).items()} if is_dataclass(value) else {name: value}
        values |= {k: np.asarray(v) for k, v in nested.items() if v is not None and name != "entry"}
    record = np.zeros((), [(k, v.dtype, v.shape) for k, v in values.items()])
    for k, v in values.items():
        record[k] = v
    return record


def _survey_from(entry: Entry, record: Array) -> Survey:
    values: dict[str, Any] = {"entry": entry, "gravity_samples": None}
    nested: dict[str, dict[str, Any]] = {}
    for name in record.dtype.names or ():
        value = record[name] if record[name].shape else record[name].item()
        owner, _, field = name.rpartition(".")
        (nested.setdefault(owner, {}) if owner else values)[field] = value
    del values["key"]
    objects = {owner: NESTED[owner](**of_class) for owner, of_class in nested.items()}
    return Survey(**{"torque": None, **values, **objects})
