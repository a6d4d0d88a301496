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
# Of the regression, in the order of its columns.
PARAMETERS = (*PASSIVE_FIELDS, "bias", "constant")
LOWEST = np.array([0.0, 0.0, 0.0, -np.inf, 1e-9])  # of PARAMETERS
# PARAMETERS where too few rows move.
UNFITTED = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
PART_S = 4.0  # of recordings that fit and judge in turn
MIN_PART_S = 2.0  # of the last one of a recording
MIN_ROWS = 20  # of a regression
# Standard deviations, beyond which a row counts less: somebody pushed.
HUBER_SCALE = 1.345
HUBER_ROUNDS = 10
# Standard deviation of normal numbers over their median absolute deviation.
MAD_TO_STD = 1.4826


class _Rows(NamedTuple):
    """Filtered rows of a recording, operated joints."""

    torque: Array  # N·m or A, for each of DELAYS_S, (delays, rows, n)
    required: Array  # by inverse dynamics without the fitted fields, (rows, n) N·m
    acceleration: Array  # (rows, n) rad/s²
    velocity: Array  # (rows, n) rad/s
    sign: Array  # of the velocity, smoothed, (rows, n)
    moving: Array  # whether the joint moves, (rows, n) bool


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
    train: ListOf[Sequence],
    judging: ListOf[Sequence],
    robot: RobotSpec,
    constant: bool = False,
) -> TorqueDrivenFit:
    """Fit the joints one by one, and judge all together.

    Args:
        train, judging: Recordings with torque; if they are one list, parts of PART_S fit and judge
            in turn.
        robot: Its file gives inertias and gravity; payloads are taken as true.
        constant: Fit N·m per unit of the torque, as of a current.

    Raises:
        UsageError: A recording has no torque, or none of those that judge is long enough.
    """
    _require_torque([*train, *judging], robot)
    if train is judging:
        train, judging = _parts_in_turn(judging)
    windows = sum(len(_starts(s)) for s in judging)
    if windows == 0:
        raise UsageError(
            f"a fit from torque is judged on motions of more than {HORIZONS_S[-1]:g} s, and no "
            "validation recording is that long; record longer motions"
        )
    joints = _fit_joints([_rows(s, robot) for s in train], robot.operated, constant)
    fitted = robot.with_identified(joints.servos)
    op = robot.operated_index
    model = build_model(robot)
    of_file = {}
    of_fit = {}
    for field in PASSIVE_FIELDS:
        of_file[field] = np.ravel(getattr(model, f"dof_{field}"))[op]
        of_fit[field] = fitted.servo[field][op]
    newton_metres = np.ones_like(joints.constant)
    no_lags = np.zeros_like(joints.lags)
    rows = [_rows(s, robot) for s in judging]
    torque_before = _residual(rows, of_file, newton_metres, no_lags)
    torque_after = _residual(rows, of_fit, joints.constant, joints.lags)
    angle_before = _ahead(judging, robot, newton_metres)
    angle_after = _ahead(judging, fitted, joints.constant)
    angle = {}
    for horizon in HORIZONS_S:
        angle[horizon] = (angle_before[horizon], angle_after[horizon])
    return TorqueDrivenFit(
        robot=fitted,
        constant=joints.constant,
        bias=joints.bias,
        std=joints.std,
        torque=(torque_before, torque_after),
        angle=angle,
        windows=windows,
    )


class _JointFits(NamedTuple):
    """Fits of n joints one by one."""

    servos: dict[str, dict[str, float]]  # joint → PASSIVE_FIELDS and delay
    std: dict[str, dict[str, float]]  # joint → standard error of each of PARAMETERS
    constant: Array  # N·m per unit of the recorded torque, (n,)
    bias: Array  # N·m, (n,)
    lags: Array  # numbers of DELAYS_S, (n,)


def _fit_joints(rows: ListOf[_Rows], names: ListOf[str], constant: bool) -> _JointFits:
    """Fit the joints; `constant`: the torque per unit too."""
    n = len(names)
    fits = _JointFits({}, {}, np.ones(n), np.zeros(n), np.zeros(n, int))
    for j, name in enumerate(names):
        x, lag = _joint(rows, j, constant)
        found = dict(zip(PARAMETERS, x.tolist(), strict=True))
        errors = _jackknife(rows, j, constant, lag).tolist()
        fits.std[name] = dict(zip(PARAMETERS, errors, strict=True))
        fits.bias[j] = found.pop("bias")
        fits.constant[j] = found.pop("constant")
        fits.servos[name] = found | {"delay": float(DELAYS_S[lag])}
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
        for start in range(0, len(s) - round(MIN_PART_S / s.dt), rows):
            parts.append(s.rows(slice(start, start + rows)))
    if len(parts) < 2:
        raise UsageError(
            f"less than {2 * PART_S:g} s in all: record more, or other motions to judge by"
        )
    return parts[::2], parts[1::2]


def _rows(s: Sequence, robot: RobotSpec) -> _Rows:
    """Return the filtered rows of a recording with torque."""
    op = robot.operated_index
    dt = s.dt
    model = build_model(robot, s.meta.payload_mass, s.meta.payload_side)
    model.dof_armature[op] = 0.0
    model.dof_damping[op] = 0.0
    qpos = lowpass(s.qpos.astype(float), dt, DIFFERENTIATION_CUTOFF_HZ)
    qvel = differentiate(qpos, dt)
    qacc = differentiate(qvel, dt)
    required = inverse_dynamics(model, qpos, qvel, qacc)[:, op]
    velocity = qvel[:, op]
    return _Rows(
        torque=_late_torques(s, op),
        required=lowpass(required, dt, CUTOFF_HZ),
        acceleration=lowpass(qacc[:, op], dt, CUTOFF_HZ),
        velocity=lowpass(velocity, dt, CUTOFF_HZ),
        sign=lowpass(np.tanh(velocity / MIN_SPEED), dt, CUTOFF_HZ),
        moving=np.abs(velocity) > MIN_SPEED,
    )


def _late_torques(s: Sequence, joints: Array) -> Array:
    """Return the filtered torques of joints, by number, after each of DELAYS_S, (delays, T, n)."""
    assert s.tau is not None
    time = np.arange(len(s)) * s.dt
    torque_of_joint = s.tau[:, joints].astype(float).T
    torques = []
    for delay in DELAYS_S:
        late = [np.interp(time - delay, time, torque) for torque in torque_of_joint]
        torques.append(lowpass(np.stack(late, axis=1), s.dt, CUTOFF_HZ))
    return np.array(torques)


def _system(
    rows: ListOf[_Rows],
    j: int,
    constant: bool,
    lag: int,
) -> tuple[Array, Array]:
    """Return the regression's columns, in the order of PARAMETERS, and its right-hand side, of the
    rows in which joint j moves.

    Args:
        constant: Whether there is a column for the constant.
        lag: Number of the torque's delay.
    """
    matrices = []
    targets = []
    for r in rows:
        use = r.moving[:, j]
        torque = r.torque[lag][use, j]
        required = r.required[use, j]
        one = np.ones_like(torque)
        columns = [r.acceleration[use, j], r.velocity[use, j], r.sign[use, j], one]
        if constant:
            columns.append(-torque)
            targets.append(-required)
        else:
            targets.append(torque - required)
        matrices.append(np.stack(columns, axis=1))
    return np.concatenate(matrices), np.concatenate(targets)


def _solved(a: Array, y: Array) -> tuple[Array, float]:
    """Return PARAMETERS, (5,), and the robust squared residual, by least squares with bounds and
    Huber's weights; `a` and `y` as of `_system`.
    """
    columns = a.shape[1]
    if len(y) < MIN_ROWS:
        return UNFITTED, np.inf
    weight = np.ones(len(y))
    for _ in range(HUBER_ROUNDS):
        q, r = np.linalg.qr(a * weight[:, None])
        bounds = (LOWEST[:columns], np.inf)
        x = lsq_linear(r, q.T @ (y * weight), bounds, method="bvls").x
        residual = np.abs(a @ x - y)
        std = MAD_TO_STD * float(np.median(residual))
        huber = HUBER_SCALE * std / np.maximum(residual, 1e-12)
        weight = np.sqrt(np.minimum(1.0, huber))
    constant = np.ones(len(PARAMETERS) - columns)  # if it is no column
    return np.append(x, constant), std**2


def _joint(rows: ListOf[_Rows], j: int, constant: bool) -> tuple[Array, int]:
    """Return PARAMETERS of joint j, and the number of the delay with the least residual."""
    parameters = []
    residuals = []
    for lag in range(len(DELAYS_S)):
        x, squared_residual = _solved(*_system(rows, j, constant, lag))
        unit = x[PARAMETERS.index("constant")]
        parameters.append(x)
        residuals.append(squared_residual / unit**2)
    best = int(np.argmin(residuals))
    return parameters[best], best


def _jackknife(rows: ListOf[_Rows], j: int, constant: bool, lag: int) -> Array:
    """Return standard errors of PARAMETERS, (5,), by a jackknife over blocks of rows."""
    a, y = _system(rows, j, constant, lag)
    block_of_row = np.arange(len(y)) * JACKKNIFE_BLOCKS // max(len(y), 1)
    solutions = []
    for block in range(JACKKNIFE_BLOCKS):
        is_kept = block_of_row != block
        x, _ = _solved(a[is_kept], y[is_kept])
        solutions.append(x)
    return np.asarray(np.sqrt((JACKKNIFE_BLOCKS - 1) * np.var(solutions, axis=0)))


def _residual(
    rows: ListOf[_Rows],
    passive: dict[str, Array],
    constant: Array,
    lags: Array,
) -> Array:
    """Return the median |recorded − required torque|, (n,) N·m.

    Args:
        passive: Field of PASSIVE_FIELDS → value, (n,).
        constant: N·m per unit of the recorded torque, (n,).
        lags: Numbers of the torques' delays, (n,).
    """
    residuals = []
    for r in rows:
        late = [r.torque[lag][:, j] for j, lag in enumerate(lags)]
        recorded = constant * np.stack(late, axis=1)  # (rows, n) N·m
        required = r.required + passive["armature"] * r.acceleration
        required = required + passive["damping"] * r.velocity
        residuals.append(np.abs(recorded - required - passive["frictionloss"] * r.sign))
    return np.asarray(np.median(np.concatenate(residuals), axis=0))


def _starts(s: Sequence) -> Array:
    """Return the rows from which the simulator starts: one for each middle horizon, and the longest
    one before the end.
    """
    last = len(s) - round(HORIZONS_S[-1] / s.dt) - 1
    return np.arange(0, last, max(1, round(HORIZONS_S[1] / s.dt)))


def _ahead(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    constant: Array,
) -> dict[float, Array]:
    """Return horizon → median |error| of the operated joints, driven by the torque from recorded
    states, (n,) rad.
    """
    errors: dict[float, list[Array]] = {}
    for s in sequences:
        model = build_model(robot, s.meta.payload_mass, s.meta.payload_side, dt=s.dt)
        model.actuator_gainprm[:] = 0.0
        model.actuator_biasprm[:] = 0.0
        torque = _acting_torque(s, robot, constant)
        qpos = lowpass(s.qpos.astype(float), s.dt, DIFFERENTIATION_CUTOFF_HZ)
        qvel = differentiate(qpos, s.dt)
        for start in _starts(s):
            played = _played(s, model, torque, qvel, start)
            for horizon, away in zip(HORIZONS_S, played, strict=True):
                errors.setdefault(horizon, []).append(away[robot.operated_index])
    return {horizon: np.median(away, axis=0) for horizon, away in errors.items()}


def _acting_torque(s: Sequence, robot: RobotSpec, constant: Array) -> Array:
    """Return the recorded torques after the robot's delay, (T, joints) N·m."""
    assert s.tau is not None
    time = np.arange(len(s)) * s.dt
    torque = s.tau.astype(float)
    for j, i in enumerate(robot.operated_index):
        late = np.interp(time - robot.servo.delay[i], time, torque[:, i])
        torque[:, i] = constant[j] * late
    return torque


def _played(
    s: Sequence,
    model: mujoco.MjModel,
    torque: Array,
    qvel: Array,
    start: int,
) -> list[Array]:
    """Return |simulated − recorded position| of all joints at each of HORIZONS_S, (joints,) rad,
    from the recorded state in row `start`.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = s.qpos[start]
    data.qvel[:] = qvel[start]
    steps = round(s.dt / model.opt.timestep)
    away = []
    for before, horizon in pairwise((0.0, *HORIZONS_S)):
        first = start + round(before / s.dt)
        last = start + round(horizon / s.dt)
        for row in torque[first:last]:
            data.qfrc_applied[:] = row
            mujoco.mj_step(model, data, steps)
        away.append(np.abs(data.qpos - s.qpos[last]))
    return away
