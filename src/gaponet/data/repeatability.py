"""Repeatability: how much a robot differs from itself when it is asked for the same thing again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence

SAME_COMMAND = 1e-3  # rad; repetitions whose commands differ by more somewhere were not asked for the same thing
SHORTEST = 0.5  # s: of a period
MOVED = 0.02  # rad; joints commanded to move by less say nothing
REPEATED = ("qpos", "qvel", "tau", "temperature")


@dataclass(frozen=True)
class _Repeated:
    """What came of the repetitions of a motion; nothing as long as it."""

    count: int
    others: int
    """Repetitions with another command."""
    moved: Array
    """Which joints were commanded to move, (n)."""
    variance: dict[str, Array]
    """The variance of each channel over repetitions, averaged over rows, (n)."""


class Repetitions:
    """Row-by-row spread over repetitions of one motion by one unit with one payload, taken in one at a time.

    Repetitions are compared from their first rows on, as far as the shortest goes.
    """

    def __init__(self) -> None:
        self.count = 0  # with the first one's command
        self.others = 0  # with another command
        self._ctrl: Array = np.zeros((0, 0))
        self._mean: dict[str, Array] = {}
        self._squares: dict[str, Array] = {}

    def add(self, sequence: Sequence) -> None:
        """Take in a repetition (Welford's update, so that nothing but sums is kept)."""
        arrays = {c: x.astype(float) for c in REPEATED if (x := getattr(sequence, c)) is not None}
        if self.count == 0:
            self.count, self._ctrl, self._mean = 1, sequence.ctrl, arrays
            self._squares = {c: np.zeros_like(x) for c, x in arrays.items()}
            return
        rows = min(len(self._ctrl), len(sequence))
        if np.abs(self._ctrl[:rows] - sequence.ctrl[:rows]).max() > SAME_COMMAND:
            self.others += 1
            return
        self.count += 1
        self._ctrl = self._ctrl[:rows]
        for name in [c for c in self._mean if c in arrays]:
            mean, value = self._mean[name][:rows], arrays[name][:rows]
            step = value - mean
            self._mean[name] = mean + step / self.count
            self._squares[name] = self._squares[name][:rows] + step * (value - self._mean[name])

    def result(self) -> _Repeated:
        """What two repetitions or more say."""
        variance = {c: squares.mean(axis=0) / (self.count - 1) for c, squares in self._squares.items()}
        return _Repeated(self.count, self.others, np.ptp(self._ctrl, axis=0) > MOVED, variance)

    @staticmethod
    def periods(sequence: Sequence) -> list[Sequence]:
        """The periods of a motion after the first, in which the robot came from elsewhere; none where none repeats."""
        ctrl = sequence.ctrl
        rows = len(ctrl)
        for period in range(max(1, round(SHORTEST / sequence.dt)), rows // 3 + 1):
            before, after = ctrl[:-period], ctrl[period:]  # most are ruled out by a few rows
            if all(np.abs(after[::every] - before[::every]).max() <= SAME_COMMAND for every in (97, 1)):
                break
        else:
            return []
        starts = range(period, rows - period + 1, period) if np.ptp(ctrl, axis=0).max() > MOVED else ()
        return [sequence.rows(slice(a, a + period)) for a in starts]

    @staticmethod
    def summary(groups: list[_Repeated], joint_names: tuple[str, ...]) -> dict[str, Any]:
        """Root-mean-square standard deviation over repetitions, by channel and joint.

        Args:
            groups: A motion's each.
            joint_names: (n).

        Returns:
            groups, sequences, and channels {name: {unit, mean over joints that moved, joints {name: value}}}; a joint
            that no group moved is left out.
        """
        channels = {}
        for name in REPEATED:
            found = [np.where(g.moved, g.variance[name], np.nan) for g in groups if name in g.variance]
            values = {}
            for j, joint in enumerate(joint_names):
                column = np.array([v[j] for v in found])
                if np.isfinite(column).any():
                    values[joint] = float(f"{np.sqrt(np.nanmean(column)):.6g}")
            if values:
                channels[name] = {"unit": UNITS[name], "mean": float(np.mean(list(values.values()))), "joints": values}
        return {
            "groups": len(groups),
            "sequences": sum(g.count for g in groups),
            "left_out_other_command": sum(g.others for g in groups),
            "channels": channels,
        }
