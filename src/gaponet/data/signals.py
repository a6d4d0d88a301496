"""Pure numpy on time series (T, n): resampling, derivatives, delay."""

from __future__ import annotations

import numpy as np

from gaponet.arrays import Array

FAST = 0.3  # rad/s of fast_speed from which a lag is mostly delay; below, it is mostly stiction


def resample_linear(time: Array, values: Array, grid: Array) -> Array:
    """Interpolate measurements onto a grid; for states, which are continuous, never for commands.

    Args:
        time: Strictly increasing timestamps, (k,), s.
        values: Measurements, (k, n).
        grid: Query times, (T,), s, within [time[0], time[-1]].
    """
    right = np.clip(np.searchsorted(time, grid, side="right"), 1, len(time) - 1)
    left = right - 1
    weight = ((grid - time[left]) / (time[right] - time[left]))[:, None]
    return values[left] * (1 - weight) + values[right] * weight  # (T, n)


def resample_zoh(time: Array, values: Array, grid: Array) -> Array:
    """Hold each command until the next one arrives.

    Commands are steps, not ramps: linear interpolation would invent motion the robot was never asked for.

    Args:
        time: Strictly increasing timestamps, (k,), s.
        values: Commands, (k, n), rad.
        grid: Query times, (T,), s, within [time[0], time[-1]].
    """
    return values[np.searchsorted(time, grid, side="right") - 1]  # (T, n)


def differentiate(values: Array, dt: float) -> Array:
    """Central differences, one-sided at the ends; (T, n) → (T, n) per second. No phase shift."""
    return np.gradient(values, dt, axis=0)


def lowpass(values: Array, dt: float, cutoff: float) -> Array:
    """Zero-phase second-order Butterworth, for derivatives of logged signals; never inside a control loop.

    Args:
        values: (T, n).
        dt: s.
        cutoff: Hz, below 1 / (2 dt).
    """
    from scipy.signal import butter, sosfiltfilt

    sos = butter(2, min(cutoff * 2 * dt, 0.99), output="sos")
    return sosfiltfilt(sos, values, axis=0)  # (T, n)


def estimate_delay(ctrl: Array, qpos: Array, dt: float, max_delay: float = 0.4) -> Array:
    """Command-to-state lag of each joint: the shift at which velocity follows commanded velocity best.

    Positions would let slow drift and sag decide; correlated velocities see motion only. Parabolic interpolation around
    the best whole shift gives a resolution below dt.

    Args:
        ctrl, qpos: (T, n), rad.
        dt: s.
        max_delay: Longest lag tried, s.

    Returns:
        (n,) s; NaN for a joint that was not commanded to move (range below 0.02 rad), does not follow (correlation
        below 0.3) or follows best at the longest lag tried, which then is no maximum: slow motions through stiction.
    """
    kernel = np.hanning(7)[1:-1, None] / np.hanning(7).sum()
    smooth = lambda x: np.apply_along_axis(lambda c: np.convolve(c, kernel[:, 0], "same"), 0, np.diff(x, axis=0))  # noqa: E731
    u, v = smooth(ctrl), smooth(qpos)
    shifts = range(min(int(max_delay / dt), len(u) // 2) + 1)
    score = np.stack([_correlation(u[: len(u) - s], v[s:]) for s in shifts])  # (S, n)
    best = score.argmax(axis=0)
    delay = np.full(ctrl.shape[1], np.nan)
    for j, s in enumerate(best):
        if np.ptp(ctrl[:, j]) < 0.02 or not score[s, j] > 0.3 or s == len(score) - 1:
            continue
        offset = 0.0
        if s > 0:
            a, b, c = score[s - 1 : s + 2, j]
            offset = 0.5 * (a - c) / (a - 2 * b + c) if a - 2 * b + c < 0 else 0.0
        delay[j] = (s + offset) * dt
    return delay


def fast_speed(ctrl: Array, dt: float) -> Array:
    """How fast a joint is commanded when it is commanded fast: 95th percentile of the speed, (T, n) → (n), rad/s."""
    return np.percentile(np.abs(differentiate(ctrl, dt)), 95, axis=0)


def _correlation(a: Array, b: Array) -> Array:
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    power = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return (a * b).sum(axis=0) / np.where(power > 0, power, np.inf)


def busiest(qpos: Array, rows: int) -> int:
    """First row of the stretch of so many periods with the most motion; qpos (T, n) rad."""
    moved = np.concatenate([[0.0], np.abs(np.diff(qpos, axis=0)).sum(axis=1).cumsum()])
    return 0 if len(moved) <= rows else int((moved[rows:] - moved[:-rows]).argmax())


def encoder_step(recordings: list[Array]) -> float:
    """The smallest step between distinct readings of one joint, rad; 0 where readings are continuous."""
    values = np.unique(np.concatenate(recordings).astype(np.float64))
    steps = np.diff(values)
    steps = steps[steps > 2e-6]  # below: rounding of the stored float32
    if steps.size < 10:
        return 0.0
    step = float(np.percentile(steps, 5))
    off = np.abs(steps / step - np.round(steps / step))
    return step if np.median(off) < 0.1 else 0.0
