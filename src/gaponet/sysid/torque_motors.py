"""Identification of robots that are driven by torque or current: friction, inertia and delay of
the joints.

The recorded torque exceeds that of inverse dynamics by armature · q̈ + damping · q̇ + friction ·
sign(q̇); a current is also scaled by N·m per ampere. All columns pass one filter, which keeps sums.
The delay is the shift of the torque with the least residual. The fit is judged forwards on rows
that were not fitted: the simulator starts in a recorded state and is driven by the recorded torque.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.servo_fields import PASSIVE_FIELDS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model

DIFFERENTIATION_CUTOFF_HZ = 25.0  # of positions
CUTOFF_HZ = 8.0  # of every column of the regression
MIN_SPEED = 0.05  # rad/s of rows that show friction
DELAYS_S = np.arange(0.0, 0.0405, 0.001)
JACKKNIFE_BLOCKS = 10  # of the rows, each left out once
HORIZONS_S = (0.1, 0.5, 1.0)
PART_S = 4.0  # of recordings that fit and judge in turn
MIN_ROWS = 20  # of a regression
HUBER_SCALE = 1.345  # standard deviations, beyond which a row counts less: somebody pushed
HUBER_ROUNDS = 10
MAD_TO_STD = 1.4826  # standard deviation of normal numbers over their median absolute deviation


class _Rows(NamedTuple):
    """Filtered rows of a recording, operated joints."""

    torque: Array  # N·m or A, for each of DELAYS_S, (delays, rows, n)
    required: Array  # by inverse dynamics without the fitted fields, N·m, (rows, n)
    acceleration: Array
    velocity: Array
    sign: Array
    moving: Array  # bool


@dataclass(frozen=True)
class TorqueDrivenFit:
    """Result of the fit, arrays of the operated joints (n,).

    Attributes:
        robot: The robot with armature, damping, friction and delay.
        constant: N·m per unit of the recorded torque; 1 if it is taken as N·m.
        bias: Mean residual, N·m: gravity that the file lacks, or the sensor's.
        std: Joint → field → standard error.
        torque: Median |residual| of rows that were not fitted, N·m: of the file, of the robot. A
            median, so that a push by hand has no effect.
        angle: Horizon, s → median |error| when driven by the torque, rad: of the file, of the
            robot.
        windows: Number of starts of these rollouts.
    """

    robot: RobotSpec
    constant: Array
    bias: Array
    std: dict[str, dict[str, float]]
    torque: tuple[Array, Array]
    angle: dict[float, tuple[Array, Array]]
    windows: int


def fit_torque_driven(
    train: ListOf[Sequence], judging: ListOf[Sequence], robot: RobotSpec, constant: bool = False
) -> TorqueDrivenFit:
    """Fit the joints one by one, and judge all together.

    Args:
        train, judging: Recordings with torque; if they are one list, parts of PART_S fit and judge
            in turn.
        robot: Its file gives inertias and gravity; payloads are taken as true.
        constant: Fit N·m per unit of the torque, as of a current.

    Raises:
        UsageError: A recording has no torque.
    """
    _require_torque([*train, *judging], robot)
    if train is judging:
        train, judging = _parts_in_turn(judging)
    fitted_rows = [_rows(s, robot) for s in train]
    judging_rows = [_rows(s, robot) for s in judging]
    joints = _fit_joints(fitted_rows, robot.operated, constant)
    fitted = robot.with_identified(joints.servos)
    one = np.ones_like(joints.constant)
    given = build_model(robot)
    op = robot.operated_index
    old = {f: np.ravel(getattr(given, f"dof_{f}"))[op] for f in PASSIVE_FIELDS}
    new = {f: fitted.servo[f][op] for f in PASSIVE_FIELDS}
    torque_before = _residual(judging_rows, old, one, 0 * joints.lags)
    torque_after = _residual(judging_rows, new, joints.constant, joints.lags)
    angle_before = _ahead(judging, robot, one)
    angle_after = _ahead(judging, fitted, joints.constant)
    return TorqueDrivenFit(
        robot=fitted,
        constant=joints.constant,
        bias=joints.bias,
        std=joints.std,
        torque=(torque_before, torque_after),
        angle={h: (angle_before[h], angle_after[h]) for h in HORIZONS_S},
        windows=sum(len(_starts(s)) for s in judging),
    )


class _JointFits(NamedTuple):
    """Fits of n joints one by one."""

    servos: dict[str, dict[str, float]]  # joint → PASSIVE_FIELDS and delay
    std: dict[str, dict[str, float]]  # joint → standard error of PASSIVE_FIELDS, bias and constant
    constant: Array  # N·m per unit of the recorded torque, (n,)
    bias: Array  # N·m, (n,)
    lags: Array  # numbers of DELAYS_S, (n,)


def _fit_joints(rows: ListOf[_Rows], names: ListOf[str], constant: bool) -> _JointFits:
    """Fit the joints; `constant`: the torque per unit too."""
    n = len(names)
    fits = _JointFits({}, {}, np.ones(n), np.zeros(n), np.zeros(n, int))
    for j, name in enumerate(names):
        x, lag = _joint(rows, j, constant)
        errors = _jackknife(rows, j, constant, lag).tolist()
        fits.servos[name] = dict(zip(PASSIVE_FIELDS, x[:3].tolist(), strict=True))
        fits.servos[name]["delay"] = float(DELAYS_S[lag])
        fits.std[name] = dict(zip((*PASSIVE_FIELDS, "bias", "constant"), errors, strict=True))
        fits.bias[j] = x[3]
        fits.constant[j] = x[4]
        fits.lags[j] = lag
    return fits


def _require_torque(sequences: ListOf[Sequence], robot: RobotSpec) -> None:
    """Raise UsageError if a recording has no torque of an operated joint."""
    for s in sequences:
        if s.tau is None or not np.isfinite(s.tau[:, robot.operated_index]).all():
            what = "has no torque of every operated joint; say its column as tau in logs.toml"
            raise UsageError(f"{s.meta.motion}: {what}")


def _parts_in_turn(sequences: ListOf[Sequence]) -> tuple[list[Sequence], list[Sequence]]:
    """Return parts of PART_S, in turn to fit and to judge.

    Raises:
        UsageError: There are less than two.
    """
    parts = []
    for s in sequences:
        rows = round(PART_S / s.dt)
        for start in range(0, len(s) - round(2 / s.dt), rows):
            parts.append(s.rows(slice(start, start + rows)))
    if len(parts) < 2:
        raise UsageError(
            f"less than {2 * PART_S:g} s in all: record more, or other motions to judge by"
        )
    return parts[::2], parts[1::2]


def _rows(s: Sequence, robot: RobotSpec) -> _Rows:
    op = robot.operated_index
    dt = s.dt
    model = build_model(robot, s.meta.payload_mass, s.meta.payload_side)
    model.dof_armature[op] = model.dof_damping[op] = 0.0
    smooth = lowpass(s.qpos.astype(float), dt, DIFFERENTIATION_CUTOFF_HZ)
    v = differentiate(smooth, dt)
    a = differentiate(v, dt)
    assert s.tau is not None
    time = np.arange(len(s)) * dt
    tau = s.tau[:, op].astype(float)
    torques = []
    for delay in DELAYS_S:
        late = [np.interp(time - delay, time, torque) for torque in tau.T]
        torques.append(lowpass(np.stack(late, axis=1), dt, CUTOFF_HZ))
    required = inverse_dynamics(model, smooth, v, a)[:, op]
    v = v[:, op]
    return _Rows(
        np.array(torques),
        lowpass(required, dt, CUTOFF_HZ),
        lowpass(a[:, op], dt, CUTOFF_HZ),
        lowpass(v, dt, CUTOFF_HZ),
        lowpass(np.tanh(v / MIN_SPEED), dt, CUTOFF_HZ),
        np.abs(v) > MIN_SPEED,
    )


def _system(rows: ListOf[_Rows], j: int, constant: bool, lag: int) -> tuple[Array, Array]:
    """Return the regression's columns armature, damping, friction, bias and constant, and its
    right-hand side.
    """
    matrices = []
    targets = []
    for r in rows:
        use = r.moving[:, j]
        torque = r.torque[lag][use, j]
        required = r.required[use, j]
        columns = [r.acceleration[use, j], r.velocity[use, j], r.sign[use, j], np.ones_like(torque)]
        if constant:
            columns.append(-torque)
            targets.append(-required)
        else:
            targets.append(torque - required)
        matrices.append(np.stack(columns, axis=1))
    return np.concatenate(matrices), np.concatenate(targets)


def _solved(a: Array, y: Array) -> tuple[Array, float]:
    """Return armature, damping, friction ≥ 0, bias and constant, and the robust squared
    residual.
    """
    low = np.array([0.0, 0.0, 0.0, -np.inf, 1e-9])[: a.shape[1]]
    if len(y) < MIN_ROWS:
        return np.array([0.0, 0.0, 0.0, 0.0, 1.0]), np.inf
    weight = np.ones(len(y))
    for _ in range(HUBER_ROUNDS):
        q, r = np.linalg.qr(a * weight[:, None])
        x = lsq_linear(r, q.T @ (y * weight), (low, np.inf), method="bvls").x
        residual = np.abs(a @ x - y)
        scale = MAD_TO_STD * float(np.median(residual))
        weight = np.sqrt(np.minimum(1.0, HUBER_SCALE * scale / np.maximum(residual, 1e-12)))
    return np.append(x, np.ones(5 - len(x))), scale**2


def _joint(rows: ListOf[_Rows], j: int, constant: bool) -> tuple[Array, int]:
    """Return a joint's parameters, and the index of the delay with the least residual."""
    fits = [_solved(*_system(rows, j, constant, lag)) for lag in range(len(DELAYS_S))]
    lag = int(np.argmin([residual / (x[4] ** 2) for x, residual in fits]))
    return fits[lag][0], lag


def _jackknife(rows: ListOf[_Rows], j: int, constant: bool, lag: int) -> Array:
    """Return standard errors, (5,), by a jackknife over blocks of rows."""
    a, y = _system(rows, j, constant, lag)
    block = np.arange(len(y)) * JACKKNIFE_BLOCKS // max(len(y), 1)
    solutions = []
    for k in range(JACKKNIFE_BLOCKS):
        kept = block != k
        x, _ = _solved(a[kept], y[kept])
        solutions.append(x)
    return np.asarray(np.sqrt((JACKKNIFE_BLOCKS - 1) * np.var(solutions, axis=0)))


def _residual(rows: ListOf[_Rows], terms: dict[str, Array], constant: Array, lags: Array) -> Array:
    """Return the median |recorded − required torque|, (n,) N·m."""
    residuals = []
    for r in rows:
        torque = constant * np.stack([r.torque[lag][:, j] for j, lag in enumerate(lags)], axis=1)
        required = r.required + terms["armature"] * r.acceleration + terms["damping"] * r.velocity
        residuals.append(np.abs(torque - required - terms["frictionloss"] * r.sign))
    return np.asarray(np.median(np.concatenate(residuals), axis=0))


def _starts(s: Sequence) -> Array:
    """Return the rows from which the simulator starts: one for each middle horizon, and the longest
    one before the end.
    """
    last = len(s) - round(HORIZONS_S[-1] / s.dt) - 1
    return np.arange(0, last, max(1, round(HORIZONS_S[1] / s.dt)))


def _ahead(sequences: ListOf[Sequence], robot: RobotSpec, constant: Array) -> dict[float, Array]:
    """Return horizon → median |error| of the operated joints, driven by the torque from recorded
    states, (n,) rad.
    """
    op = robot.operated_index
    errors = dict[float, list[Array]]()
    for s in sequences:
        model = build_model(robot, s.meta.payload_mass, s.meta.payload_side, dt=s.dt)
        model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
        data = mujoco.MjData(model)
        steps = round(s.dt / model.opt.timestep)
        assert s.tau is not None
        time = np.arange(len(s)) * s.dt
        tau = s.tau.astype(float)
        for j, i in enumerate(op):
            tau[:, i] = constant[j] * np.interp(time - robot.servo.delay[i], time, tau[:, i])
        v = differentiate(lowpass(s.qpos.astype(float), s.dt, DIFFERENTIATION_CUTOFF_HZ), s.dt)
        for start in _starts(s):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = s.qpos[start]
            data.qvel[:] = v[start]
            for before, horizon in pairwise((0.0, *HORIZONS_S)):
                first = start + round(before / s.dt)
                last = start + round(horizon / s.dt)
                for torque in tau[first:last]:
                    data.qfrc_applied[:] = torque
                    mujoco.mj_step(model, data, steps)
                errors.setdefault(horizon, []).append(np.abs(data.qpos - s.qpos[last])[op])
    return {horizon: np.median(each, axis=0) for horizon, each in errors.items()}
