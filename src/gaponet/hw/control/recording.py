"""Recording: every period of a controller, what it read, sent and why; as a Log of the motion, and as files."""

from __future__ import annotations

import itertools
import json
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.data.formats.table import NOT_OBEYED
from gaponet.data.log import Channel, Log
from gaponet.hw.control.rows import CYCLES, READINGS, Rows
from gaponet.hw.control.safety import FAULTS


class Event(NamedTuple):
    """A change of phase: when (s, monotonic), into which, and why."""

    time: float
    phase: str
    kind: str
    text: str


@dataclass
class Recording:
    """What a controller did.

    Attributes:
        virtual: Whether there was no real robot.
        joint_names: All joints, (n).
        dt: Control period, s.
        rows, events: In order of time.
        missed: Periods in which the loop did not start at all.
        late: How late each period started, s.
        meta: What the caller knows beside (unit, payload, gains, model).
        not_obeyed: What the robot did not do as it was told; a recording with such a mark is no data.
    """

    robot: str
    virtual: bool
    joint_names: tuple[str, ...]
    commanded: tuple[str, ...]
    dt: float
    events: list[Event] = field(default_factory=list)
    missed: int = 0
    late: array[float] = field(default_factory=lambda: array("d"))
    meta: dict[str, Any] = field(default_factory=dict)
    not_obeyed: str = ""

    def __post_init__(self) -> None:
        self.rows = Rows(self.joint_names)

    def grow_in(self, folder: Path) -> None:
        """Where the periods shall be written as they come, to be saved there; before the first one.

        Raises:
            FolderError, OSError: Nothing can be written there.
        """
        with lock_folder(folder, KIND):
            self.rows.grow_in(folder)

    @property
    def fault(self) -> Event | None:
        """The fault that ended it, if one did."""
        return next((e for e in self.events if e.kind in FAULTS), None)

    def log(self, source: str = "controller", phase: str = "run") -> Log:
        """The periods of a phase as a Log of the commanded joints, time from its first period, s.

        A row is what to_sequence wants: the state read at the start of a period, and the command sent in it.

        Raises:
            LogError: The robot did not obey, or the phase was not reached or has fewer than two periods, or the disk
                was too full for all.
        """
        if self.not_obeyed:
            raise LogError(f"{source}: no data, the robot did not do what it was told: {self.not_obeyed}")
        if self.rows.trouble:
            raise LogError(f"{source}: not whole, {self.rows.trouble.strerror}; make room and record again")
        return self._log(source, phase)

    def _log(self, source: str, phase: str = "run") -> Log:
        rows = self.during(phase)
        if len(rows) < 2:
            last = self.events[-1] if self.events else None
            why = f"; it ended with: {last.text}" if last else ""
            raise LogError(f"{source}: {len(rows)} periods of phase '{phase}', nothing to learn from{why}")
        at = [self.joint_names.index(name) for name in self.commanded]
        time, values = np.array(rows["time"]), {"ctrl": rows["ctrl"][:, at]}
        for name in READINGS:
            column = rows[name][:, at]
            if np.isfinite(column).all():  # a bus without thermometers, say
                values[name] = column
        channels = {name: Channel(time - time[0], value) for name, value in values.items()}
        return Log(self.robot, self.commanded, channels, source, {"files": {}, **self.summary()})

    def during(self, phase: str) -> Array:
        """The periods of a phase in which a position was commanded, as of Rows.table."""
        table = self.rows.table()
        found = np.flatnonzero((table["phase"] == phase) & ~np.isnan(table["ctrl"]).all(axis=1))
        if len(found) and found[-1] - found[0] + 1 == len(found):  # as it is: nothing is copied
            return table[found[0] : found[-1] + 1]
        return table[found]

    def summary(self) -> dict[str, Any]:
        """Phases, reasons and timing, for JSON; times from the first period, s."""
        table = self.rows.table()
        start = table["time"][0] if len(table) else 0.0
        late = np.array(self.late or [0.0])
        ages = table["time"] - table["state_time"] if len(table) else np.zeros(1)
        trouble = {"not_whole": self.rows.trouble.strerror} if self.rows.trouble else {}
        return (
            trouble
            | self.meta
            | {
                "robot": self.robot,
                "virtual": self.virtual,
                "obeyed": not self.not_obeyed,
                "rate_hz": 1 / self.dt,
                "periods": len(table),
                "missed": self.missed,
                "late_ms": {q: round(float(np.quantile(late, p)) * 1e3, 3) for q, p in QUANTILES.items()},
                "state_age_ms": {q: round(float(np.quantile(ages, p)) * 1e3, 3) for q, p in QUANTILES.items()},
                "refused_messages": int(table["refused"][-1]) if len(table) else 0,
                "events": [[round(e.time - start, 4), e.phase, e.kind, e.text] for e in self.events],
            }
        )

    def save(self, folder: Path, name: str) -> Path:
        """NAME.parquet for gaponet import (if the run was reached), all periods in NAME.cycles.npy, and NAME.json.

        Where there is a recording of that name, this one is NAME-2, and so on. Returns the path of NAME.parquet.

        Raises:
            OSError: A file could not be written; the periods that grew in this folder are kept all the same.
        """
        with lock_folder(folder, KIND):
            return self._save(folder, name)

    def _save(self, folder: Path, name: str) -> Path:
        import pyarrow as pa
        import pyarrow.parquet as pq

        taken = {file.name.removesuffix(end) for end in (".json", CYCLES) for file in folder.glob(f"*{end}")}
        name = next(n for k in itertools.count(1) if (n := f"{name}-{k}" if k > 1 else name) not in taken)
        self.rows.save(folder / f"{name}{CYCLES}")
        path = folder / f"{name}.parquet"
        try:
            if len(self.during("run")) >= 2:
                log = self._log(str(path))
                columns = {"time": log.channels["ctrl"].time}
                for channel, (_, values) in log.channels.items():
                    columns |= {f"{channel}.{j}": values[:, i] for i, j in enumerate(log.joint_names)}
                table = pa.table(columns, metadata={NOT_OBEYED: self.not_obeyed} if self.not_obeyed else None)
                with atomic_write(path) as temporary:
                    pq.write_table(table, temporary)
            write_text(folder / f"{name}.json", json.dumps(self.summary(), indent=1, ensure_ascii=False) + "\n")
        except OSError as error:
            kept = f"{error.strerror or error}; all periods that were written are in {name}{CYCLES}"
            raise OSError(error.errno, kept, error.filename) from error
        return path


KIND = "recordings"
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
