"""Free runs of every joint on its own beside recordings, the others moving as recorded: many candidates at once.

A servo's parameters act on its own joint first; what they do to the others is a few milliradians of their path. So
inertia, gravity and the pull of the others are taken from the recording once, and a joint is one equation, stepped as
MuJoCo steps it (implicit damping, friction that stops within a step): a hundredth of the time of a simulator of the
whole robot, and its error by joint to a few per cent (tests/sim/test_joint_runs.py).
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.signals import differentiate, lowpass
from gaponet.robot import LAW, RobotSpec
from gaponet.sim.model import build_model
from gaponet.sim.servo import friction_limit, present, servo_torque

Array = np.ndarray

SOFT = 0.01  # rad: errors beyond count linearly, so that one blocked joint does not decide
SETTLE = 0.1  # s: velocities at a window's start are measured ones
CUTOFF = 10.0  # Hz, of the other joints' accelerations: above the arms' bandwidth
TURN = 0.02  # rad: for the derivative of gravity's torque


class JointRuns:
    """Windows of recordings, n operated joints; rows in which the robot may touch something are passed over."""

    def __init__(self, parts: list[Sequence], robot: RobotSpec, below: float = -np.inf) -> None:
        """
        Args:
            parts: Windows at one control period.
            robot: Stops, zeros, limits and inertias are its own.
            below: Height (m) under which a tip counts as touching.
        """
        self.robot, self.op = robot, robot.operated_index
        self.dt = float(np.median([p.dt for p in parts]))
        self.count = robot.steps_per(self.dt)
        rows = max(map(len, parts))
        made: dict[tuple[float, str], Along] = {}
        for p in parts:
            key = (p.meta.payload_mass, p.meta.payload_side)
            if key not in made:
                made[key] = Along(robot, build_model(robot, *key, self.dt, bare=True))
        along = [made[p.meta.payload_mass, p.meta.payload_side].follow(p) for p in parts]
        low, high = robot.qpos_range[self.op].T
        stack = lambda xs: np.stack([_held(x, rows) for x in xs], axis=1)  # noqa: E731
        self.ctrl = stack([np.clip(p.ctrl[:, self.op], low, high) for p in parts])
        self.qpos = stack([p.qpos[:, self.op].astype(float) for p in parts])
        self.qvel = stack([p.qvel[:, self.op].astype(float) for p in parts])
        # In the middle of each period.
        middle = lambda x: 0.5 * (x + np.concatenate([x[1:], x[-1:]]))  # noqa: E731
        self.inertia, self.weight, self.pull, self.slope = (middle(stack([a[i] for a in along])) for i in range(4))
        self.at = middle(self.qpos)
        self.touch = stack([a[4] for a in along]) < below  # (rows, windows)
        self.lengths = np.array([len(p) for p in parts])
        self.counted = self._counted()
        # Gains while recording: kp as a multiple of the robot's own, kd in N·m·s/rad, (windows, n).
        set_to = [robot.with_gains(*p.meta.known_gains) for p in parts]
        self.stiffer = np.array([(r.kp / robot.kp)[self.op] for r in set_to])
        self.kd = np.array([r.kd[self.op] for r in set_to])

    def _counted(self) -> Array:
        """Rows that count, (rows, windows): after the start has settled, away from what may be touched."""
        rows, after = len(self.touch), round(SETTLE / self.dt)
        near = np.array([self.touch[max(0, t - after) : t + 1].any(axis=0) for t in range(rows)])
        time = np.arange(rows)[:, None]
        return np.asarray((time > max(after, 1)) & (time < self.lengths) & ~near)

    def shortened(self, seconds: float) -> JointRuns:
        """The same windows, put back on the recording every so many seconds: a smoother surface to descend on."""
        short = copy.copy(self)
        short.touch = self.touch.copy()
        short.touch[:: max(round(seconds / self.dt), 1)] = True
        short.counted = short._counted()
        return short

    def errors(self, values: dict[str, Array]) -> Array:
        """q_sim − q_real of parameters (k, n) each, (rows, k, windows, n) rad; zero where rows do not count.

        Args:
            values: kp at the robot's own gains, damping, frictionloss, armature, offset, delay, and
                any of effort_limit and LAW.
        """
        k = len(values["kp"])
        shape = (k, *self.qpos.shape[1:])
        # Every array has the shape of the state and its precision: broadcasting costs more than the sums.
        v = {name: _filled(x[:, None], shape) for name, x in values.items()}
        law = present({name: v[name] for name in LAW if name in v})
        kp, kd = v["kp"] * _filled(self.stiffer, shape), _filled(self.kd, shape)
        own, mass, offset, dry = v["damping"], v["armature"], v["offset"], v["frictionloss"]
        damping, limit = own + kd, v.get("effort_limit", _filled(self.robot.effort_limit[self.op], shape))
        h = np.float32(self.dt / self.count)
        given = [x.astype(np.float32) for x in (self.inertia, self.weight, self.pull, self.slope, self.at)]
        driven, late = bool(self.kd.any()), bool(values["delay"].any())
        q, w = _filled(self.qpos[0], shape), _filled(self.qvel[0], shape)
        out = np.zeros((len(self.ctrl), *shape), np.float32)
        for t in range(len(out) - 1):
            inertia, weight, pull, slope, at = (x[t] for x in given)
            heavy = inertia + mass
            turn, stop = h / (heavy + h * damping), heavy / -h
            weight, slope = weight - slope * at, _filled(slope, shape)
            for part in range(self.count):
                aim = (self._target(t, part, values["delay"]) if late else self.ctrl[t]).astype(np.float32)
                torque = servo_torque(law, kp, aim + offset, q)
                torque = np.minimum(np.maximum(torque - kd * w if driven else torque, -limit), limit)
                load = slope * q + weight
                most = friction_limit(law, dry, w, torque, load)
                net = torque - load - pull - own * w
                w = w + turn * (net + np.minimum(np.maximum(stop * w - net, -most), most))
                q = q + h * w
            touch = self.touch[t + 1]
            if touch.any():  # goes on from the recording
                q[:, touch], w[:, touch] = self.qpos[t + 1, touch], self.qvel[t + 1, touch]
            out[t + 1] = q - self.qpos[t + 1]
        return out * self.counted[:, None, :, None]

    def _target(self, t: int, part: int, delay: Array) -> Array:
        """The command in force in a physics step, (k or 1, windows, n); a part of it where it changes on the way."""
        at = part / self.count - delay / self.dt  # rows from t
        row = np.floor(at)
        late = np.clip((at - row - 1) * self.count + 1, 0, 1)
        out = np.zeros((len(delay), *self.ctrl[t].shape))
        for r in range(int(row.min()), int(row.max()) + 2):
            share = np.where(row == r, 1 - late, 0.0) + np.where(row + 1 == r, late, 0.0)
            if share.any():
                out += share[:, None] * self.ctrl[min(max(t + r, 0), len(self.ctrl) - 1)]
        return out


class Along:
    """Inertia, load and tip height along recordings with one payload."""

    def __init__(self, robot: RobotSpec, model: mujoco.MjModel) -> None:
        self.op, self.model, self.data = robot.operated_index, model, mujoco.MjData(model)
        self.tips = [(model.body(tip.body).id, np.array(tip.pos), tip.radius) for tip in robot.tips]
        # Forces at a posture, without what a servo does and what a table does.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT

    def follow(self, part: Sequence) -> tuple[Array, ...]:
        """Inertia of each operated joint without armature, kg·m², the torques that gravity and Coriolis forces and that
        the other joints' accelerations ask of it, N·m, the slope of the former over the joint's angle, N·m/rad, (rows,
        n) each; lowest tip, (rows,) m."""
        model, data, op = self.model, self.data, self.op
        smooth = lowpass(part.qpos.astype(float), part.dt, CUTOFF)
        qvel = differentiate(smooth, part.dt)
        qacc = differentiate(qvel, part.dt)
        inertia, weight, pull, slope = (np.empty((len(part), len(op))) for _ in range(4))
        tip, full = np.full(len(part), np.inf), np.empty((model.nv, model.nv))
        for t in range(len(part)):
            here = self._bias(part.qpos[t], qvel[t])
            mujoco.mj_fullM(model, data, full)
            own = full.diagonal().copy()
            inertia[t] = (own - model.dof_armature)[op]
            weight[t], pull[t] = here[op], (full @ qacc[t] - own * qacc[t])[op]
            for body, place, radius in self.tips:
                z = data.xpos[body, 2] + data.xmat[body].reshape(3, 3)[2] @ place - radius
                tip[t] = min(tip[t], z)
            if t % SPARSE == 0:
                for k, j in enumerate(op):
                    turned = part.qpos[t].astype(float)
                    turned[j] += TURN
                    slope[t : t + SPARSE, k] = (self._bias(turned, qvel[t])[j] - here[j]) / TURN
        return inertia, weight, pull, slope, tip

    def _bias(self, qpos: Array, qvel: Array) -> Array:
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        return self.data.qfrc_bias.copy()


def _filled(x: Array, shape: tuple[int, ...]) -> Array:
    return np.array(np.broadcast_to(x, shape), np.float32)


SPARSE = 5  # rows that share the slope of gravity's torque


def _held(x: Array, rows: int) -> Array:
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
