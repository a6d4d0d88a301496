"""Rows of a recording: each period is appended to a file, so that memory holds about a second only.

The file is a NumPy .npy with one row per period and a named column per number (qpos.elbow_flex).
numpy.load can read it at any time, also after a kill or on a full disk: its header counts the
complete rows.
"""

from __future__ import annotations

import io
import os
import queue
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.files import atomic_write
from gaponet.hw.control.driver import State

ROWS_SUFFIX = ".cycles.npy"
CHUNK_ROWS = 64  # written at once
READINGS = ("qpos", "qvel", "tau", "temperature")


class Row(NamedTuple):
    """One period: its start, s, phase, target and command (n) rad (None: no position command), and
    state.
    """

    time: float
    phase: str
    target: Array | None
    ctrl: Array | None
    state: State


class Rows:
    """Appends rows; a thread writes them, so that no period waits for a disk.

    Attributes:
        path: Path of the file; None for a temporary one.
        error: Why no more rows are written; "" if they are.
    """

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        n = len(joint_names)
        scalars = [
            ("time", "<f8"),
            ("state_time", "<f8"),
            ("tilt", "<f8"),
            ("refused", "<i8"),
            ("phase", "<U9"),
        ]
        vectors = [(name, "<f8", (n,)) for name in ("target", "ctrl", *READINGS)]
        self._dtype = np.dtype([*scalars, *vectors])
        self._columns = list(scalars)
        for name, kind, _ in vectors:
            self._columns += [(f"{name}.{joint}", kind) for joint in joint_names]
        self._chunk = np.empty(CHUNK_ROWS, self._dtype)
        self._count = 0
        self._absent = np.full(n, np.nan)
        self._file: IO[bytes] | None = None
        self.path: Path | None = None
        self.error = ""
        self._written = 0  # rows in the file
        self._header_size = len(self._header(0))  # bytes
        self._pending: queue.Queue[bytes | None] = queue.Queue()
        self._writer: threading.Thread | None = None

    def write_to(self, folder: Path | None) -> None:
        """Make the file in a folder; None: a temporary one, which ends with the process.

        Without this call the first full chunk makes a temporary one.

        Raises:
            OSError: No file can be made there.
        """
        if folder is None:
            self._open(tempfile.TemporaryFile(buffering=0))  # noqa: SIM115
            return
        descriptor, name = tempfile.mkstemp(ROWS_SUFFIX, "unfinished-", folder)
        try:
            self._open(os.fdopen(descriptor, "w+b", buffering=0))
        except OSError:
            os.unlink(name)
            raise
        self.path = Path(name)

    def append(self, row: Row) -> None:
        """Append a row."""
        target = self._absent if row.target is None else row.target
        ctrl = self._absent if row.ctrl is None else row.ctrl
        state = row.state
        self._chunk[self._count % CHUNK_ROWS] = (
            row.time,
            state.time,
            state.tilt,
            state.refused,
            row.phase,
            target,
            ctrl,
            *(getattr(state, name) for name in READINGS),
        )
        self._count += 1
        if self._count % CHUNK_ROWS == 0:
            self._enqueue(CHUNK_ROWS)

    def table(self) -> Array:
        """Return all rows as a structured array (rows,); columns of joints are (rows, n).

        It is read from the file.
        """
        if self._file is None:
            return self._chunk[: self._count]
        self._flush()
        if not self._written:
            return self._chunk[:0]
        return np.memmap(self._file, self._dtype, "r", self._header_size, (self._written,))

    def wait_written(self) -> None:
        """Wait until all whole chunks are in the file."""
        self._pending.join()

    def close(self) -> None:
        """Finish writing; a file without any row is removed."""
        if self._writer:
            self._flush()
            self._pending.put(None)
            self._writer.join()
            self._writer = None
            if self.path and not self._written:
                self.path.unlink()
                self.path = None

    def save(self, path: Path) -> None:
        """Move the file to a path, or copy a temporary one."""
        self.close()
        if self.path is not None:
            self.path = self.path.replace(path)
            return
        rows = self.table()
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            file.write(self._header(len(rows)))
            for at in range(0, len(rows), CHUNK_ROWS):
                file.write(rows[at : at + CHUNK_ROWS].tobytes())

    def _flush(self) -> None:
        begun = self._count % CHUNK_ROWS  # rows of a chunk that is not full
        if self._writer and begun:
            self._enqueue(begun)
            self._count += CHUNK_ROWS - begun
        self._pending.join()

    def __len__(self) -> int:
        return len(self.table())

    def __iter__(self) -> Iterator[Row]:
        return (self._row(record) for record in self.table())

    def __getitem__(self, index: Any) -> Any:
        records = self.table()[index]
        if isinstance(index, slice):
            return [self._row(record) for record in records]
        return self._row(records)

    def _row(self, record: Any) -> Row:
        target = None if np.isnan(record["target"]).all() else np.array(record["target"])
        ctrl = None if np.isnan(record["ctrl"]).all() else np.array(record["ctrl"])
        qpos, qvel, tau, temperature = [np.array(record[name]) for name in READINGS]
        refused = int(record["refused"])
        tilt = float(record["tilt"])
        state = State(float(record["state_time"]), qpos, qvel, tau, temperature, refused, tilt)
        return Row(float(record["time"]), str(record["phase"]), target, ctrl, state)

    def _enqueue(self, rows: int) -> None:
        if self._file is None:
            self.write_to(None)
        self._pending.put(self._chunk[:rows].tobytes())

    def _open(self, file: Any) -> None:
        os.pwrite(file.fileno(), self._header(0), 0)
        self._file = file
        weakref.finalize(self, file.close)
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    def _write(self) -> None:
        assert self._file
        descriptor = self._file.fileno()
        size = self._dtype.itemsize
        while (data := self._pending.get()) is not None:
            at = self._header_size + self._written * size
            done = 0
            try:
                while done < len(data) and not self.error:
                    done += os.pwrite(descriptor, data[done:], at + done)
            except OSError as error:
                self.error = error.strerror or str(error)
            except Exception as error:  # of any kind, or who waits for the rows waits for ever
                self.error = repr(error)
            self._written += done // size
            # Overwrites, which works on a full disk unless its file system copies.
            with suppress(Exception):
                os.pwrite(descriptor, self._header(self._written), 0)
            self._pending.task_done()
        self._pending.task_done()

    def _header(self, rows: int) -> bytes:
        text = io.BytesIO()
        header = {"descr": self._columns, "fortran_order": False, "shape": (rows,)}
        np.lib.format.write_array_header_1_0(text, header)
        return text.getvalue()
