"""Pure numpy on time series (T, n): resampling, derivatives, delay, and how states follow commands in time.

`Response` holds correlations that add up over recordings: the velocity of a joint is taken as a sum of commanded
velocities of so long ago, and the weights say when it begins to move, and by how much a recording follows later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array

TIE = 0.1  # of a period by which stamps may differ and mean one instant, as in rows that are kept as recorded
FAST = 0.3  # rad/s of fast_speed from which a lag is mostly delay; below, it is mostly stiction
STEP = 0.01  # s at the least
BEFORE, AFTER = 0.12, 0.6  # s of the command before and after the state
PARTS = 3  # of a recording
SHIFTS = np.arange(-0.12, 0.1201, 0.002)  # s by which a part may follow later
RIDGE = 1e-3
SHARP = 0.8  # of the command's power: its correlation 20 ms later
FOLLOWS = 0.7  # of the state's power is left where a joint does not follow


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


def resample_zoh(time: Array, values: Array, grid: Array, near: float = TIE) -> Array:
    """Hold each command until the next one arrives.

    Commands are steps, not ramps: linear interpolation would invent motion the robot was never asked for. A command
    that comes a little after an instant is of that instant: one loop writes state and command with one stamp, and
    neither the grid's rounding nor the loop's jitter may make it a whole period late.

    Args:
        time: Strictly increasing timestamps, (k,), s.
        values: Commands, (k, n), rad.
        grid: Query times, evenly spaced, (T,), s, within [time[0], time[-1]].
        near: How much is a little, of the grid's period.
    """
    slack = near * (grid[-1] - grid[0]) / max(len(grid) - 1, 1)
    return values[np.searchsorted(time, grid + slack, side="right") - 1]  # (T, n)


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
    kernel = np.hanning(7)[1:-1] / np.hanning(7).sum()
    u, v = (np.stack([np.convolve(c, kernel, "same") for c in np.diff(x, axis=0).T]) for x in (ctrl, qpos))
    shifts = range(min(int(max_delay / dt), u.shape[1] // 2) + 1)
    score = np.stack([correlation(u[:, : u.shape[1] - s], v[:, s:]) for s in shifts])  # (S, n)
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


def correlation(a: Array, b: Array) -> Array:
    """Correlate row by row, (n, T) with (n, T) → (n); 0 where one does not change."""
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    product = lambda x, y: np.einsum("it,it->i", x, y)  # noqa: E731
    power = np.sqrt(product(a, a) * product(b, b))
    return np.asarray(product(a, b) / np.where(power > 0, power, np.inf))


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


@dataclass(frozen=True)
class Response:
    """Correlations of one recording in PARTS parts, n joints, at lags of `step` s.

    Attributes:
        own: Correlations of the command with itself, lags 0 … BEFORE + AFTER, (PARTS, n, L).
        cross: Correlations of the command with the state, so much later: −BEFORE … AFTER, (PARTS, n, L).
        power: The power of the state, (PARTS, n).
        duration: s.
    """

    step: float
    own: Array
    cross: Array
    power: Array
    duration: float

    def later(self, seconds: float) -> Response:
        """The same as if the state had been read so much later; what is not known stays so."""
        lags = np.arange(self.cross.shape[-1]) * self.step
        if not (seconds := np.nan_to_num(seconds)):
            return self
        moved = [np.interp(lags - seconds, lags, x) for x in self.cross.reshape(-1, len(lags))]
        return replace(self, cross=np.reshape(moved, self.cross.shape).astype(np.float32))

    @classmethod
    def of(cls, ctrl: Array, qpos: Array, dt: float) -> Response:
        """Correlations of ctrl and qpos (T, n)."""
        every = max(1, round(STEP / dt))
        step = every * dt
        before, lags = round(BEFORE / step), round(BEFORE / step) + round(AFTER / step) + 1
        size = len(ctrl[::every]) // PARTS
        own, cross, power = [], [], []
        for part in range(PARTS):
            rows = slice(part * size, (part + 1) * size)
            u, v = (np.diff(x[::every][rows].astype(float), axis=0) for x in (ctrl, qpos))
            length = 1 << (2 * max(len(u), lags) - 1).bit_length()
            a, b = np.fft.rfft(u, length, axis=0), np.fft.rfft(v, length, axis=0)
            own.append(np.fft.irfft(a.conj() * a, length, axis=0)[:lags].T)
            later = np.fft.irfft(a.conj() * b, length, axis=0)
            cross.append(np.concatenate([later[length - before :], later[: lags - before]]).T)
            power.append((v**2).sum(axis=0))
        same, other, strength = (np.array(x, np.float32) for x in (own, cross, power))
        return Response(step, same, other, strength, duration=len(ctrl) * dt)

    @staticmethod
    def sharp(found: list[Response]) -> Array:
        """Joints whose commands change quickly enough to show when the joint begins to move, (n)."""
        lags = [max(round(0.02 / r.step), 1) for r in found]
        now, soon = (np.sum([r.own.sum(axis=0)[:, k] for r, k in zip(found, ks, strict=True)], axis=0)
                     for ks in ([0] * len(found), lags))  # fmt: skip
        return np.asarray(soon < SHARP * now)

    @staticmethod
    def following(found: list[Response], told: list[bool] | None = None) -> _Following:
        """What recordings at one step say together; those not `told` are shifted against the others, which alone say
        how joints follow."""
        from scipy.linalg import toeplitz

        step, n, lags = found[0].step, *found[0].own.shape[1:]
        at = (np.arange(lags) - round(BEFORE / step)) * step
        use = np.ones(len(found), bool) if told is None else np.array(told)
        parts = [np.stack([getattr(r, f) for r in found]).astype(float) for f in ("own", "cross", "power")]
        own, cross, power = (x[use].sum(axis=(0, 1)) for x in parts)
        quick = Response.sharp(found)
        onset, early, fits = np.full(n, np.nan), np.full(n, np.nan), np.zeros((len(found), PARTS, len(SHIFTS)))
        for j in range(n):
            if own[j, 0] <= 0 or power[j] <= 0:
                continue
            weights = np.linalg.solve(toeplitz(own[j]) + RIDGE * own[j, 0] * np.eye(lags), cross[j])
            left, first = power[j] - weights @ cross[j], round(BEFORE / step)
            if left > FOLLOWS * power[j] or weights.sum() < 0.3:
                continue
            later = toeplitz(own[j, :-first]) + RIDGE * own[j, 0] * np.eye(lags - first)
            early[j] = (power[j] - cross[j, first:] @ np.linalg.solve(later, cross[j, first:])) / left
            way = np.cumsum(weights) / weights.sum()
            first = int(np.argmax(way > 0.05))
            if quick[j] and first:  # the earliest lag of all stands for what is earlier still, or for chance
                before = way[first - 1]
                onset[j] = at[first] + step - step * (way[first] - 0.05) / max(way[first] - before, 1e-9)
            moved = np.stack([np.interp(at - s, at, weights, left=0.0, right=0.0) for s in SHIFTS])
            spread = np.fft.rfft(moved, 2 * lags, axis=1)
            square = np.fft.irfft(np.abs(spread) ** 2, 2 * lags, axis=1)[:, :lags]  # of the weights with themselves
            square[:, 1:] *= 2
            fits += (parts[1][:, :, j] @ moved.T - 0.5 * parts[0][:, :, j] @ square.T) / left
        return _Following(onset, early, _peaks(fits), _peaks(fits.sum(axis=1)))


@dataclass(frozen=True)
class _Following:
    """What some recordings say together.

    Attributes:
        onset: Time after which a joint has made a twentieth of the way, (n) s; NaN where it does not follow, or is
            told to move so smoothly that this is not known.
        early: What is left unexplained without weights of commands to come, over what is left with them, (n).
        shifts: How much later each part of each recording follows than all, (recordings, PARTS) s; whole: all parts
            of each together, (recordings).
    """

    onset: Array
    early: Array
    shifts: Array
    whole: Array


def _peaks(fits: Array) -> Array:
    """Shift of the best fit, (…, S) → (…) s; NaN at an end, and where nothing says."""
    found = SHIFTS[fits.argmax(axis=-1)]
    return np.where((np.abs(found) > SHIFTS[-2]) | (np.ptp(fits, axis=-1) == 0), np.nan, found)
