"""Repeatability: differences between repetitions of one command by one robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence

MAX_COMMAND_DIFFERENCE_RAD = 1e-3  # repetitions whose commands differ by more have another command
MIN_PERIOD_S = 0.5  # of a periodic motion
MIN_MOTION_RAD = 0.02  # joints that are commanded to move by less are left out
CHANNELS = ("qpos", "qvel", "tau", "temperature")


@dataclass(frozen=True)
class RepetitionResult:
    """Result of the repetitions of one motion.

    Attributes:
        count: Repetitions of the first command.
        other_commands: Repetitions with another command, which are left out.
        moved: Joints that were commanded to move, (n) bool.
        variance: Channel → variance over repetitions, averaged over rows, (n).
    """

    count: int
    other_commands: int
    moved: Array
    variance: dict[str, Array]


class Repetitions:
    """Accumulates repetitions of one motion by one unit with one payload, compared row by row from the first row.

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
        arrays = {c: x.astype(float) for c in CHANNELS if (x := getattr(sequence, c)) is not None}
        if self.count == 0:
            self.count, self._ctrl, self._mean = 1, sequence.ctrl, arrays
            self._squares = {c: np.zeros_like(x) for c, x in arrays.items()}
            return
        rows = min(len(self._ctrl), len(sequence))
        if np.abs(self._ctrl[:rows] - sequence.ctrl[:rows]).max() > MAX_COMMAND_DIFFERENCE_RAD:
            self.other_commands += 1
            return
        self.count += 1
        self._ctrl = self._ctrl[:rows]
        for name in [c for c in self._mean if c in arrays]:
            mean, value = self._mean[name][:rows], arrays[name][:rows]
            step = value - mean
            self._mean[name] = mean + step / self.count
            self._squares[name] = self._squares[name][:rows] + step * (value - self._mean[name])

    def result(self) -> RepetitionResult:
        """Return the result of two or more repetitions."""
        variance = {c: squares.mean(axis=0) / (self.count - 1) for c, squares in self._squares.items()}
        moved = np.ptp(self._ctrl, axis=0) > MIN_MOTION_RAD
        return RepetitionResult(self.count, self.other_commands, moved, variance)

    @staticmethod
    def periods(sequence: Sequence) -> list[Sequence]:
        """Return the periods of a periodic motion, without the first, which starts elsewhere; [] if it has none."""
        ctrl = sequence.ctrl
        rows = len(ctrl)
        for period in range(max(1, round(MIN_PERIOD_S / sequence.dt)), rows // 3 + 1):
            before, after = ctrl[:-period], ctrl[period:]
            differences = (np.abs(after[::every] - before[::every]).max() for every in (97, 1))  # a few rows first
            if all(difference <= MAX_COMMAND_DIFFERENCE_RAD for difference in differences):
                break
        else:
            return []
        starts = range(period, rows - period + 1, period) if np.ptp(ctrl, axis=0).max() > MIN_MOTION_RAD else ()
        return [sequence.rows(slice(a, a + period)) for a in starts]

    @staticmethod
    def summary(results: list[RepetitionResult], joint_names: tuple[str, ...]) -> dict[str, Any]:
        """Return the root-mean-square standard deviation over repetitions, by channel and joint.

        Args:
            results: One per motion.
            joint_names: (n).

        Returns:
            groups, sequences, and channels {name: {unit, mean over joints, joints {name: value}}}; without joints that
            never moved.
        """
        channels = {}
        for name in CHANNELS:
            variances = [np.where(r.moved, r.variance[name], np.nan) for r in results if name in r.variance]
            values = {}
            for j, joint in enumerate(joint_names):
                column = np.array([v[j] for v in variances])
                if np.isfinite(column).any():
                    values[joint] = float(f"{np.sqrt(np.nanmean(column)):.6g}")
            if values:
                channels[name] = {"unit": UNITS[name], "mean": float(np.mean(list(values.values()))), "joints": values}
        return {
            "groups": len(results),
            "sequences": sum(r.count for r in results),
            "left_out_other_command": sum(r.other_commands for r in results),
            "channels": channels,
        }
