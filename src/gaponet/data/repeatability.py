"""Repeatability: differences between repetitions of one command by one robot."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.fingerprint import equal_commands, fingerprint
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence

MAX_COMMAND_DIFFERENCE_RAD = 1e-3  # repetitions whose commands differ by more have another command
# the same, of the command's range, on average: of commands computed twice
MAX_COMMAND_DIFFERENCE_SHARE = 0.02
# by which clocks differ; of recordings that are compared
MAX_SHIFT_ROWS = 5
MAX_PAIRS = 100
MIN_PERIOD_S = 0.5  # of a periodic motion
MIN_MOTION_RAD = 0.02  # joints that are commanded to move by less are left out
CHANNELS = ("qpos", "qvel", "tau", "temperature")


def repetition_difference(sequences: ListOf[Sequence], joints: ListOf[str]) -> Array:
    """Return the RMS difference between the tracking errors of two recordings of one command, (n)
    rad; 0 if unknown.

    Commands count as one if they agree after a shift of MAX_SHIFT_ROWS rows at most: the clocks of
    two recordings may differ by that.

    Args:
        sequences: Recordings; only those of one unit, payload and rate are compared.
        joints: Names of the n joints.
    """
    marks = [fingerprint(s.ctrl, s.dt) for s in sequences]
    pairs = []
    for i, j in equal_commands(marks):
        a = sequences[i]
        b = sequences[j]
        if a.meta.repetition_key[1:] == b.meta.repetition_key[1:] and a.dt == b.dt:
            pairs.append((a, b))
    total, count = np.zeros((2, len(joints)))
    for a, b in pairs[:: max(1, len(pairs) // MAX_PAIRS)]:
        unrecorded = {*a.meta.unrecorded, *b.meta.unrecorded}
        columns = [i for i, name in enumerate(joints) if name not in unrecorded]
        if not columns:
            continue
        places = [a.joint_names.index(joints[i]) for i in columns]
        difference = _tracking_difference(a, b, places)
        if difference is not None:
            total[columns] += difference
            count[columns] += 1
    return np.sqrt(total / np.maximum(count, 1))


def _tracking_difference(a: Sequence, b: Sequence, columns: list[int]) -> Array | None:
    """Return the mean squared difference of the tracking errors of two recordings, (n) rad²; None
    for two commands.
    """
    n = len(columns)
    one = _command_and_position(a, columns)
    other = _command_and_position(b, columns)
    rows = np.arange(MAX_SHIFT_ROWS, min(len(a), len(b)) - MAX_SHIFT_ROWS)
    if not len(rows):
        return None
    shifts = range(-MAX_SHIFT_ROWS, MAX_SHIFT_ROWS + 1)
    differences = [one[rows] - other[rows + shift] for shift in shifts]
    difference = min(differences, key=lambda x: np.abs(x[:, :n]).mean())
    command = difference[:, :n]
    position = difference[:, n:]
    limit = MAX_COMMAND_DIFFERENCE_SHARE * float(np.ptp(a.ctrl[:, columns], axis=0).max())
    if np.abs(command).mean() > max(MAX_COMMAND_DIFFERENCE_RAD, limit):
        return None
    return np.asarray(np.square(position - command).mean(axis=0))


def _command_and_position(sequence: Sequence, columns: list[int]) -> Array:
    """Return commands and positions of some of the joints side by side, (T, 2 n) rad."""
    both = [sequence.ctrl[:, columns], sequence.qpos[:, columns]]
    return np.concatenate(both, axis=1).astype(float)


@dataclass(frozen=True)
class RepetitionResult:
    """Result of the repetitions of one motion."""

    count: int  # of the first command
    other_commands: int  # repetitions with another command, which are left out
    moved: Array  # joints that were commanded to move, (n) bool
    variance: dict[str, Array]  # channel → over repetitions, averaged over rows, (n)


class Repetitions:
    """Accumulates repetitions of one motion by one unit with one payload, compared row by row from
    the first row.

    Attributes:
        count, other_commands: The fields of RepetitionResult so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self.other_commands = 0
        self._ctrl: Array = np.zeros((0, 0))
        self._mean: dict[str, Array] = {}
        self._squares: dict[str, Array] = {}

    def add(self, sequence: Sequence) -> None:
        """Add a repetition (Welford's update: only sums are stored)."""
        arrays = {}
        for channel in CHANNELS:
            values = getattr(sequence, channel)
            if values is not None:
                arrays[channel] = values.astype(float)
        if self.count == 0:
            self.count = 1
            self._ctrl = sequence.ctrl
            self._mean = arrays
            self._squares = {c: np.zeros_like(x) for c, x in arrays.items()}
            return
        rows = min(len(self._ctrl), len(sequence))
        if np.abs(self._ctrl[:rows] - sequence.ctrl[:rows]).max() > MAX_COMMAND_DIFFERENCE_RAD:
            self.other_commands += 1
            return
        self.count += 1
        self._ctrl = self._ctrl[:rows]
        for name in [c for c in self._mean if c in arrays]:
            mean = self._mean[name][:rows]
            value = arrays[name][:rows]
            step = value - mean
            self._mean[name] = mean + step / self.count
            self._squares[name] = self._squares[name][:rows] + step * (value - self._mean[name])

    def result(self) -> RepetitionResult:
        """Return the result of two or more repetitions."""
        variance = {
            c: squares.mean(axis=0) / (self.count - 1) for c, squares in self._squares.items()
        }
        moved = np.ptp(self._ctrl, axis=0) > MIN_MOTION_RAD
        return RepetitionResult(self.count, self.other_commands, moved, variance)

    @staticmethod
    def periods(sequence: Sequence) -> list[Sequence]:
        """Return the periods of a periodic motion, without the first, which starts elsewhere; []
        if it has none.
        """
        ctrl = sequence.ctrl
        rows = len(ctrl)
        for period in range(max(1, round(MIN_PERIOD_S / sequence.dt)), rows // 3 + 1):
            before = ctrl[:-period]
            after = ctrl[period:]
            # a few rows first
            differences = (np.abs(after[::every] - before[::every]).max() for every in (97, 1))
            if all(difference <= MAX_COMMAND_DIFFERENCE_RAD for difference in differences):
                break
        else:
            return []
        starts = (
            range(period, rows - period + 1, period)
            if np.ptp(ctrl, axis=0).max() > MIN_MOTION_RAD
            else ()
        )
        return [sequence.rows(slice(a, a + period)) for a in starts]

    @staticmethod
    def summary(results: list[RepetitionResult], joint_names: tuple[str, ...]) -> dict[str, Any]:
        """Return the root-mean-square standard deviation over repetitions, by channel and joint.

        Args:
            results: One per motion.
            joint_names: (n).

        Returns:
            groups, sequences, and channels {name: {unit, mean over joints, joints {name: value}}};
            without joints that never moved.
        """
        channels = {}
        for name in CHANNELS:
            variances = [
                np.where(r.moved, r.variance[name], np.nan) for r in results if name in r.variance
            ]
            values = {}
            for j, joint in enumerate(joint_names):
                column = np.array([v[j] for v in variances])
                if np.isfinite(column).any():
                    values[joint] = float(f"{np.sqrt(np.nanmean(column)):.6g}")
            if values:
                channels[name] = {
                    "unit": UNITS[name],
                    "mean": float(np.mean(list(values.values()))),
                    "joints": values,
                }
        return {
            "groups": len(results),
            "sequences": sum(r.count for r in results),
            "left_out_other_command": sum(r.other_commands for r in results),
            "channels": channels,
        }
