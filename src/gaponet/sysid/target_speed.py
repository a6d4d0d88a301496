"""Does a servo's own trajectory generator limit the speed of its targets, and to what?

A joint behind such a generator follows the ramp that it makes of a command, and never the command itself. So the state
is held against the commands, as they came and as a sluggish servo follows them, and against ramps of several speeds,
each with the lag and the offset that suit it best: no servo's parameters are needed for that. Where a ramp shows, the
robot is identified with it as well.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import ramped
from gaponet.sim.replay import whole_errors
from gaponet.sysid.fit import Identified, Tried

FINEST, LATEST, LAGS = 0.01, 0.3, 16  # s between rows, s of lag, and how many lags
SHARES = np.geomspace(0.7, 1.25, 30)  # of a joint's greatest speed
TOP = 0.995  # quantile of a speed that is its greatest
SPAN = 0.06  # s over which a speed is seen
SLUGGISH = (0.0, 0.02, 0.04, 0.08, 0.16, 0.32)  # s, time constants of a servo without a ramp
LESS = 0.8  # of the error, in both halves of the recordings: a ramp
ASKED, LONG = 0.02, 0.3  # rad RMS and s by which a ramp must be behind its command


def target_speeds(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """Speed of each operated joint's ramp, (n,), rad/s; 0 where a sluggish servo explains the state as well."""
    op = robot.operated_index
    low, high = robot.qpos_range[op].T
    parts = []
    for s in sequences:
        if s.duration < 2 * LATEST:
            continue
        every = max(1, round(FINEST / s.dt))
        ctrl, qpos = np.clip(s.ctrl[::every, op], low, high).astype(float), s.qpos[::every, op].astype(float)
        parts.append((ctrl, qpos, every * s.dt))
    if len(parts) < 2:
        return np.zeros(len(op))
    span = [max(1, round(SPAN / dt)) for _, _, dt in parts]
    speeds = [np.abs(q[k:] - q[:-k]) / (k * dt) for (_, q, dt), k in zip(parts, span, strict=True) if len(q) > k]
    top = np.quantile(np.concatenate(speeds), TOP, axis=0)  # (n,)
    tried = np.maximum(SHARES[:, None] * top, 1e-6)  # (k, n)
    error, asked = np.zeros((2, len(SHARES) + len(SLUGGISH), len(op), LAGS)), np.zeros((2, *tried.shape))
    rows = np.zeros(2)
    for i, (ctrl, qpos, dt) in enumerate(parts):
        ramps = ramped(np.broadcast_to(ctrl[:, None], (len(ctrl), *tried.shape)), qpos[0], tried, dt)
        behind = np.abs(ramps - ctrl[:, None])
        asked = np.stack([asked[0] + (behind**2).sum(axis=0), np.maximum(asked[1], behind.max(axis=0))])
        aims = np.concatenate([ramps, _sluggish(ctrl, dt)], axis=1)  # (T, k and others, n)
        for j, lag in enumerate(np.linspace(0, LATEST, LAGS)):
            late = round(lag / dt)
            away = qpos[late:, None] - aims[: len(aims) - late]
            error[i % 2, ..., j] += ((away - away.mean(axis=0)) ** 2).sum(axis=0)
        rows[i % 2] += len(ctrl)
    left = np.sqrt(error.min(axis=-1) / rows[:, None, None])  # (2, k, n)
    left, others = np.split(left, [len(tried)], axis=1)
    best = left.sum(axis=0).argmin(axis=0)
    share = np.take_along_axis(left, best[None, None], axis=1)[:, 0] / np.maximum(others.min(axis=1), 1e-9)  # (2, n)
    joints = np.arange(len(op))
    speed, (power, most) = tried[best, joints], asked[:, best, joints]
    ramp = (share < LESS).all(axis=0) & (np.sqrt(power / rows.sum()) > ASKED) & (most > LONG * speed)
    speed[~ramp] = 0.0
    if ramp.any():
        speed[ramp] = _on_the_way([(c[:, ramp], q[:, ramp], dt) for c, q, dt in parts], speed[ramp])
    return np.asarray(speed)


def _on_the_way(parts: list[tuple[Array, Array, float]], speed: Array) -> Array:
    """Speed of joints that have a ramp of about this speed (n,) well before them: the ramp's own, but for its size."""
    seen = []
    for ctrl, qpos, dt in parts:
        behind = np.abs(ramped(ctrl, qpos[0], speed, dt) - ctrl)
        k, late = max(1, round(SPAN / dt)), round(LONG / 2 / dt)  # so late the joint goes as its ramp does
        moved = np.abs(qpos[late + k :] - qpos[late:-k]) / (k * dt)
        seen.append(np.where(behind[: len(moved)] > LONG / 2 * speed, moved, np.nan))
    return np.asarray(np.nanmedian(np.concatenate([*seen, speed[None]]), axis=0))


def _sluggish(ctrl: Array, dt: float) -> Array:
    """Targets (T, n) as servos of several time constants follow them, (T, those, n)."""
    share = np.minimum(dt / np.maximum(SLUGGISH, dt), 1)[:, None]
    found = np.empty((len(ctrl), len(SLUGGISH), ctrl.shape[1]))
    at = np.repeat(ctrl[:1], len(SLUGGISH), axis=0)
    for t, target in enumerate(ctrl):
        found[t] = at = at + share * (target - at)
    return found


def with_ramps(
    fit: Callable[[RobotSpec, float | None], Identified],
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    validation: ListOf[Sequence],
    budget: float | None,
) -> Identified:
    """What `fit` finds of a robot; with ramps where the recordings show some and motions that were not fitted are
    surely followed better.

    Args:
        fit: Takes a robot to start from and the time that it may take, s.
        sequences: Recordings that are fitted.
        robot: Where the fit starts; the ramps that it has are believed.
        validation: Others, which judge, motion by motion.
        budget: Time for all fits together, s; None for as long as they take.
    """
    speeds = {} if robot.target_speed.any() else dict(zip(robot.operated, target_speeds(sequences, robot), strict=True))
    slow = {j: {"target_speed": float(f"{v:.3g}")} for j, v in speeds.items() if v}
    if not slow:
        return fit(robot, budget)
    made, other = (fit(r, budget and budget / 2) for r in (robot, robot.with_servos(slow)))
    motions = np.array([s.meta.motion for s in validation])
    of = [motions == m for m in dict.fromkeys(motions.tolist())]
    left = [whole_errors(validation, m.judged or m.robot) for m in (made, other)]
    tried = Tried("ramp", *(np.array([e[rows].mean() for rows in of]) for e in left))
    if not tried.kept:
        return replace(made, tried=(*made.tried, tried))
    told = ", ".join(f"{joint} {v['target_speed']:.3g}" for joint, v in slow.items())
    warning = (
        f"servos move their targets at most so fast, rad/s: {told}. That is a setting of theirs (profile velocity, "
        "goal speed): recorded and run with the same one, it is in the simulator; engines that load an export know none"
    )
    return replace(
        other, before=made.before, chosen=other.chosen if other.better else "ramp", tried=(*other.tried, tried),
        warnings=(warning, *other.warnings),
    )  # fmt: skip
