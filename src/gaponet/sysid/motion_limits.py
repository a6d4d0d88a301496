"""Limits of motion that recordings show: joint stops, torque limits, and servos that limit the
speed of their targets.

A servo's own trajectory generator moves its target along a ramp, and the joint follows the ramp,
never the command. So the recorded state is compared with the commands, with commands behind a
first-order lag, and with ramps of several speeds, each with the lag and the offset that suit it
best. That needs none of the servo's parameters. Where a ramp fits much better, the robot is
identified with it as well.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import DEFAULT_TERMS, Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.commands import speed_limited
from gaponet.sim.temperature import temperature_varies
from gaponet.sysid.axes import GREATEST_SPEED_QUANTILE, greatest_speeds

MIN_PERIOD_S = 0.01  # between rows that are compared
MAX_LAG_S = 0.3  # of a state behind its ramp or command
LAGS = 16  # that are tried
# Of the ramps that are tried, over a joint's greatest speed.
SPEED_RATIOS = np.geomspace(0.7, 1.25, 30)
SPEED_SPAN_S = 0.06  # over which a speed is measured
# Of servos without a ramp.
LAG_TIME_CONSTANTS_S = (0.0, 0.02, 0.04, 0.08, 0.16, 0.32)
MIN_SPEED = 1e-6  # rad/s, of a ramp that is tried
MIN_LAG_ERROR_RAD = 1e-9  # so that it can be divided by
# Of a ramp's error over that of the best lag, in both halves of the recordings.
MAX_ERROR_RATIO = 0.8
MIN_RAMP_ERROR_RAD = 0.02  # RMS by which a ramp must be behind its command
MIN_RAMP_DELAY_S = 0.3  # by which it must be behind it at least once
MIN_BEYOND_STOP_RAD = 0.1  # that commands go beyond a stop, and further there
MIN_STOP_ROWS = 50  # that show a stop
AT_STOP_RAD = 0.005  # from the end of a joint's path
MIN_NARROWING_RAD = 0.01  # of the robot's range by a stop
# A joint shows its torque limit if in this share of its rows this share of the limit is asked.
LIMITED_TORQUE_SHARE = 0.9
MIN_LIMITED_ROWS_SHARE = 0.01
# It shows its motor's torque-speed line if in this share of its rows it moves at this share of its
# greatest speed, while this share of the torque limit is asked in the direction of motion.
FAST_SPEED_SHARE = 0.5
DRIVEN_TORQUE_SHARE = 0.8
MIN_FAST_ROWS_SHARE = 0.003


def with_stops(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """Return the robot with joint stops narrower than the MJCF's where commands go on and the
    joint stays.

    A joint far behind its command is loaded, or sticks as its command comes back. A stop is where a
    command went on by MIN_BEYOND_STOP_RAD after the joint had come to its end, twice at least.
    """
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(robot.operated, robot.operated_index, strict=True):
        low, high = robot.qpos_range[i].tolist()
        paths = [_Path(s.ctrl[:, i], s.qpos[:, i]) for s in sequences]
        mirrored = [_Path(-ctrl, -qpos) for ctrl, qpos in paths]
        stop_low = _stop(mirrored, -low)
        stop_high = _stop(paths, high)
        if stop_low is not None:
            servos.setdefault(joint, {})["stop_low"] = round(-stop_low, 4)
        if stop_high is not None:
            servos.setdefault(joint, {})["stop_high"] = round(stop_high, 4)
    if not servos:
        return robot
    return robot.with_identified(servos)


class _Path(NamedTuple):
    """Commands and positions of one joint in a recording, (T,) rad each."""

    ctrl: Array
    qpos: Array


def _stop(paths: list[_Path], end_of_range: float) -> float | None:
    """Return the highest position of a joint, rad, if commands show a stop there, inside the
    joint's range; else None.
    """
    end = max(float(path.qpos.max()) for path in paths)
    if end_of_range <= end + MIN_NARROWING_RAD or not _meets_stop(paths, end):
        return None
    return end


def _meets_stop(paths: list[_Path], end: float) -> bool:
    """Return True if commands go on where a joint is at the end of its path, rad."""
    pushes: list[Array] = []
    for path in paths:
        pushes += _pushes(path, end)
    rows = sum(len(push) for push in pushes)
    went_on = [push for push in pushes if push.max() - push[0] > MIN_BEYOND_STOP_RAD]
    return rows >= MIN_STOP_ROWS and len(went_on) > 1


def _pushes(path: _Path, end: float) -> list[Array]:
    """Return the commands well beyond the end of a joint's path, rad, while the joint is there,
    push by push.
    """
    is_beyond = path.ctrl > end + MIN_BEYOND_STOP_RAD
    is_there = path.qpos > end - AT_STOP_RAD
    rows = np.flatnonzero(is_beyond & is_there)
    if not len(rows):
        return []
    first_of_push = np.flatnonzero(np.diff(rows) > 1) + 1
    return np.split(path.ctrl[rows], first_of_push)


def stop_questions(given: RobotSpec, stopped: RobotSpec) -> list[str]:
    """Return a question for each stop that `with_stops` added, since the joint may have met
    anything.
    """
    questions = []
    for joint, i in zip(given.operated, given.operated_index, strict=True):
        for name, direction in (("stop_low", "lower"), ("stop_high", "higher")):
            stop = float(stopped.servo[name][i])
            if not np.isfinite(stop) or stop == given.servo[name][i]:
                continue
            questions.append(
                f"{joint}: stayed at {stop:.3f} rad where commands went {direction}: if that is a "
                "stop, identify with --stops; if something was in its way, leave those motions out"
            )
    return questions


def default_terms(sequences: ListOf[Sequence], robot: RobotSpec) -> tuple[Term, ...]:
    """Return the terms that are tried without being named, in their order.

    These are "limit" and "speed", if gains and recorded errors ask some joint for such torques as
    the constants above say; DEFAULT_TERMS; and "temperature", if recordings vary it.
    """
    fast = FAST_SPEED_SHARE * greatest_speeds(sequences, robot)
    counts = [_demanding_rows(s, robot, fast) for s in sequences]
    rows, limited_rows, driven_rows = np.sum(counts, axis=0)  # (n,) each
    terms: list[Term] = []
    if (limited_rows > MIN_LIMITED_ROWS_SHARE * rows).any():
        terms.append("limit")
    if (driven_rows > MIN_FAST_ROWS_SHARE * rows).any():
        terms.append("speed")
    terms += DEFAULT_TERMS
    if temperature_varies(sequences, robot).any():
        terms.append("temperature")
    return tuple(terms)


def _demanding_rows(s: Sequence, robot: RobotSpec, fast: Array) -> Array:
    """Return how many rows of a recording hold each joint, how many of these ask for its torque
    limit, and in how many it is driven while it moves faster than `fast` (n,), rad/s; (3, n).
    """
    op = robot.operated_index
    servo = robot.with_gains(*s.meta.recorded_gains).servo
    asked = (servo.kp * (s.ctrl - s.qpos) - servo.kd * s.qvel)[:, op]  # (T, n) N·m
    qvel = s.qvel[:, op]
    limit = robot.servo.effort_limit[op]
    is_limited = np.abs(asked) > LIMITED_TORQUE_SHARE * limit
    is_driven = asked * np.sign(qvel) > DRIVEN_TORQUE_SHARE * limit
    is_fast = np.abs(qvel) > fast
    every = np.ones_like(is_limited)
    counts = np.stack([every, is_limited, is_driven & is_fast]).sum(axis=1)
    return np.asarray(counts * s.meta.records(robot.operated))


class _Part(NamedTuple):
    """A recording of n operated joints, in rows about MIN_PERIOD_S apart."""

    ctrl: Array  # commands inside the joints' ranges, (T, n) rad
    qpos: Array  # (T, n) rad
    dt: float  # s


class _AimErrors(NamedTuple):
    """Errors of k ramps, and then of the lags of LAG_TIME_CONSTANTS_S, for n joints."""

    rms: Array  # of recorded positions, in every other recording, (2, k + lags, n) rad
    rms_behind: Array  # of ramps behind their commands, (k, n) rad
    most_behind: Array  # the same at most, (k, n) rad


def target_speeds(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the speed of each operated joint's ramp, (n,) rad/s; 0 where a lag explains the state
    as well.
    """
    op = robot.operated_index
    parts = _parts(sequences, robot)
    if len(parts) < 2:
        return np.zeros(len(op))
    tried = SPEED_RATIOS[:, None] * _greatest_measured(parts)  # (k, n) rad/s
    tried = np.maximum(tried, MIN_SPEED)
    errors = _aim_errors(parts, tried)
    ramp_rms = errors.rms[:, : len(tried)]  # (2, k, n) rad
    lag_rms = errors.rms[:, len(tried) :]  # (2, lags, n) rad
    best = ramp_rms.sum(axis=0).argmin(axis=0)  # number of each joint's ramp, (n,)
    joints = np.arange(len(op))
    speed = tried[best, joints]
    best_lag_rms = np.maximum(lag_rms.min(axis=1), MIN_LAG_ERROR_RAD)
    ratio = ramp_rms[:, best, joints] / best_lag_rms  # (2, n)
    fits_better = (ratio < MAX_ERROR_RATIO).all(axis=0)
    is_behind = errors.rms_behind[best, joints] > MIN_RAMP_ERROR_RAD
    is_late = errors.most_behind[best, joints] > MIN_RAMP_DELAY_S * speed
    limited = fits_better & is_behind & is_late
    speed[~limited] = 0.0
    if limited.any():
        of_limited = [_Part(p.ctrl[:, limited], p.qpos[:, limited], p.dt) for p in parts]
        speed[limited] = _speed_behind(of_limited, speed[limited])
    return np.asarray(speed)


def _parts(sequences: ListOf[Sequence], robot: RobotSpec) -> list[_Part]:
    """Return the recordings that are long enough to compare."""
    op = robot.operated_index
    low, high = robot.qpos_range[op].T
    parts = []
    for s in sequences:
        if s.duration < 2 * MAX_LAG_S:
            continue
        stride = max(1, round(MIN_PERIOD_S / s.dt))
        ctrl = np.clip(s.ctrl[::stride, op], low, high).astype(float)
        qpos = s.qpos[::stride, op].astype(float)
        parts.append(_Part(ctrl, qpos, stride * s.dt))
    return parts


def _greatest_measured(parts: list[_Part]) -> Array:
    """Return the greatest speed of each joint over SPEED_SPAN_S, without outliers, (n,) rad/s."""
    speeds = []
    for _, qpos, dt in parts:
        span = max(1, round(SPEED_SPAN_S / dt))
        if len(qpos) > span:
            way = np.abs(qpos[span:] - qpos[:-span])
            speeds.append(way / (span * dt))
    return np.asarray(np.quantile(np.concatenate(speeds), GREATEST_SPEED_QUANTILE, axis=0))


def _aim_errors(parts: list[_Part], tried: Array) -> _AimErrors:
    """Return the errors of ramps with speeds (k, n), rad/s, and of lags, each with the delay and
    the offset that suit it best.
    """
    ramps_and_lags = len(tried) + len(LAG_TIME_CONSTANTS_S)
    squares = np.zeros((2, ramps_and_lags, tried.shape[1], LAGS))
    squares_behind = np.zeros(tried.shape)
    most_behind = np.zeros(tried.shape)
    rows = np.zeros(2)
    for number, (ctrl, qpos, dt) in enumerate(parts):
        half = number % 2
        commands = np.broadcast_to(ctrl[:, None], (len(ctrl), *tried.shape))
        ramps = speed_limited(commands, qpos[0], tried, dt)  # (T, k, n)
        behind = np.abs(ramps - ctrl[:, None])
        squares_behind += (behind**2).sum(axis=0)
        most_behind = np.maximum(most_behind, behind.max(axis=0))
        aims = np.concatenate([ramps, _lagged(ctrl, dt)], axis=1)  # (T, k + lags, n)
        squares[half] += _squared_errors(aims, qpos, dt)
        rows[half] += len(ctrl)
    rms = np.sqrt(squares.min(axis=-1) / rows[:, None, None])
    rms_behind = np.sqrt(squares_behind / rows.sum())
    return _AimErrors(rms, rms_behind, most_behind)


def _squared_errors(aims: Array, qpos: Array, dt: float) -> Array:
    """Return the sums of squared distances of positions (T, n) from aims (T, aims, n), rad², for
    each lag up to MAX_LAG_S, without their offset; (aims, n, LAGS).
    """
    squares = []
    for lag in np.linspace(0, MAX_LAG_S, LAGS):
        late = round(lag / dt)
        away = qpos[late:, None] - aims[: len(aims) - late]
        without_offset = away - away.mean(axis=0)
        squares.append((without_offset**2).sum(axis=0))
    return np.stack(squares, axis=-1)


def _speed_behind(parts: list[_Part], speed: Array) -> Array:
    """Return the median speed of joints while they are well behind a ramp of about `speed` (n,)
    rad/s: then they are as fast as their ramp.
    """
    seen = [speed[None]]
    for ctrl, qpos, dt in parts:
        ramp = speed_limited(ctrl, qpos[0], speed, dt)
        behind = np.abs(ramp - ctrl)
        span = max(1, round(SPEED_SPAN_S / dt))
        late = round(MIN_RAMP_DELAY_S / 2 / dt)
        way = np.abs(qpos[late + span :] - qpos[late:-span])
        is_far_behind = behind[: len(way)] > MIN_RAMP_DELAY_S / 2 * speed
        seen.append(np.where(is_far_behind, way / (span * dt), np.nan))
    return np.asarray(np.nanmedian(np.concatenate(seen), axis=0))


def _lagged(ctrl: Array, dt: float) -> Array:
    """Return commands (T, n) behind first-order lags of LAG_TIME_CONSTANTS_S, (T, lags, n)."""
    share = np.minimum(dt / np.maximum(LAG_TIME_CONSTANTS_S, dt), 1)[:, None]  # of the way, a row
    lagged = np.empty((len(ctrl), len(LAG_TIME_CONSTANTS_S), ctrl.shape[1]))
    aim = np.repeat(ctrl[:1], len(LAG_TIME_CONSTANTS_S), axis=0)
    for t, target in enumerate(ctrl):
        aim = aim + share * (target - aim)
        lagged[t] = aim
    return lagged
