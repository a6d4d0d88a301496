"""The periods of a run in a file that grows: memory holds the last second, whatever else holds the file.

The file is NumPy's .npy with a row per period and a named column per number (qpos.elbow_flex), and can be read with
numpy.load at every moment of its growth, after a kill and on a full disk too: the head counts what is whole.
"""

from __future__ import annotations

import io
import os
import queue
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.files import atomic_write
from gaponet.hw.control.driver import State

CYCLES = ".cycles.npy"
CHUNK = 64  # rows written at once
READINGS = ("qpos", "qvel", "tau", "temperature")


class Row(NamedTuple):
    """One period: its start, phase, what was asked for and sent (n) rad (None: no position command), and the state."""

    time: float
    phase: str
    target: Array | None
    ctrl: Array | None
    state: State


class Rows:
    """Row after row; a thread writes them, so that no period waits for a disk.

    Attributes:
        trouble: Why no more rows are kept, where that is so.
    """

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        n = len(joint_names)
        scalars = [("time", "<f8"), ("state_time", "<f8"), ("tilt", "<f8"), ("refused", "<i8"), ("phase", "<U9")]
        vectors = ("target", "ctrl", *READINGS)
        self._kind = np.dtype([*scalars, *((name, "<f8", (n,)) for name in vectors)])
        self._head = scalars + [(f"{name}.{joint}", "<f8") for name in vectors for joint in joint_names]
        self._chunk, self._count, self._absent = np.empty(CHUNK, self._kind), 0, np.full(n, np.nan)
        self._file: IO[bytes] | None = None
        self.path: Path | None = None
        self.trouble: OSError | None = None
        self._written = 0  # rows in the file
        self._start = len(self._header(0))
        self._todo: queue.Queue[bytes | None] = queue.Queue()
        self._writer: threading.Thread | None = None

    def grow_in(self, folder: Path) -> None:
        """Where the file shall grow; else it is a temporary one, made when it is needed, that goes with the process.

        Raises:
            OSError: No file can be made there.
        """
        descriptor, name = tempfile.mkstemp(CYCLES, "unfinished-", folder)
        self.path = Path(name)
        self._open(os.fdopen(descriptor, "w+b", buffering=0))

    def append(self, row: Row) -> None:
        """Keep one more."""
        target, ctrl = (self._absent if x is None else x for x in (row.target, row.ctrl))
        state = row.state
        self._chunk[self._count % CHUNK] = (
            row.time, state.time, state.tilt, state.refused, row.phase, target, ctrl,
            *(getattr(state, name) for name in READINGS),
        )  # fmt: skip
        self._count += 1
        if self._count % CHUNK == 0:
            self._hand_over(CHUNK)

    def table(self) -> Array:
        """All rows that are kept, (rows,), with columns by name, (rows, n) those of joints; read from the file."""
        if self._file is None:
            return self._chunk[: self._count]
        self._flush()
        if not self._written:
            return self._chunk[:0]
        return np.memmap(self._file, self._kind, "r", self._start, (self._written,))

    def close(self) -> None:
        """No more rows come; a file without any goes."""
        if self._writer:
            self._flush()
            self._todo.put(None)
            self._writer.join()
            self._writer = None
            if self.path and not self._written:
                self.path.unlink()
                self.path = None

    def save(self, path: Path) -> None:
        """Make this the file's place; what grew elsewhere is copied."""
        self.close()
        if self.path is not None:
            os.replace(self.path, path)
            self.path = path
            return
        rows = self.table()
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            file.write(self._header(len(rows)))
            for at in range(0, len(rows), CHUNK):
                file.write(rows[at : at + CHUNK].tobytes())

    def _flush(self) -> None:
        if self._writer and self._count % CHUNK:
            self._hand_over(self._count % CHUNK)
            self._count += -self._count % CHUNK
        self._todo.join()

    def __len__(self) -> int:
        return len(self.table())

    def __iter__(self) -> Iterator[Row]:
        return (self._row(record) for record in self.table())

    def __getitem__(self, which: Any) -> Any:
        found = self.table()[which]
        return [self._row(record) for record in found] if isinstance(which, slice) else self._row(found)

    def _row(self, record: Any) -> Row:
        target, ctrl = (None if np.isnan(record[name]).all() else np.array(record[name]) for name in ("target", "ctrl"))
        qpos, qvel, tau, temperature = (np.array(record[name]) for name in READINGS)
        refused, tilt = int(record["refused"]), float(record["tilt"])
        state = State(float(record["state_time"]), qpos, qvel, tau, temperature, refused, tilt)
        return Row(float(record["time"]), str(record["phase"]), target, ctrl, state)

    def _hand_over(self, rows: int) -> None:
        if self._file is None:
            self._open(tempfile.TemporaryFile(buffering=0))  # noqa: SIM115
        self._todo.put(self._chunk[:rows].tobytes())

    def _open(self, file: Any) -> None:
        self._file = file
        os.pwrite(file.fileno(), self._header(0), 0)
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    def _write(self) -> None:
        assert self._file
        descriptor, size = self._file.fileno(), self._kind.itemsize
        while (data := self._todo.get()) is not None:
            at, begun = self._start + self._written * size, 0
            try:
                while begun < len(data) and not self.trouble:
                    begun += os.pwrite(descriptor, data[begun:], at + begun)
            except OSError as error:
                self.trouble = error
            self._written += begun // size
            os.pwrite(descriptor, self._header(self._written), 0)  # where it is already: no disk is too full for that
            self._todo.task_done()
        self._todo.task_done()

    def _header(self, rows: int) -> bytes:
        text = io.BytesIO()
        head = {"descr": self._head, "fortran_order": False, "shape": (rows,)}
        np.lib.format.write_array_header_1_0(text, head)
        return text.getvalue()
