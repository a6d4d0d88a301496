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

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import DEFAULT_TERMS, Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import speed_limited
from gaponet.sim.temperature import temperature_varies
from gaponet.sysid.axes import greatest_speeds

# of rows that are compared; lags that are tried
MIN_PERIOD_S = 0.01
MAX_LAG_S = 0.3
LAGS = 16
SPEED_RATIOS = np.geomspace(0.7, 1.25, 30)  # ramps that are tried, over a joint's greatest speed
GREATEST_SPEED_QUANTILE = 0.995
SPEED_SPAN_S = 0.06  # over which a speed is measured
LAG_TIME_CONSTANTS_S = (0.0, 0.02, 0.04, 0.08, 0.16, 0.32)  # of a servo without a ramp
MAX_ERROR_RATIO = 0.8  # of a ramp over the best lag, in both halves of the recordings
# RMS and time by which a ramp must be behind its command
MIN_RAMP_ERROR_RAD = 0.02
MIN_RAMP_DELAY_S = 0.3
# that commands go beyond a stop, and further there; rows that show it
MIN_BEYOND_STOP_RAD = 0.1
MIN_STOP_ROWS = 50
AT_STOP_RAD = 0.005  # from the end of a joint's path
MIN_NARROWING_RAD = 0.01  # of the robot's range by a stop
# of the robot's limit; of a joint's rows
AT_TORQUE_LIMIT = 0.9
MIN_LIMITED_SHARE = 0.01
# of a joint's greatest speed; of the robot's limit, in the direction of motion
FAST = 0.5
DRIVEN_FAST = 0.8
MIN_FAST_SHARE = 0.003  # of a joint's rows


def with_stops(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """Return the robot with joint stops narrower than the MJCF's where commands go on and the
    joint stays.

    A joint far behind its command is loaded, or sticks as its command comes back. A stop is where a
    command went on by MIN_BEYOND_STOP_RAD after the joint had come to its end, twice at least.
    """
    servos: dict[str, dict[str, float]] = {}
    for joint, i in zip(robot.operated, robot.operated_index, strict=True):
        for name, sign in (("stop_low", -1.0), ("stop_high", 1.0)):
            paths = [(sign * s.ctrl[:, i], sign * s.qpos[:, i]) for s in sequences]
            end = max(float(qpos.max()) for _, qpos in paths)
            pushes = [c for ctrl, qpos in paths for c in _pushes(ctrl, qpos, end)]
            went_on = [c.max() - c[0] > MIN_BEYOND_STOP_RAD for c in pushes]
            met = sum(map(len, pushes)) >= MIN_STOP_ROWS and sum(went_on) > 1
            if met and sign * robot.qpos_range[i, int(sign > 0)] > end + MIN_NARROWING_RAD:
                servos.setdefault(joint, {})[name] = round(sign * end, 4)
    return robot.with_servos(servos) if servos else robot


def _pushes(ctrl: Array, qpos: Array, end: float) -> list[Array]:
    """Return the commands well beyond the end of a joint's path while the joint is there, push by
    push.
    """
    rows = np.flatnonzero((ctrl > end + MIN_BEYOND_STOP_RAD) & (qpos > end - AT_STOP_RAD))
    return np.split(ctrl[rows], np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []


def stop_questions(given: RobotSpec, stopped: RobotSpec) -> list[str]:
    """Return a question for each stop that `with_stops` added, since the joint may have met
    anything.
    """
    questions = []
    for joint, i in zip(given.operated, given.operated_index, strict=True):
        for name, side in (("stop_low", 0), ("stop_high", 1)):
            stop = float(getattr(stopped, name)[i])
            if np.isfinite(stop) and stop != getattr(given, name)[i]:
                questions.append(
                    f"{joint}: stayed at {stop:.3f} rad where commands went "
                    f"{('lower', 'higher')[side]}: if that is a stop, identify with --stops; if "
                    "something was in its way, leave those motions out"
                )
    return questions


def default_terms(sequences: ListOf[Sequence], robot: RobotSpec) -> tuple[Term, ...]:
    """Return DEFAULT_TERMS, after "limit" and "speed" if gains and recorded errors ask a joint for
    such torques, and before "temperature" if recordings vary it.

    That is so if the servo asks, in MIN_LIMITED_SHARE of a joint's rows, for AT_TORQUE_LIMIT of the
    robot's limit; for "speed", in MIN_FAST_SHARE, for DRIVEN_FAST of it while the joint moves that
    way at FAST of its greatest speed.
    """
    op = robot.operated_index
    fast = FAST * greatest_speeds(sequences, robot)
    limit = robot.effort_limit[op]
    reached: dict[Term, Array] = {"limit": np.zeros(len(op)), "speed": np.zeros(len(op))}
    rows = np.zeros(len(op))
    for s in sequences:
        own = robot.with_gains(*s.meta.recorded_gains)
        torque = (own.kp * (s.ctrl - s.qpos) - own.kd * s.qvel)[:, op]
        qvel = s.qvel[:, op]
        recorded = np.array([j not in s.meta.unrecorded for j in robot.operated])
        reached["limit"] += recorded * (np.abs(torque) > AT_TORQUE_LIMIT * limit).sum(axis=0)
        driven = (torque * np.sign(qvel) > DRIVEN_FAST * limit) & (np.abs(qvel) > fast)
        reached["speed"] += recorded * driven.sum(axis=0)
        rows += len(s) * recorded
    shares: dict[Term, float] = {"limit": MIN_LIMITED_SHARE, "speed": MIN_FAST_SHARE}
    limited = (t for t, share in shares.items() if (reached[t] > share * rows).any())
    warm = ("temperature",) if temperature_varies(sequences, robot).any() else ()
    return (*limited, *DEFAULT_TERMS, *warm)


def target_speeds(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Return the speed of each operated joint's ramp, (n,) rad/s; 0 where a lag explains the state
    as well.
    """
    op = robot.operated_index
    low, high = robot.qpos_range[op].T
    parts = []
    for s in sequences:
        if s.duration < 2 * MAX_LAG_S:
            continue
        every = max(1, round(MIN_PERIOD_S / s.dt))
        ctrl = np.clip(s.ctrl[::every, op], low, high).astype(float)
        qpos = s.qpos[::every, op].astype(float)
        parts.append((ctrl, qpos, every * s.dt))
    if len(parts) < 2:
        return np.zeros(len(op))
    span = [max(1, round(SPEED_SPAN_S / dt)) for _, _, dt in parts]
    speeds = [
        np.abs(q[k:] - q[:-k]) / (k * dt)
        for (_, q, dt), k in zip(parts, span, strict=True)
        if len(q) > k
    ]
    greatest = np.quantile(np.concatenate(speeds), GREATEST_SPEED_QUANTILE, axis=0)  # (n,)
    tried = np.maximum(SPEED_RATIOS[:, None] * greatest, 1e-6)  # (k, n)
    # Squared errors of odd and even recordings; squares and maxima of how far ramps are behind
    # their commands.
    error = np.zeros((2, len(SPEED_RATIOS) + len(LAG_TIME_CONSTANTS_S), len(op), LAGS))
    behind_command = np.zeros((2, *tried.shape))
    rows = np.zeros(2)
    for i, (ctrl, qpos, dt) in enumerate(parts):
        ramps = speed_limited(
            np.broadcast_to(ctrl[:, None], (len(ctrl), *tried.shape)), qpos[0], tried, dt
        )
        behind = np.abs(ramps - ctrl[:, None])
        squares, most = behind_command
        behind_command = np.stack(
            [squares + (behind**2).sum(axis=0), np.maximum(most, behind.max(axis=0))]
        )
        aims = np.concatenate([ramps, _lagged(ctrl, dt)], axis=1)  # (T, k and lags, n)
        for j, lag in enumerate(np.linspace(0, MAX_LAG_S, LAGS)):
            late = round(lag / dt)
            away = qpos[late:, None] - aims[: len(aims) - late]
            error[i % 2, ..., j] += ((away - away.mean(axis=0)) ** 2).sum(axis=0)
        rows[i % 2] += len(ctrl)
    rms = np.sqrt(error.min(axis=-1) / rows[:, None, None])  # (2, k, n)
    ramp_rms, lag_rms = np.split(rms, [len(tried)], axis=1)
    best = ramp_rms.sum(axis=0).argmin(axis=0)
    lowest = np.take_along_axis(ramp_rms, best[None, None], axis=1)[:, 0]
    ratio = lowest / np.maximum(lag_rms.min(axis=1), 1e-9)  # (2, n)
    joints = np.arange(len(op))
    speed = tried[best, joints]
    squares, most = behind_command[:, best, joints]
    limited = (ratio < MAX_ERROR_RATIO).all(axis=0) & (
        np.sqrt(squares / rows.sum()) > MIN_RAMP_ERROR_RAD
    )
    limited &= most > MIN_RAMP_DELAY_S * speed
    speed[~limited] = 0.0
    if limited.any():
        speed[limited] = _speed_behind(
            [(c[:, limited], q[:, limited], dt) for c, q, dt in parts], speed[limited]
        )
    return np.asarray(speed)


def _speed_behind(parts: list[tuple[Array, Array, float]], speed: Array) -> Array:
    """Return the median speed of joints well behind a ramp of about `speed` (n,) rad/s: that of
    the ramp itself.
    """
    seen = []
    for ctrl, qpos, dt in parts:
        behind = np.abs(speed_limited(ctrl, qpos[0], speed, dt) - ctrl)
        # then it is as fast as its ramp
        k = max(1, round(SPEED_SPAN_S / dt))
        late = round(MIN_RAMP_DELAY_S / 2 / dt)
        moved = np.abs(qpos[late + k :] - qpos[late:-k]) / (k * dt)
        seen.append(np.where(behind[: len(moved)] > MIN_RAMP_DELAY_S / 2 * speed, moved, np.nan))
    return np.asarray(np.nanmedian(np.concatenate([*seen, speed[None]]), axis=0))


def _lagged(ctrl: Array, dt: float) -> Array:
    """Return commands (T, n) behind first-order lags of LAG_TIME_CONSTANTS_S, (T, lags, n)."""
    share = np.minimum(dt / np.maximum(LAG_TIME_CONSTANTS_S, dt), 1)[:, None]
    lagged = np.empty((len(ctrl), len(LAG_TIME_CONSTANTS_S), ctrl.shape[1]))
    at = np.repeat(ctrl[:1], len(LAG_TIME_CONSTANTS_S), axis=0)
    for t, target in enumerate(ctrl):
        lagged[t] = at = at + share * (target - at)
    return lagged
