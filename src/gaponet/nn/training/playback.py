"""Which row of its recording each environment has reached, on the host and on the device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array, array_module, copy_array, zeros_like
from gaponet.nn.observation import History
from gaponet.nn.training.recorded_rows import RecordedRows


class DeviceRows(NamedTuple):
    """Copies of a RecordedRows' arrays on the device of the simulations.

    Attributes:
        operated: Operated joints among those of ctrl, qpos and qvel, (n,).
        ctrl, qpos, qvel: (rows, n_free) rad, rad, rad/s.
        track: [q | q̇ | a] of the operated joints, (rows, 3n) float32.
    """

    operated: Any
    ctrl: Any
    qpos: Any
    qvel: Any
    track: Any


class Playback:
    """Row of its recording that each environment has reached.

    The host decides which environments end. The device has copies of what a step needs, so that a
    step transfers nothing.

    Attributes:
        rows: The recordings on the device.
        row, first, last: Present, first and last row of each environment's recording, (num_envs,),
            on the host.
        elapsed: Control periods since the reset, (num_envs,), on the host.
        row_on_device, last_on_device: Copies of row and last on the device.
        recorded: Present row of track, (num_envs, 3n), on the device.
    """

    def __init__(
        self, rows: RecordedRows, num_envs: int, past_rows: int, to_device: Callable[[Any], Any]
    ) -> None:
        """
        Args:
            past_rows: Number of rows before its start that an environment needs.
            to_device: Copies an array to the device.
        """
        self.rows = DeviceRows(
            operated=to_device(rows.operated),
            ctrl=to_device(rows.ctrl),
            qpos=to_device(rows.qpos),
            qvel=to_device(rows.qvel),
            track=to_device(rows.track),
        )
        self._past_rows = past_rows
        self._to_device = to_device
        self.row = np.zeros(num_envs, np.int64)
        self.first = np.zeros(num_envs, np.int64)
        self.last = np.zeros(num_envs, np.int64)
        self.elapsed = np.zeros(num_envs, np.int64)
        self.row_on_device = copy_array(to_device(self.row))
        self.last_on_device = copy_array(to_device(self.last))
        track = self.rows.track
        self.recorded = zeros_like(track, num_envs, track.shape[1])

    def start(self, ids: Any, row: Array, first: Array, last: Array) -> None:
        """Place environments `ids` (on the host) at a row of a recording, (k,) each."""
        self.row[ids] = row
        self.first[ids] = first
        self.last[ids] = last
        self.elapsed[ids] = 0
        on_device = ids if isinstance(ids, slice) else self._to_device(ids)
        row = self._to_device(row)
        self.row_on_device[on_device] = row
        self.last_on_device[on_device] = self._to_device(last)
        self.recorded[on_device] = self.rows.track[row]

    def rows_before(self, ids: Any) -> Any:
        """Return the rows before the present one of environments `ids` (on the host), newest
        first, (k, past_rows).

        Before the first row of a recording, that row is repeated.
        """
        first = self.first[ids]
        before = History.rows_before(self.row[ids] - first, self._past_rows)
        return self._to_device(first[:, None] + before)

    def commanded(self) -> Any:
        """Return the recorded targets of the coming period, (num_envs, n_free) rad."""
        return take_rows(self.rows.ctrl, self.row_on_device)

    def advance(self) -> None:
        """Go to the next row of every recording."""
        self.row += 1
        self.elapsed += 1
        self.row_on_device += 1
        take_rows(self.rows.track, self.row_on_device, out=self.recorded)

    def ended(self, periods: int, max_periods: Array) -> Array:
        """Return the environments without `periods` further rows, or played for max_periods,
        (num_envs,).
        """
        at_end = self.row > self.last - periods
        return at_end | (self.elapsed >= max_periods)

    def ahead(self, periods: Any) -> Any:
        """Return track that many rows ahead, or its last row, (num_envs, len(periods), 3n)."""
        rows = self.row_on_device[:, None] + periods
        rows = array_module(rows).minimum(rows, self.last_on_device[:, None])
        return take_rows(self.rows.track, rows)

    def state(self) -> dict[str, Array]:
        """Return the rows for a checkpoint."""
        return {"row": self.row, "first": self.first, "last": self.last, "elapsed": self.elapsed}

    def set_state(self, arrays: dict[str, Array]) -> None:
        """Restore a `state`."""
        self.row[:] = arrays["row"]
        self.first[:] = arrays["first"]
        self.last[:] = arrays["last"]
        self.elapsed[:] = arrays["elapsed"]
        self.row_on_device[:] = self._to_device(self.row)
        self.last_on_device[:] = self._to_device(self.last)
        self.recorded[:] = self.rows.track[self.row_on_device]


def take_rows(x: Any, rows: Any, out: Any = None) -> Any:
    """Return x[rows], written into out if that is given; rows (k,) then."""
    if isinstance(x, np.ndarray):
        return x.take(rows, axis=0, out=out)  # faster than an index
    if out is None:
        return x[rows]
    return array_module(x).index_select(x, 0, rows, out=out)
