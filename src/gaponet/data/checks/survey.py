"""Survey: measurements of one sequence about its own recording, without judgement (data.checks
judges).

`survey_all` measures the sequences of a dataset, in several processes if there are many.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.executor import LOCAL, open_pool
from gaponet.base.progress import Progress
from gaponet.data.describe.row_copies import copied_rows
from gaponet.data.log import Channel
from gaponet.data.sequence import Sequence
from gaponet.data.signals import (
    FAST_COMMAND_RAD_S,
    Response,
    correlation,
    differentiate,
    estimate_delay,
    fast_speed,
    lowpass,
    range_before,
)
from gaponet.data.static_poses import StaticPoses
from gaponet.data.store import Dataset, Entry
from gaponet.robot.spec import RobotSpec

MAX_LAG_S = 0.4
# a joint that moves less in this time stands still
STANDSTILL_S = 0.2
STANDSTILL_RAD = 0.005
# distance of a blocked joint from its command; a loaded joint may be as far, so that its command
# must also move
BLOCKED_ERROR_RAD = 0.15
BLOCKED_COMMAND_RAD = 0.1
REPEATED_COMMAND_RAD = 0.1  # the command must move by this while the state repeats itself
SLOPE_MIN_RANGE_RAD = 0.2  # of the command; below, sag and stiction decide the slope
SLOW_HZ = 0.3  # faster, a servo's resonance changes the slope
# rows in which torque is compared with gravity, and the highest speed there
GRAVITY_SAMPLES = 60
SLOW_RAD_S = 0.5
MOTION_HZ = 4.0  # above it, noise and a servo's resonance outweigh the weight of the links
# of a recording in which motion is compared with the model
MOTION_ROWS = 60
MIN_MOTION_ROWS = 10
MOTION_MARGIN_S = 0.2  # at both ends, where smoothing is poor
# time and range of a command that stands still
HOLD_S = 0.4
HELD_COMMAND_RAD = 2e-3
TORQUE_TOLERANCE = 0.05  # share of the torque limit by which a reading may exceed it
# distance from the line between the neighbouring rows that no joint reaches
JUMP_RAD = 0.1
JUMP_RAD_S2 = 1000.0
ZERO_JUMP_RAD = 0.05  # step from a row of zeros to the next row
COMMAND_STEP_RAD = 0.05  # step of a command; the torque may follow it
# above the running median by this share of the torque limit
SPIKE_WINDOW_S = 0.3
SPIKE_SHARE = 0.3
SPECTRUM_HZ = np.arange(0.5, 60, 0.1)
MOVING_RAD = 0.05
# of one job; from which starting processes pays
JOB_ROWS = 40_000
MIN_PARALLEL_ROWS = 600_000
OVERHEAD_ROWS = 1500  # rows that take as long as the fixed costs of a recording
# distinct positions from which a step is known; deviation in steps
LEVELS = 8
LEVEL_TOLERANCE = 0.1


class Torque(NamedTuple):
    """Torques of one sequence per joint, (n)."""

    low: Array  # N·m
    high: Array
    over_limit: Array  # rows above the torque limit
    spikes: Array  # rows far above the rows around
    flat: Array  # rows at exactly the greatest magnitude


@dataclass(frozen=True)
class Timing:
    """Times of the rows of one sequence, from the state's timestamps."""

    rate_hz: float
    jitter_ms: float  # largest deviation of a period from the median
    uneven_ms: float  # 95th percentile of these deviations
    longest_gap_ms: float

    @classmethod
    def of(cls, notes: dict[str, Any], dt: float) -> Timing:
        """Take what the import noted; without notes, rows are dt (s) apart."""
        return Timing(
            rate_hz=float(notes.get("rate_hz", 1 / dt)),
            jitter_ms=float(notes.get("jitter_ms", 0.0)),
            uneven_ms=float(notes.get("uneven_ms", 0.0)),
            longest_gap_ms=float(notes.get("longest_gap_ms", dt * 1e3)),
        )

    @property
    def missing_samples(self) -> bool:
        """True if a period is 2.5 times as long as usual."""
        return self.longest_gap_ms * self.rate_hz / 1e3 > 2.5


@dataclass(frozen=True)
class Tracking:
    """How the state of one sequence follows its command, n joints.

    follows and opposes [i, j] are the greatest correlation of commanded velocity i with measured
    velocity j, and with its negative, at lags up to MAX_LAG_S; 0 where one does not move. Periodic
    motion shows both.
    """

    speed: Array  # signals.fast_speed of the command, (n) rad/s
    delay: Array  # of the state behind the command, (n) s; NaN where the motion does not show it
    lead: Array  # of the state before the command, (n) s; NaN where there is none
    follows: Array  # (n, n)
    opposes: Array
    # motion of the state per motion of the command, (n); NaN where the motion does not show it
    slope: Array
    # rows by which the state repeats the command (describe.row_copies), (n); NaN where it does not
    copied_rows: Array
    response: Response  # of the operated joints

    @classmethod
    def of(cls, sequence: Sequence, robot: RobotSpec) -> Tracking:
        """Compare command and state of one sequence."""
        ctrl = sequence.ctrl
        qpos = sequence.qpos
        dt = sequence.dt
        op = robot.operated_index
        speed = fast_speed(ctrl, dt)
        follows, opposes = _correlations(ctrl, qpos, dt)
        delay = estimate_delay(ctrl, qpos, dt, MAX_LAG_S)
        lead = estimate_delay(qpos, ctrl, dt, MAX_LAG_S)
        return Tracking(
            speed=speed,
            delay=delay,
            lead=np.where((lead > 1.5 * dt) & ~(delay > 0.5 * dt), lead, np.nan),
            follows=follows,
            opposes=opposes,
            slope=_slope(ctrl, qpos, dt, np.nan_to_num(delay) / dt, speed),
            copied_rows=_copied_rows(sequence),
            response=Response.of(ctrl[:, op], qpos[:, op], dt),
        )


@dataclass(frozen=True)
class KindOfCommand:
    """What a command is like: a position, a velocity or a torque; n joints."""

    # nearest state to the command of up to MAX_LAG_S before, in standard deviations of the state,
    # (n); NaN where the joint does not move
    distance: Array
    velocity_correlation: Array  # of the command with the measured velocity, (n)
    torque_correlation: Array  # of the command with the measured torque, (n)


@dataclass(frozen=True)
class Standstill:
    """Joints that stand still while their commands move, n joints."""

    blocked_s: Array  # longest standstill far from a moving command, (n) s
    blocked_at: Array  # its position, (n) rad
    all_s: float  # longest standstill of all joints while the commands of half of them move
    # longest stretch in which a joint repeats one number while its command moves, (n) s
    repeated_s: Array
    # longest stretch in which the whole state repeats itself while the command moves
    all_repeated_s: float

    @classmethod
    def of(cls, sequence: Sequence) -> Standstill:
        """Measure the standstills of one sequence."""
        ctrl = sequence.ctrl
        qpos = sequence.qpos
        blocked_s, blocked_at = _blocked(ctrl, qpos, sequence.dt)
        return Standstill(
            blocked_s=blocked_s,
            blocked_at=blocked_at,
            all_s=_standstill(ctrl, qpos, sequence.dt),
            repeated_s=_repeated(ctrl, qpos, sequence.dt),
            all_repeated_s=_all_repeated(sequence),
        )


@dataclass(frozen=True)
class Encoders:
    """Readings of position and velocity of one sequence, n joints."""

    jump_rows: Array  # rows with a position that no joint can reach and leave in a period, (n)
    zero_rows: int  # rows in which every joint is exactly 0, far from the rows around
    # recorded qvel over the derivative of qpos, (n); NaN where the joint hardly moves
    qvel_ratio: Array
    # step between positions, (n) rad; 0 where positions are continuous, or too few
    resolution: Array

    @classmethod
    def of(cls, sequence: Sequence, notes: dict[str, Any], robot: RobotSpec) -> Encoders:
        """Measure the readings of one sequence."""
        qpos = sequence.qpos
        # from the line between the neighbouring rows
        apart = np.abs(qpos[1:-1] - (qpos[:-2] + qpos[2:]) / 2)
        return Encoders(
            jump_rows=(apart > max(JUMP_RAD, JUMP_RAD_S2 / 2 * sequence.dt**2)).sum(axis=0),
            zero_rows=_zero_rows(sequence, notes, robot),
            qvel_ratio=_qvel_ratio(sequence),
            resolution=_resolution(qpos),
        )


@dataclass(frozen=True)
class Samples:
    """Rows of one sequence that are compared with the model of the robot."""

    static_poses: StaticPoses
    # positions and torques in slow rows, (2, k, n); None if no torque was recorded
    gravity: Array | None
    # rows of smoothed motion: position, velocity, acceleration, torque (NaN if none was recorded),
    # command − position (its lag taken off), and the command's velocity and acceleration,
    # (7, k, n) in SI; None if the recording is too short
    movement: Array | None
    # of single joints that rest under a constant command: joint, command − position (rad), torque,
    # and positions of all joints, (k, 3 + n); None if no torque was recorded
    holds: Array | None


@dataclass(frozen=True)
class Survey:
    """Measurements of one sequence; n joints in robot order."""

    entry: Entry
    content: str  # hash of command and state alone, without unit and payload
    timing: Timing
    ctrl_limits: Array  # least and greatest, (n, 2) rad
    qpos_limits: Array
    tracking: Tracking
    kind: KindOfCommand
    standstill: Standstill
    encoders: Encoders
    torque: Torque | None  # None if no torque was recorded
    samples: Samples
    spectra: Array  # log power of command and state at SPECTRUM_HZ, (2, H)

    @property
    def motion(self) -> str:
        """Name of the motion."""
        return self.entry.meta.motion

    @property
    def ctrl_range(self) -> Array:
        """(n) rad."""
        return np.asarray(np.ptp(self.ctrl_limits, axis=1))

    @property
    def qpos_range(self) -> Array:
        """(n) rad."""
        return np.asarray(np.ptp(self.qpos_limits, axis=1))

    @classmethod
    def of(cls, entry: Entry, sequence: Sequence, robot: RobotSpec) -> Survey:
        """Measure one sequence."""
        ctrl = sequence.ctrl
        qpos = sequence.qpos
        dt = sequence.dt
        notes = entry.meta.notes
        tracking = Tracking.of(sequence, robot)
        samples = Samples(
            static_poses=StaticPoses.of(sequence, robot.operated_index),
            gravity=_gravity_samples(sequence),
            movement=_movement(sequence, tracking.delay),
            holds=_holds(sequence),
        )
        return Survey(
            entry=entry,
            content=hashlib.sha256(ctrl.tobytes() + qpos.tobytes()).hexdigest(),
            timing=Timing.of(notes, dt),
            ctrl_limits=np.stack([ctrl.min(axis=0), ctrl.max(axis=0)], axis=1),
            qpos_limits=np.stack([qpos.min(axis=0), qpos.max(axis=0)], axis=1),
            tracking=tracking,
            kind=_kind_of_command(sequence),
            standstill=Standstill.of(sequence),
            encoders=Encoders.of(sequence, notes, robot),
            torque=_torque(sequence, robot),
            samples=samples,
            spectra=np.stack([_spectrum(ctrl, dt), _spectrum(qpos, dt)]).astype(np.float32),
        )


def survey_all(
    dataset: Dataset, robot: RobotSpec, progress: Progress, executor: str | Executor
) -> list[Survey]:
    """Return one survey per sequence, in the order of the dataset's entries; many are measured by
    the executor.

    Raises:
        WorkerError: Workers of the executor died.
    """
    surveys = []
    for survey in _measure(dataset, robot, executor):
        surveys.append(survey)
        progress(len(surveys), len(dataset), survey.motion)
    return surveys


def _measure(dataset: Dataset, robot: RobotSpec, executor: str | Executor) -> Iterator[Survey]:
    jobs = list[list[Entry]]()
    rows = JOB_ROWS
    total = 0
    for entry in dataset.entries:
        if rows + entry.rows > JOB_ROWS:
            jobs = [*jobs, []]
            rows = 0
        jobs[-1].append(entry)
        rows += entry.rows + OVERHEAD_ROWS
        total += entry.rows + OVERHEAD_ROWS
    if executor == LOCAL and (len(jobs) < 2 or total < MIN_PARALLEL_ROWS):
        for entry in dataset.entries:
            yield Survey.of(entry, dataset.read(entry), robot)
        return
    loaded = ([(entry, dataset.read(entry)) for entry in job] for job in jobs)
    with open_pool(executor, 0) as pool:
        for surveys in pool.map(partial(_survey_job, robot=robot), loaded):
            yield from surveys


def _survey_job(job: list[tuple[Entry, Sequence]], robot: RobotSpec) -> list[Survey]:
    return [Survey.of(entry, sequence, robot) for entry, sequence in job]


def _correlations(ctrl: Array, qpos: Array, dt: float) -> tuple[Array, Array]:
    """Return `follows` and `opposes`: velocities over about 60 ms, at lags in steps of about 40
    ms.
    """
    span = max(1, round(0.06 / dt))
    stride = max(1, round(0.04 / dt))
    u = ctrl[span:] - ctrl[:-span]
    v = qpos[span:] - qpos[:-span]
    most, least = np.zeros((2, ctrl.shape[1], ctrl.shape[1]))
    for lag in range(0, min(round(MAX_LAG_S / dt), len(u) // 2) + 1, stride):
        a = u[: len(u) - lag]
        b = v[lag:]
        a = a - a.mean(axis=0)
        b = b - b.mean(axis=0)
        scale = np.sqrt(np.outer((a**2).sum(axis=0), (b**2).sum(axis=0)))
        coefficients = (a.T @ b) / np.where(scale > 0, scale, np.inf)
        most = np.maximum(most, coefficients)
        least = np.minimum(least, coefficients)
    return most, -least


def _slope(ctrl: Array, qpos: Array, dt: float, lag: Array, speed: Array) -> Array:
    """Return the slope of the state over the command of `lag` rows before; NaN for a fast joint
    with unknown lag.
    """
    slope = np.full(len(lag), np.nan)
    signals = [(ctrl, qpos)]
    if len(ctrl) * dt > 3 / SLOW_HZ:
        signals.append((lowpass(ctrl, dt, SLOW_HZ), lowpass(qpos, dt, SLOW_HZ)))
    is_moved = np.ptp(ctrl, axis=0) > SLOPE_MIN_RANGE_RAD
    for j in np.flatnonzero(is_moved & ((lag > 0) | (speed < FAST_COMMAND_RAD_S))):
        steps = round(float(lag[j]))
        slopes = []
        for commands, states in signals:
            if np.ptp(commands[:, j]) > SLOPE_MIN_RANGE_RAD:
                slopes.append(_fitted_slope(commands[:, j], states[:, j], steps))
        slope[j] = min(slopes, key=lambda x: abs(x - 1))  # a resonance changes one of them
    return slope


def _fitted_slope(command: Array, state: Array, steps: int) -> float:
    """Return the least-squares slope of a state (T,) over the command `steps` rows before."""
    before = command[: len(command) - steps].astype(float)
    after = state[steps:].astype(float)
    before = before - before.mean()
    return float(before @ after / (before @ before))


def _kind_of_command(sequence: Sequence) -> KindOfCommand:
    """Compare the command with the position soon after, with the velocity, and with the torque."""
    every = max(1, round(0.02 / sequence.dt))
    ctrl = np.ascontiguousarray(sequence.ctrl[::every].T, float)  # (n, T)
    qpos = np.ascontiguousarray(sequence.qpos[::every].T, float)
    rows = qpos.shape[1]
    speed = np.gradient(qpos, axis=1)
    distances = []
    velocity = []
    for lag in range(0, min(round(MAX_LAG_S / 0.02), rows // 2), 2):
        u = ctrl[:, : rows - lag]
        q = qpos[:, lag:]
        product = np.abs(u @ q.T) / (rows - lag)  # (n, n)
        u_power = (u**2).mean(axis=1)[:, None]
        q_power = (q**2).mean(axis=1)
        variance = np.maximum(q.var(axis=1), 1e-12)
        # other checks judge units, signs and names
        for scale in (1.0, np.degrees(1), np.radians(1)):
            square = scale**2 * u_power + q_power - 2 * scale * product
            distances.append((np.maximum(square, 0) / variance).min(axis=1))
        velocity.append(correlation(u, speed[:, lag:]))
    near = np.where(np.ptp(qpos, axis=1) > MOVING_RAD, np.sqrt(np.min(distances, axis=0)), np.nan)
    torque = np.full(near.shape, np.nan)
    if sequence.tau is not None:
        torque = correlation(ctrl, sequence.tau[::every].T)
    return KindOfCommand(
        distance=near,
        velocity_correlation=np.max(velocity, axis=0),
        torque_correlation=torque,
    )


def _standing(qpos: Array, dt: float) -> Array:
    """Return where joints have not moved for STANDSTILL_S, (T, n) bool."""
    w = max(1, round(STANDSTILL_S / dt))
    stands = np.zeros(qpos.shape, bool)
    stands[w:] = np.abs(qpos[w:] - qpos[:-w]) < STANDSTILL_RAD
    return stands


def _standstill(ctrl: Array, qpos: Array, dt: float) -> float:
    """Return the longest standstill of all joints (brakes on, drives off) while at least two
    commands move, s.
    """
    commanded = max(2.0, 0.5 * (np.ptp(ctrl, axis=0) > BLOCKED_COMMAND_RAD).sum())
    late = round(MAX_LAG_S / dt)
    standing = np.asarray(_standing(qpos, dt).all(axis=1))
    longest = 0
    for run in _runs(standing):
        rows = run.stop - run.start
        if rows <= 2 * late:
            continue
        moving = np.ptp(ctrl[run.start : run.stop - late], axis=0) > BLOCKED_COMMAND_RAD
        if moving.sum() >= commanded:
            longest = max(longest, rows)
    return longest * dt


def _copied_rows(sequence: Sequence) -> Array:
    """Return by how many rows the state repeats the command, (n); NaN where it does not."""
    time = sequence.dt * np.arange(len(sequence))
    rows = copied_rows(Channel(time, sequence.ctrl), Channel(time, sequence.qpos))
    for i, name in enumerate(sequence.joint_names):
        rows[i] = sequence.copied.get(name, rows[i])
    return rows


def _blocked(ctrl: Array, qpos: Array, dt: float) -> tuple[Array, Array]:
    seconds, places = np.zeros((2, qpos.shape[1]))
    for j, mask in enumerate((_standing(qpos, dt) & (np.abs(ctrl - qpos) > BLOCKED_ERROR_RAD)).T):
        runs = [r for r in _runs(mask) if np.ptp(ctrl[r, j]) > BLOCKED_COMMAND_RAD]
        if runs:
            longest = max(runs, key=lambda r: r.stop - r.start)
            seconds[j] = (longest.stop - longest.start) * dt
            places[j] = qpos[longest.start, j]
    return seconds, places


def _zero_rows(sequence: Sequence, notes: dict[str, Any], robot: RobotSpec) -> int:
    """Count rows of zeros of the joints that were logged in rad or deg; one joint alone may well
    pass through zero.
    """
    converted = (joint for joint, unit in notes.get("converted_from", {}).items() if unit != "deg")
    excluded = {*notes.get("held_at_home", ()), *converted}
    logged = [i for i, name in enumerate(robot.joint_names) if name not in excluded]
    if len(logged) < 2:
        return 0
    count = 0
    for values, min_edges in ((sequence.qpos[:, logged], 1), (sequence.ctrl[:, logged], 2)):
        far = np.abs(np.diff(values, axis=0)).max(axis=1) > ZERO_JUMP_RAD  # (T − 1,)
        for run in _runs((values == 0).all(axis=1)):
            edges = 0  # ends of the run at which a joint jumps
            if run.start > 0:
                edges += int(far[run.start - 1])
            if run.stop < len(values):
                edges += int(far[run.stop - 1])
            # A command may step away from zero; it does not step there and back within a few rows.
            if edges >= min_edges and (min_edges == 1 or run.stop - run.start <= 5):
                count += run.stop - run.start
    return count


def _gravity_samples(sequence: Sequence) -> Array | None:
    if sequence.tau is None:
        return None
    slow = np.flatnonzero((np.abs(sequence.qvel) < SLOW_RAD_S).all(axis=1))
    rows = slow[:: max(1, len(slow) // GRAVITY_SAMPLES)]
    return np.stack([sequence.qpos[rows], sequence.tau[rows]])


def _movement(sequence: Sequence, delay: Array) -> Array | None:
    """Return rows of smoothed motion (Survey.movement).

    delay: of the state, (n) s; NaN where it is not known.
    """
    dt = sequence.dt
    margin = max(2, round(MOTION_MARGIN_S / dt))
    rows = np.arange(margin, len(sequence) - margin)
    if len(rows) < MIN_MOTION_ROWS:
        return None
    known = delay[np.isfinite(delay)]
    usual = min(float(np.median(known)), MAX_LAG_S) if len(known) else 0.0
    lag = round(usual / dt)
    ctrl = np.concatenate([np.repeat(sequence.ctrl[:1], lag, axis=0), sequence.ctrl])
    target = lowpass(ctrl[: len(sequence)], dt, MOTION_HZ)
    target_speed = differentiate(target, dt)
    qpos = lowpass(sequence.qpos, dt, MOTION_HZ)
    qvel = differentiate(qpos, dt)
    qacc = differentiate(qvel, dt)
    torque = np.full_like(qpos, np.nan)
    if sequence.tau is not None:
        torque = lowpass(sequence.tau, dt, MOTION_HZ)
    chosen = rows[:: max(1, len(rows) // MOTION_ROWS)]
    target_acceleration = differentiate(target_speed, dt)
    channels = (qpos, qvel, qacc, torque, target - qpos, target_speed, target_acceleration)
    return np.stack([channel[chosen] for channel in channels]).astype(np.float32)


def _holds(sequence: Sequence) -> Array | None:
    if sequence.tau is None:
        return None
    rows = max(2, round(HOLD_S / sequence.dt))
    least = HOLD_S / 2 / sequence.dt
    rests = range_before(sequence.ctrl, rows) < HELD_COMMAND_RAD
    rests &= range_before(sequence.qpos, max(2, rows // 4)) < STANDSTILL_RAD
    rests[:rows] = False
    holds = []
    for j, mask in enumerate(rests.T):
        for run in _runs(mask):
            if run.stop - run.start > least:
                ctrl = sequence.ctrl[run].mean(axis=0)
                qpos = sequence.qpos[run].mean(axis=0)
                tau = sequence.tau[run].mean(axis=0)
                holds.append([j, ctrl[j] - qpos[j], tau[j], *qpos])
    return np.reshape(holds, (-1, 3 + rests.shape[1])).astype(float)


def _qvel_ratio(sequence: Sequence) -> Array:
    derivative = differentiate(sequence.qpos, sequence.dt)
    power = (derivative**2).sum(axis=0)
    moves = np.ptp(sequence.qpos, axis=0) > MOVING_RAD
    return np.where(
        moves, (sequence.qvel * derivative).sum(axis=0) / np.where(power > 0, power, 1.0), np.nan
    )


def _all_repeated(sequence: Sequence) -> float:
    """A resting robot repeats its positions; if every signal repeats while the command moves,
    nothing was read.
    """
    same = np.ones(len(sequence) - 1, bool)
    for name in ("qpos", "qvel", "tau", "temperature"):
        signal = getattr(sequence, name)
        if signal is not None:
            same &= (np.diff(signal, axis=0) == 0).all(axis=1)
    late = round(MAX_LAG_S / 2 / sequence.dt)
    longest = 0
    for run in _runs(same):
        command = sequence.ctrl[run.start : max(run.stop - late, run.start) + 1]
        if np.ptp(command, axis=0).max() > REPEATED_COMMAND_RAD:
            longest = max(longest, run.stop - run.start)
    return longest * sequence.dt


def _repeated(ctrl: Array, qpos: Array, dt: float) -> Array:
    """A loaded or stuck joint stands still, but noise and encoder steps change its number, and it
    moves at last.
    """
    late = round(MAX_LAG_S / 2 / dt)
    seconds = np.zeros(qpos.shape[1])
    for j, same in enumerate((np.diff(qpos, axis=0) == 0).T):
        for r in _runs(same):
            command = ctrl[r.start : max(r.stop - late, r.start), j]
            if len(command) and np.ptp(command) > REPEATED_COMMAND_RAD:
                seconds[j] = max(seconds[j], (r.stop - r.start) * dt)
    return seconds


def _resolution(qpos: Array) -> Array:
    """Return the step of which all differences of positions are multiples, where there are few
    distinct positions.
    """
    steps = np.zeros(qpos.shape[1])
    for j, column in enumerate(qpos.T):
        levels = np.unique(column.astype(float))
        gaps = np.diff(levels)
        if LEVELS <= len(levels) <= len(column) / 4:
            step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
            if np.abs(gaps / step - np.round(gaps / step)).max() < LEVEL_TOLERANCE:
                steps[j] = step
    return steps


def _runs(mask: Array) -> list[slice]:
    """Return the runs of True in (T,)."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    return [slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def _torque(sequence: Sequence, robot: RobotSpec) -> Torque | None:
    if sequence.tau is None:
        return None
    from scipy.ndimage import maximum_filter1d, median_filter

    tau = sequence.tau
    magnitude = np.abs(tau)
    window = max(3, round(SPIKE_WINDOW_S / sequence.dt))
    usual = median_filter(magnitude, size=(window, 1), mode="nearest")
    steps = (
        np.abs(np.diff(sequence.ctrl, axis=0, prepend=sequence.ctrl[:1])).max(axis=1)
        > COMMAND_STEP_RAD
    )
    calm = maximum_filter1d(steps, 2 * window + 1) == 0
    limit = robot.servo.effort_limit
    spikes = (magnitude - usual > SPIKE_SHARE * limit) & calm[:, None]
    return Torque(
        low=tau.min(axis=0),
        high=tau.max(axis=0),
        over_limit=(magnitude > limit * (1 + TORQUE_TOLERANCE)).sum(axis=0),
        spikes=spikes.sum(axis=0),
        flat=(magnitude == magnitude.max(axis=0)).sum(axis=0),
    )


def _spectrum(qpos: Array, dt: float) -> Array:
    """Return the mean logarithm of the power of the velocities at SPECTRUM_HZ, (H); NaN above half
    the rate.
    """
    moved = qpos[:, np.ptp(qpos, axis=0) > 0.02].astype(float)
    if not moved.size or len(moved) < 100:
        return np.full(len(SPECTRUM_HZ), np.nan)
    v = np.diff(moved, axis=0)
    power = np.log(np.abs(np.fft.rfft(v * np.hanning(len(v))[:, None], axis=0)) ** 2 + 1e-30).mean(
        axis=1
    )
    smooth = np.convolve(power, np.ones(3) / 3, "same")
    return np.where(
        0.48 / dt > SPECTRUM_HZ, np.interp(SPECTRUM_HZ, np.fft.rfftfreq(len(v), dt), smooth), np.nan
    )
