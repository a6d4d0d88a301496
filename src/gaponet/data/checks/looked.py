"""What was found in each recording, kept beside the dataset, so that one is looked at once; several in processes.

    surveys/<id>  a hash of what follows and of all that it was found from (recording, robot, this code); what `Survey`
                  holds; what `Standing` holds: each a line of JSON with names, types and shapes, and the numbers

A file of another hash is made again. Where nothing can be written, the files lie in a temporary folder. No lock is
needed: whoever writes one writes the same.
"""

from __future__ import annotations

import hashlib
import json
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

from gaponet.base.executor import LOCAL, open_pool
from gaponet.base.files import FOLDER_MARKER
from gaponet.base.progress import Progress
from gaponet.data.checks.touching import RATE, Heights, Standing
from gaponet.data.holds import Holds
from gaponet.data.offsets import Gravity
from gaponet.data.sequence import Sequence
from gaponet.data.signals import Response
from gaponet.data.store import SURVEYS, Dataset, Entry
from gaponet.data.survey import Survey, Torque
from gaponet.robot.spec import RobotSpec

OWN = 1500  # rows that take as long as what is done once for a recording
PART, MANY = 40_000, 600_000  # rows of a job, and from which processes are worth their start
SAMPLE = 300_000  # rows of standing arms in memory
PLACES = ("mjcf", "folder", "description", "nominal")  # of a robot: not what it is


class Looked:
    """What is found in a dataset's recordings.

    Attributes:
        sample: Rows of standing arms, SAMPLE at most, of every recording alike; none without model and heights.
    """

    def __init__(
        self, dataset: Dataset, robot: RobotSpec, model: Gravity | None, heights: Heights | None, simulator: str
    ) -> None:
        """Nothing is read yet; `simulator` is the hash of the model that gravity and heights are of."""
        self.dataset, self.stands = dataset, model is not None and heights is not None
        self._find = partial(_look, robot=robot, model=model, heights=heights)
        self._elsewhere: TemporaryDirectory[str] | None = None
        self._every = 1 + int(RATE * 3600 * dataset.hours() / SAMPLE)
        code = [p.read_bytes() for p in sorted(Path(__file__).parents[1].rglob("*.py"))]
        code += [(Path(__file__).parents[2] / "sim" / "dynamics.py").read_bytes(), np.__version__.encode()]
        known = [np.asarray(getattr(robot, f.name)).tolist() for f in fields(robot) if f.name not in PLACES]
        self._from = hashlib.sha256(b"\0".join([*code, repr((known, simulator, self.stands)).encode()]))
        self.sample: list[Standing] = []

    def surveys(self, progress: Progress, executor: str | Executor) -> list[Survey]:
        """One per recording: read where it is kept, made where it is new, by an executor if that is much."""
        entries, done = self.dataset.entries, 0
        surveys, sample = dict[str, Survey](), dict[str, Standing]()

        def take(entry: Entry, both: bytes) -> None:
            nonlocal done
            end = 8 + int.from_bytes(both[:8])
            surveys[entry.id], done = _survey(entry, both[8:end]), done + 1
            if self.stands:
                sample[entry.id] = Standing(**_unpacked(both[end:])).every(self._every)
            progress(done, len(entries), entry.meta.motion)

        todo = []
        for entry in entries:
            both = self._kept(entry)
            take(entry, both) if both is not None else todo.append(entry)
        for entry, both in self._new(todo, executor):
            self._keep(entry, both)
            take(entry, both)
        self.sample = [sample[e.id] for e in entries if self.stands]
        return [surveys[e.id] for e in entries]

    def standing(self) -> Iterator[Standing]:
        """All rows in which arms stand, one recording in memory at a time."""
        for entry in self.dataset.entries if self.stands else ():
            both = self._kept(entry) or self._find([(entry, self.dataset.read(entry))])[0]
            yield Standing(**_unpacked(both[8 + int.from_bytes(both[:8]) :]))

    def _new(self, todo: list[Entry], executor: str | Executor) -> Iterator[tuple[Entry, bytes]]:
        parts, size = list[list[Entry]](), PART
        for entry in todo:
            if size + entry.rows > PART:
                parts, size = [*parts, []], 0
            parts[-1].append(entry)
            size += entry.rows + OWN
        read = (zip(part, map(self.dataset.read, part), strict=True) for part in parts)
        if executor == LOCAL and (len(parts) < 2 or sum(e.rows + OWN for e in todo) < MANY):
            yield from ((pair[0], self._find([pair])[0]) for part in read for pair in part)
            return
        with open_pool(executor, 0, 1) as pool:
            for part, found in zip(parts, pool.map(self._find, map(list, read)), strict=True):
                yield from zip(part, found, strict=True)

    def _hash(self, entry: Entry, both: bytes) -> bytes:
        file, digest = self.dataset.path / "sequences" / f"{entry.id}.parquet", self._from.copy()
        state = os.stat(file) if file.is_file() else None  # of a dataset in a bucket there is none
        digest.update(repr((entry, state and (state.st_size, state.st_mtime_ns))).encode() + both)
        return digest.digest()

    def _kept(self, entry: Entry) -> bytes | None:
        for folder in (self.dataset.path / SURVEYS, *([Path(self._elsewhere.name)] if self._elsewhere else [])):
            with suppress(OSError):
                content = (folder / entry.id).read_bytes()
                if content[:32] == self._hash(entry, content[32:]):
                    return content[32:]
        return None

    def _keep(self, entry: Entry, both: bytes) -> None:
        """Without waiting for the disk: a file that a power cut took half of has another hash."""
        content = self._hash(entry, both) + both
        folder = Path(self._elsewhere.name) if self._elsewhere else self.dataset.path / SURVEYS
        temporary = folder / f"{FOLDER_MARKER}-{os.getpid()}-{entry.id}"
        try:
            folder.mkdir(exist_ok=True)
            temporary.write_bytes(content)
            os.replace(temporary, folder / entry.id)
        except OSError:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            if self._elsewhere is not None:
                raise
            self._elsewhere = TemporaryDirectory(prefix="gaponet-surveys-")
            self._keep(entry, both)


def _look(
    part: list[tuple[Entry, Sequence]], robot: RobotSpec, model: Gravity | None, heights: Heights | None
) -> list[bytes]:
    """What is kept of each."""
    found = []
    for entry, sequence in part:
        survey = _packed(Survey.of(entry, sequence, robot))
        stands = b"" if model is None or heights is None else _packed(Standing.of(sequence, robot, heights, model))
        found.append(len(survey).to_bytes(8) + survey + stands)
    return found


def _packed(found: object) -> bytes:
    arrays = {name: np.ascontiguousarray(x) if np.ndim(x) else np.array(x) for name, x in _leaves(found)}
    head = json.dumps({name: [x.dtype.str, x.shape] for name, x in arrays.items()})
    return b"\n".join([head.encode(), b"".join(x.tobytes() for x in arrays.values())])


def _leaves(found: object, within: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in vars(found).items():
        if is_dataclass(value) and not isinstance(value, Entry):
            yield from _leaves(value, f"{name}.")
        elif value is not None and not isinstance(value, Entry):
            yield within + name, value


def _unpacked(content: bytes) -> dict[str, Any]:
    """Arrays by name, views of the bytes."""
    head, found = json.loads(content[: (at := content.index(b"\n") + 1)]), {}
    for name, (kind, shape) in head.items():
        values = np.frombuffer(content, kind, int(np.prod(shape)), at).reshape(shape)
        found[name], at = values if shape else values.item(), at + values.nbytes
    return found


def _survey(entry: Entry, content: bytes) -> Survey:
    inner: dict[str, dict[str, Any]] = {"": {"entry": entry, "torque": None, "loads": None}}
    for name, value in _unpacked(content).items():
        of, _, field = name.rpartition(".")
        inner.setdefault(of, {})[field] = value
    for of, kind in (("torque", Torque), ("holds", Holds), ("response", Response)):
        if of in inner:
            inner[""][of] = kind(**inner[of])
    return Survey(**inner[""])
