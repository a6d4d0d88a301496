"""Windows: training batches of short stretches drawn at random from a dataset of any size, in bounded memory."""

from __future__ import annotations

import os

import numpy as np

from gaponet.data.store import Dataset, Entry
from gaponet.data.window_cache import CHANNELS, DTYPE, Progress, window_cache
from gaponet.errors import DatasetError, UsageError

Array = np.ndarray


class Windows:
    """Stretches of `length` rows that lie within one sequence, each as likely as any other.

    Rows come from the window cache. A cache of up to `resident` bytes is mapped: a batch is one gather. Mapped pages
    count as memory of this process, so a larger cache is read piece by piece: slower, and of any size.
    """

    def __init__(
        self,
        dataset: Dataset,
        joints: tuple[str, ...],
        entries: list[Entry] | None = None,
        progress: Progress | None = None,
        resident: int = 1 << 30,
    ) -> None:
        """Open the cache of these joints, making it first where it is missing.

        Args:
            dataset: Where the sequences are.
            joints: Which joints, (n), usually RobotSpec.operated.
            entries: Draw from these only, e.g. one part of a split; default all.
            progress: Called with sequences done, total and the motion while the cache is made.
            resident: Largest cache to map, bytes.
        """
        self.joints = joints
        self.entries = dataset.entries if entries is None else entries
        ends = np.cumsum([e.rows for e in dataset.entries])
        first = {e.hash: int(end) - e.rows for e, end in zip(dataset.entries, ends, strict=True)}
        self._first = np.array([first[e.hash] for e in self.entries], np.int64)
        self._rows = np.array([e.rows for e in self.entries], np.int64)
        self._payload = np.array([e.meta.payload_mass for e in self.entries], np.float32)
        self._dt = np.array([e.dt for e in self.entries], np.float32)
        path = window_cache(dataset, joints, progress)
        self._file = path.open("rb", buffering=0)
        self._width = len(CHANNELS) * len(joints)
        small = path.stat().st_size <= resident
        self._mapped = np.asarray(np.memmap(path, DTYPE, "r")).reshape(-1, self._width) if small else None

    def count(self, length: int) -> int:
        """How many different windows of this length there are."""
        return int(np.maximum(self._rows - length + 1, 0).sum())

    def batch(self, rng: np.random.Generator, size: int, length: int) -> dict[str, Array]:
        """Draw windows.

        Args:
            rng: Decides which.
            size: How many, B.
            length: Rows of each, L.

        Returns:
            ctrl, qpos, qvel (B, L, n), rad, rad, rad/s, views of one array; payload_mass (B), kg; dt (B), s;
            entry (B), places in `entries`; row (B), where in its sequence a window starts.

        Raises:
            UsageError: No sequence is that long.
        """
        starts = np.maximum(self._rows - length + 1, 0)
        ends = starts.cumsum()
        if length < 1 or not len(ends) or ends[-1] == 0:
            raise UsageError(
                f"windows of {length} rows: the longest of {len(self._rows)} sequences has "
                f"{self._rows.max(initial=0)}; use between 1 and that"
            )
        draw = rng.integers(ends[-1], size=size)
        entry = np.searchsorted(ends, draw, side="right")
        row = draw - (ends[entry] - starts[entry])
        frames = self._read(self._first[entry] + row, length)
        parts = np.split(frames, len(CHANNELS), axis=2)
        return dict(zip(CHANNELS, parts, strict=True)) | {
            "payload_mass": self._payload[entry], "dt": self._dt[entry], "entry": entry, "row": row,
        }  # fmt: skip

    def _read(self, rows: Array, length: int) -> Array:
        """Stretches that start at these rows of the cache, (B,) → (B, L, 3 n)."""
        if self._mapped is not None:
            return np.take(self._mapped, rows[:, None] + np.arange(length), axis=0)
        frames = np.empty((len(rows), length, self._width), DTYPE)
        row_bytes, got = frames.strides[1], 0
        order = np.argsort(rows)  # as they lie on the disk
        for i, offset in zip(order.tolist(), (rows[order] * row_bytes).tolist(), strict=True):
            got += os.preadv(self._file.fileno(), [frames[i]], offset)
        if got != frames.nbytes:
            raise DatasetError(f"{self._file.name}: shorter than its dataset; delete that folder, it is made again")
        return frames
