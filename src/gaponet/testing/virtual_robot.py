"""VirtualRobot: N virtual robots, each with its unit's hidden physics and a payload, stepped together.

It is used like a robot: send targets for one control period, then read encoders, current sensors and thermometers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, expand_differences
from gaponet.sim.model import build_model, qpos_range, stiffen_friction
from gaponet.testing.motor import (
    Backlash,
    Bristles,
    CommandLink,
    Couplings,
    Firmware,
    Thermal,
    cogging_torque,
    derated,
    friction_limit,
    supply_share,
    torque_share,
)
from gaponet.testing.physics import Physics, stack

Array = np.ndarray

PHYSICS_STEP = 0.001  # s, at most
LAW_PERIOD = 0.002  # s, at most: how often the hidden laws are evaluated; bristles and currents at every step
NOISE_ROWS = 50  # control periods of noise drawn at a time
HOT = 80.0  # °C: winding temperature from which a unit reports it


@dataclass(frozen=True)
class UnitEvent:
    """Something that a unit reports beside its readings: kind is packet_lost, torque_limit or hot."""

    time: float  # s since reset
    kind: str
    joint: str = ""


@dataclass(frozen=True)
class Reading:
    """What the sensors report now, all (N, n): rad, rad/s, N·m (current × rated torque constant), °C (winding)."""

    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array


class VirtualRobot:
    """N robots of one type. Rows are independent: a row's result does not depend on the others, bit for bit."""

    def __init__(
        self,
        robot: RobotSpec,
        units: list[Physics],
        payloads: list[tuple[float, str]],
        dt: float | None = None,
        timestep: float | None = None,
        locked: tuple[str, ...] = (),
        nthread: int = 1,
    ) -> None:
        """
        Args:
            robot: The type; its nominal model is what the hidden physics is added to.
            units: Hidden parameters of each row.
            payloads: Mass (kg, per hand) and side of each row.
            dt: Control period, s; default the robot's.
            timestep: Physics step, s; default the largest one up to 1 ms that divides dt.
            locked: Joints clamped at home (sim.model.idle_joints).
            nthread: Threads; 0 for all cores.
        """
        self.robot = robot
        self.dt = robot.dt if dt is None else dt
        self.decimation = int(np.ceil(self.dt / PHYSICS_STEP - 1e-9)) if timestep is None else round(self.dt / timestep)
        self.timestep = self.dt / self.decimation
        self.active = np.array([i for i, name in enumerate(robot.joint_names) if name not in locked])
        self.physics = stack(units, self.active)
        stiff = bool((self.physics.presliding > 0).any() or (self.physics.current_time > 0).any())
        self.substeps = 1 if stiff else _substeps(self.decimation, self.timestep)
        self.everywhere = stack(units, np.arange(len(robot.joint_names)))
        models = _models(robot, units, payloads, self.dt, self.timestep, locked)
        self.batch = Batch(models[0], nsim=len(units), nthread=nthread)
        expand_differences(self.batch, models)
        self.num_envs, self.n = len(units), len(robot.joint_names)
        self._bind(models[0])

    def _bind(self, model: mujoco.MjModel) -> None:
        b, robot, p = self.batch, self.robot, self.physics
        self._qpos, self._qvel, self._ctrl = b.bind("qpos"), b.bind("qvel"), b.bind("ctrl")
        self._warmstart, self._time = b.bind("qacc_warmstart"), b.bind("time")
        self._constraint = b.bind("qfrc_constraint")
        self._gain, self._bias = b.expand("actuator_gainprm"), b.expand("actuator_biasprm")
        self._range, self._frictionloss = b.expand("actuator_forcerange"), b.expand("dof_frictionloss")
        self._applied, self._force = b.bind("qfrc_applied"), b.bind("actuator_force")
        self._cogs, self._fast = bool((p.cogging != 0).any()), bool(np.isfinite(p.no_load_speed).any())
        self._thins, self._lags = bool((p.thinning != 0).any()), bool((p.current_time > 0).any())
        self._churns = bool((p.churning > 0).any())
        self._damping = b.expand("dof_damping")
        self._cold_damping, self._thinned = self._damping.copy(), np.ones((1, 1))
        self._nominal_friction = model.dof_frictionloss.copy()
        self._kp = robot.kp[self.active] * p.kp_scale
        self._kd = robot.kd[self.active] * p.kd_scale
        self._added = np.zeros_like(self._kp)
        self._effort = robot.effort_limit[self.active]
        self._compliance, self._twists = p.windup / self._effort, bool((p.windup > 0).any())  # rad per N·m
        self._limits = qpos_range(model)
        self.backlash = Backlash(p, model.dof_armature)
        self.bristles = Bristles(p, self._nominal_friction)
        self.thermal = Thermal(p)
        self.link, self.firmware = CommandLink(p, self.dt), Firmware(p)
        self.couplings = Couplings(p, model, b, self._effort)
        self._supply = np.ones((self.num_envs, 1))

    def reset(self, ctrl: Array, seeds: list[int], warmth: Array | float = 0.0, start: Array | None = None) -> None:
        """Stand still under a command, as a robot does before a recording starts.

        Args:
            ctrl: Targets, (N, n) rad.
            seeds: Seeds of each row's noise and jitter, and of where in its friction band it came to rest.
            warmth: Motor temperature above ambient, (N,) K.
            start: True joint positions to start from instead of the rest position, (N, n) rad.
        """
        self._rng = [np.random.default_rng(seed) for seed in seeds]
        self._row, self._now = NOISE_ROWS, 0.0
        target = np.clip(np.asarray(ctrl, float)[:, self.active], *self._limits.T) - self.physics.zero_offset
        warm = 25.0 + np.broadcast_to(np.asarray(warmth, float), (self.num_envs,))[:, None]
        self.thermal.reset(np.repeat(warm, len(self.active), axis=1))
        self._idle_temperature = np.repeat(warm, self.n, axis=1)
        self.link.reset(target)
        self.firmware.reset(target)
        self._supply[:], self._limb_share = 1.0, np.ones_like(target)
        self._time[:], self._qvel[:], self._warmstart[:] = 0.0, 0.0, 0.0
        self._ctrl[:] = target
        if start is None:
            self._settle(target)
        else:
            self._qpos[:] = np.asarray(start)[:, self.active]
        load = self._load()
        self._limb_share = self.couplings.share(load)
        self._twist = self._compliance * load
        self._ctrl[:] -= self._twist
        self._push, self._passed = np.zeros_like(target), self._motor_torque() * self.thermal.kt()
        self.bristles.reset(self._passed - load, self._friction_limit(self._passed))
        self.backlash.reset(self._motor_torque())
        self._squares = np.zeros_like(target)
        self.events: list[list[UnitEvent]] = [[] for _ in seeds]
        self._reported = np.zeros((2, *target.shape), bool)

    def set_gains(self, kp: Array, kd: Array, effort: Array | None = None, torque: Array | float = 0.0) -> None:
        """Gains told to the drives instead of the robot's, (n) or (N, n); they deliver their share of them.

        Zero stiffness damps: only the velocity feedback is left. Set after reset, which settles by those it finds.

        Args:
            kp, kd: N·m/rad, N·m·s/rad.
            effort: Torque limits, (n) N·m; those in force stay where it is not given.
            torque: Added to what they ask for, N·m.
        """
        p, at = self.physics, self.active
        self._kp = np.broadcast_to(np.asarray(kp, float)[..., at] * p.kp_scale, self._kp.shape)
        self._kd = np.broadcast_to(np.asarray(kd, float)[..., at] * p.kd_scale, self._kd.shape)
        if effort is not None:
            self._effort = np.asarray(effort, float)[at]
        self._added = np.broadcast_to(np.broadcast_to(torque, self.n)[..., at], self._kd.shape)

    def _settle(self, target: Array) -> None:
        """Where PD and gravity balance, and a little off it: friction keeps a joint where it happened to stop."""
        whole = self._kp * self.thermal.kt() * derated(self.physics, self.thermal.winding)
        self._qpos[:] = target
        for _ in range(40):  # contracts by gravity stiffness / kp, 0.4 at worst on H1-2
            load = self._load()
            self.couplings.reset()
            stiffness = whole * self.couplings.share(load)
            self._qpos[:] = target - load * (1.0 / stiffness + self._compliance)
            np.clip(self._qpos, *self._limits.T, out=self._qpos)
        rest = np.stack([rng.standard_normal(self.n) for rng in self._rng])[:, self.active]
        band = (self._nominal_friction + self.physics.friction) / stiffness
        self._qpos += REST_SPREAD * band * np.clip(rest, -3, 3)

    def _load(self) -> Array:
        """What gravity and cables take from a joint at rest, (N, active), N·m."""
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        return self.batch.bind("qfrc_bias") - self.batch.bind("qfrc_passive")

    def _friction_limit(self, torque: Array) -> Array:
        """What friction can take now, under a motor torque at the joint, (N, active), N·m."""
        dry = self._nominal_friction + (self.couplings.drag(self._qpos) if self.couplings.drags else 0.0)
        return friction_limit(self.physics, dry, self._qvel, torque, self._push, self._thinned)

    def _motor_torque(self) -> Array:
        """What the drive asks of the motor at the rated torque constant, (N, active), N·m."""
        torque = self._kp * (self._ctrl - self._qpos) - self._kd * self._qvel + self._added
        return np.clip(torque * self._gain_share(), -self._effort, self._effort)

    def _gain_share(self) -> Array:
        share = 1.0 + self.physics.supply_gain * (self._supply - 1.0)
        return share * derated(self.physics, self.thermal.winding) * self._limb_share

    def step(self, ctrl: Array, rows: Array | None = None) -> None:
        """Send targets (N, n) rad and let one control period pass; for `rows` (k,) only, where given."""
        if self._row == NOISE_ROWS:
            self._draw()
        target = np.clip(np.asarray(ctrl, float)[:, self.active], *self._limits.T) - self.physics.zero_offset
        self.link.send(target, self._now, self._chance[:, self._row])
        count = self.decimation // self.substeps
        period = self.substeps * self.timestep
        self._squares[:] = 0.0
        kt = self.thermal.kt()
        share = kt * self._gain_share()
        self._most = self._effort * kt * np.minimum(self._supply, 1.0)
        self._range[:, :, 1], self._range[:, :, 0] = self._most, -self._most
        if self._thins:
            self._thinned = self.thermal.thinned()
            self._damping[:] = self._cold_damping * self._thinned
        kp, kd, added = self._kp * share, self._kd * share, self._added * share
        for k in range(count):
            target = self.link.read(self._now + k * period)
            if self.firmware.any:
                target = self.firmware.step(target, period)
            if self.couplings.flexes:
                self.couplings.flex(period)
            self._ctrl[:] = target - self._twist
            self._laws(kp, kd, added, kt, period)
            self.batch.step(rows, nstep=self.substeps)
            self._push = -self._constraint
            if self.bristles.any:
                self._push = np.where(self.bristles.soft, self.bristles.torque, self._push)
            if self._lags or self._twists:
                self._passed = self._force.copy()
                self._twist = self._compliance * (self._passed - self._push)
        self._slow_laws(count)
        self._report(range(self.num_envs) if rows is None else rows.tolist())
        self._now += self.dt
        self._row += 1

    def _laws(self, kp: Array, kd: Array, added: Array, kt: Array, period: float) -> None:
        torque = self._motor_torque()
        self._squares += torque * torque
        joint_torque = torque * kt
        if self._lags:
            lag = np.exp(-period / np.maximum(self.physics.current_time, 1e-9))
            kp, kd, added = kp * (1.0 - lag), kd * (1.0 - lag), added * (1.0 - lag) + lag * self._passed
        if self.backlash.any:
            engaged = self.backlash.step(joint_torque, period)
            kp, kd, added = kp * engaged, kd * engaged, added * engaged
        self._gain[:, :, 0] = kp
        self._bias[:, :, 0] = added
        self._bias[:, :, 1] = -kp
        self._bias[:, :, 2] = -kd
        if self._fast:
            self._range[:, :, 1] = self._most * torque_share(self.physics, self._qvel)
            self._range[:, :, 0] = -self._most * torque_share(self.physics, -self._qvel)
        self._friction(joint_torque, period)

    def _friction(self, joint_torque: Array, period: float) -> None:
        limit = self._friction_limit(joint_torque)
        ripple = cogging_torque(self.physics, self._qpos) if self._cogs else 0.0
        if self._churns:
            ripple = ripple - self.physics.churning * self._qvel * np.abs(self._qvel)
        if self.bristles.any:
            self._applied[:] = ripple - self.bristles.step(limit, self._qvel, period)
            self._frictionloss[:] = np.where(self.bristles.soft, 0.0, limit)
            return
        self._frictionloss[:] = limit
        if self._cogs or self._churns:
            self._applied[:] = ripple

    def _slow_laws(self, count: int) -> None:
        squares = self._squares / count
        self.thermal.step(squares, self.dt)
        work = np.maximum(self._motor_torque() * self._qvel, 0.0)
        if self.couplings.limits:
            self._limb_share = self.couplings.share(self._motor_torque())
        self._supply = supply_share(self.physics, (self.thermal.heat(squares) + work).sum(axis=1, keepdims=True))

    def _report(self, rows: Iterable[int]) -> None:
        """Note lost packets, and when a joint reaches its torque limit or gets hot; again only after it has left it."""
        lost = self._chance[:, self._row, 1] < self.physics.drop[:, 0]
        now = np.stack([np.abs(self._motor_torque()) >= self._effort, self.thermal.winding > HOT])
        begun, self._reported = now & ~self._reported, now
        if not (lost.any() or begun.any()):
            return
        for i in rows:
            if lost[i]:
                self.events[i].append(UnitEvent(round(self._now, 4), "packet_lost"))
            for kind, column in zip(*np.nonzero(begun[:, i]), strict=True):
                joint = self.robot.joint_names[self.active[column]]
                self.events[i].append(UnitEvent(round(self._now, 4), ("torque_limit", "hot")[kind], joint))

    def _draw(self) -> None:
        noise = np.stack([rng.standard_normal((NOISE_ROWS, 3, self.n)) for rng in self._rng])
        self._noise = noise  # (N, rows, 3, n)
        self._chance = np.stack([rng.random((NOISE_ROWS, 2)) for rng in self._rng])
        self._row = 0

    def read(self) -> Reading:
        """What sensors say at this moment; reading twice within a period gives the same noise."""
        if self._row == NOISE_ROWS:
            self._draw()
        p, noise = self.everywhere, self._noise[:, self._row]
        true = self._full(self._qpos + self._twist, self.robot.qpos_home)  # the encoder sits on the motor's side
        qpos = true + p.zero_offset + p.encoder_noise * noise[:, 0]
        step = np.where(p.encoder_step > 0, p.encoder_step, 1.0)
        qpos = np.where(p.encoder_step > 0, np.round(qpos / step) * step, qpos)
        qvel = self._full(self._qvel, 0.0) + p.velocity_noise * noise[:, 1]
        tau = self._full(self._motor_torque(), 0.0) + p.current_offset + p.current_noise * noise[:, 2]
        temperature = self._idle_temperature.copy()
        temperature[:, self.active] = self.thermal.winding
        return Reading(qpos, qvel, tau, temperature)

    def true_qpos(self) -> Array:
        """Joint positions as no sensor sees them, (N, n) rad: for tests and for the hand's true place."""
        return self._full(self._qpos, self.robot.qpos_home)

    def _full(self, values: Array, rest: Array | float) -> Array:
        out = np.empty((self.num_envs, self.n))
        out[:] = rest
        out[:, self.active] = values
        return out


REST_SPREAD = 0.1  # of the friction band (σ): a robot that always arrives the same way stops in nearly the same place


def _substeps(decimation: int, timestep: float) -> int:
    """Most physics steps that laws may hold for, of those that divide a control period."""
    most = max(1, int(LAW_PERIOD / timestep + 1e-6))
    return next(k for k in range(min(most, decimation), 0, -1) if decimation % k == 0)


def _models(
    robot: RobotSpec,
    units: list[Physics],
    payloads: list[tuple[float, str]],
    dt: float,
    timestep: float,
    locked: tuple[str, ...],
) -> list[mujoco.MjModel]:
    """One model per row, the same object for rows that share unit and payload."""
    made: dict[tuple[int, float, str], mujoco.MjModel] = {}
    for unit, (mass, side) in zip(units, payloads, strict=True):
        key = (id(unit), mass, side)
        if key not in made:
            model = build_model(robot, mass, side, dt, locked, bare=True)
            model.opt.timestep = timestep
            _edit(model, robot, unit, locked)
            made[key] = model
    return [made[id(u), m, s] for u, (m, s) in zip(units, payloads, strict=True)]


def _edit(model: mujoco.MjModel, robot: RobotSpec, unit: Physics, locked: tuple[str, ...]) -> None:
    """Write into a model what MuJoCo itself can play: damping, cable springs, link masses and centres."""
    for i, name in enumerate(robot.joint_names):
        if name in locked:
            continue
        joint = model.joint(name)
        dof, body = int(joint.dofadr[0]), int(joint.bodyid[0])
        model.dof_damping[dof] += unit.damping[i]
        model.jnt_stiffness[joint.id] += unit.cable_stiffness[i]
        model.qpos_spring[joint.qposadr[0]] += unit.cable_angle[i]
        model.body_mass[body] *= unit.mass_scale[i]
        model.body_inertia[body] *= unit.mass_scale[i]
        model.body_ipos[body] += (unit.com_x[i], unit.com_y[i], unit.com_z[i])
    for mount in robot.payload_mounts:
        model.body(f"payload_{mount.side}").pos += (unit.grip_x[0], 0.0, unit.grip_z[0])
    roll, pitch = float(unit.tilt_roll[0]), float(unit.tilt_pitch[0])
    g = np.linalg.norm(model.opt.gravity)
    if roll or pitch:  # what a level world looks like from a base that leans
        model.opt.gravity = g * np.array([np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    stiffen_friction(model)
