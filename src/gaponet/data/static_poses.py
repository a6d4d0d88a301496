"""Static poses: moments at which a robot stood still under a constant command, with the static
error that remains.

A joint with friction stops short of its target, on the side from which it came. Its positions lie
in a band; the middle of the band is the position without friction. On an SO-101 the elbow's band is
75 mrad wide. A plain median of the static error would therefore depend on the direction of motion
more than on sag. Each static pose stores the side of approach, and `static_error` weighs both sides
equally.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array, joined
from gaponet.data.sequence import Sequence
from gaponet.data.signals import range_before

WINDOW_S = 0.5  # command and state must stand still for this time
MAX_CTRL_RANGE_RAD = 1e-3  # of the command in the window
MAX_DRIFT_RAD = 2e-3  # between the means of the window's halves
MAX_NOISE_RAD = 3e-3  # standard deviation in the window; two steps of a 12-bit encoder
MIN_MOTION_RAD = 0.01  # by which a joint is away from where it rests
MIN_POSES_PER_SIDE = 3  # from which the width of a joint's band is known
BLOCK_ROWS = 1024  # extremes of blocks are searched before the rows


@dataclass(frozen=True)
class StaticPoses:
    """k static poses of one or more sequences, one row each; n joints."""

    qpos: Array  # averaged over the window, (k, n) rad
    ctrl: Array  # (k, n) rad
    # (k, n), +1 if the joint's last motion was upwards, −1 downwards, 0 if it had not moved
    approach: Array
    distinct: Array  # (k, n) bool; False if neither joint nor command moved since the previous pose

    def __len__(self) -> int:
        return len(self.qpos)

    @classmethod
    def of(cls, sequence: Sequence, joints: Array) -> StaticPoses:
        """Return the ends of all stretches in which the joints (k indices) rest under a constant
        command.
        """
        ends = _ends_of_rest(sequence, joints)
        n = sequence.qpos.shape[1]
        qpos = np.zeros((len(ends), n))
        ctrl = np.zeros((len(ends), n))
        approach = np.zeros((len(ends), n), int)
        distinct = np.ones((len(ends), n), bool)
        window = _window_rows(sequence)
        blocks = _Blocks.of(sequence.qpos)
        for i, end in enumerate(ends):
            qpos[i] = sequence.qpos[end + 1 - window : end + 1].mean(axis=0)
            ctrl[i] = sequence.ctrl[end]
            approach[i] = -_last_side(sequence.qpos[: end + 1], blocks, qpos[i])
            if i:
                state_moved = np.abs(qpos[i] - qpos[i - 1]) > MIN_MOTION_RAD
                command_moved = np.abs(ctrl[i] - ctrl[i - 1]) > MIN_MOTION_RAD
                distinct[i] = state_moved | command_moved
        copied = [name in sequence.copied for name in sequence.joint_names]
        distinct[:, copied] = False
        return cls(qpos, ctrl, approach, distinct)

    @classmethod
    def joined(cls, parts: list[StaticPoses], n: int) -> StaticPoses:
        """Return the static poses of several sequences of n joints as one."""
        empty = np.zeros((0, n))
        none = cls(empty, empty, np.zeros((0, n), int), np.zeros((0, n), bool))
        return joined([none, *parts])

    def static_error(self, joint: int, expected: Array | float = 0.0) -> StaticError:
        """Return the static error of a joint over its distinct poses, both approaches weighed
        equally.

        Args:
            expected: Error to subtract, (k,) rad, such as the sag of the nominal model.
        """
        error = self.qpos[:, joint] - self.ctrl[:, joint] - expected
        distinct = self.distinct[:, joint]
        side = self.approach[:, joint]
        up = error[distinct & (side > 0)]
        down = error[distinct & (side < 0)]
        if min(len(up), len(down)) < MIN_POSES_PER_SIDE:
            of_any_side = error[distinct]
            middle = float(np.median(of_any_side)) if len(of_any_side) else np.nan
            return StaticError(middle, np.nan, len(up), len(down))
        high = float(np.median(down))
        low = float(np.median(up))
        return StaticError((high + low) / 2, max(high - low, 0.0) / 2, len(up), len(down))


@dataclass(frozen=True)
class StaticError:
    """qpos − ctrl of one joint at rest."""

    # mean of the medians of both approaches, rad; the plain median if one side is missing
    middle: float
    # half their distance, rad; NaN if one side is missing; times kp it is the stiction torque
    half_band: float
    up: int  # poses reached from below
    down: int  # poses reached from above

    @property
    def balanced(self) -> bool:
        """True if both sides were recorded; otherwise stiction and sag cannot be separated."""
        return bool(np.isfinite(self.half_band))


@dataclass(frozen=True)
class _Blocks:
    """Extremes of positions in blocks of BLOCK_ROWS rows, (blocks, n) rad."""

    least: Array
    greatest: Array

    @classmethod
    def of(cls, qpos: Array) -> _Blocks:
        """Return the extremes of positions (T, n)."""
        starts = np.arange(0, len(qpos), BLOCK_ROWS)
        return cls(np.minimum.reduceat(qpos, starts), np.maximum.reduceat(qpos, starts))

    def moved_from(self, rest: Array, count: int) -> Array:
        """Return where joints were away from `rest` (n) in the first blocks, (count, n) bool."""
        below = np.abs(self.least[:count] - rest) > MIN_MOTION_RAD
        above = np.abs(self.greatest[:count] - rest) > MIN_MOTION_RAD
        return np.asarray(below | above)


def _last_side(qpos: Array, blocks: _Blocks, rest: Array) -> Array:
    """Return on which side of `rest` (n) the joints of qpos (T, n) were last, (n): +1, −1, or 0 if
    never away.

    Args:
        blocks: Of the recording that begins with qpos.
    """
    complete = len(qpos) // BLOCK_ROWS
    moved = blocks.moved_from(rest, complete)
    side = np.zeros(len(rest), int)
    for j, at_rest in enumerate(rest):
        # the rows behind the last complete block first, then the last block in which it moved
        last_moved = np.flatnonzero(moved[:, j])[-1:]
        for block in (complete, *last_moved):
            start = block * BLOCK_ROWS
            offset = qpos[start : start + BLOCK_ROWS, j] - at_rest
            away = np.flatnonzero(np.abs(offset) > MIN_MOTION_RAD)
            if away.size:
                side[j] = np.sign(offset[away[-1]])
                break
    return side


def _window_rows(sequence: Sequence) -> int:
    return max(2, round(WINDOW_S / sequence.dt))


def _ends_of_rest(sequence: Sequence, joints: Array) -> Array:
    """Return the last row of each stretch at rest.

    Time and memory grow with the rows only, not with the window.
    """
    window = _window_rows(sequence)
    if len(sequence) < 2 * window:
        return np.zeros(0, int)
    ctrl = sequence.ctrl[:, joints]
    state = sequence.qpos[:, joints].astype(float)
    half = window // 2
    ctrl_range = range_before(ctrl, window)[window - 1 :]
    mean = _moving_mean(state, window)  # (T − window + 1, k), from each row on
    noise = np.sqrt(np.maximum(_moving_mean(state**2, window) - mean**2, 0))
    halves = _moving_mean(state, half)
    drift = np.abs(halves[window - half :] - halves[: len(halves) - window + half])
    quiet = (ctrl_range < MAX_CTRL_RANGE_RAD) & (noise < MAX_NOISE_RAD) & (drift < MAX_DRIFT_RAD)
    rows = np.flatnonzero(quiet.all(axis=1))
    if not rows.size:
        return rows
    is_last = np.append(np.diff(rows) > 1, True)
    return np.asarray(rows[is_last] + window - 1)


def _moving_mean(values: Array, window: int) -> Array:
    """Return the mean of rows t … t + window − 1, (T, k) → (T − window + 1, k)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return np.asarray((total[window:] - total[:-window]) / window)
