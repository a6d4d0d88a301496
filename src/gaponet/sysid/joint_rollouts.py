"""Rollouts of every joint by itself beside recordings, the others moving as recorded: many
candidates at once.

A servo's parameters act on its own joint first, and change the path of others by a few
milliradians. So inertia, gravity and the torque by the other joints' accelerations are computed
along the recording once. A joint is then one equation, stepped as MuJoCo steps it (implicit
damping, friction that stops within a step). That takes a hundredth of the time of the robot's
simulator; errors by joint agree to a few per cent (tests/sysid/test_joint_rollouts.py).
"""

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import nnls

from gaponet.base.arrays import Array
from gaponet.data.sequence import RATE_TOLERANCE, Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.servo_parameters import ratio_to
from gaponet.robot.spec import RobotSpec
from gaponet.sim.commands import speed_limited
from gaponet.sim.dynamics import motion_of_followers, tips_of
from gaponet.sim.model import build_model
from gaponet.sim.servo import JOINT_RECORD, Windows, compiled, simulate_joints
from gaponet.sim.temperature import recorded_temperatures, warm_values

# Larger errors count linearly (soft L1), so that one blocked joint does not decide.
ERROR_SCALE_RAD = 0.01
ROW_PERIOD_S = 0.01  # between rows that are compared
SETTLE_S = 0.1  # after a window's start, where velocities are measured ones
UNLIMITED_STOP_RAD = 7.0  # stops of a joint without any
MAX_REGRESSION_ROWS = 20_000
MAX_REGRESSION_DELAY_S = 0.1
REGRESSED_FIELDS = ("kp", "damping", "frictionloss", "armature", "offset", "delay")
SLIP_SPEED = 0.02  # rad/s, of the regression: at which friction is whole
CUTOFF_HZ = 10.0  # of the other joints' accelerations: above the arms' bandwidth
GRAVITY_STEP_RAD = 0.02  # of the derivative of gravity's torque
GRAVITY_ROWS = 5  # rows that share one derivative


class RowSpacing(NamedTuple):
    """Windows whose compared rows are equally far apart."""

    windows: Array  # which of all, (windows,)
    period: float  # control period, s
    stride: int  # periods from one compared row to the next


class JointRollouts:
    """Rollouts of windows of recordings, n operated joints; rows in which a tip may touch
    something do not count.

    Attributes:
        windows: The recordings side by side, and the loads along them.
        recorded: Whether a window holds a joint, (n, windows); without, there is no error.
        counted: Rows that count, (windows, rows).
        kp_ratio: kp of each recording over the robot's own, (windows, n).
        kd: kd of each recording, (windows, n) N·m·s/rad.
        temperature: Mean temperature of each recording, (n, windows) °C.
    """

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        contact_height: float = -np.inf,
        nthread: int = 0,
    ) -> None:
        """
        Args:
            parts: Windows, each at its own control period.
            robot: Its stops, zeros, limits and inertias hold.
            contact_height: Height under which a tip may touch something, m.
        """
        self.parts = parts
        self.robot = robot
        self.op = robot.operated_index
        self.nthread = nthread or os.cpu_count() or 1
        self.windows = _windows(parts, robot, contact_height)
        self.recorded = np.stack([p.meta.records(robot.operated) for p in parts], axis=1)
        self.counted = _counted_rows(self.windows)
        acting = [robot.with_gains(*p.meta.recorded_gains) for p in parts]
        self.kp_ratio = np.array([ratio_to(r.servo.kp, robot.servo.kp)[self.op] for r in acting])
        self.kd = np.array([r.servo.kd[self.op] for r in acting])
        self.temperature = recorded_temperatures(parts, self.op).T

    @property
    def dt(self) -> float:
        """Longest control period, s."""
        return float(self.windows.periods.max())

    @property
    def window(self) -> Array:
        """Window of each row of the flattened errors, (windows · rows,)."""
        return np.repeat(np.arange(len(self.counted)), self.counted.shape[1])

    @property
    def rows(self) -> Array:
        """Number of rows that count, of each joint, (n,)."""
        return np.asarray((self.counted & self.recorded[..., None]).sum(axis=(1, 2)))

    @property
    def spacings(self) -> list[RowSpacing]:
        """Windows by the spacing of their compared rows; nearly equal periods are the longest."""
        periods = self.windows.periods
        longest = self.dt
        nearly_longest = periods * (1 + RATE_TOLERANCE) > longest
        spacing = np.stack(
            [
                np.where(nearly_longest, longest, periods),
                _compared_rows(periods, self.windows.thin),
            ]
        )
        spacings = []
        for period, stride in np.unique(spacing, axis=1).T:
            same = (spacing[0] == period) & (spacing[1] == stride)
            spacings.append(RowSpacing(same, float(period), int(stride)))
        return spacings

    @property
    def seconds(self) -> Array:
        """Duration of the rows that count, of each joint, (n,) s."""
        rows = (self.counted & self.recorded[..., None]).sum(axis=2)  # (n, windows)
        seconds = np.zeros(len(rows))
        for spacing in self.spacings:
            own = rows[:, spacing.windows].sum(axis=1)
            seconds += own * spacing.period * spacing.stride
        return seconds

    def shortened(self, seconds: float) -> JointRollouts:
        """Return the same windows, put back on the recording every `seconds`: a smoother surface
        to descend on.
        """
        touch = self.windows.touch.copy()
        for of_window, period in zip(touch, self.windows.periods, strict=True):
            of_window[:: max(round(seconds / period), 1)] = True
        short = copy.copy(self)
        short.windows = self.windows._replace(touch=touch)
        short.counted = _counted_rows(short.windows)
        return short

    def errors(self, values: dict[str, Array]) -> Array:
        """Return q_sim − q_real of k candidates, (k, n, windows, rows) rad; zero where rows do not
        count.

        Args:
            values: kp at the robot's own gains, damping, frictionloss, armature, offset, delay, and
                any of effort_limit, SERVO_TERMS and those of temperature, (k, n) each. A damping
                below zero is taken from the servo's own kd.
        """
        k = len(values["kp"])
        n = len(self.op)
        out = np.zeros((k, n * len(self.parts), self.counted.shape[1]), np.float32)
        joints = self._joints(values)
        simulate = compiled(simulate_joints)
        ends = np.linspace(0, len(joints), self.nthread + 1).astype(int).tolist()
        with ThreadPoolExecutor(self.nthread) as pool:
            done = [
                pool.submit(simulate, first, last, joints, self.windows, out)
                for first, last in pairwise(ends)
            ]
            for one in done:
                one.result()
        errors = out.reshape(k, n, len(self.parts), -1)
        return np.asarray(errors * (self.counted & self.recorded[..., None]))

    def flat_errors(self, values: dict[str, Array]) -> Array:
        """Return `errors` of all windows in one row, (k, n, windows · rows) rad."""
        errors = self.errors(values)
        return errors.reshape(*errors.shape[:2], -1)

    def _joints(self, values: dict[str, Array]) -> Array:
        """Return candidates beside each window, JOINT_RECORD (n · windows, k); values (k, n) as of
        `errors`.
        """
        damping, frictionloss = warm_values(values, self.temperature)  # (k, n, windows)
        k, n, windows = damping.shape
        own = {"effort_limit": self.robot.servo.effort_limit[self.op]} | values
        each = {f: np.broadcast_to(x, (k, n))[..., None] for f, x in own.items()}
        each["kp"] = each["kp"] * self.kp_ratio.T
        kd = self.kd.T
        kd_ratio = ratio_to(kd, self.robot.servo.kd[self.op][:, None])
        each["kd"] = np.maximum(kd + kd_ratio * np.minimum(damping, 0.0), 0.0)
        each["damping"] = np.maximum(damping, 0.0)
        each["frictionloss"] = frictionloss
        joints = np.zeros((n, windows, k), JOINT_RECORD)
        for field in each.keys() & set(JOINT_RECORD.names or ()):
            joints[field] = np.moveaxis(np.broadcast_to(each[field], (k, n, windows)), 0, -1)
        return joints.reshape(n * windows, k)


def _windows(parts: list[Sequence], robot: RobotSpec, contact_height: float) -> Windows:
    """Return the recordings side by side, whose rows in which a tip is below a height, m, touch
    something.
    """
    op = robot.operated_index
    periods = np.array([p.dt for p in parts])
    dt = float(periods.max())
    thin = max(1, round(ROW_PERIOD_S / dt))
    qpos = _side_by_side([p.qpos[:, op] for p in parts])
    return Windows(
        loads=_loads(parts, robot, qpos, _compared_rows(periods, thin)),
        ctrl=_commands(parts, robot, qpos[..., 0]),
        qpos=qpos,
        qvel=_side_by_side([p.qvel[:, op] for p in parts]),
        touch=_touch(parts, robot, contact_height),
        lengths=np.array([len(p) for p in parts]),
        stops=_stops(robot, qpos),
        periods=periods,
        steps=robot.steps_per(dt),  # of every period, so that windows step side by side
        thin=thin,
    )


def _side_by_side(windows: list[Array]) -> Array:
    """Return arrays (rows, n) of each window as (n, windows, rows) float32; the last row of a
    shorter one is repeated.
    """
    rows = max(map(len, windows))
    extended = np.stack([_extended(x, rows) for x in windows])
    return np.ascontiguousarray(extended.transpose(2, 0, 1), np.float32)


def _extended(x: Array, rows: int) -> Array:
    """Return x, (k, …), with its last row repeated up to `rows`."""
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])


def _compared_rows(periods: Array, thin: int) -> Array:
    """Return the rows of each window from one that is compared to the next, (windows,): multiples
    of `thin`.
    """
    thins = np.round(ROW_PERIOD_S / periods / thin)
    return np.asarray(thin * np.maximum(1, thins).astype(int))


def _commands(parts: list[Sequence], robot: RobotSpec, start: Array) -> Array:
    """Return the commands inside the joints' ranges, as servos with a speed limit ramp them from
    `start` (n, windows) rad on, (n, windows, rows).
    """
    op = robot.operated_index
    low, high = robot.qpos_range[op].T
    ctrl = _side_by_side([np.clip(p.ctrl[:, op], low, high) for p in parts])
    speed = robot.servo.target_speed[op]
    if not speed.any():
        return ctrl
    limit = np.where(speed > 0, speed, np.inf)[:, None]
    periods = np.array([p.dt for p in parts])
    limited = speed_limited(np.moveaxis(ctrl, -1, 0), start, limit, periods)
    return np.ascontiguousarray(np.moveaxis(limited, 0, -1))


def _loads(parts: list[Sequence], robot: RobotSpec, qpos: Array, thins: Array) -> Array:
    """Return the loads along the recordings in the middle of each period, as `Windows.loads`.

    Args:
        qpos: (n, windows, rows) rad.
        thins: Rows from one for which loads are computed to the next, (windows,).
    """
    dt = max(p.dt for p in parts)
    payloads = [(p.meta.payload_mass, p.meta.payload_side) for p in parts]
    models = {}
    for payload in dict.fromkeys(payloads):
        models[payload] = build_model(robot, *payload, dt, physics_only=True)
    along = []
    for part, payload, thin in zip(parts, payloads, thins, strict=True):
        along.append(_loads_along(part, models[payload], robot.operated_index, thin))
    stacked = []
    for of_windows in zip(*along, strict=True):
        stacked.append(_at_middle(_side_by_side(list(of_windows))))
    inertia, weight, pull, slope = stacked
    weight_at_zero = weight - slope * _at_middle(qpos)
    return np.stack([inertia, weight_at_zero, pull, slope])


def _loads_along(part: Sequence, model: mujoco.MjModel, op: Array, thin: int) -> Array:
    """Return the loads of joints `op` along a recording, computed every `thin` rows and
    interpolated, (4, rows, n).

    These are inertia without armature, kg·m²; torque by gravity, Coriolis forces and springs, N·m;
    torque by the other joints' accelerations, N·m; slope of the second over the joint's angle,
    N·m/rad.
    """
    data = mujoco.MjData(model)
    full = np.empty((model.nv, model.nv))
    # no forces of servos and of a table
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    followers = motion_of_followers(model)
    moves = np.eye(model.nv) if followers is None else followers

    def bias(qpos: Array, qvel: Array) -> Array:
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        # Springs and the compensation of gravity act like a weight.
        torque = data.qfrc_bias - data.qfrc_spring - data.qfrc_gravcomp
        return np.asarray(torque if followers is None else torque @ followers)

    qvel = differentiate(lowpass(part.qpos.astype(float), part.dt, CUTOFF_HZ), part.dt)
    qacc = differentiate(qvel, part.dt)
    at = np.arange(0, len(part) + thin, thin).clip(max=len(part) - 1)
    loads = np.empty((4, len(at), len(op)))
    inertia, weight, pull, slope = loads
    for i, t in enumerate(at):
        here = bias(part.qpos[t], qvel[t])
        mujoco.mj_fullM(model, data, full)
        own = full.diagonal().copy()
        if followers is not None:
            own = np.einsum("ij,ik,kj->j", followers, full, followers)
        inertia[i] = (own - model.dof_armature)[op]
        weight[i] = here[op]
        pull[i] = (full @ qacc[t] @ moves - own * qacc[t])[op]
        if i % GRAVITY_ROWS == 0:
            for k, j in enumerate(op):
                turned = part.qpos[t].astype(float)
                turned += GRAVITY_STEP_RAD * moves[:, j]
                change = bias(turned, qvel[t])[j] - here[j]
                slope[i : i + GRAVITY_ROWS, k] = change / GRAVITY_STEP_RAD
    if thin == 1:
        return loads[:, : len(part)]
    rows = np.arange(len(part))
    return np.apply_along_axis(lambda load: np.interp(rows, at, load), 1, loads)


def _at_middle(x: Array) -> Array:
    """Return values (…, rows) in the middle between each row and the next."""
    return np.asarray(0.5 * (x + np.concatenate([x[..., 1:], x[..., -1:]], axis=-1)))


def _stops(robot: RobotSpec, qpos: Array) -> Array:
    """Return the ends of each joint's range, or of the recordings (n, windows, rows), so that no
    rollout diverges, (n, 2) rad.
    """
    low, high = robot.qpos_range[robot.operated_index].T
    lowest = np.where(np.isfinite(low), low, -UNLIMITED_STOP_RAD)
    highest = np.where(np.isfinite(high), high, UNLIMITED_STOP_RAD)
    ends = (
        np.minimum(lowest, qpos.min(axis=(1, 2))),
        np.maximum(highest, qpos.max(axis=(1, 2))),
    )
    return np.stack(ends, axis=1).astype(np.float32)


def _touch(parts: list[Sequence], robot: RobotSpec, contact_height: float) -> Array:
    """Return the rows in which a tip is below a height, m, (windows, rows)."""
    rows = max(map(len, parts))
    heights = tips_of(robot)
    if heights is None:
        return np.zeros((len(parts), rows), bool)
    each = np.stack([_extended(heights(p.qpos), rows) for p in parts])
    return np.asarray(each < contact_height)


def _counted_rows(windows: Windows) -> Array:
    """Return the rows that count, (windows, rows): after the start has settled, away from
    contacts.
    """
    rows = windows.touch.shape[1]
    settling = np.round(SETTLE_S / windows.periods).astype(int)  # rows, (windows,)
    near = []
    for touch, after in zip(windows.touch, settling, strict=True):
        near.append(np.convolve(touch, np.ones(after + 1))[:rows] > 0.5)
    row = np.arange(rows)
    has_settled = row > np.maximum(settling, 1)[:, None]
    is_recorded = row < windows.lengths[:, None]
    is_compared = row % _compared_rows(windows.periods, windows.thin)[:, None] == 0
    counted = has_settled & is_recorded & ~np.array(near) & is_compared
    return np.asarray(counted[:, :: windows.thin])


def balanced_values(windows: Windows) -> dict[str, Array]:
    """Return kp, total damping, dry friction, armature, offset and delay that balance the recorded
    accelerations, (n,) each; kp is 0 where it fails.

    The regression is linear but for the delay, biased by noise, and independent of any file's
    gains.
    """
    joints = [_balanced_joint(windows, j) for j in range(len(windows.qpos))]
    by_field = np.array([list(joint.values()) for joint in joints]).T
    return dict(zip(REGRESSED_FIELDS, by_field, strict=True))


def _balanced_joint(windows: Windows, j: int) -> dict[str, float]:
    """Return `balanced_values` of joint j: the fit with the delay that leaves the least residual.

    A least-squares fit of non-negative factors x to

        torque of the links = x0 (command − q) − x1 q̇ − x2 sign(q̇) − x3 q̈ + x4 − x5

    in which x4 − x5 is kp times the offset, of either sign.
    """
    row = np.concatenate([np.arange(length) for length in windows.lengths])
    window = np.repeat(np.arange(len(windows.lengths)), windows.lengths)
    q, v, a = _smooth_motion(windows, j)
    inertia, weight, pull, slope = windows.loads[:, j, window, row]
    torque = inertia * a + weight + slope * q + pull
    one = np.ones_like(q)
    best = dict.fromkeys(REGRESSED_FIELDS, 0.0)
    least = np.inf
    delay_step = max(windows.periods.max() / 2, 5e-3)
    for delay in np.arange(0.0, MAX_REGRESSION_DELAY_S, delay_step):
        error = _late_commands(windows, j, delay, window, row) - q
        columns = np.stack([error, -v, -np.tanh(v / SLIP_SPEED), -a, one, -one], axis=1)
        x, residual = _nonnegative_factors(columns, torque)
        if residual < least and x[0] > 0:
            least = residual
            offset = (x[4] - x[5]) / x[0]
            best = dict(zip(REGRESSED_FIELDS, (*x[:4], offset, delay), strict=True))
    return best


def _smooth_motion(windows: Windows, j: int) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of joint j in all rows of all windows, (rows,)
    each, SI.
    """
    positions = []
    velocities = []
    accelerations = []
    for window, (length, dt) in enumerate(zip(windows.lengths, windows.periods, strict=True)):
        recorded = windows.qpos[j, window, :length, None].astype(float)
        smooth = lowpass(recorded, dt, CUTOFF_HZ)[:, 0]
        speed = np.gradient(smooth, dt)
        positions.append(smooth)
        velocities.append(speed)
        accelerations.append(np.gradient(speed, dt))
    position = np.concatenate(positions)
    velocity = np.concatenate(velocities)
    acceleration = np.concatenate(accelerations)
    return position, velocity, acceleration


def _late_commands(windows: Windows, j: int, delay: float, window: Array, row: Array) -> Array:
    """Return the command of joint j that reaches its servo in rows of windows, (rows,) rad,
    interpolated between the commands before and after `delay`, s.
    """
    late = row - delay / windows.periods[window]
    whole = np.floor(late).astype(int)
    last = windows.lengths[window] - 1
    before = windows.ctrl[j, window, np.clip(whole, 0, last)]
    after = windows.ctrl[j, window, np.clip(whole + 1, 0, last)]
    return np.asarray(before + (late - whole) * (after - before))


def _nonnegative_factors(columns: Array, torque: Array) -> tuple[Array, float]:
    """Return the non-negative factors of columns (rows, 6) that balance a torque (rows,) N·m, and
    the residual; at most MAX_REGRESSION_ROWS rows count.
    """
    some = slice(None, None, max(1, len(torque) // MAX_REGRESSION_ROWS))
    size = np.sqrt(np.square(columns[some]).mean(axis=0)) + 1e-12
    x, residual = nnls(columns[some] / size, torque[some])
    return x / size, float(residual)
