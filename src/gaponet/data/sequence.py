"""Sequence: one recording on a uniform grid. `to_sequence` is the only door from Log."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Interval

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError, UsageError
from gaponet.base.structure import Json
from gaponet.data.describe.row_copies import copied_rows
from gaponet.data.log import COMMANDS, FEEDFORWARD, Log
from gaponet.data.signals import SAME_INSTANT, differentiate, resample_linear, resample_zoh
from gaponet.robot.finding import masked_names
from gaponet.robot.log_joints import Follower
from gaponet.robot.simulator_change import SimulatorChange
from gaponet.robot.spec import GAIN_TOLERANCE, RobotSpec

ARRAYS = ("ctrl", "qpos", "qvel", "qacc", "tau", "tau_eq", "temperature")
OPTIONAL = ("qacc", "tau", "tau_eq", "temperature")
RATE_TOLERANCE = 0.02  # relative, within which control rates count as one: they are measured
MIN_PERIOD_S = 1e-4
MAX_PERIOD_S = 1.0
# Between two samples of the state: what moved there is not known, and a clock that jumps is no
# clock.
MAX_GAP_S = 2.0
MAX_UNEVEN_SHARE = 0.1  # of the median period, by which the periods of even rows differ from it
EXACT_PERIOD_S = 2e-6  # by which the periods of a clock that does not waver differ from their mean
MAX_GROWTH = 3  # times as many rows as were recorded: a few bursts must not set the period of all
FIRST_LOOP_ROWS = 16  # from which the period of a loop is told first
MAX_LOOP_DIFFERENCE = 0.1  # of the median period, by which that of a loop differs from it
MAX_OFF_LOOP = 0.2  # of a period, by which most rows of a loop lie beside their instants
MAX_ADDED_DRIFT = 0.1  # of a period, over all rows, by which a rounder period may move the last row
# By which states end before the commands where a file was cut short, or after them where that is
# said.
MIN_LOST_END_S = 1.0
MIN_LOST_END_SHARE = 0.1  # of the recording, the same
MAX_PAYLOAD_KG = 100.0
ASSUMED = "of robot.toml"  # note of gains that the log did not say
LEVELS = ("joint", "upper_body", "whole_body")


@dataclass(frozen=True)
class SequenceMeta:
    """Where a sequence comes from. payload_mass has no default: an empty hand is said as 0.0.

    kp, kd are the gains that the robot had while it was recorded, (n) N·m/rad and N·m·s/rad in the
    order of the sequence's joints; None in recordings made before gains were kept.
    """

    robot: str
    unit_id: str
    motion: str
    payload_mass: float  # kg, in each hand named by payload_side
    payload_side: str = "both"
    level: str = "whole_body"
    repetition: Annotated[int, Interval(ge=0, le=10**9)] = 0
    virtual: bool = False
    source: str = ""
    source_sha256: str = ""
    recorded_at: str = ""
    notes: dict[str, Json] = field(default_factory=dict)
    kp: tuple[float, ...] | None = None
    kd: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("unit_id", "motion", "source"):  # a file's name need not be text
            text = getattr(self, name).encode("utf-8", "backslashreplace").decode()
            object.__setattr__(self, name, text)
        where = self.source or self.motion
        for name in ("kp", "kd"):
            gains = getattr(self, name)
            if gains is not None:
                object.__setattr__(self, name, _gains(name, gains, where))
        object.__setattr__(self, "payload_mass", _payload_mass(self.payload_mass, where))
        if not self.unit_id or not self.motion:
            raise LogError(f"{self.source}: unit_id and motion must be named")
        if self.level not in LEVELS:
            raise LogError(f"{self.source}: level '{self.level}' is not one of {', '.join(LEVELS)}")

    @property
    def recorded_gains(self) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
        """kp and kd; None where the log did not say them and those of robot.toml stand for them."""
        note = str(self.notes.get("gains", ""))  # "as stated", or "kp as stated, kd …"
        kp_origin, _, kd_origin = note.removeprefix("kp ").partition(", kd ")
        kd_origin = kd_origin or kp_origin
        kp = None if kp_origin == ASSUMED else self.kp
        kd = None if kd_origin == ASSUMED else self.kd
        return kp, kd

    @property
    def unrecorded(self) -> tuple[str, ...]:
        """Joints of which nothing was recorded: they stand where they were said to, or at home."""
        return (*self.notes.get("posture", {}), *self.notes.get("held_at_home", ()))

    def records(self, joints: Iterable[str]) -> Array:
        """Return which of these joints were recorded, (n,)."""
        unrecorded = self.unrecorded
        return np.array([joint not in unrecorded for joint in joints], bool)

    @property
    def independent_motion(self) -> str:
        """The motion; of a piece of a longer recording (gaponet import --cut) that recording's
        motion.
        """
        return self.motion.rpartition("@")[0] if "from_s" in self.notes else self.motion

    @property
    def repetition_key(self) -> tuple[str, str, float, str]:
        """Recordings in one slot, at one rate, are repetitions of each other."""
        return self.motion, self.unit_id, self.payload_mass, self.payload_side


@dataclass(frozen=True)
class Sequence:
    """T rows at a uniform period dt, n joints by name.

    Row t holds the state measured at t·dt and the command applied over [t·dt, (t+1)·dt). The error
    of step t therefore compares states at t+1. This convention is said here and nowhere else.

    Attributes:
        joint_names: (n).
        dt: s.
        ctrl, qpos, qvel: (T, n), rad, rad, rad/s, float32.
        qacc, tau, tau_eq, temperature: (T, n) or None, rad/s², N·m, N·m, °C.
        simulator: How the simulator in which the recording is replayed differs from the robot's
            own; None: not at all. It is no part of the recording, and is not stored.
    """

    meta: SequenceMeta
    joint_names: tuple[str, ...]
    dt: float
    ctrl: Array
    qpos: Array
    qvel: Array
    qacc: Array | None = None
    tau: Array | None = None
    tau_eq: Array | None = None
    temperature: Array | None = None
    simulator: SimulatorChange | None = None

    def __post_init__(self) -> None:
        if not MIN_PERIOD_S <= self.dt <= MAX_PERIOD_S:
            raise LogError(
                f"{self.meta.source}: dt is {self.dt} s; expected {MIN_PERIOD_S} to "
                f"{MAX_PERIOD_S:g}"
            )
        shape = (len(self.ctrl), len(self.joint_names))
        for name in ARRAYS:
            value = getattr(self, name)
            if value is None and name in OPTIONAL:
                continue
            value = np.ascontiguousarray(value, np.float32)
            if value.shape != shape or not np.isfinite(value).all():
                raise LogError(
                    f"{self.meta.source}: {name} has shape {value.shape} or holds NaN; expected "
                    f"{shape}"
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        for name in ("kp", "kd"):
            if len(getattr(self.meta, name) or self.joint_names) != shape[1]:
                raise LogError(
                    f"{self.meta.source}: {name} must hold one number for each of the {shape[1]} "
                    "joints"
                )

    def __len__(self) -> int:
        return len(self.ctrl)

    @property
    def rate(self) -> float:
        """Hz."""
        return 1.0 / self.dt

    @property
    def duration(self) -> float:
        """s."""
        return len(self) * self.dt

    @property
    def temperatures(self) -> tuple[float, ...] | None:
        """Mean temperature of each joint, (n) °C; None if it was not recorded."""
        if self.temperature is None:
            return None
        return tuple(self.temperature.mean(axis=0, dtype=float).round(1).tolist())

    @property
    def copied(self) -> dict[str, int]:
        """Joint → by how many rows of the log its state repeats its command
        (describe.row_copies).
        """
        copies: dict[str, int] = self.meta.notes.get("copied_rows", {})
        return copies

    def rows(self, part: slice) -> Sequence:
        """The same recording, only these rows."""
        cut = {}
        for name in ARRAYS:
            value = getattr(self, name)
            if value is not None:
                cut[name] = value[part]
        return replace(self, **cut)

    def content_hash(self) -> str:
        """Identity of the recording: joints, period, payload, unit and samples; not its name, path
        or date.
        """
        digest = hashlib.sha256()
        key = (self.meta.robot, self.meta.unit_id, self.meta.payload_mass, self.meta.payload_side)
        digest.update(repr((key, self.joint_names, round(self.dt, 7))).encode())
        for name in ("ctrl", "qpos"):
            digest.update(getattr(self, name).tobytes())
        return digest.hexdigest()


def recorded_gains(name: str, log: Log, robot: RobotSpec) -> tuple[float, ...]:
    """Return the gains (n) that a log says, the robot's own for joints of which it says none."""
    gains = np.array(robot.before_identification.servo[name])
    if name in log.meta:
        gains[robot.index(log.joint_names)] = _gains(name, log.meta[name], log.source)
    return tuple(gains.tolist())


def _gains(name: str, values: Any, where: str) -> tuple[float, ...]:
    try:
        gains = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        gains = (np.nan,)
    if not all(np.isfinite(gain) and gain >= 0 for gain in gains):
        raise LogError(f"{where}: {name} is {values!r}; give one finite number ≥ 0 for each joint")
    return gains


def _payload_mass(mass: Any, where: str) -> float:
    """Return a payload as a float, kg: 0, 0.0 and numpy's 0 are one payload, and one hash."""
    try:
        number = float(str(mass))  # float() of a float32 would have more digits than were given
    except ValueError:
        number = np.nan
    if not 0 <= number <= MAX_PAYLOAD_KG:
        raise LogError(f"{where}: payload_mass is {mass!r}; give kg, 0 when empty")
    return abs(number)  # -0.0 too is 0.0


def require_same_gains(
    metas: Iterable[SequenceMeta], joint_names: tuple[str, ...], joints: tuple[str, ...]
) -> None:
    """Refuse recordings made with different gains: what one robot does with two stiffnesses is not
    one gap.

    Args:
        metas: Metadata of the recordings taken together; one that does not say its gains (an old
            journal) may be any.
        joint_names: Joints that their gains belong to, (n).

    Raises:
        UsageError: Naming joint, gains and one recording of each.
    """
    first: dict[tuple[str, str], tuple[float, SequenceMeta]] = {}
    for meta in metas:
        for name in ("kp", "kd"):
            for joint, gain in zip(joint_names, getattr(meta, name) or (), strict=False):
                other, where = first.setdefault((name, joint), (gain, meta))
                if joint in joints and abs(gain - other) > GAIN_TOLERANCE * max(other, gain):
                    raise UsageError(
                        f"{name} of {joint} was {other:g} in '{where.motion}' of {where.unit_id} "
                        f"and {gain:g} in '{meta.motion}' of {meta.unit_id}: take recordings with "
                        "one set of gains, or add --mixed-gains to take them together"
                    )


def is_same_rate(dt: float, other: float) -> bool:
    """Return True if two control periods, s, count as one rate."""
    return abs(dt / other - 1) <= RATE_TOLERANCE


def whole_rate(dt: float) -> int:
    """Return the rate of a control period in whole Hz, by which recordings are grouped."""
    return round(1 / dt)


def to_sequence(log: Log, robot: RobotSpec, meta: SequenceMeta) -> Sequence:
    """Put a log on a uniform grid.

    Where all channels share timestamps and every period is within 10 % of the median, rows are kept
    as they are and dt is the median period rounded to 10 µs: the robot's real rate (49.85 Hz stays
    49.85 Hz); or the exact period where the format states one; or the mean period. It is the first
    by which no row is moved by more than half a period: time is never stretched. Where none is, or
    rows are uneven, measurements are interpolated and commands held: on the periods of the loop
    that wrote the rows, if they share timestamps and keep to one, else on a grid of the state's
    median period. The manifest says which. Refused are clocks that cannot be right: periods below
    0.1 ms or above 1 s, a gap of more than 2 s, three times as many rows as were recorded, a stated
    period that the timestamps contradict, states that end long before the commands.

    Args:
        log: The recording; its joints are reordered to the robot's, and missing ones stand where
            its posture (meta "posture", {joint: rad}) says, else at home, which is noted.
        robot: Decides the joint order; its gains stand where neither meta nor the log (meta "kp",
            "kd") says them.
    """
    _require_both_ends(log)
    median = _median_period(log)
    copies = _copies(log)
    arrays, dt, regular = _on_grid(log, median, robot.dt)
    same = [copies.get(name) == 0 for name in log.joint_names]
    if any(same) and not regular:  # the same numbers stay the same between the rows
        arrays["ctrl"][:, same] = arrays["qpos"][:, same]
    arrays = {name: _to_robot(name, values, log, robot) for name, values in arrays.items()}
    _add_velocities(arrays, dt, log, robot)
    notes = meta.notes | log.meta.get("notes", {}) | _row_notes(log, median, dt, regular)
    if copies:
        notes["copied_rows"] = copies
    notes |= _posture_notes(log, robot)
    kp = meta.kp or recorded_gains("kp", log, robot)
    kd = meta.kd or recorded_gains("kd", log, robot)
    kp_origin = _gain_origin("kp", meta, log)
    kd_origin = _gain_origin("kd", meta, log)
    notes["gains"] = f"kp {kp_origin}, kd {kd_origin}"
    if kp_origin == kd_origin:
        notes["gains"] = kp_origin
    if FEEDFORWARD in arrays:
        torque = arrays.pop(FEEDFORWARD)
        assumed = kp_origin == ASSUMED
        further = _feedforward_position(torque, np.array(kp), assumed, log, robot)
        arrays["ctrl"] = arrays["ctrl"] + further
        notes |= _feedforward_notes(further, robot)
    channels: dict[str, Any] = dict(arrays)
    return Sequence(replace(meta, kp=kp, kd=kd, notes=notes), robot.joint_names, dt, **channels)


def _on_grid(log: Log, median: float, usual: float) -> tuple[dict[str, Array], float, bool]:
    """Return the channels' values on one grid, its period, and whether these are the rows as they
    were recorded.

    Args:
        median, usual: Period of the log's state, and of the robot's controller, s.
    """
    time = log.channels["qpos"].time
    period = np.diff(time)
    shared = _share_clock(log)
    even = bool((np.abs(period - median) <= MAX_UNEVEN_SHARE * median).all())
    if shared and even:
        dt = _row_period(time, _even_periods(log, median))
        if dt is not None:
            return {name: channel.values for name, channel in log.channels.items()}, dt, True
    loop = None
    if shared and "dt" not in log.meta:
        loop = _loop(time, median, usual)
    if loop is not None:
        return _resample(log, loop.period, loop.begin), loop.period, False
    dt = round(median, 5)
    return _resample(log, dt, None), dt, False


def _even_periods(log: Log, median: float) -> tuple[float, ...]:
    """Return periods that even rows may have, s, the likeliest first."""
    if "dt" in log.meta:
        return (log.meta["dt"],)
    period = np.diff(log.channels["qpos"].time)
    mean = round(float(period.mean()), 7)
    rounded = (round(median, 5), mean)
    if np.abs(period - mean).max() < EXACT_PERIOD_S:
        return (mean, *rounded)
    return rounded


def _add_velocities(arrays: dict[str, Array], dt: float, log: Log, robot: RobotSpec) -> None:
    """Compute velocities that were not recorded, or that a joint logged as a fraction has in any
    unit at all.
    """
    qvel = differentiate(arrays["qpos"], dt)
    if "qvel" not in arrays:
        arrays["qvel"] = qvel
        return
    converted = log.meta.get("converted_from", {})
    odd = [j for j, name in enumerate(robot.joint_names) if converted.get(name) == "fraction"]
    arrays["qvel"][:, odd] = qvel[:, odd]


def _posture_notes(log: Log, robot: RobotSpec) -> dict[str, Any]:
    """Return notes of joints that the log does not hold, and of units that were converted."""
    notes: dict[str, Any] = {}
    posture = {}
    for joint, angle in log.meta.get("posture", {}).items():
        if joint not in log.joint_names:
            posture[joint] = angle
    known = {*log.joint_names, *posture, *_led(log, robot)}
    absent = [name for name in robot.joint_names if name not in known]
    if posture:
        notes["posture"] = posture
    if absent:
        notes["held_at_home"] = absent
    if log.meta.get("converted_from"):
        notes["converted_from"] = log.meta["converted_from"]
    return notes


def _gain_origin(name: str, meta: SequenceMeta, log: Log) -> str:
    if getattr(meta, name):
        return "as stated"
    return "as recorded" if name in log.meta else ASSUMED


def _feedforward_notes(further: Array, robot: RobotSpec) -> dict[str, Any]:
    """Return notes of positions (T, n) rad that were added to the command for a torque."""
    largest = {}
    for name, most in zip(robot.joint_names, np.abs(further).max(axis=0), strict=True):
        if most:
            largest[name] = round(float(most), 4)
    if not largest:
        return {}
    return {FEEDFORWARD: {"in": "ctrl, as torque / kp", "largest_rad": largest}}


def _copies(log: Log) -> dict[str, int]:
    """Joint → by how many rows its state repeats its command; without joints whose state does
    not.
    """
    rows = copied_rows(log.channels["ctrl"], log.channels["qpos"])
    copies = {}
    for name, shift in zip(log.joint_names, rows.tolist(), strict=True):
        if np.isfinite(shift):
            copies[name] = int(shift)
    return copies


def _row_notes(log: Log, median: float, dt: float, regular: bool) -> dict[str, Any]:
    """Notes of the clock and of what became of the rows; median: period of the log, s; dt: of the
    sequence.
    """
    time = log.channels["qpos"].time
    period = np.diff(time)
    off = np.abs(period - median)
    notes: dict[str, Any] = {
        "rows": "as recorded",
        "rate_hz": round(1 / median, 3),
        "jitter_ms": round(float(off.max()) * 1e3, 3),
        "uneven_ms": round(float(np.percentile(off, 95)) * 1e3, 3),
        "longest_gap_ms": round(float(period.max()) * 1e3, 3),
        "qvel": "as recorded" if "qvel" in log.channels else "central differences of qpos",
    }
    if regular:
        return notes
    notes["rows"] = f"resampled to {1 / dt:.2f} Hz: commands held, states interpolated"
    if not _share_clock(log):
        notes["why_resampled"] = "its channels have clocks of their own"
        unused = float(time[-1] - log.channels["ctrl"].time[-1])
        if unused > MIN_LOST_END_S:
            notes["why_resampled"] += f"; {unused:.1f} s after the last command are left out"
    elif (off <= MAX_UNEVEN_SHARE * median).all():
        notes["why_resampled"] = "no even period fits its rows"
    else:
        span = f"{1e3 * period.min():.1f} to {1e3 * period.max():.1f} ms"
        notes["why_resampled"] = f"its rows lie {span} apart, and shorter delays are not known"
    return notes


def _share_clock(log: Log) -> bool:
    """Return True if all channels have the timestamps of the state."""
    time = log.channels["qpos"].time
    return all(np.array_equal(channel.time, time) for channel in log.channels.values())


def _require_both_ends(log: Log) -> None:
    """Refuse states that end long before the commands do: a file that was cut at the end of a row
    reads well.
    """
    states = log.channels["qpos"].time
    commands = log.channels["ctrl"].time
    missing = float(commands[-1] - states[-1])
    duration = float(commands[-1] - commands[0])
    least = max(MIN_LOST_END_S, MIN_LOST_END_SHARE * duration)
    if commands[0] < states[-1] and missing > least:
        raise LogError(
            f"{log.source}: its states end {missing:.1f} s before its commands do: the file may "
            "be cut short; copy it again, or cut the commands where the robot stopped (--skip-bad "
            "leaves the recording out)"
        )


def _row_period(time: Array, periods: tuple[float, ...]) -> float | None:
    """Return the first period, s, by which row t is never further than half a period from where
    t·period puts it; None if there is none.
    """
    rows = np.arange(len(time))
    for period in periods:
        off = np.abs(time - time[0] - period * rows)
        if off.max() <= 0.5 * period:
            return period
    return None


def _median_period(log: Log) -> float:
    """Median period of the state, s; a clock that cannot be right is refused before anything is
    put on a grid.
    """
    time = log.channels["qpos"].time
    period = np.diff(time)
    median = float(np.median(period))
    longest = int(period.argmax())
    if not MIN_PERIOD_S <= median <= MAX_PERIOD_S:
        raise LogError(
            f"{log.source}: the median period is {median:.3g} s, expected {MIN_PERIOD_S} to "
            f"{MAX_PERIOD_S:g}; is the unit of time right (tables: --time-unit)?"
        )
    if period[longest] > MAX_GAP_S:
        raise LogError(
            f"{log.row('qpos', longest + 1)}: {period[longest]:.4g} s after the row before it; "
            f"longer gaps than {MAX_GAP_S:g} s are not filled: cut the log there, or mend a clock "
            "that jumped"
        )
    duration = time[-1] - time[0]
    if duration > MAX_GROWTH * median * len(time):
        raise LogError(
            f"{log.source}: {len(time)} rows lie in bursts over {duration:.4g} s: at their median "
            f"period of {median * 1e3:.3g} ms there would be {duration / median:.0f}; mend the "
            "timestamps, or give the rate of even rows (rate in logs.toml, --rate), which replaces "
            "the clock"
        )
    stated = log.meta.get("dt", median)
    if abs(stated - median) > 0.1 * stated:
        raise LogError(
            f"{log.source}: the period is said to be {stated:.6g} s, but the timestamps are "
            f"{median:.6g} s apart; mend one of them"
        )
    return median


class _Loop(NamedTuple):
    """A loop that wrote a row in each of its periods, some of them late, some lost."""

    begin: float  # s
    period: float  # s


def _loop(time: Array, median: float, usual: float) -> _Loop | None:
    """Return the loop that wrote uneven rows, by least squares over the rows' numbers; None where
    rows keep to no period.

    Args:
        time: Of the rows, s.
        median: Of their periods, s.
        usual: Period of the robot's controller, s, which is taken where it fits.
    """
    begin = float(time[0])
    period = float(np.diff(time).mean())
    if abs(period - median) >= 0.05 * median:
        period = median
    rows = FIRST_LOOP_ROWS
    while True:  # twice as many rows each time: their numbers are surer with a better period
        some = time[:rows]
        numbers = np.round((some - begin) / period)
        period, begin = np.polyfit(numbers, some - time[0], 1)
        begin += time[0]
        if rows >= len(time):
            break
        rows *= 2
    number = (time - begin) / period
    off = np.median(np.abs(number - np.round(number)))
    if not abs(period - median) < MAX_LOOP_DIFFERENCE * median or off > MAX_OFF_LOOP:
        return None
    for rounder in (usual, round(float(period), 5)):
        if abs(rounder - period) * number[-1] <= MAX_ADDED_DRIFT * period:
            return _Loop(begin, rounder)
    return _Loop(begin, float(period))


def _resample(log: Log, dt: float, begin: float | None) -> dict[str, Array]:
    """Return the channels' values on a grid, (T, n) each.

    Args:
        dt: Period of the grid, s.
        begin: When the loop began that wrote the rows, s: a command then belongs to the period
            that its row is nearest to. None: no loop is known.
    """
    start = max(channel.time[0] for channel in log.channels.values())
    stop = min(channel.time[-1] for channel in log.channels.values())
    if stop - start < 2 * dt:
        raise LogError(
            f"{log.source}: command and state channels overlap for {stop - start:.3f} s only; "
            "check the clocks"
        )
    if begin is None:
        grid = start + dt * np.arange(int((stop - start) / dt + 1e-9) + 1)
        near = SAME_INSTANT
    else:
        grid = begin + dt * np.arange(round((stop - begin) / dt) + 1)
        near = 0.5
    grid = np.clip(grid, start, stop)
    arrays = {}
    for name, (time, values) in log.channels.items():
        if name in COMMANDS:
            arrays[name] = resample_zoh(time, values, grid, near)
        else:
            arrays[name] = resample_linear(time, values, grid)
    return arrays


def _feedforward_position(
    torque: Array, kp: Array, assumed: bool, log: Log, robot: RobotSpec
) -> Array:
    """Return the distance of the command, (T, n) rad, that has the effect of a torque on a PD
    controller.

    kp (command − q) − kd q̇ + torque is kp (command + torque / kp − q) − kd q̇.

    Args:
        torque: That is fed forward, (T, n) N·m.
        kp: (n) N·m/rad.
        assumed: Nobody stated kp.
    """
    lacking = masked_names(robot, torque.any(axis=0) & (assumed | (kp == 0)))
    if lacking:
        raise LogError(
            f"{log.source}: a {FEEDFORWARD} counts as command + torque / kp, and kp of "
            f"{', '.join(lacking)} is {'not stated' if assumed else '0'}; give it in logs.toml "
            "(kp), or --kp; leave joints that torque alone drives out with ignore"
        )
    return torque / np.where(kp > 0, kp, 1.0)


def _led(log: Log, robot: RobotSpec) -> dict[str, Follower]:
    """Mimic joints that a log lacks, and whose leading joint it holds."""
    led = {}
    for name, follower in robot.log_joints.followers.items():
        if name not in log.joint_names and follower.joint in log.joint_names:
            led[name] = follower
    return led


def _to_robot(channel: str, values: Array, log: Log, robot: RobotSpec) -> Array:
    """Return values (T, n) of a log's joints in robot order.

    Joints that the log lacks stand where its posture says or at home (positions), or at zero.
    """
    out = np.zeros((len(values), len(robot.joint_names)))
    if channel in ("ctrl", "qpos"):
        out += robot.qpos_home
        for joint, angle in log.meta.get("posture", {}).items():
            out[:, robot.index([joint])] = angle
    out[:, robot.index(log.joint_names)] = values
    if channel not in ("ctrl", "qpos", "qvel"):
        return out
    for name, follower in _led(log, robot).items():
        leader = out[:, robot.index([follower.joint])]
        at_zero = 0.0 if channel == "qvel" else follower.at_zero
        out[:, robot.index([name])] = follower.ratio * leader + at_zero
    return out
