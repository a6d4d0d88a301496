"""Survey: what one sequence shows about its own recording, measured and not yet judged."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.holds import Holds
from gaponet.data.sequence import Sequence
from gaponet.data.signals import FAST, Response, correlation, differentiate, estimate_delay, fast_speed, lowpass
from gaponet.data.store import Entry
from gaponet.robot.spec import RobotSpec

MAX_LAG_S = 0.4
BLOCKED_ERROR = 0.15  # standing this far from a command, rad; a loaded joint may, so the command must also move
BLOCKED_CHANGE = 0.1  # by this, rad, without moving the joint
STAND_S, STAND = 0.2, 0.005  # a joint that moves less than this in this time stands: s, rad
FROZEN_CHANGE = 0.1  # the command must move this far while the state repeats itself, rad
SLOPE_RANGE = 0.2  # commanded over less, sag and stiction decide the slope, rad
SLOW_HERTZ = 0.3  # faster, a servo's resonance has its own scale
LOADS, SLOW = 60, 0.5  # rows of a sequence in which torque is compared with gravity; no joint is faster there, rad/s
TORQUE_NOISE = 0.05  # of the limit; a reading may exceed it by that
COPIED = 1e-5  # command and state closer than this are one signal, rad
JUMP, JUMP_ACCELERATION = 0.1, 1000.0  # off the line between its neighbours by this, rad, no joint turns back so fast
DROPPED = 0.05  # a row of zeros so far from the next row was not measured, rad
FLAT = 0.02  # rad that a joint moves while its torque says one number
STEPPED = 0.05  # rad by which a command jumps, and a torque with it
HERTZ = np.arange(0.5, 60, 0.1)  # of spectra
SPIKE_WINDOW_S, SPIKE_SHARE = 0.3, 0.3  # above the running median by this share of the torque limit


@dataclass(frozen=True)
class Torque:
    """Torques of one sequence, per joint (n): least and greatest, N·m; rows above the limit; rows that are spikes;
    rows at exactly the greatest size while the joint moves on."""

    low: Array
    high: Array
    over_limit: Array
    spikes: Array
    flat: Array


@dataclass(frozen=True)
class Survey:
    """Numbers of one sequence; n joints in robot order.

    Attributes:
        samples: Hash of command and state alone, whatever unit or payload they are filed under.
        rate_hz, jitter_ms, longest_gap_ms: From the state's own timestamps; jitter: the largest deviation from median.
        ctrl_limits, qpos_limits: (n, 2), least and greatest, rad.
        speed: signals.fast_speed of the command, (n), rad/s.
        delay: (n) s, NaN where the motion does not say.
        follows, opposes: (n, n); [i, j] is the greatest correlation of commanded velocity i with measured velocity j,
            and with its negative, at lags up to MAX_LAG_S; 0 where one does not move; periodic motion does both.
        lead: Time by which the state moves before its command, (n) s, NaN where it does not.
        slope: How far the state goes where the command goes 1 rad, (n); NaN where the motion does not say.
        copied: Joints whose state is the command itself, (n).
        jumps: Rows in which a joint is where it cannot have come from and gone back to, (n).
        dropped: Rows in which every joint is exactly 0 and was not a row before or after.
        qvel_gain: Recorded qvel over the derivative of qpos, (n); NaN where the joint hardly moves.
        blocked_s, blocked_at: Longest stand-still far from a command that moves on, (n) s, and where, rad.
        frozen_s: Longest stretch in which no sample of the state changed while the command moved, s.
        stopped_s: Longest stretch in which a joint repeated one number while its command had long moved on, (n) s.
        step: Steps in which positions are told, (n) rad; 0 where they are fine, or too few to tell.
        torque: None where no torque was recorded.
        holds: Rests.
        response: When operated joints move after their commands (data.signals). spectra: Of command and state, (2, H).
        beside: How far the nearest state is from the command of up to MAX_LAG_S ago, over that state's spread, (n); NaN
            where the joint does not move.
        as_velocity, as_torque: Correlation of the command with the measured velocity and torque, (n).
        halted_s: Longest time for which all joints stood at once while the commands of half of them moved on, s.
        loads: Joint angles and torques, (2, k, n), in slow rows; None where no torque was recorded.
    """

    entry: Entry
    samples: str
    rate_hz: float
    jitter_ms: float
    longest_gap_ms: float
    ctrl_limits: Array
    qpos_limits: Array
    speed: Array
    delay: Array
    follows: Array
    opposes: Array
    lead: Array
    slope: Array
    copied: Array
    jumps: Array
    dropped: int
    qvel_gain: Array
    blocked_s: Array
    blocked_at: Array
    frozen_s: float
    stopped_s: Array
    step: Array
    torque: Torque | None
    holds: Holds
    response: Response
    spectra: Array
    beside: Array
    as_velocity: Array
    as_torque: Array
    halted_s: float
    loads: Array | None

    @property
    def motion(self) -> str:
        """Name."""
        return self.entry.meta.motion

    @property
    def ctrl_range(self) -> Array:
        """(n) rad."""
        return np.ptp(self.ctrl_limits, axis=1)

    @property
    def qpos_range(self) -> Array:
        """(n) rad."""
        return np.ptp(self.qpos_limits, axis=1)

    @classmethod
    def of(cls, entry: Entry, sequence: Sequence, robot: RobotSpec) -> Survey:
        """Measure one sequence."""
        ctrl, qpos, dt, notes = sequence.ctrl, sequence.qpos, sequence.dt, entry.meta.notes
        blocked_s, blocked_at = _blocked(ctrl, qpos, dt)
        follows, opposes = _follows(ctrl, qpos, dt)
        delay, lead = estimate_delay(ctrl, qpos, dt, MAX_LAG_S), estimate_delay(qpos, ctrl, dt, MAX_LAG_S)
        return Survey(
            entry=entry,
            samples=hashlib.sha256(ctrl.tobytes() + qpos.tobytes()).hexdigest(),
            rate_hz=float(notes.get("rate_hz", 1 / dt)),
            jitter_ms=float(notes.get("jitter_ms", 0.0)),
            longest_gap_ms=float(notes.get("longest_gap_ms", dt * 1e3)),
            ctrl_limits=np.stack([ctrl.min(axis=0), ctrl.max(axis=0)], axis=1),
            qpos_limits=np.stack([qpos.min(axis=0), qpos.max(axis=0)], axis=1),
            speed=fast_speed(ctrl, dt),
            delay=delay,
            follows=follows,
            opposes=opposes,
            lead=np.where((lead > 1.5 * dt) & ~(delay > 0.5 * dt), lead, np.nan),
            slope=_slope(ctrl, qpos, dt, np.nan_to_num(delay) / dt, fast_speed(ctrl, dt)),
            copied=(np.ptp(ctrl, axis=0) > 0.05) & (np.abs(ctrl - qpos) < COPIED).all(axis=0),
            jumps=_jumps(qpos, dt),
            dropped=_dropped(sequence, notes, robot),
            qvel_gain=_qvel_gain(sequence),
            blocked_s=blocked_s,
            blocked_at=blocked_at,
            frozen_s=_frozen(sequence),
            stopped_s=_stopped(ctrl, qpos, dt),
            step=_step(qpos),
            torque=_torque(sequence, robot),
            holds=Holds.of(sequence, robot.operated_index),
            response=Response.of(ctrl[:, robot.operated_index], qpos[:, robot.operated_index], dt),
            spectra=np.stack([_spectrum(ctrl, dt), _spectrum(qpos, dt)]).astype(np.float32),
            **_kind(sequence),
            halted_s=_halted(ctrl, qpos, dt),
            loads=_loads(sequence),
        )


def _follows(ctrl: Array, qpos: Array, dt: float) -> tuple[Array, Array]:
    """Velocities over a step of about 60 ms; lags in steps of about 40 ms."""
    span, stride = max(1, round(0.06 / dt)), max(1, round(0.04 / dt))
    u, v = ctrl[span:] - ctrl[:-span], qpos[span:] - qpos[:-span]
    most, least = np.zeros((2, ctrl.shape[1], ctrl.shape[1]))
    for lag in range(0, min(round(MAX_LAG_S / dt), len(u) // 2) + 1, stride):
        a, b = u[: len(u) - lag], v[lag:]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        scale = np.sqrt(np.outer((a**2).sum(axis=0), (b**2).sum(axis=0)))
        correlation = (a.T @ b) / np.where(scale > 0, scale, np.inf)
        most, least = np.maximum(most, correlation), np.minimum(least, correlation)
    return most, -least


def _slope(ctrl: Array, qpos: Array, dt: float, lag: Array, speed: Array) -> Array:
    """Slope of the state over the command of `lag` rows ago; where a fast joint's lag is unknown, nothing is said."""
    slope = np.full(len(lag), np.nan)
    slow = [lowpass(x, dt, SLOW_HERTZ) for x in (ctrl, qpos)] if len(ctrl) * dt > 3 / SLOW_HERTZ else None
    for j in np.flatnonzero((np.ptp(ctrl, axis=0) > SLOPE_RANGE) & ((lag > 0) | (speed < FAST))):
        steps, found = round(float(lag[j])), []
        for a, b in ((ctrl, qpos), *([slow] if slow and np.ptp(slow[0][:, j]) > SLOPE_RANGE else [])):
            u, v = a[: len(a) - steps, j].astype(float), b[steps:, j].astype(float)
            u = u - u.mean()
            found.append(float(u @ v / (u @ u)))
        slope[j] = min(found, key=lambda x: abs(x - 1))  # what a resonance makes of it is no scale
    return slope


def _kind(sequence: Sequence) -> dict[str, Array]:
    """What the command is like: the position soon after, the velocity, or the torque?"""
    every = max(1, round(0.02 / sequence.dt))
    ctrl, qpos = (np.ascontiguousarray(x[::every].T, float) for x in (sequence.ctrl, sequence.qpos))  # (n, T)
    rows, speed = qpos.shape[1], np.gradient(qpos, axis=1)
    beside, fast = [], []
    for lag in range(0, min(round(MAX_LAG_S / 0.02), rows // 2), 2):
        u, q = ctrl[:, : rows - lag], qpos[:, lag:]
        both = np.abs(u @ q.T) / (rows - lag)  # (n, n)
        told, is_at, spread = (u**2).mean(axis=1)[:, None], (q**2).mean(axis=1), np.maximum(q.var(axis=1), 1e-12)
        for scale in (1.0, np.degrees(1), np.radians(1)):  # units, signs and names are other checks' matters
            away = scale**2 * told + is_at - 2 * scale * both
            beside.append((np.maximum(away, 0) / spread).min(axis=1))
        fast.append(correlation(u, speed[:, lag:]))
    near = np.where(np.ptp(qpos, axis=1) > 0.05, np.sqrt(np.min(beside, axis=0)), np.nan)
    torque = np.full(near.shape, np.nan) if sequence.tau is None else correlation(ctrl, sequence.tau[::every].T)
    return {"beside": near, "as_velocity": np.max(fast, axis=0), "as_torque": torque}


def _halted(ctrl: Array, qpos: Array, dt: float) -> float:
    """The brakes are on, or the drives off: two joints at least are told to move."""
    w = max(1, round(STAND_S / dt))
    stands = np.zeros(len(qpos), bool)
    stands[w:] = (np.abs(qpos[w:] - qpos[:-w]) < STAND).all(axis=1)
    told = max(2.0, 0.5 * (np.ptp(ctrl, axis=0) > BLOCKED_CHANGE).sum())
    late = round(MAX_LAG_S / dt)
    runs = [r for r in _runs(stands) if r.stop - r.start > 2 * late]
    runs = [r for r in runs if (np.ptp(ctrl[r.start : r.stop - late], axis=0) > BLOCKED_CHANGE).sum() >= told]
    return max((r.stop - r.start for r in runs), default=0) * dt


def _jumps(qpos: Array, dt: float) -> Array:
    off = np.abs(qpos[1:-1] - (qpos[:-2] + qpos[2:]) / 2)
    return (off > max(JUMP, JUMP_ACCELERATION / 2 * dt**2)).sum(axis=0)


def _dropped(sequence: Sequence, notes: dict[str, Any], robot: RobotSpec) -> int:
    """Joints that were not logged, or not in rad, are no zeros; one joint alone may well pass through zero."""
    strange = {*notes.get("held_at_home", ()), *(j for j, u in notes.get("converted_from", {}).items() if u != "deg")}
    logged = [i for i, name in enumerate(robot.joint_names) if name not in strange]
    if len(logged) < 2:
        return 0
    count = 0
    for values, ends in ((sequence.qpos[:, logged], 1), (sequence.ctrl[:, logged], 2)):
        far = np.abs(np.diff(values, axis=0)).max(axis=1) > DROPPED  # (T − 1,)
        for run in _runs((values == 0).all(axis=1)):
            edges = [*far[run.start - 1 : run.start if run.start else 0], *far[run.stop - 1 : run.stop]]
            # A command may step away from zero; it does not step there and back within a few rows.
            if sum(edges) >= ends and (ends == 1 or run.stop - run.start <= 5):
                count += run.stop - run.start
    return count


def _loads(sequence: Sequence) -> Array | None:
    if sequence.tau is None:
        return None
    slow = np.flatnonzero((np.abs(sequence.qvel) < SLOW).all(axis=1))
    rows = slow[:: max(1, len(slow) // LOADS)]
    return np.stack([sequence.qpos[rows], sequence.tau[rows]])


def _qvel_gain(sequence: Sequence) -> Array:
    derivative = differentiate(sequence.qpos, sequence.dt)
    power = (derivative**2).sum(axis=0)
    moves = np.ptp(sequence.qpos, axis=0) > 0.05
    return np.where(moves, (sequence.qvel * derivative).sum(axis=0) / np.where(power > 0, power, 1.0), np.nan)


def _blocked(ctrl: Array, qpos: Array, dt: float) -> tuple[Array, Array]:
    w = max(1, round(STAND_S / dt))
    stands = np.zeros(qpos.shape, bool)
    stands[w:] = np.abs(qpos[w:] - qpos[:-w]) < STAND
    seconds, places = np.zeros((2, qpos.shape[1]))
    for j, mask in enumerate((stands & (np.abs(ctrl - qpos) > BLOCKED_ERROR)).T):
        runs = [r for r in _runs(mask) if np.ptp(ctrl[r, j]) > BLOCKED_CHANGE]
        if runs:
            longest = max(runs, key=lambda r: r.stop - r.start)
            seconds[j], places[j] = (longest.stop - longest.start) * dt, qpos[longest.start, j]
    return seconds, places


def _frozen(sequence: Sequence) -> float:
    """A resting robot repeats its positions; one whose every signal repeats while it is told to move is not read."""
    state = [getattr(sequence, name) for name in ("qpos", "qvel", "tau", "temperature")]
    same = np.all([(np.diff(x, axis=0) == 0).all(axis=1) for x in state if x is not None], axis=0)
    late = round(MAX_LAG_S / 2 / sequence.dt)
    asked = lambda r: np.ptp(sequence.ctrl[r.start : max(r.stop - late, r.start) + 1], axis=0).max()  # noqa: E731
    return max((r.stop - r.start for r in _runs(same) if asked(r) > FROZEN_CHANGE), default=0) * sequence.dt


def _stopped(ctrl: Array, qpos: Array, dt: float) -> Array:
    """A loaded or stuck joint stands still, but noise and encoder steps change its number, and it gives in at last."""
    late = round(MAX_LAG_S / 2 / dt)
    seconds = np.zeros(qpos.shape[1])
    for j, same in enumerate((np.diff(qpos, axis=0) == 0).T):
        for r in _runs(same):
            asked = ctrl[r.start : max(r.stop - late, r.start), j]
            if len(asked) and np.ptp(asked) > FROZEN_CHANGE:
                seconds[j] = max(seconds[j], (r.stop - r.start) * dt)
    return seconds


def _step(qpos: Array) -> Array:
    """The step of which all positions are multiples but for a constant, where a few dozen numbers are all there are."""
    found = np.zeros(qpos.shape[1])
    for j, column in enumerate(qpos.T):
        levels = np.unique(column.astype(float))
        gaps = np.diff(levels)
        if 8 <= len(levels) <= len(column) / 4:
            step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
            if np.abs(gaps / step - np.round(gaps / step)).max() < 0.1:
                found[j] = step
    return found


def _runs(mask: Array) -> list[slice]:
    """Runs of True in (T,)."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _torque(sequence: Sequence, robot: RobotSpec) -> Torque | None:
    if sequence.tau is None:
        return None
    from scipy.ndimage import maximum_filter1d, median_filter

    tau = sequence.tau
    size = np.abs(tau)
    window = max(3, round(SPIKE_WINDOW_S / sequence.dt))
    usual = median_filter(size, size=(window, 1), mode="nearest")
    jumps = np.abs(np.diff(sequence.ctrl, axis=0, prepend=sequence.ctrl[:1])).max(axis=1) > STEPPED
    calm = maximum_filter1d(jumps, 2 * window + 1) == 0
    flat = [sum(r.stop - r.start for r in _runs(x == x.max()) if r.stop - r.start >= FLAT) for x in size.T]
    return Torque(
        low=tau.min(axis=0),
        high=tau.max(axis=0),
        over_limit=(size > robot.effort_limit * (1 + TORQUE_NOISE)).sum(axis=0),
        spikes=((size - usual > SPIKE_SHARE * robot.effort_limit) & calm[:, None]).sum(axis=0),
        flat=np.array(flat),
    )


def _spectrum(qpos: Array, dt: float) -> Array:
    """Mean logarithm of the power of the velocities that are not zero, at HERTZ, (H); NaN above half the rate."""
    moved = qpos[:, np.ptp(qpos, axis=0) > 0.02].astype(float)
    if not moved.size or len(moved) < 100:
        return np.full(len(HERTZ), np.nan)
    v = np.diff(moved, axis=0)
    power = np.log(np.abs(np.fft.rfft(v * np.hanning(len(v))[:, None], axis=0)) ** 2 + 1e-30).mean(axis=1)
    smooth = np.convolve(power, np.ones(3) / 3, "same")
    return np.where(0.48 / dt > HERTZ, np.interp(HERTZ, np.fft.rfftfreq(len(v), dt), smooth), np.nan)
