"""A robot that is driven by torque or current: friction, inertia and delay of its joints with the torque as the input.

What inverse dynamics of the robot's file ask for along a recording, and what was told, differ by armature · q̈ +
damping · q̇ + friction · sign(q̇); of a current also by N·m per ampere. All columns pass one filter, which alters no sum.
The delay is the shift of the torque that leaves least. What is found is judged forwards, on rows that were not fitted:
the simulator starts in a recorded state and is driven by the recorded torque.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model

SMOOTH, FILTER = 25.0, 8.0  # Hz: before differentiating, and of every column
MOVES = 0.05  # rad/s below which a row says nothing of friction
DELAYS = np.arange(0.0, 0.0405, 0.001)  # s
BLOCKS = 10  # of the rows, each left out once for standard errors
HORIZONS = (0.1, 0.5, 1.0)  # s
PART = 4.0  # s
HUBER, ROUNDS = 1.345, 10  # of what is left in the middle row, beyond which a row counts less: somebody pushed
TERMS = ("armature", "damping", "frictionloss")


class _Rows(NamedTuple):
    """What a regression needs of recordings, operated joints."""

    told: Array  # N·m or A, one for each of DELAYS, (D, rows, n)
    asked: Array  # by inverse dynamics without the terms that are sought, N·m, (rows, n)
    acceleration: Array
    velocity: Array
    sign: Array
    moving: Array  # bool


@dataclass(frozen=True)
class Driven:
    """What was found of the operated joints, (n,).

    Attributes:
        robot: The robot with armature, damping, friction and delay.
        constant: N·m in one unit of what was recorded; 1 where that was believed.
        bias: N·m that is left on average: gravity that the file does not know, or the sensor's.
        std: Joint → field → standard error.
        torque: Median |told − asked for| of rows that were not fitted, N·m: of the file, of the robot. Medians, for
            a row in which somebody pushed says nothing of the robot.
        angle: s ahead → median |error| when driven by the torque, rad: of the file, of the robot.
        windows: How many starts that is of.
    """

    robot: RobotSpec
    constant: Array
    bias: Array
    std: dict[str, dict[str, float]]
    torque: tuple[Array, Array]
    angle: dict[float, tuple[Array, Array]]
    windows: int


def driven(train: ListOf[Sequence], judging: ListOf[Sequence], robot: RobotSpec, constant: bool = False) -> Driven:
    """Fit the joints one by one, and judge all together.

    Args:
        train: Recordings with torque.
        judging: Others; the same list is taken in parts of PART, which fit and judge in turn.
        robot: The robot whose file says inertias and gravity; its payloads are taken as true.
        constant: The torque's unit is not known, as of a current: fit N·m in one of it.

    Raises:
        UsageError: A recording has no torque.
    """
    for s in (*train, *judging):
        if s.tau is None or not np.isfinite(s.tau[:, robot.operated_index]).all():
            raise UsageError(
                f"{s.meta.motion}: has no torque of every operated joint; say its column as tau in logs.toml"
            )
    if train is judging:
        parts = [
            s.rows(slice(i, i + round(PART / s.dt)))
            for s in judging
            for i in range(0, len(s) - round(2 / s.dt), round(PART / s.dt))
        ]
        train, judging = parts[::2], parts[1::2]
        if not judging:
            raise UsageError(f"less than {2 * PART:g} s in all: record more, or other motions to judge by")
    fit, test = ([_rows(s, robot) for s in part] for part in (train, judging))
    names, servos, std = robot.operated, dict[str, dict[str, float]](), dict[str, dict[str, float]]()
    factor, bias = np.ones(len(names)), np.zeros(len(names))
    for j, name in enumerate(names):
        x, lag = _joint(fit, j, constant)
        spread = _jackknife(fit, j, constant, lag)
        servos[name] = dict(zip(TERMS, x[:3].tolist(), strict=True)) | {"delay": float(DELAYS[lag])}
        std[name] = dict(zip((*TERMS, "bias", "constant"), spread.tolist(), strict=True))
        bias[j], factor[j] = x[3], x[4]
    found = robot.with_servos(servos)
    angles = [_ahead(judging, r, k) for r, k in ((robot, np.ones_like(factor)), (found, factor))]
    given = build_model(robot)
    dof = [given.joint(name).dofadr[0] for name in names]
    old = {f: np.ravel(getattr(given, f"dof_{f}"))[dof] for f in TERMS}
    new = {f: getattr(found, f)[robot.operated_index] for f in TERMS}
    lags = np.array([round(servos[n]["delay"] / (DELAYS[1] - DELAYS[0])) for n in names])
    told = (_left(test, old, np.ones_like(factor), 0 * lags), _left(test, new, factor, lags))
    angle = {h: (angles[0][h], angles[1][h]) for h in HORIZONS}
    return Driven(found, factor, bias, std, told, angle, _windows(judging))


def _rows(s: Sequence, robot: RobotSpec) -> _Rows:
    op, dt = robot.operated_index, s.dt
    model = build_model(robot, s.meta.payload_mass, s.meta.payload_side)
    for name in robot.operated:
        dof = model.joint(name).dofadr[0]
        model.dof_armature[dof] = 0.0
        model.dof_damping[dof, ...] = 0.0
    smooth = lowpass(s.qpos.astype(float), dt, SMOOTH)
    v = differentiate(smooth, dt)
    a = differentiate(v, dt)
    assert s.tau is not None
    time, tau = np.arange(len(s)) * dt, s.tau[:, op].astype(float)
    late = [np.stack([np.interp(time - d, time, x) for x in tau.T], axis=1) for d in DELAYS]
    columns = (inverse_dynamics(model, smooth, v, a)[:, op], a[:, op], v[:, op], np.tanh(v[:, op] / MOVES))
    asked, acceleration, velocity, sign = (lowpass(x, dt, FILTER) for x in columns)
    told = np.array([lowpass(x, dt, FILTER) for x in late])
    return _Rows(told, asked, acceleration, velocity, sign, np.abs(v[:, op]) > MOVES)


def _system(rows: ListOf[_Rows], j: int, constant: bool, lag: int) -> tuple[Array, Array]:
    """Columns armature, damping, friction, bias, and the constant's; and what they have to make up."""
    parts = []
    for r in rows:
        use = r.moving[:, j]
        told, asked = r.told[lag][use, j], r.asked[use, j]
        columns = [r.acceleration[use, j], r.velocity[use, j], r.sign[use, j], np.ones_like(told)]
        columns += [-told] if constant else []
        parts.append((np.stack(columns, axis=1), -asked if constant else told - asked))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _solved(a: Array, y: Array) -> tuple[Array, float]:
    """Armature, damping, friction ≥ 0, bias, constant; and the square of what is left, robustly."""
    low = np.array([0.0, 0.0, 0.0, -np.inf, 1e-9])[: a.shape[1]]
    if len(y) < 20:
        return np.array([0.0, 0.0, 0.0, 0.0, 1.0]), np.inf
    weight = np.ones(len(y))
    for _ in range(ROUNDS):
        q, r = np.linalg.qr(a * weight[:, None])
        x = lsq_linear(r, q.T @ (y * weight), (low, np.inf), method="bvls").x
        left = np.abs(a @ x - y)
        scale = 1.4826 * float(np.median(left))
        weight = np.sqrt(np.minimum(1.0, HUBER * scale / np.maximum(left, 1e-12)))
    return np.append(x, np.ones(5 - len(x))), scale**2


def _joint(rows: ListOf[_Rows], j: int, constant: bool) -> tuple[Array, int]:
    """Its parameters, and which of DELAYS leaves least."""
    fits = [_solved(*_system(rows, j, constant, lag)) for lag in range(len(DELAYS))]
    lag = int(np.argmin([left / (x[4] ** 2) for x, left in fits]))
    return fits[lag][0], lag


def _jackknife(rows: ListOf[_Rows], j: int, constant: bool, lag: int) -> Array:
    """Standard errors, (5,), of blocks of rows that are each left out once."""
    a, y = _system(rows, j, constant, lag)
    block = np.arange(len(y)) * BLOCKS // max(len(y), 1)
    each = np.array([_solved(a[block != k], y[block != k])[0] for k in range(BLOCKS)])
    return np.sqrt((BLOCKS - 1) * each.var(axis=0))


def _left(rows: ListOf[_Rows], terms: dict[str, Array], constant: Array, lags: Array) -> Array:
    """Median |told − asked for|, (n,) N·m."""
    apart = []
    for r in rows:
        told = constant * np.stack([r.told[lag][:, j] for j, lag in enumerate(lags)], axis=1)
        asked = r.asked + terms["armature"] * r.acceleration + terms["damping"] * r.velocity
        apart.append(np.abs(told - asked - terms["frictionloss"] * r.sign))
    return np.asarray(np.median(np.concatenate(apart), axis=0))


def _starts(s: Sequence) -> Array:
    return np.arange(0, len(s) - round(HORIZONS[-1] / s.dt) - 1, max(1, round(HORIZONS[1] / s.dt)))


def _windows(sequences: ListOf[Sequence]) -> int:
    return sum(len(_starts(s)) for s in sequences)


def _ahead(sequences: ListOf[Sequence], robot: RobotSpec, constant: Array) -> dict[float, Array]:
    """Median |error| of the operated joints so many seconds after a recorded state, driven by the torque, (n,) rad."""
    op, errors = robot.operated_index, dict[float, list[Array]]()
    for s in sequences:
        model = build_model(robot, s.meta.payload_mass, s.meta.payload_side, dt=s.dt)
        model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
        data, steps = mujoco.MjData(model), round(s.dt / model.opt.timestep)
        joints = [model.joint(name) for name in robot.joint_names]
        at, dof = (np.array([getattr(x, f)[0] for x in joints]) for f in ("qposadr", "dofadr"))
        assert s.tau is not None
        time, tau = np.arange(len(s)) * s.dt, s.tau.astype(float)
        for j, i in enumerate(op):
            tau[:, i] = constant[j] * np.interp(time - robot.delay[i], time, tau[:, i])
        v = differentiate(lowpass(s.qpos.astype(float), s.dt, SMOOTH), s.dt)
        for start in _starts(s):
            mujoco.mj_resetData(model, data)
            data.qpos[at], data.qvel[dof] = s.qpos[start], v[start]
            for h in HORIZONS:
                last = start + round(h / s.dt)
                for t in range(start + round(([0.0, *HORIZONS][HORIZONS.index(h)]) / s.dt), last):
                    data.qfrc_applied[dof] = tau[t]
                    mujoco.mj_step(model, data, steps)
                errors.setdefault(h, []).append(np.abs(data.qpos[at] - s.qpos[last])[op])
    return {h: np.median(each, axis=0) for h, each in errors.items()}
