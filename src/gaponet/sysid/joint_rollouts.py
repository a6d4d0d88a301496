"""Free runs of every joint on its own beside recordings, the others moving as recorded: many candidates at once.

A servo's parameters act on its own joint first; what they do to the others is a few milliradians of their path. So
inertia, gravity and the pull of the others are taken from the recording once, and a joint is one equation, stepped as
MuJoCo steps it (implicit damping, friction that stops within a step): a hundredth of the time of a simulator of the
whole robot, and its error by joint to a few per cent (tests/sysid/test_joint_rollouts.py).
"""

from __future__ import annotations

import copy
import os
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import nnls

from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim import servo
from gaponet.sim.batch import ramped
from gaponet.sim.model import build_model
from gaponet.sim.servo import friction_limit, present, servo_torque

try:
    jitable = import_module("numba.extending").register_jitable  # an extra, eight times as fast as numpy
    jitable(servo.passing_friction), jitable(servo.resting_friction)
    advance: Any = import_module("numba").njit(cache=True, nogil=True, error_model="numpy")(servo.advance)
except ImportError:
    advance = None

Array = np.ndarray

SOFT = 0.01  # rad: errors beyond count linearly, so that one blocked joint does not decide
THIN = 0.01  # s between rows that are compared
MOST, SLIPS, LATEST = 20_000, 0.02, 0.1  # of a regression: rows, rad/s at which friction is whole, s of delay
BEYOND = 7.0  # rad: the stops of a joint without any
KERNEL = (
    "kp",
    "damping",
    "frictionloss",
    "armature",
    "offset",
    "delay",
    "effort_limit",
    *SERVO_TERMS,
)  # order of its values
SETTLE = 0.1  # s: velocities at a window's start are measured ones
CUTOFF = 10.0  # Hz, of the other joints' accelerations: above the arms' bandwidth
TURN = 0.02  # rad: for the derivative of gravity's torque


class JointRollouts:
    """Windows of recordings, n operated joints; rows in which the robot may touch something are passed over."""

    def __init__(self, parts: list[Sequence], robot: RobotSpec, below: float = -np.inf, nthread: int = 0) -> None:
        """
        Args:
            parts: Windows, each at its own control period.
            robot: Stops, zeros, limits and inertias are its own.
            below: Height (m) under which a tip counts as touching.
            nthread: Threads of the compiled runs, 0 for all cores.
        """
        self.parts, self.robot, self.op = parts, robot, robot.operated_index
        self.nthread = nthread or os.cpu_count() or 1
        self.periods = np.array([p.dt for p in parts])  # (windows,) s
        self.dt = float(self.periods.max())
        self.count = robot.steps_per(self.dt)  # of every period, so that all windows step side by side
        self.thin = max(1, round(THIN / self.dt))
        rows = max(map(len, parts))
        made: dict[tuple[float, str], _Along] = {}
        for p in parts:
            key = (p.meta.payload_mass, p.meta.payload_side)
            if key not in made:
                made[key] = _Along(robot, build_model(robot, *key, self.dt, bare=True))
        thins = self._thins()
        along = [made[p.meta.payload_mass, p.meta.payload_side].follow(p, thins[i]) for i, p in enumerate(parts)]
        low, high = robot.qpos_range[self.op].T
        # (n, windows, rows) each, so that a run reads what lies side by side.
        stack = lambda xs: np.stack([_held(x, rows) for x in xs]).transpose(2, 0, 1).astype(np.float32)  # noqa: E731
        self.qpos = stack([p.qpos[:, self.op] for p in parts])
        self.ctrl = stack([np.clip(p.ctrl[:, self.op], low, high) for p in parts])
        if (speed := robot.target_speed[self.op]).any():
            most = np.where(speed > 0, speed, np.inf)[:, None]
            slow = ramped(np.moveaxis(self.ctrl, -1, 0), self.qpos[..., 0], most, self.periods)
            self.ctrl = np.ascontiguousarray(np.moveaxis(slow, 0, -1))
        self.qvel = stack([p.qvel[:, self.op] for p in parts])
        # In the middle of each period: inertia, gravity's torque at an angle of zero, the others' pull, its slope.
        middle = lambda x: 0.5 * (x + np.concatenate([x[..., 1:], x[..., -1:]], axis=-1))  # noqa: E731
        inertia, weight, pull, slope = (middle(stack([a[i] for a in along])) for i in range(4))
        self.tables = np.stack([inertia, weight - slope * middle(self.qpos), pull, slope])
        # A run that leaves what joints can do stops there, and none flies away.
        reached = self.qpos.min(axis=(1, 2)), self.qpos.max(axis=(1, 2))
        self.stops = np.stack([
            np.minimum(np.where(np.isfinite(low), low, -BEYOND), reached[0]),
            np.maximum(np.where(np.isfinite(high), high, BEYOND), reached[1]),
        ], axis=1).astype(np.float32)  # fmt: skip
        self.touch = np.stack([_held(a[4], rows) for a in along]) < below  # (windows, rows)
        self.lengths = np.array([len(p) for p in parts])
        # Joints of which a window holds nothing, (n, windows): their error says nothing.
        self.recorded = np.array([[j not in p.meta.unrecorded for p in parts] for j in robot.operated])
        self.counted = self._counted()
        # Gains while recording: kp as a multiple of the robot's own, kd in N·m·s/rad, (windows, n).
        set_to = [robot.with_gains(*p.meta.known_gains) for p in parts]
        self.stiffer = np.array([(r.kp / robot.kp)[self.op] for r in set_to])
        self.kd = np.array([r.kd[self.op] for r in set_to])

    def _thins(self) -> Array:
        """Rows of each window from one that is compared to the next, (windows,): multiples of `thin`."""
        return self.thin * np.maximum(1, np.round(THIN / self.periods / self.thin)).astype(int)

    def _counted(self) -> Array:
        """Rows that count, (windows, rows): after the start has settled, away from what may be touched."""
        rows, after = self.touch.shape[1], np.round(SETTLE / self.periods).astype(int)
        near = np.zeros_like(self.touch)
        for k in np.unique(after):
            touch = self.touch[after == k]
            near[after == k] = np.array([touch[:, max(0, t - k) : t + 1].any(axis=1) for t in range(rows)]).T
        time, thin = np.arange(rows), self._thins()[:, None]
        counted = (time > np.maximum(after, 1)[:, None]) & (time < self.lengths[:, None]) & ~near & (time % thin == 0)
        return np.asarray(counted[:, :: self.thin])

    @property
    def window(self) -> Array:
        """Window of each row of flattened errors, (windows · rows,)."""
        return np.repeat(np.arange(len(self.counted)), self.counted.shape[1])

    @property
    def rows(self) -> Array:
        """Rows that count, of each joint, (n,)."""
        return np.asarray((self.counted & self.recorded[..., None]).sum(axis=(1, 2)))

    def shortened(self, seconds: float) -> JointRollouts:
        """The same windows, put back on the recording every so many seconds: a smoother surface to descend on."""
        short = copy.copy(self)
        short.touch = self.touch.copy()
        for touch, period in zip(short.touch, self.periods, strict=True):
            touch[:: max(round(seconds / period), 1)] = True
        short.counted = short._counted()
        return short

    def regressed(self) -> dict[str, Array]:
        """kp, total damping, dry friction, armature, offset and delay with which the recorded accelerations balance
        best, (n,) each: linear but for the delay, biased by noise, and owing nothing to any file's gains."""
        n = len(self.op)
        found = {f: np.zeros(n) for f in ("kp", "damping", "frictionloss", "armature", "offset", "delay")}
        period = np.concatenate([np.arange(length) for length in self.lengths])
        window = np.repeat(np.arange(len(self.lengths)), self.lengths)
        part = slice(None, None, max(1, len(period) // MOST))
        for j in range(n):
            smooth = [lowpass(self.qpos[j, w, :k, None].astype(float), self.periods[w], CUTOFF)[:, 0]
                      for w, k in enumerate(self.lengths)]  # fmt: skip
            speed = [np.gradient(x, dt) for x, dt in zip(smooth, self.periods, strict=True)]
            q, v = np.concatenate(smooth), np.concatenate(speed)
            a = np.concatenate([np.gradient(x, dt) for x, dt in zip(speed, self.periods, strict=True)])
            inertia, weight, pull, slope = self.tables[:, j, window, period]
            asked = inertia * a + weight + slope * q + pull
            least = np.inf
            for delay in np.arange(0.0, LATEST, max(self.dt / 2, 5e-3)):
                rows = period - delay / self.periods[window]
                whole = np.floor(rows).astype(int)
                aim = [self.ctrl[j, window, np.clip(whole + i, 0, self.lengths[window] - 1)] for i in (0, 1)]
                error = aim[0] + (rows - whole) * (aim[1] - aim[0]) - q
                columns = np.stack([error, -v, -np.tanh(v / SLIPS), -a, np.ones_like(q), -np.ones_like(q)], axis=1)
                size = np.sqrt(np.square(columns[part]).mean(axis=0)) + 1e-12
                x, left = nnls(columns[part] / size, asked[part])
                x = x / size
                if left < least and x[0] > 0:
                    least = left
                    for f, value in zip(found, (*x[:4], (x[4] - x[5]) / x[0], delay), strict=True):
                        found[f][j] = value
        return found

    def errors(self, values: dict[str, Array]) -> Array:
        """q_sim − q_real of parameters (k, n) each, (k, n, windows, rows) rad; zero where rows do not count.

        Args:
            values: kp at the robot's own gains, damping, frictionloss, armature, offset, delay, and any of
                effort_limit and SERVO_TERMS. A damping below zero takes from the servo's own kd.
        """
        out = _compiled(self, values) if advance is not None else self._arrays(values)
        return np.asarray(out * (self.counted & self.recorded[..., None]))

    def _arrays(self, values: dict[str, Array]) -> Array:
        """The runs in numpy: every array has the shape of the state and its precision, since broadcasting costs more
        than the sums."""
        k = len(values["kp"])
        shape = (k, *self.qpos.shape[:2])
        v = {name: _filled(x[:, :, None], shape) for name, x in values.items()}
        law = present({name: v[name] for name in SERVO_TERMS if name in v})
        kp, kd = v["kp"] * _filled(self.stiffer.T, shape), _filled(self.kd.T, shape)
        kd = np.maximum(kd + np.minimum(v["damping"], 0), 0)
        own, mass, offset, dry = np.maximum(v["damping"], 0), v["armature"], v["offset"], v["frictionloss"]
        damping, limit = own + kd, v.get("effort_limit", _filled(self.robot.effort_limit[self.op][:, None], shape))
        h = _filled(self.periods / self.count, shape)
        low, high = (_filled(x[:, None], shape) for x in self.stops.T)
        driven = bool(kd.any())
        q, w = _filled(self.qpos[..., 0], shape), _filled(self.qvel[..., 0], shape)
        out = np.zeros((*shape, self.counted.shape[1]), np.float32)
        for t in range(self.qpos.shape[2] - 1):
            inertia, weight, pull, slope = self.tables[..., t]
            heavy, slope = inertia + mass, _filled(slope, shape)
            turn, stop = h / (heavy + h * damping), heavy / -h
            aims = self._targets(t, values["delay"]) + offset
            for aim in aims:
                torque = servo_torque(law, kp, aim, q)
                torque = np.minimum(np.maximum(torque - kd * w if driven else torque, -limit), limit)
                load = slope * q + weight
                most = friction_limit(law, dry, w, torque, load)
                net = torque - load - pull - own * w
                w = w + turn * (net + np.minimum(np.maximum(stop * w - net, -most), most))
                q = q + h * w
                w = np.where(q < low, np.maximum(w, 0), np.where(q > high, np.minimum(w, 0), w))
                q = np.minimum(np.maximum(q, low), high)
            touch = self.touch[:, t + 1]
            if touch.any():  # goes on from the recording
                q[..., touch], w[..., touch] = self.qpos[:, touch, t + 1], self.qvel[:, touch, t + 1]
            if (t + 1) % self.thin == 0:
                out[..., (t + 1) // self.thin] = q - self.qpos[..., t + 1]
        return out

    def _targets(self, t: int, delay: Array) -> Array:
        """The commands in force in the physics steps of a period, (count, k, n, windows); a part of each where they
        change on the way."""
        at = np.arange(self.count)[:, None, None, None] / self.count - delay[..., None] / self.periods  # rows from t
        row = np.floor(at).astype(int)
        share = np.maximum((at - row - 1) * self.count + 1, 0).astype(np.float32)
        last, joint = self.lengths - 1, np.arange(len(self.op))[:, None]
        window = np.arange(len(self.lengths))
        first, then = (self.ctrl[joint, window, np.clip(t + row + more, 0, last)] for more in (0, 1))
        return np.asarray((1 - share) * first + share * then)


class _Along:
    """Inertia, load and tip height along recordings with one payload."""

    def __init__(self, robot: RobotSpec, model: mujoco.MjModel) -> None:
        self.op, self.model, self.data = robot.operated_index, model, mujoco.MjData(model)
        self.tips = [(model.body(tip.body).id, np.array(tip.pos), tip.radius) for tip in robot.tips]
        # Forces at a posture, without what a servo does and what a table does.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT

    def follow(self, part: Sequence, thin: int = 1) -> tuple[Array, ...]:
        """Inertia of each operated joint without armature, kg·m², the torques that gravity and Coriolis forces and that
        the other joints' accelerations ask of it, N·m, the slope of the former over the joint's angle, N·m/rad, (rows,
        n) each; lowest tip, (rows,) m. Every `thin` rows, and between them on a line."""
        model, data, op = self.model, self.data, self.op
        smooth = lowpass(part.qpos.astype(float), part.dt, CUTOFF)
        qvel = differentiate(smooth, part.dt)
        qacc = differentiate(qvel, part.dt)
        at = np.arange(0, len(part) + thin, thin).clip(max=len(part) - 1)
        inertia, weight, pull, slope = (np.empty((len(at), len(op))) for _ in range(4))
        tip, full = np.full(len(at), np.inf), np.empty((model.nv, model.nv))
        for i, t in enumerate(at):
            here = self._bias(part.qpos[t], qvel[t])
            mujoco.mj_fullM(model, data, full)
            own = full.diagonal().copy()
            inertia[i] = (own - model.dof_armature)[op]
            weight[i], pull[i] = here[op], (full @ qacc[t] - own * qacc[t])[op]
            for body, place, radius in self.tips:
                z = data.xpos[body, 2] + data.xmat[body].reshape(3, 3)[2] @ place - radius
                tip[i] = min(tip[i], z)
            if i % SPARSE == 0:
                for k, j in enumerate(op):
                    turned = part.qpos[t].astype(float)
                    turned[j] += TURN
                    slope[i : i + SPARSE, k] = (self._bias(turned, qvel[t])[j] - here[j]) / TURN
        rows = np.arange(len(part))
        between = lambda x: np.stack([np.interp(rows, at, y) for y in x.T], axis=1)  # noqa: E731
        tables = [x if thin == 1 else between(x) for x in (inertia, weight, pull, slope, tip[:, None])]
        return (*(x[: len(part)] for x in tables[:4]), tables[4][: len(part), 0])

    def _bias(self, qpos: Array, qvel: Array) -> Array:
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        return self.data.qfrc_bias.copy()


def _compiled(runs: JointRollouts, values: dict[str, Array]) -> Array:
    """The runs of candidates, shared by threads."""
    k, (n, windows) = len(values["kp"]), runs.qpos.shape[:2]
    own = {"effort_limit": runs.robot.effort_limit[runs.op]}
    packed = np.stack([np.broadcast_to(values.get(f, own.get(f, 0.0)), (k, n)) for f in KERNEL], axis=-1)
    law = any(values[f].any() for f in SERVO_TERMS if f in values)
    out = np.zeros((k, n * windows, runs.counted.shape[1]), np.float32)
    cuts = np.linspace(0, n * windows, runs.nthread + 1).astype(int)
    rest = (packed, law, runs.tables, runs.ctrl, runs.qpos, runs.qvel, runs.touch, runs.lengths, runs.stiffer, runs.kd,
            runs.stops, runs.periods, runs.count, runs.thin, out)  # fmt: skip
    with ThreadPoolExecutor(runs.nthread) as pool:
        list(pool.map(lambda a, b: advance(a, b, *rest), cuts[:-1].tolist(), cuts[1:].tolist()))
    return out.reshape(k, n, windows, -1)


def _filled(x: Array, shape: tuple[int, ...]) -> Array:
    return np.array(np.broadcast_to(x, shape), np.float32)


SPARSE = 5  # rows that share the slope of gravity's torque


def _held(x: Array, rows: int) -> Array:
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
