"""Log: what came off the wire.

Named channels with their own timestamps; nothing interpolated, nothing corrected.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError

# that a controller adds to its PD torque; data.sequence makes it a position
FEEDFORWARD = "feedforward_torque"
COMMANDS = ("ctrl", FEEDFORWARD)  # channels that are held between their rows
# Channel names and their SI units. ctrl is the commanded joint position.
CHANNELS = {
    "ctrl": "rad",
    "qpos": "rad",
    "qvel": "rad/s",
    "tau": "N·m",
    "temperature": "°C",
    FEEDFORWARD: "N·m",
}
# What others computed from these; kept where a format states it (an exported dataset), never looked
# for elsewhere.
DERIVED = {"qacc": "rad/s²", "tau_eq": "N·m"}
UNITS = {"time": "s"} | CHANNELS | DERIVED
REQUIRED = ("ctrl", "qpos")
_bad: ContextVar[list[str] | None] = ContextVar("bad", default=None)


@contextmanager
def skip_bad_rows(wanted: bool = True) -> Iterator[list[str] | None]:
    """While this is open, a Log cuts its bad rows instead of refusing them; yields the list of
    what was cut.
    """
    token = _bad.set([] if wanted else None)
    try:
        yield _bad.get()
    finally:
        _bad.reset(token)


def skipped_rows() -> list[str] | None:
    """Where bad rows are listed now; None where they are refused."""
    return _bad.get()


class Channel(NamedTuple):
    """time (k,) s, strictly increasing; values (k, n) in the order of the log's joint_names."""

    time: Array
    values: Array


RESTART_PERIODS = 3  # by which clocks of recordings in one file may begin apart
MIN_PIECE_ROWS = 20  # of each of these recordings
MAX_REPEATED_STAMPS = 0.5  # of the rows; with more, a clock is too coarse


@dataclass(frozen=True)
class Log:
    """One recording.

    Acted on of meta are: dt, the exact period of regular rows, s; kp and kd, gains of joint_names;
    notes, for SequenceMeta; stated, fields of SequenceMeta that the format itself holds; for
    errors, first_line, and by channel the file and the numbers of its rows in it.
    """

    robot: str
    joint_names: tuple[str, ...]  # the robot's own names, (n)
    channels: dict[str, Channel]  # among CHANNELS and DERIVED, at least ctrl and qpos
    source: str  # file or folder it was read from
    meta: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in REQUIRED:
            if name not in self.channels:
                raise LogError(
                    f"{self.source}: no {name} channel (it has "
                    f"{', '.join(self.channels) or 'none'}); a log needs commanded and measured "
                    "joint positions; of a robot that is driven by torque say the position's name "
                    "for ctrl too, and see gaponet identify"
                )
        bad = _bad.get()
        if bad is not None and not any(_starts_again(c.time) for c in self.channels.values()):
            self._cut_bad_rows(bad)
        for name, (time, values) in self.channels.items():
            self._check(name, np.asarray(time), np.asarray(values))

    def _cut_bad_rows(self, bad: list[str]) -> None:
        """Cut rows that are not finite or go back in time, in all channels of the same clock; they
        are listed.
        """
        channels: dict[str, Channel] = {}
        rows: dict[str, Array] = {}
        for name, (clock, _) in self.channels.items():
            if name in channels:
                continue
            same = self._channels_of(clock)
            good = np.isfinite(clock)
            for values in same.values():
                good &= np.isfinite(values).all(axis=1)
            good = _longest_increase(clock, good)
            for row in np.flatnonzero(~good):
                bad.append(f"{self.row(name, int(row))}: cut")
            for other, values in same.items():
                channels[other] = Channel(clock[good], values[good])
                rows[other] = self.row_numbers(other)[good]
        cut = 0
        for name, channel in self.channels.items():
            cut = max(cut, len(channel.time) - len(channels[name].time))
        if cut:
            self.meta["notes"] = self.meta.get("notes", {}) | {"rows_cut": cut}
            self.meta["rows"] = rows
            object.__setattr__(self, "channels", channels)

    def _channels_of(self, clock: Array) -> dict[str, Array]:
        """Return the values of the channels that have a clock."""
        same = {}
        for name, (time, values) in self.channels.items():
            if np.array_equal(time, clock, equal_nan=True):
                same[name] = values
        return same

    def _check(self, name: str, time: Array, values: Array) -> None:
        """Refuse a channel that is unknown, has another shape, is not finite, or goes back."""
        if name not in UNITS:
            raise LogError(
                f"{self.source}: unknown channel '{name}'; known are "
                f"{', '.join(CHANNELS | DERIVED)}"
            )
        if values.shape != (len(time), len(self.joint_names)):
            raise LogError(
                f"{self.source}: channel {name} has shape {values.shape}, expected "
                f"({len(time)}, {len(self.joint_names)}) for joints {', '.join(self.joint_names)}"
            )
        if len(time) < 2:
            raise LogError(
                f"{self.source}: channel {name} has {len(time)} rows; nothing to learn from"
            )
        self._require_finite(name, time, values)
        self._require_clock(name, time)

    def _require_finite(self, name: str, time: Array, values: Array) -> None:
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1) | ~np.isfinite(time))
        if not bad.size:
            return
        row = int(bad[0])
        what = "time"
        if np.isfinite(time[row]):
            joint = int(np.flatnonzero(~np.isfinite(values[row]))[0])
            what = f"{name} of {self.joint_names[joint]}"
        raise LogError(
            f"{self.row(name, row)}: {what} is empty or not finite; repair or cut the row "
            "(--skip-bad does)"
        )

    def _require_clock(self, name: str, time: Array) -> None:
        """Refuse a clock that does not increase, with the likely cause."""
        back = np.flatnonzero(np.diff(time) <= 0)
        if not back.size:
            return
        before = time[back[0]]
        after = time[back[0] + 1]
        where = self.row(name, int(back[0]) + 1)
        if _starts_again(time):
            raise LogError(
                f"{where}: the clock starts again at {after:.6g} s: several recordings in one "
                "file; write each into a file of its own, or number them in a column episode_index"
            )
        if np.mean(np.diff(time) == 0) > MAX_REPEATED_STAMPS:
            stamps = np.unique(time)
            step = f"{stamps[1] - stamps[0]:g} s" if len(stamps) > 1 else "nothing"
            raise LogError(
                f"{where}: the clock is too coarse: it has {len(stamps)} stamps in {len(time)} "
                f"rows and advances by {step}; log milliseconds, or state the rate of even rows "
                "(rate in logs.toml, --rate)"
            )
        raise LogError(
            f"{where}: time does not increase in channel {name} ({before:.6f} s, then "
            f"{after:.6f} s); sort the rows or cut the log there (--skip-bad does)"
        )

    def row(self, name: str, index: int) -> str:
        """File and line of a row of a channel, as the reader noted them."""
        file = self.meta.get("files", {}).get(name, self.source)
        number = int(self.row_numbers(name)[index])
        return f"{file}:{number + int(self.meta.get('first_line', 1))}"

    def row_numbers(self, name: str) -> Array:
        """Return where the rows of a channel stand in their file, (k,), counted from 0."""
        rows = self.meta.get("rows", {}).get(name)
        if rows is None:
            return np.arange(len(self.channels[name].time))
        return np.asarray(rows)


def _longest_increase(clock: Array, good: Array) -> Array:
    """Return the most of the good rows whose times increase, (k,) bool: of one stamp that is too
    late, and of one that is too early, only its own row is left out.
    """
    rows = np.flatnonzero(good)
    if (np.diff(clock[rows]) > 0).all():
        return good
    ends: list[float] = []  # the earliest last time of an increase over so many rows
    end_rows: list[int] = []
    before: dict[int, int] = {}  # row → the row before it in its increase
    for row in rows.tolist():
        time = float(clock[row])
        length = bisect_left(ends, time)
        if length < len(ends) and ends[length] == time:
            continue  # of equal times the first row stays
        if length:
            before[row] = end_rows[length - 1]
        ends[length : length + 1] = [time]
        end_rows[length : length + 1] = [row]
    kept = np.zeros(len(clock), bool)
    row = end_rows[-1]
    while row in before:
        kept[row] = True
        row = before[row]
    kept[row] = True
    return kept


def _starts_again(time: Array) -> bool:
    """Return True if a clock goes back to where it began, and on as before, as where recordings
    follow each other.
    """
    time = np.asarray(time, float)
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0)
    if not back.size or not np.isfinite(time).all():
        return False
    period = float(np.median(steps))
    restarts = time[back + 1]
    near = np.abs(restarts - time[0]) < RESTART_PERIODS * max(period, 0.0)
    pieces = np.diff(np.concatenate([[0], back + 1, [len(time)]]))
    return bool(near.all() and pieces.min() >= MIN_PIECE_ROWS)
