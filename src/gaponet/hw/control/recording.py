"""Recording of a run: readings, commands and events of every period, as a Log of the motion and as
files.
"""

from __future__ import annotations

import json
from array import array
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet import __version__
from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError, LogError, UnsavedError, UsageError
from gaponet.base.files import atomic_write, lock_folder, write_text
from gaponet.data.formats.table import NOT_OBEYED, SI_UNITS
from gaponet.data.log import Channel, Log
from gaponet.hw.control.phases import Phase
from gaponet.hw.control.rows import READINGS, ROWS_SUFFIX, Rows
from gaponet.hw.control.safety import FAULT_KINDS

FOLDER_KIND = "recordings"
# of a motion or unit: both are in one file's name, of which file systems take 255
MAX_NAME_BYTES = 100
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


class Event(NamedTuple):
    """Change of phase: its time (s, monotonic), the new phase, kind of fault or end, and reason."""

    time: float
    phase: str
    kind: str
    text: str


@dataclass
class Recording:
    """Record of one run of a controller.

    Attributes:
        robot: Name of the robot.
        virtual: True without a real robot.
        joint_names: All joints, (n).
        commanded: The commanded ones.
        dt: Control period, s.
        events: In order of time.
        missed: Number of periods in which the loop did not start at all.
        late: How late each period started, s.
        meta: Further values of the caller (unit id, payload, gains, model).
        disobedience: How the robot disobeyed, in words; such a recording is no data. Empty if it
            obeyed.
        rows: Readings and commands of every period.
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
    disobedience: str = ""
    rows: Rows = field(init=False)

    def __post_init__(self) -> None:
        self.rows = Rows(self.joint_names)

    def write_to(self, folder: Path | None) -> None:
        """Write the periods to a file in a folder as they come; None: to a temporary file. Call it
        before the first period.

        Raises:
            FolderError, OSError: Nothing can be written there.
        """
        if folder is None:
            self.rows.write_to(None)
            return
        with lock_folder(folder, FOLDER_KIND):
            self.rows.write_to(folder)

    @property
    def fault(self) -> Event | None:
        """Return the fault that ended the run, or None."""
        return next((e for e in self.events if e.kind in FAULT_KINDS), None)

    @property
    def ending(self) -> str:
        """Return why the run ended: its fault, else its last event. Empty: it did not begin."""
        if self.fault is not None:
            return self.fault.text
        return self.events[-1].text if self.events else ""

    def log(self, source: str = "controller") -> Log:
        """Return the periods of the phase `run` as a Log of the commanded joints.

        Its time begins with them, s.

        A row has the state read at the start of a period and the command sent in it, as to_sequence
        requires.

        Raises:
            LogError: The robot did not obey; the phase has fewer than two periods; or the disk was
                full.
        """
        if self.disobedience:
            raise LogError(
                f"{source}: no data, the robot did not do what it was told: {self.disobedience}"
            )
        if self.rows.error:
            raise LogError(f"{source}: not whole, {self.rows.error}; make room and record again")
        return self._log(source)

    def _log(self, source: str) -> Log:
        rows = self.run_rows()
        if len(rows) < 2:
            why = f"; it ended with: {self.ending}" if self.ending else ""
            raise LogError(
                f"{source}: {len(rows)} periods of phase 'run', nothing to learn from{why}"
            )
        at = [self.joint_names.index(name) for name in self.commanded]
        time = np.array(rows["time"])
        values = {"ctrl": rows["ctrl"][:, at]}
        for name in READINGS:
            column = rows[name][:, at]
            if np.isfinite(column).all():  # not every bus measures all of them
                values[name] = column
        channels = {name: Channel(time - time[0], value) for name, value in values.items()}
        return Log(self.robot, self.commanded, channels, source, {"files": {}, **self.summary()})

    def run_rows(self) -> Array:
        """Return the rows of Rows.table of phase run in which a position was commanded."""
        table = self.rows.table()
        at = np.flatnonzero((table["phase"] == "run") & ~np.isnan(table["ctrl"]).all(axis=1))
        if len(at) and at[-1] - at[0] + 1 == len(at):  # a slice, which copies nothing
            return table[at[0] : at[-1] + 1]
        return table[at]

    def summary(self) -> dict[str, Any]:
        """Return events and timing for JSON; times begin with the first period, s."""
        table = self.rows.table()
        start = table["time"][0] if len(table) else 0.0
        late = np.array(self.late or [0.0])
        ages = table["time"] - table["state_time"] if len(table) else np.zeros(1)
        events = []
        for event in self.events:
            events.append([round(event.time - start, 4), event.phase, event.kind, event.text])
        incomplete = {"not_whole": self.rows.error} if self.rows.error else {}
        facts = {
            "gaponet": __version__,
            "robot": self.robot,
            "virtual": self.virtual,
            "obeyed": not self.disobedience,
            "rate_hz": 1 / self.dt,
            "periods": len(table),
            "missed": self.missed,
            "late_ms": _quantiles_ms(late),
            "state_age_ms": _quantiles_ms(ages),
            "refused_messages": int(table["refused"][-1]) if len(table) else 0,
            "events": events,
        }
        return incomplete | self.meta | facts

    def save(self, folder: Path, name: str) -> Path:
        """Write NAME.parquet for gaponet import, all periods as NAME.cycles.npy, and NAME.json.

        NAME.parquet is written if the phase `run` was reached. If NAME exists, NAME-2 is used, and
        so on.

        Returns:
            The path of NAME.parquet.

        Raises:
            UnsavedError: A file could not be written; the periods written so far stay in the
                folder.
        """
        try:
            return self._write(folder, name)
        except (OSError, GAPONetError) as error:
            reason = error.strerror if isinstance(error, OSError) else ""
            raise UnsavedError(self._describe_unsaved(folder, reason or str(error))) from error

    def _describe_unsaved(self, folder: Path, reason: str) -> str:
        """Return in words whether the robot moved, and where the rows are that were written."""
        has_moved = any(event.phase == Phase.BLEND_IN for event in self.events)
        happened = "the robot has moved" if has_moved else "nothing was commanded"
        place = "no rows were written"
        if self.rows.path is not None:
            place = f"the rows that were written are in {self.rows.path} (numpy.load reads it)"
        return f"{happened}, and the recording could not be saved in {folder}: {reason}; {place}"

    def _write(self, folder: Path, name: str) -> Path:
        """Write the files of `save`."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        with lock_folder(folder, FOLDER_KIND):
            name = _free_name(folder, name)
            self.rows.save(folder / f"{name}{ROWS_SUFFIX}")
            path = folder / f"{name}.parquet"
            if len(self.run_rows()) >= 2:
                log = self._log(str(path))
                columns = {"time": log.channels["ctrl"].time}
                for channel, (_, values) in log.channels.items():
                    for i, joint in enumerate(log.joint_names):
                        columns[f"{channel}.{joint}"] = values[:, i]
                metadata = {SI_UNITS: "s, rad"}
                if self.disobedience:
                    metadata[NOT_OBEYED] = self.disobedience
                table = pa.table(columns, metadata=metadata)
                with atomic_write(path) as temporary:
                    pq.write_table(table, temporary)
            saved = datetime.now().astimezone().isoformat(timespec="seconds")
            facts = {"saved": saved} | self.summary()
            text = json.dumps(facts, indent=1, ensure_ascii=False)
            write_text(folder / f"{name}.json", text + "\n")
            return path


def require_file_name(name: str, what: str) -> None:
    """Refuse a name that cannot be part of a recording's file name.

    Call it before a robot moves: afterwards its recording could not be saved.

    Args:
        name: Of a motion or unit.
        what: What it names, or its option, for the message.

    Raises:
        UsageError: It has /, \\, .. or a control character, or is too long.
    """
    has_path = any(part in name for part in ("/", "\\", ".."))
    if has_path or not name.isprintable():
        raise UsageError(
            f"{what} {name!r} becomes part of a file's name; leave out /, \\, .. and control "
            "characters"
        )
    if len(name.encode()) > MAX_NAME_BYTES:
        raise UsageError(
            f"{what} {name!r} is longer than {MAX_NAME_BYTES} bytes; choose a shorter one"
        )


def _quantiles_ms(seconds: Array) -> dict[str, float]:
    """Return the quantiles of some durations, s, in ms."""
    quantiles = {}
    for name, share in QUANTILES.items():
        quantiles[name] = round(float(np.quantile(seconds, share)) * 1e3, 3)
    return quantiles


def _free_name(folder: Path, name: str) -> str:
    """Return a name under which no recording lies in a folder: name, name-2, and so on."""
    taken = set()
    for suffix in (".json", ROWS_SUFFIX):
        for file in folder.glob(f"*{suffix}"):
            taken.add(file.name.removesuffix(suffix))
    free = name
    number = 1
    while free in taken:
        number += 1
        free = f"{name}-{number}"
    return free
