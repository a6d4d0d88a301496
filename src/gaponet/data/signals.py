"""Numerical functions of time series (T, n): resampling, derivatives, delay, and responses to
commands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array

SAME_INSTANT = 0.1  # of a period by which stamps of one instant may differ
# fast_speed from which a lag is mostly delay; below, it is mostly stiction
FAST_COMMAND_RAD_S = 0.3
# Of a Response:
MIN_STEP_S = 0.01  # between its lags
BEFORE_S = 0.12  # longest time by which a state may come before its command
AFTER_S = 0.6  # and after it
SAME_STEP = 0.01  # relative difference of steps that count as one
SPLITS = 3  # parts of a recording
SHIFT_STEP_S = 0.002  # between the shifts of a part that are tried
SHIFTS_S = np.arange(-0.12, 0.1201, SHIFT_STEP_S)
RIDGE = 1e-3  # of the command's power, added to the diagonal of the normal equations
ONSET_SHARE = 0.05  # of a joint's way, after which it has begun to move
SHARP_LAG_S = 0.02
MAX_SHARP_CORRELATION = 0.8  # of a command with itself SHARP_LAG_S later, if it changes sharply
MAX_UNEXPLAINED = 0.7  # share of the state's power, if the joint follows
MIN_FOLLOWED_SHARE = 0.3  # of its command's way, the same
# Of a joint whose delay is known:
MIN_COMMAND_RAD = 0.02
MIN_CORRELATION = 0.3


def resample_linear(time: Array, values: Array, grid: Array) -> Array:
    """Interpolate states, which are continuous, onto a grid. Not for commands.

    Args:
        time: Strictly increasing timestamps, (k,), s.
        values: Measurements, (k, n).
        grid: Query times, (T,), s, within [time[0], time[-1]].
    """
    right = np.clip(np.searchsorted(time, grid, side="right"), 1, len(time) - 1)
    left = right - 1
    weight = ((grid - time[left]) / (time[right] - time[left]))[:, None]
    return np.asarray(values[left] * (1 - weight) + values[right] * weight)  # (T, n)


def resample_zoh(time: Array, values: Array, grid: Array, near: float = SAME_INSTANT) -> Array:
    """Hold each command until the next one arrives.

    Commands are steps: linear interpolation would invent motion that was never commanded. A command
    that comes shortly after an instant belongs to that instant. One loop writes state and command
    with one stamp, and neither rounding nor jitter may delay it by a whole period.

    Args:
        time: Strictly increasing timestamps, (k,), s.
        values: Commands, (k, n), rad.
        grid: Query times, evenly spaced, (T,), s, within [time[0], time[-1]].
        near: Share of the grid's period that is shortly.
    """
    slack = near * (grid[-1] - grid[0]) / max(len(grid) - 1, 1)
    rows = np.searchsorted(time, grid + slack, side="right") - 1
    return np.asarray(values[rows])  # (T, n)


def differentiate(values: Array, dt: float) -> Array:
    """Return central differences, one-sided at the ends, without phase shift; (T, n) → (T, n) per
    second.
    """
    return np.asarray(np.gradient(values, dt, axis=0))


def lowpass(values: Array, dt: float, cutoff: float) -> Array:
    """Apply a zero-phase second-order Butterworth filter. Not for a control loop.

    Args:
        values: (T, n).
        dt: s.
        cutoff: Hz, below 1 / (2 dt).
    """
    from scipy.signal import butter, sosfiltfilt

    sos = butter(2, min(cutoff * 2 * dt, 0.99), output="sos")
    return np.asarray(sosfiltfilt(sos, values, axis=0))  # (T, n)


def estimate_delay(ctrl: Array, qpos: Array, dt: float, max_delay: float = 0.4) -> Array:
    """Return the lag of each joint: the shift at which its velocity correlates best with the
    commanded velocity.

    Velocities do not contain drift and sag. Parabolic interpolation around the best whole shift
    gives a resolution below dt.

    Args:
        ctrl, qpos: (T, n), rad.
        dt: s.
        max_delay: Longest lag tried, s.

    Returns:
        (n,) s; NaN for a joint that is not commanded to move, does not follow, or follows best at
        the longest lag tried, which happens in slow motions with stiction.
    """
    commanded = _smooth_changes(ctrl)
    moved = _smooth_changes(qpos)
    rows = commanded.shape[1]
    shifts = range(min(int(max_delay / dt), rows // 2) + 1)
    scores = []
    for shift in shifts:
        scores.append(correlation(commanded[:, : rows - shift], moved[:, shift:]))
    score = np.stack(scores)  # (shifts, n)
    delay = np.full(ctrl.shape[1], np.nan)
    for j, best in enumerate(score.argmax(axis=0)):
        is_commanded = np.ptp(ctrl[:, j]) >= MIN_COMMAND_RAD
        follows = score[best, j] > MIN_CORRELATION
        if is_commanded and follows and best < len(score) - 1:
            delay[j] = (best + _peak_offset(score[:, j], best)) * dt
    return delay


def _smooth_changes(values: Array) -> Array:
    """Return the change from row to row, averaged over five, (T, n) → (n, T − 1)."""
    kernel = np.hanning(7)[1:-1] / np.hanning(7).sum()  # hanning(7) is 0 at both ends
    changes = np.diff(values, axis=0).T
    return np.stack([np.convolve(of_joint, kernel, "same") for of_joint in changes])


def _peak_offset(score: Array, best: int) -> float:
    """Return by how much of a step the vertex of a parabola through the best score and both beside
    it lies behind the best; score (S).
    """
    if best == 0:
        return 0.0
    before, peak, after = score[best - 1 : best + 2]
    curvature = before - 2 * peak + after
    if not curvature < 0:
        return 0.0
    return float(0.5 * (before - after) / curvature)


def range_before(values: Array, rows: int) -> Array:
    """Return the range of each value over its row and those before, `rows` in all, (T, n)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    origin = (rows - 1) // 2
    most = maximum_filter1d(values, rows, axis=0, origin=origin)
    least = minimum_filter1d(values, rows, axis=0, origin=origin)
    return np.asarray(most - least)


def fast_speed(ctrl: Array, dt: float) -> Array:
    """Return the 95th percentile of the commanded speed, (T, n) → (n), rad/s."""
    return np.asarray(np.percentile(np.abs(differentiate(ctrl, dt)), 95, axis=0))


def correlation(a: Array, b: Array) -> Array:
    """Return the correlation of each row, (n, T) and (n, T) → (n); 0 where one does not change."""
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    power = np.sqrt(_row_products(a, a) * _row_products(b, b))
    return np.asarray(_row_products(a, b) / np.where(power > 0, power, np.inf))


def _row_products(a: Array, b: Array) -> Array:
    """Return the scalar product of each row of a with that of b, (n, T) and (n, T) → (n)."""
    return np.asarray(np.einsum("it,it->i", a, b))


def busiest_window(qpos: Array, rows: int) -> int:
    """Return the first row of the window of `rows` rows with the most motion; qpos (T, n) rad."""
    steps = np.abs(np.diff(qpos, axis=0)).sum(axis=1)
    way = np.concatenate([[0.0], steps.cumsum()])  # until each row, (T) rad
    if len(way) <= rows:
        return 0
    return int((way[rows:] - way[:-rows]).argmax())


def encoder_step(recordings: list[Array]) -> float:
    """Return the smallest step between distinct readings of one joint, rad; 0 if readings are
    continuous.
    """
    values = np.unique(np.concatenate(recordings).astype(np.float64))
    steps = np.diff(values)
    steps = steps[steps > 2e-6]  # below: rounding of the stored float32
    if steps.size < 10:
        return 0.0
    step = float(np.percentile(steps, 5))
    multiples = steps / step
    off = np.abs(multiples - np.round(multiples))
    return step if np.median(off) < 0.1 else 0.0


@dataclass(frozen=True)
class Response:
    """Correlations of commands and states of one recording, in SPLITS parts, n joints, at lags of
    `step` s.

    They add up over recordings. The velocity of a joint is modelled as a weighted sum of earlier
    commanded velocities. The weights show when a joint begins to move, and by how much a recording
    follows later than others.
    """

    step: float  # s
    own: Array  # command with itself, at lags 0 … BEFORE_S + AFTER_S, (SPLITS, n, L)
    cross: Array  # command with the later state, at lags −BEFORE_S … AFTER_S, (SPLITS, n, L)
    power: Array  # of the state, (SPLITS, n)
    duration: float  # s

    @classmethod
    def of(cls, ctrl: Array, qpos: Array, dt: float) -> Response:
        """Return the correlations of ctrl and qpos (T, n)."""
        every = max(1, round(MIN_STEP_S / dt))
        step = every * dt
        before = round(BEFORE_S / step)
        lags = before + round(AFTER_S / step) + 1
        size = len(ctrl[::every]) // SPLITS
        own = []
        cross = []
        power = []
        for part in range(SPLITS):
            rows = slice(part * size, (part + 1) * size)
            commanded = np.diff(ctrl[::every][rows].astype(float), axis=0)
            moved = np.diff(qpos[::every][rows].astype(float), axis=0)
            # correlations by the Fourier transform, with zeros behind so that ends do not meet
            length = 1 << (2 * max(len(commanded), lags) - 1).bit_length()
            u = np.fft.rfft(commanded, length, axis=0)
            v = np.fft.rfft(moved, length, axis=0)
            own.append(np.fft.irfft(u.conj() * u, length, axis=0)[:lags].T)
            later = np.fft.irfft(u.conj() * v, length, axis=0)
            negative_lags = later[length - before :]
            cross.append(np.concatenate([negative_lags, later[: lags - before]]).T)
            power.append((moved**2).sum(axis=0))
        return Response(
            step=step,
            own=np.array(own, np.float32),
            cross=np.array(cross, np.float32),
            power=np.array(power, np.float32),
            duration=len(ctrl) * dt,
        )

    @property
    def lags_before(self) -> int:
        """Number of lags at which the state comes before its command."""
        return round(BEFORE_S / self.step)

    def is_comparable(self, other: Response) -> bool:
        """True if `common` can take both: their steps are nearly the same, since clocks vary."""
        same_step = abs(self.step / other.step - 1) <= SAME_STEP
        return same_step and self.lags_before == other.lags_before

    def later(self, seconds: float) -> Response:
        """Return the correlations as if the state had been recorded later; NaN changes nothing."""
        seconds = np.nan_to_num(seconds)
        if seconds == 0:
            return self
        lags = np.arange(self.cross.shape[-1]) * self.step
        rows = self.cross.reshape(-1, len(lags))  # of each part and joint
        moved = [np.interp(lags - seconds, lags, row) for row in rows]
        return replace(self, cross=np.reshape(moved, self.cross.shape).astype(np.float32))

    @staticmethod
    def sharp(responses: list[Response]) -> Array:
        """Return the joints whose commands change quickly enough to show when the joint begins to
        move, (n) bool.
        """
        now = []  # correlation of the command with itself, (n) each
        soon = []  # and with itself SHARP_LAG_S later
        for response in responses:
            own = response.own.sum(axis=0)  # (n, L)
            now.append(own[:, 0])
            soon.append(own[:, max(round(SHARP_LAG_S / response.step), 1)])
        return np.asarray(np.sum(soon, axis=0) < MAX_SHARP_CORRELATION * np.sum(now, axis=0))

    @staticmethod
    def common(responses: list[Response], used: list[bool] | None = None) -> CommonResponse:
        """Estimate the common response of comparable recordings, and how each recording is shifted
        against it.

        Args:
            used: Recordings from which the common response is estimated; all by default.
        """
        step = responses[0].step
        n = responses[0].own.shape[1]
        now = responses[0].lags_before
        lags = min(r.own.shape[2] for r in responses)
        at = (np.arange(lags) - now) * step  # lags of the weights, s
        mask = np.ones(len(responses), bool) if used is None else np.array(used)
        # (recordings, SPLITS, n, lags)
        own = np.stack([r.own[..., :lags] for r in responses]).astype(float)
        cross = np.stack([r.cross[..., :lags] for r in responses]).astype(float)
        power = np.stack([r.power for r in responses]).astype(float)  # (recordings, SPLITS, n)
        own_sum = own[mask].sum(axis=(0, 1))  # (n, lags)
        cross_sum = cross[mask].sum(axis=(0, 1))  # (n, lags)
        power_sum = power[mask].sum(axis=(0, 1))  # (n)
        sharp = Response.sharp(responses)
        onset = np.full(n, np.nan)
        early = np.full(n, np.nan)
        fits = np.zeros((len(responses), SPLITS, len(SHIFTS_S)))
        for j in range(n):
            if own_sum[j, 0] <= 0 or power_sum[j] <= 0:
                continue  # it is not commanded to move, or does not
            joint = _JointResponse.of(own_sum[j], cross_sum[j], power_sum[j], now)
            if joint is None:
                continue
            early[j] = joint.early
            if sharp[j]:
                onset[j] = _onset(joint.weights, at, step)
            # Least squares: weights w leave |v − w∗u|² = power − 2 w·cross + (w∗w)·own unexplained.
            # A fit is minus half of that without the power, in units of the usual residual.
            shifted, square = _shifted_weights(joint.weights, at)
            fits += (cross[:, :, j] @ shifted.T - 0.5 * own[:, :, j] @ square.T) / joint.residual
        return CommonResponse(onset, early, _best_shifts(fits), _best_shifts(fits.sum(axis=1)))


@dataclass(frozen=True)
class CommonResponse:
    """How joints follow their commands in several recordings.

    onset is NaN if a joint does not follow, or if its commands are too smooth to show it.
    """

    onset: Array  # time after which a joint has covered ONSET_SHARE of its way, (n) s
    early: Array  # unexplained power without weights of future commands over that with them, (n)
    shifts: Array  # delay of each part of each recording against all, (recordings, SPLITS) s
    whole: Array  # delay of whole recordings, (recordings) s


class _JointResponse(NamedTuple):
    """How one joint follows its commands."""

    weights: Array  # of commanded velocities before and after, (L)
    residual: float  # power that they do not explain
    early: float  # power that weights of earlier commands alone do not explain, over residual

    @classmethod
    def of(cls, own: Array, cross: Array, power: float, now: int) -> _JointResponse | None:
        """Return the response; None if the joint does not follow.

        Args:
            own, cross, power: As in Response, of one joint.
            now: Index of lag 0 in cross.
        """
        weights = _ridge_weights(own, cross)
        residual = power - weights @ cross
        if residual > MAX_UNEXPLAINED * power or weights.sum() < MIN_FOLLOWED_SHARE:
            return None
        past = _ridge_weights(own[:-now], cross[now:])
        residual_of_past = power - cross[now:] @ past
        return cls(weights, residual, residual_of_past / residual)


def _ridge_weights(own: Array, cross: Array) -> Array:
    """Return the weights of commanded velocities that explain a joint's velocity; all (L).

    Args:
        own: Correlation of the command with itself.
        cross: With the state.
    """
    from scipy.linalg import toeplitz

    return np.linalg.solve(toeplitz(own) + RIDGE * own[0] * np.eye(len(own)), cross)


def _onset(weights: Array, at: Array, step: float) -> float:
    """Return the lag at which a joint has covered ONSET_SHARE of its way, s; NaN if that is the
    earliest one, which also stands for still earlier ones, or for chance.

    Args:
        weights, at: At lags (L) s, `step` s apart.
    """
    progress = np.cumsum(weights) / weights.sum()
    first = int(np.argmax(progress > ONSET_SHARE))
    if first == 0:
        return np.nan
    gain = max(progress[first] - progress[first - 1], 1e-9)
    return float(at[first] + step - step * (progress[first] - ONSET_SHARE) / gain)


def _shifted_weights(weights: Array, at: Array) -> tuple[Array, Array]:
    """Return weights of a joint that follows later by each of SHIFTS_S, and the correlation of
    these with themselves; both (S, L).
    """
    lags = len(weights)
    shifted = np.stack([np.interp(at - s, at, weights, left=0.0, right=0.0) for s in SHIFTS_S])
    spectrum = np.fft.rfft(shifted, 2 * lags, axis=1)
    square = np.fft.irfft(np.abs(spectrum) ** 2, 2 * lags, axis=1)[:, :lags]
    square[:, 1:] *= 2  # for negative lags, at which both correlations are the same
    return shifted, square


def _best_shifts(fits: Array) -> Array:
    """Return the shift of the best fit, (…, S) → (…) s; NaN at an end, or if all fits are equal."""
    best = SHIFTS_S[fits.argmax(axis=-1)]
    at_end = np.abs(best) > SHIFTS_S[-2]
    all_equal = np.ptp(fits, axis=-1) == 0
    return np.where(at_end | all_equal, np.nan, best)
