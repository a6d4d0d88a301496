"""Repeatability: differences between repetitions of one command by one robot."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.fingerprint import equal_commands, fingerprint
from gaponet.data.log import UNITS
from gaponet.data.sequence import Sequence, whole_rate

MAX_COMMAND_DIFFERENCE_RAD = 1e-3  # repetitions whose commands differ by more have another command
# the same, of the command's range, on average: of commands computed twice
MAX_COMMAND_DIFFERENCE_SHARE = 0.02
MAX_SHIFT_ROWS = 5  # by which the clocks of two recordings differ
MAX_PAIRS = 100  # of recordings that are compared, about
MIN_PERIOD_S = 0.5  # of a periodic motion
FEW_ROWS = 97  # every so many are compared before all of them
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
    pairs = []
    commands = [fingerprint(sequence.ctrl, sequence.dt) for sequence in sequences]
    for i, j in equal_commands(commands):
        one = sequences[i]
        other = sequences[j]
        _, *labels = one.meta.repetition_key
        _, *other_labels = other.meta.repetition_key
        if labels == other_labels and whole_rate(one.dt) == whole_rate(other.dt):
            pairs.append((one, other))
    total = np.zeros(len(joints))
    count = np.zeros(len(joints))
    for one, other in pairs[:: max(1, len(pairs) // MAX_PAIRS)]:
        unrecorded = {*one.meta.unrecorded, *other.meta.unrecorded}
        recorded = [i for i, name in enumerate(joints) if name not in unrecorded]
        if not recorded:
            continue
        columns = [one.joint_names.index(joints[i]) for i in recorded]
        difference = _tracking_difference(one, other, columns)
        if difference is not None:
            total[recorded] += difference
            count[recorded] += 1
    return np.sqrt(total / np.maximum(count, 1))


def _tracking_difference(a: Sequence, b: Sequence, columns: list[int]) -> Array | None:
    """Return the mean squared difference of the tracking errors of two recordings, (n) rad²; None
    for two commands.

    Args:
        columns: Of the n joints that are compared.
    """
    n = len(columns)
    one = _command_and_position(a, columns)
    other = _command_and_position(b, columns)
    rows = np.arange(MAX_SHIFT_ROWS, min(len(a), len(b)) - MAX_SHIFT_ROWS)
    if not len(rows):
        return None
    differences = []  # at each shift
    for shift in range(-MAX_SHIFT_ROWS, MAX_SHIFT_ROWS + 1):
        differences.append(one[rows] - other[rows + shift])
    difference = min(differences, key=lambda both: np.abs(both[:, :n]).mean())
    command = difference[:, :n]
    position = difference[:, n:]
    widest = float(np.ptp(a.ctrl[:, columns], axis=0).max())
    limit = max(MAX_COMMAND_DIFFERENCE_RAD, MAX_COMMAND_DIFFERENCE_SHARE * widest)
    if np.abs(command).mean() > limit:
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
    # channel that all repetitions hold → variance over them, averaged over rows, (n)
    variance: dict[str, Array]


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
        """Add a repetition.

        Welford's update (1962): mean and squared deviations so far are enough. Channels that one
        repetition lacks are left out.
        """
        arrays = {}
        for channel in CHANNELS:
            values = getattr(sequence, channel)
            if values is not None:
                arrays[channel] = values.astype(float)
        if self.count == 0:
            self.count = 1
            self._ctrl = sequence.ctrl
            self._mean = arrays
            self._squares = {name: np.zeros_like(values) for name, values in arrays.items()}
            return
        rows = min(len(self._ctrl), len(sequence))
        if np.abs(self._ctrl[:rows] - sequence.ctrl[:rows]).max() > MAX_COMMAND_DIFFERENCE_RAD:
            self.other_commands += 1
            return
        self.count += 1
        self._ctrl = self._ctrl[:rows]
        means = {}
        squares = {}
        for name in [channel for channel in self._mean if channel in arrays]:
            mean = self._mean[name][:rows]
            value = arrays[name][:rows]
            deviation = value - mean
            means[name] = mean + deviation / self.count
            squares[name] = self._squares[name][:rows] + deviation * (value - means[name])
        self._mean = means
        self._squares = squares

    def result(self) -> RepetitionResult:
        """Return the result of two or more repetitions."""
        variance = {}
        for name, squares in self._squares.items():
            variance[name] = squares.mean(axis=0) / (self.count - 1)
        moved = np.ptp(self._ctrl, axis=0) > MIN_MOTION_RAD
        return RepetitionResult(self.count, self.other_commands, moved, variance)

    @staticmethod
    def periods(sequence: Sequence) -> list[Sequence]:
        """Return the periods of a periodic motion, without the first, which starts elsewhere; []
        if it has none.
        """
        rows = len(sequence)
        period = _period_rows(sequence.ctrl, max(1, round(MIN_PERIOD_S / sequence.dt)))
        if period is None or np.ptp(sequence.ctrl, axis=0).max() <= MIN_MOTION_RAD:
            return []
        starts = range(period, rows - period + 1, period)
        return [sequence.rows(slice(start, start + period)) for start in starts]

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
            variances = []  # of each motion, (n); NaN for joints that did not move
            for result in results:
                if name in result.variance:
                    variances.append(np.where(result.moved, result.variance[name], np.nan))
            values = {}
            for j, joint in enumerate(joint_names):
                of_joint = np.array([variance[j] for variance in variances])
                if np.isfinite(of_joint).any():
                    values[joint] = float(f"{np.sqrt(np.nanmean(of_joint)):.6g}")
            if values:
                channels[name] = {
                    "unit": UNITS[name],
                    "mean": float(np.mean(list(values.values()))),
                    "joints": values,
                }
        return {
            "groups": len(results),
            "sequences": sum(result.count for result in results),
            "left_out_other_command": sum(result.other_commands for result in results),
            "channels": channels,
        }


def _period_rows(ctrl: Array, least: int) -> int | None:
    """Return the shortest period of commands (T, n) that fits in three times, rows; None without.

    Args:
        least: Shortest period that is tried, rows.
    """
    for period in range(least, len(ctrl) // 3 + 1):
        before = ctrl[:-period]
        after = ctrl[period:]
        few = np.abs(after[::FEW_ROWS] - before[::FEW_ROWS]).max()
        if few > MAX_COMMAND_DIFFERENCE_RAD:
            continue
        if np.abs(after - before).max() <= MAX_COMMAND_DIFFERENCE_RAD:
            return period
    return None
