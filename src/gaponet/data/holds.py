"""Holds: moments at which a robot stood still under a constant command; what remains then is sag, stiction and offset.

A joint with friction stops short of its target: below it when it came from below, above it when it came from above,
anywhere in a band whose middle is where it would rest without friction. On an SO-101 the band of the elbow is 75 mrad
wide, so a plain median of the static error tells from where the joint was driven more than how far it sags. Therefore
every hold remembers the side it was approached from, and `static_error` weighs both sides alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence

WINDOW_S = 0.5  # this long must command and state be still
CTRL_STILL = 1e-3  # range of the command in the window, rad
DRIFT_STILL = 2e-3  # between the means of the window's halves, rad
NOISE_STILL = 3e-3  # standard deviation in the window, rad; two steps of a 12-bit encoder
MOVED = 0.01  # less than this is no motion, rad
BLOCK = 1024  # rows whose extremes are looked at before the rows themselves


@dataclass(frozen=True)
class Holds:
    """k holds of one or more sequences, one row each; n joints.

    Attributes:
        qpos, ctrl: (k, n), rad; qpos averaged over the window.
        approach: (k, n), +1 where the joint last moved up before it stopped, −1 down, 0 where it had not moved.
        fresh: (k, n) bool; False where neither joint nor command moved since the previous hold: the same rest again.
    """

    qpos: Array
    ctrl: Array
    approach: Array
    fresh: Array

    def __len__(self) -> int:
        return len(self.qpos)

    @classmethod
    def of(cls, sequence: Sequence, still: Array) -> Holds:
        """The ends of all stretches in which the joints `still` (k indices) rest under a constant command."""
        ends = _hold_ends(sequence, still)
        n = sequence.qpos.shape[1]
        qpos, ctrl = np.zeros((len(ends), n)), np.zeros((len(ends), n))
        approach, fresh = np.zeros((len(ends), n), int), np.ones((len(ends), n), bool)
        w, starts = _window(sequence), np.arange(0, len(sequence), BLOCK)
        extremes = np.stack([f.reduceat(sequence.qpos, starts) for f in (np.minimum, np.maximum)])  # (2, blocks, n)
        for i, end in enumerate(ends):
            qpos[i], ctrl[i] = sequence.qpos[end + 1 - w : end + 1].mean(axis=0), sequence.ctrl[end]
            approach[i] = -_last_away(sequence.qpos[: end + 1], extremes, qpos[i])
            if i:
                fresh[i] = (np.abs(qpos[i] - qpos[i - 1]) > MOVED) | (np.abs(ctrl[i] - ctrl[i - 1]) > MOVED)
        return Holds(qpos, ctrl, approach, fresh)

    @classmethod
    def joined(cls, parts: list[Holds], n: int) -> Holds:
        """Holds of several sequences as one; n joints, for an empty list."""
        empty = Holds(np.zeros((0, n)), np.zeros((0, n)), np.zeros((0, n), int), np.zeros((0, n), bool))
        parts = [empty, *parts]
        return Holds(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("qpos", "ctrl", "approach", "fresh")))

    def static_error(self, joint: int, offset: Array | None = None) -> StaticError:
        """Static error of a joint over these fresh rests of one unit, both approaches weighed alike.

        Args:
            offset: (k,) rad, expected error to take off, such as the sag of the nominal model; default none.
        """
        error = self.qpos[:, joint] - self.ctrl[:, joint] - (0.0 if offset is None else offset)
        fresh, side = self.fresh[:, joint], self.approach[:, joint]
        up, down, both = error[fresh & (side > 0)], error[fresh & (side < 0)], error[fresh]
        if len(up) < 3 or len(down) < 3:
            return StaticError(float(np.median(both)) if len(both) else np.nan, np.nan, len(up), len(down))
        high, low = float(np.median(down)), float(np.median(up))
        return StaticError((high + low) / 2, max(high - low, 0.0) / 2, len(up), len(down))


@dataclass(frozen=True)
class StaticError:
    """qpos − ctrl of one joint at rest.

    Attributes:
        middle: Half way between the medians of both approaches, rad; the plain median where one side is missing.
        half_band: Half their distance, rad; 0 where the approach makes no difference, NaN where one side is missing.
            Times kp it is the stiction torque.
        up, down: Number of rests reached from below and from above.
    """

    middle: float
    half_band: float
    up: int
    down: int

    @property
    def balanced(self) -> bool:
        """Whether both sides were seen; otherwise stiction and sag cannot be told apart."""
        return np.isfinite(self.half_band)


def _last_away(qpos: Array, extremes: Array, rest: Array) -> Array:
    """On which side of a rest (n) the joints of (T, n) were when they last were away from it, (n): +1, −1, 0 never."""
    full, side = len(qpos) // BLOCK, np.zeros(len(rest), int)
    blocks = (np.abs(extremes[:, :full] - rest) > MOVED).any(axis=0)  # whole ones, (full, n)
    for j, x in enumerate(rest):
        for start in (full * BLOCK, *BLOCK * np.flatnonzero(blocks[:, j])[:-2:-1]):
            moved = qpos[start : start + BLOCK, j] - x
            away = np.flatnonzero(np.abs(moved) > MOVED)
            if away.size:
                side[j] = np.sign(moved[away[-1]])
                break
    return side


def _window(sequence: Sequence) -> int:
    return max(2, round(WINDOW_S / sequence.dt))


def _hold_ends(sequence: Sequence, still: Array) -> Array:
    """Last row of each quiet stretch. Time and memory grow with the rows only, not with the window."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    w = _window(sequence)
    if len(sequence) < 2 * w:
        return np.zeros(0, int)
    ctrl, state = sequence.ctrl[:, still], sequence.qpos[:, still].astype(float)
    width = (maximum_filter1d(ctrl, w, axis=0) - minimum_filter1d(ctrl, w, axis=0))[w // 2 : w // 2 + len(ctrl) - w + 1]
    half = w // 2
    mean = _moving_mean(state, w)  # (T − w + 1, k), of the window that starts at the row
    spread = np.sqrt(np.maximum(_moving_mean(state**2, w) - mean**2, 0))
    halves = _moving_mean(state, half)
    drift = np.abs(halves[w - half :] - halves[: len(halves) - w + half])
    quiet = ((width < CTRL_STILL) & (spread < NOISE_STILL) & (drift < DRIFT_STILL)).all(axis=1)
    rows = np.flatnonzero(quiet)
    return rows[np.append(np.diff(rows) > 1, True)] + w - 1 if rows.size else rows


def _moving_mean(values: Array, w: int) -> Array:
    """Mean of rows t … t + w − 1, (T, k) → (T − w + 1, k)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return (total[w:] - total[:-w]) / w
