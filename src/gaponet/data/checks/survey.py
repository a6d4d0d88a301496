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
from gaponet.data.sequence import Sequence, SequenceMeta
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
# A joint that moves by less than STANDSTILL_RAD within STANDSTILL_S stands still.
STANDSTILL_S = 0.2
STANDSTILL_RAD = 0.005
BLOCKED_ERROR_RAD = 0.15  # distance of a blocked joint from its command
# The command of a blocked joint moves by this: a loaded joint may be as far from a command at rest.
BLOCKED_COMMAND_RAD = 0.1
REPEATED_COMMAND_RAD = 0.1  # the command must move by this while the state repeats itself
SLOPE_MIN_RANGE_RAD = 0.2  # of the command; below, sag and stiction decide the slope
SLOW_HZ = 0.3  # faster, a servo's resonance changes the slope
SLOW_ROWS = 60  # of a recording, about, in which torque is compared with gravity
SLOW_RAD_S = 0.5  # highest speed of any joint in such a row
MOTION_HZ = 4.0  # above it, noise and a servo's resonance outweigh the weight of the links
MOTION_ROWS = 60  # of a recording, about, in which motion is compared with the model
MIN_MOTION_ROWS = 10  # of a recording of which any are taken
MOTION_MARGIN_S = 0.2  # at both ends, where smoothing is poor
HOLD_S = 0.4  # for which a command stands still before a rest counts
HELD_COMMAND_RAD = 2e-3  # range of a command that stands still
TORQUE_TOLERANCE = 0.05  # share of the torque limit by which a reading may exceed it
# A position that is further from the line between its neighbours than both of these is a jump.
JUMP_RAD = 0.1
JUMP_RAD_S2 = 1000.0
ZERO_JUMP_RAD = 0.05  # step from a row of zeros to the next row
MAX_ZERO_COMMAND_ROWS = 5  # after which a command of zero is one that was meant
COMMAND_STEP_RAD = 0.05  # step of a command; the torque may follow it
SPIKE_WINDOW_S = 0.3  # of the running median from which a spike stands out
SPIKE_SHARE = 0.3  # of the torque limit, by which it does
SPECTRUM_HZ = np.arange(0.5, 60, 0.1)
MOVING_RAD = 0.05  # range of a joint that moves
JOB_ROWS = 40_000  # of one job of several processes
MIN_PARALLEL_ROWS = 600_000  # of a dataset for which it pays to start processes
OVERHEAD_ROWS = 1500  # rows that take as long as the fixed costs of a recording
QVEL_CUTOFF_HZ = 10.0  # of velocities that are compared
MIN_FILTERED_ROWS = 50
MIN_LEVELS = 8  # distinct positions from which the step between them is known
LEVEL_TOLERANCE = 0.1  # of a step, by which positions lie beside its multiples
KIND_STEP_S = 0.02  # period at which a command is compared with what it may be


class Torque(NamedTuple):
    """Torques of one sequence per joint, (n)."""

    low: Array  # N·m
    high: Array  # N·m
    over_limit: Array  # rows above the torque limit
    spikes: Array  # rows far above the rows around
    flat: Array  # rows at exactly the greatest magnitude
    below_flat: Array  # rows at the next smaller one

    @property
    def largest(self) -> Array:
        """Greatest magnitude, (n) N·m."""
        return np.asarray(np.maximum(-self.low, self.high))


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
        # periodic motion shows both: a joint that follows its command does not lead it
        leads = (lead > 1.5 * dt) & ~(delay > 0.5 * dt)
        return Tracking(
            speed=speed,
            delay=delay,
            lead=np.where(leads, lead, np.nan),
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
    # Step between positions, (n) rad. 0 where it is not known: positions are continuous, or fewer
    # than MIN_LEVELS or more than a quarter of the rows are distinct.
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
class SlowRows:
    """Rows in which all joints are slow: their torque is mostly that of gravity."""

    qpos: Array  # (k, n) rad
    torque: Array  # (k, n) N·m


@dataclass(frozen=True)
class Movement:
    """Rows of smoothed motion, (k, n) each."""

    qpos: Array  # rad
    qvel: Array  # rad/s
    qacc: Array  # rad/s²
    torque: Array  # N·m; NaN if none was recorded
    error: Array  # command − position, the state's lag taken off, rad
    command_velocity: Array  # rad/s
    command_acceleration: Array  # rad/s²

    def in_double(self) -> Movement:
        """Return the rows in double precision."""
        return Movement(**{name: values.astype(float) for name, values in vars(self).items()})

    def at(self, rows: Array | slice) -> Movement:
        """Return some of the rows."""
        return Movement(**{name: values[rows] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Holds:
    """Moments at which one joint rests under a constant command, k of them."""

    joint: Array  # index of the joint that rests, (k)
    error: Array  # its command − position, (k) rad
    torque: Array  # its torque, (k) N·m
    qpos: Array  # positions of all joints, (k, n) rad


@dataclass(frozen=True)
class Samples:
    """Rows of one sequence that are compared with the model of the robot."""

    static_poses: StaticPoses
    slow_rows: SlowRows | None  # None if no torque was recorded
    movement: Movement | None  # None if the recording is too short
    holds: Holds | None  # None if no torque was recorded


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
    def meta(self) -> SequenceMeta:
        """Provenance and labels."""
        return self.entry.meta

    @property
    def motion(self) -> str:
        """Name of the motion."""
        return self.meta.motion

    @property
    def payload(self) -> tuple[float, str]:
        """Mass, kg, and the hand that carries it."""
        return self.meta.payload_mass, self.meta.payload_side

    def kp(self, robot: RobotSpec) -> Array:
        """Return the stiffness while recording, (n) N·m/rad; the robot's where none was said."""
        return robot.with_gains(*self.meta.recorded_gains).servo.kp

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
            slow_rows=_slow_rows(sequence),
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


Recorded = list[tuple[Survey, Torque]]


def with_torque(surveys: list[Survey]) -> Recorded:
    """Return the recordings of torque, each with it."""
    return [(survey, survey.torque) for survey in surveys if survey.torque is not None]


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
    commanded = ctrl[span:] - ctrl[:-span]
    moved = qpos[span:] - qpos[:-span]
    rows, n = commanded.shape
    most = np.zeros((n, n))
    least = np.zeros((n, n))
    for lag in range(0, min(round(MAX_LAG_S / dt), rows // 2) + 1, stride):
        before = commanded[: rows - lag]
        after = moved[lag:]
        before = before - before.mean(axis=0)
        after = after - after.mean(axis=0)
        scale = np.sqrt(np.outer((before**2).sum(axis=0), (after**2).sum(axis=0)))
        coefficients = (before.T @ after) / np.where(scale > 0, scale, np.inf)
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
    every = max(1, round(KIND_STEP_S / sequence.dt))
    ctrl = np.ascontiguousarray(sequence.ctrl[::every].T, float)  # (n, T)
    qpos = np.ascontiguousarray(sequence.qpos[::every].T, float)
    rows = qpos.shape[1]
    speed = np.gradient(qpos, axis=1)
    distances = []
    velocity = []
    for lag in range(0, min(round(MAX_LAG_S / KIND_STEP_S), rows // 2), 2):
        u = ctrl[:, : rows - lag]
        q = qpos[:, lag:]
        distances.append(_square_distance(u, q))
        velocity.append(correlation(u, speed[:, lag:]))
    moves = np.ptp(qpos, axis=1) > MOVING_RAD
    distance = np.where(moves, np.sqrt(np.min(distances, axis=0)), np.nan)
    torque = np.full(distance.shape, np.nan)
    if sequence.tau is not None:
        torque = correlation(ctrl, sequence.tau[::every].T)
    return KindOfCommand(
        distance=distance,
        velocity_correlation=np.max(velocity, axis=0),
        torque_correlation=torque,
    )


def _square_distance(ctrl: Array, qpos: Array) -> Array:
    """Return the mean square distance of each command from the nearest joint's positions, over
    their variance; (n, T) and (n, T) → (n).

    Any joint, either sign, and rad beside deg count as near: other checks judge names, signs and
    units.
    """
    product = np.abs(ctrl @ qpos.T) / ctrl.shape[1]  # (n, n)
    ctrl_power = (ctrl**2).mean(axis=1)[:, None]
    qpos_power = (qpos**2).mean(axis=1)
    variance = np.maximum(qpos.var(axis=1), 1e-12)
    distances = []
    for scale in (1.0, np.degrees(1), np.radians(1)):
        square = scale**2 * ctrl_power + qpos_power - 2 * scale * product
        distances.append((np.maximum(square, 0) / variance).min(axis=1))
    return np.asarray(np.min(distances, axis=0))


def _standing(qpos: Array, dt: float) -> Array:
    """Return where joints have not moved for STANDSTILL_S, (T, n) bool."""
    rows = max(1, round(STANDSTILL_S / dt))
    stands = np.zeros(qpos.shape, bool)
    stands[rows:] = np.abs(qpos[rows:] - qpos[:-rows]) < STANDSTILL_RAD
    return stands


def _standstill(ctrl: Array, qpos: Array, dt: float) -> float:
    """Return the longest standstill of all joints (brakes on, drives off) while at least two
    commands move, s.
    """
    commanded = np.ptp(ctrl, axis=0) > BLOCKED_COMMAND_RAD
    least = max(2.0, 0.5 * commanded.sum())  # joints whose commands must move
    late = round(MAX_LAG_S / dt)
    all_stand = np.asarray(_standing(qpos, dt).all(axis=1))
    longest = 0
    for run in _runs(all_stand):
        rows = run.stop - run.start
        if rows <= 2 * late:
            continue
        moving = np.ptp(ctrl[run.start : run.stop - late], axis=0) > BLOCKED_COMMAND_RAD
        if moving.sum() >= least:
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
    """Return the longest standstill of each joint far from its moving command, (n) s, and where it
    stood, (n) rad.
    """
    seconds = np.zeros(qpos.shape[1])
    places = np.zeros(qpos.shape[1])
    stands_far = _standing(qpos, dt) & (np.abs(ctrl - qpos) > BLOCKED_ERROR_RAD)  # (T, n)
    for j, mask in enumerate(stands_far.T):
        runs = [run for run in _runs(mask) if np.ptp(ctrl[run, j]) > BLOCKED_COMMAND_RAD]
        if runs:
            longest = max(runs, key=lambda run: run.stop - run.start)
            seconds[j] = (longest.stop - longest.start) * dt
            places[j] = qpos[longest.start, j]
    return seconds, places


def _zero_rows(sequence: Sequence, notes: dict[str, Any], robot: RobotSpec) -> int:
    """Count rows of zeros of the joints that were logged in rad or deg; one joint alone may well
    pass through zero.
    """
    excluded = set(notes.get("held_at_home", ()))
    for joint, unit in notes.get("converted_from", {}).items():
        if unit != "deg":
            excluded.add(joint)
    logged = [i for i, name in enumerate(robot.joint_names) if name not in excluded]
    if len(logged) < 2:
        return 0
    count = 0
    for rows, jumps in _zero_runs(sequence.qpos[:, logged]):
        if jumps >= 1:
            count += rows
    for rows, jumps in _zero_runs(sequence.ctrl[:, logged]):
        # A command may step away from zero; it does not step there and back within a few rows.
        if jumps == 2 and rows <= MAX_ZERO_COMMAND_ROWS:
            count += rows
    return count


def _zero_runs(values: Array) -> Iterator[tuple[int, int]]:
    """Yield the length of each run of rows in which all values are 0, and the number of its ends
    at which one jumps; values (T, n).
    """
    far = np.abs(np.diff(values, axis=0)).max(axis=1) > ZERO_JUMP_RAD  # (T − 1,)
    for run in _runs((values == 0).all(axis=1)):
        jumps = 0
        if run.start > 0:
            jumps += int(far[run.start - 1])
        if run.stop < len(values):
            jumps += int(far[run.stop - 1])
        yield run.stop - run.start, jumps


def _slow_rows(sequence: Sequence) -> SlowRows | None:
    if sequence.tau is None:
        return None
    slow = np.flatnonzero((np.abs(sequence.qvel) < SLOW_RAD_S).all(axis=1))
    rows = slow[:: max(1, len(slow) // SLOW_ROWS)]
    return SlowRows(sequence.qpos[rows], sequence.tau[rows])


def _movement(sequence: Sequence, delay: Array) -> Movement | None:
    """Return rows of smoothed motion; None if the recording is too short.

    Args:
        delay: Of the state, (n) s; NaN where it is not known.
    """
    dt = sequence.dt
    margin = max(2, round(MOTION_MARGIN_S / dt))
    rows = np.arange(margin, len(sequence) - margin)
    if len(rows) < MIN_MOTION_ROWS:
        return None
    known = delay[np.isfinite(delay)]
    usual = min(float(np.median(known)), MAX_LAG_S) if len(known) else 0.0
    lag = round(usual / dt)
    # the command that the state of each row follows, (T, n) rad
    ctrl = np.concatenate([np.repeat(sequence.ctrl[:1], lag, axis=0), sequence.ctrl])
    command = lowpass(ctrl[: len(sequence)], dt, MOTION_HZ)
    command_velocity = differentiate(command, dt)
    qpos = lowpass(sequence.qpos, dt, MOTION_HZ)
    qvel = differentiate(qpos, dt)
    torque = np.full_like(qpos, np.nan)
    if sequence.tau is not None:
        torque = lowpass(sequence.tau, dt, MOTION_HZ)
    movement = Movement(
        qpos=qpos.astype(np.float32),
        qvel=qvel.astype(np.float32),
        qacc=differentiate(qvel, dt).astype(np.float32),
        torque=torque.astype(np.float32),
        error=(command - qpos).astype(np.float32),
        command_velocity=command_velocity.astype(np.float32),
        command_acceleration=differentiate(command_velocity, dt).astype(np.float32),
    )
    return movement.at(rows[:: max(1, len(rows) // MOTION_ROWS)])


def _holds(sequence: Sequence) -> Holds | None:
    if sequence.tau is None:
        return None
    rows = max(2, round(HOLD_S / sequence.dt))
    least = HOLD_S / 2 / sequence.dt
    rests = range_before(sequence.ctrl, rows) < HELD_COMMAND_RAD
    rests &= range_before(sequence.qpos, max(2, rows // 4)) < STANDSTILL_RAD
    rests[:rows] = False
    joints: list[int] = []
    errors: list[float] = []
    torques: list[float] = []
    postures: list[Array] = []
    for j, mask in enumerate(rests.T):
        for run in _runs(mask):
            if run.stop - run.start <= least:
                continue
            ctrl = sequence.ctrl[run].mean(axis=0)
            qpos = sequence.qpos[run].mean(axis=0)
            torque = sequence.tau[run].mean(axis=0)
            joints.append(j)
            errors.append(ctrl[j] - qpos[j])
            torques.append(torque[j])
            postures.append(qpos)
    return Holds(
        joint=np.array(joints, int),
        error=np.array(errors, float),
        torque=np.array(torques, float),
        qpos=np.reshape(postures, (-1, rests.shape[1])).astype(float),
    )


def _qvel_ratio(sequence: Sequence) -> Array:
    """Return the slope of the recorded velocity over the derivative of the position, (n); NaN for
    a joint that hardly moves.
    """
    qpos = sequence.qpos
    qvel = sequence.qvel
    if sequence.dt < 1 / (4 * QVEL_CUTOFF_HZ) and len(sequence) > MIN_FILTERED_ROWS:
        # The derivative of an encoder's steps is noise, the more the higher the rate is.
        qpos = lowpass(qpos, sequence.dt, QVEL_CUTOFF_HZ)
        qvel = lowpass(qvel, sequence.dt, QVEL_CUTOFF_HZ)
    derivative = differentiate(qpos, sequence.dt)
    power = (derivative**2).sum(axis=0)
    product = (qvel * derivative).sum(axis=0)
    moves = np.ptp(sequence.qpos, axis=0) > MOVING_RAD
    return np.where(moves, product / np.where(power > 0, power, 1.0), np.nan)


def _all_repeated(sequence: Sequence) -> float:
    """Return for how long the whole state repeats itself while the command moves, s.

    A resting robot repeats its positions; if every signal repeats while the command moves, nothing
    was read.
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
    """Return for how long each joint repeats one number while its command moves, (n) s.

    A loaded or stuck joint stands still, but noise and encoder steps change its number, and it
    moves at last.
    """
    late = round(MAX_LAG_S / 2 / dt)
    seconds = np.zeros(qpos.shape[1])
    for j, same in enumerate((np.diff(qpos, axis=0) == 0).T):
        for run in _runs(same):
            command = ctrl[run.start : max(run.stop - late, run.start), j]
            if len(command) and np.ptp(command) > REPEATED_COMMAND_RAD:
                seconds[j] = max(seconds[j], (run.stop - run.start) * dt)
    return seconds


def _resolution(qpos: Array) -> Array:
    """Return the step of which all differences of positions are multiples, (T, n) → (n) rad; 0 as
    in Encoders.resolution.
    """
    resolution = np.zeros(qpos.shape[1])
    for j, column in enumerate(qpos.T):
        levels = np.unique(column.astype(float))
        if not MIN_LEVELS <= len(levels) <= len(column) / 4:
            continue
        gaps = np.diff(levels)
        step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
        multiples = gaps / step
        if np.abs(multiples - np.round(multiples)).max() < LEVEL_TOLERANCE:
            resolution[j] = step
    return resolution


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
    command_steps = np.abs(np.diff(sequence.ctrl, axis=0, prepend=sequence.ctrl[:1]))  # (T, n)
    steps = command_steps.max(axis=1) > COMMAND_STEP_RAD
    calm = maximum_filter1d(steps, 2 * window + 1) == 0  # no command steps near the row, (T,)
    limit = robot.servo.effort_limit
    spikes = (magnitude - usual > SPIKE_SHARE * limit) & calm[:, None]
    is_largest = magnitude == magnitude.max(axis=0)
    below = np.where(is_largest, -1.0, magnitude)
    return Torque(
        low=tau.min(axis=0),
        high=tau.max(axis=0),
        over_limit=(magnitude > limit * (1 + TORQUE_TOLERANCE)).sum(axis=0),
        spikes=spikes.sum(axis=0),
        flat=is_largest.sum(axis=0),
        below_flat=(below == below.max(axis=0)).sum(axis=0),
    )


def _spectrum(qpos: Array, dt: float) -> Array:
    """Return the mean logarithm of the power of the velocities at SPECTRUM_HZ, (H); NaN above half
    the rate.
    """
    moved = qpos[:, np.ptp(qpos, axis=0) > 0.02].astype(float)
    if not moved.size or len(moved) < 100:
        return np.full(len(SPECTRUM_HZ), np.nan)
    changes = np.diff(moved, axis=0)
    windowed = changes * np.hanning(len(changes))[:, None]
    power = np.abs(np.fft.rfft(windowed, axis=0)) ** 2
    log_power = np.log(power + 1e-30).mean(axis=1)
    smooth = np.convolve(log_power, np.ones(3) / 3, "same")
    levels = np.interp(SPECTRUM_HZ, np.fft.rfftfreq(len(changes), dt), smooth)
    return np.where(0.48 / dt > SPECTRUM_HZ, levels, np.nan)
