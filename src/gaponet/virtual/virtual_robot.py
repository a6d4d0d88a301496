"""VirtualRobot: N virtual robots, each with hidden physics and a payload, stepped together.

It is used like a robot: send targets for one control period, then read encoders, current sensors and thermometers.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, expand_differences
from gaponet.sim.model import build_model, qpos_range, stiffen_friction
from gaponet.virtual import motor
from gaponet.virtual.physics import Physics, stack

MAX_PHYSICS_STEP_S = 0.001
# of the hidden effects; bristles and current loops are evaluated at every physics step
MAX_EFFECT_PERIOD_S = 0.002
NOISE_PERIODS = 50  # control periods of noise that are sampled at a time
REST_STD = 0.1  # of the friction band: a joint that always arrives in the same way stops in nearly the same place
SETTLING_STEPS = 40  # each reduces the error by gravity stiffness / kp, 0.4 at worst on H1-2


@dataclass(frozen=True)
class Reading:
    """Readings of the sensors, (N, n) each: rad, rad/s, N·m (current × rated torque constant), °C (winding)."""

    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array


class VirtualRobot:
    """N robots of one type. A row's result does not depend on the other rows, bit for bit."""

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
            robot: Type of the robots; the hidden physics is added to its nominal model.
            units: Hidden parameters of each row.
            payloads: Mass (kg, per hand) and side of each row.
            dt: Control period, s; default the robot's.
            timestep: Physics step, s; default the largest one up to 1 ms that divides dt.
            locked: Joints clamped at home (sim.model.idle_joints).
            nthread: Threads; 0 for all cores.
        """
        self.robot = robot
        self.dt = robot.dt if dt is None else dt
        self.decimation = (
            int(np.ceil(self.dt / MAX_PHYSICS_STEP_S - 1e-9))
            if timestep is None
            else round(self.dt / timestep)
        )
        self.timestep = self.dt / self.decimation
        self.active = np.array(
            [i for i, name in enumerate(robot.joint_names) if name not in locked]
        )
        self.physics = stack(units, self.active)
        stiff = bool((self.physics.presliding > 0).any() or (self.physics.current_time > 0).any())
        self.substeps = 1 if stiff else _substeps(self.decimation, self.timestep)
        self.all_joints = stack(units, np.arange(len(robot.joint_names)))
        models = _models(robot, units, payloads, self.dt, self.timestep, locked)
        model, b, p = models[0], Batch(models[0], nsim=len(units), nthread=nthread), self.physics
        self.batch = b
        expand_differences(b, models)
        self.num_envs, self.n = len(units), len(robot.joint_names)
        self._qpos, self._qvel, self._ctrl = b.bind("qpos"), b.bind("qvel"), b.bind("ctrl")
        self._warmstart, self._time = b.bind("qacc_warmstart"), b.bind("time")
        self._constraint = b.bind("qfrc_constraint")
        self._gain, self._bias = b.expand("actuator_gainprm"), b.expand("actuator_biasprm")
        self._range, self._frictionloss = (
            b.expand("actuator_forcerange"),
            b.expand("dof_frictionloss"),
        )
        self._applied, self._force = b.bind("qfrc_applied"), b.bind("actuator_force")
        self._damping = b.expand("dof_damping")
        self._cold_damping, self._thinning = self._damping.copy(), np.ones((1, 1))
        self._nominal_friction = model.dof_frictionloss.copy()
        self._kp = robot.kp[self.active] * p.kp_scale
        self._kd = robot.kd[self.active] * p.kd_scale
        self._added = np.zeros_like(self._kp)
        self._effort = robot.effort_limit[self.active]
        self._compliance = p.windup / self._effort  # rad per N·m
        # Effects that most fleets lack cost a tenth of the time each step.
        self._fast, self._lags = (
            bool(np.isfinite(p.no_load_speed).any()),
            bool((p.current_time > 0).any()),
        )
        self._twists = bool((p.windup > 0).any())
        self._limits = qpos_range(model)
        self.backlash = motor.Backlash(p, model.dof_armature)
        self.bristles = motor.Bristles(p, self._nominal_friction)
        self.thermal = motor.Thermal(p)
        self.link, self.firmware = motor.CommandLink(p, self.dt), motor.Firmware(p)
        self.couplings = motor.Couplings(p, model, b, self._effort)
        self._supply = np.ones((self.num_envs, 1))
        self._chain_gain = self._push = self._passed = self._twist = self._squares = (
            self._max_torque
        ) = self._kp * 0.0
        self._idle_temperature = np.zeros((self.num_envs, self.n))
        self._noise, self._chance, self._row, self._now = (
            np.zeros(0),
            np.zeros(0),
            NOISE_PERIODS,
            0.0,
        )
        self._rng: list[np.random.Generator] = []

    def reset(
        self, ctrl: Array, seeds: list[int], warmth: Array | float = 0.0, start: Array | None = None
    ) -> None:
        """Put the robots at rest under a command, as before a recording.

        Args:
            ctrl: Targets, (N, n) rad.
            seeds: Seeds of each row's noise, jitter and rest position in the friction band.
            warmth: Motor temperature above ambient, (N,) K.
            start: True joint positions instead of the rest position, (N, n) rad.
        """
        self._rng = [np.random.default_rng(seed) for seed in seeds]
        self._row, self._now = NOISE_PERIODS, 0.0
        target = (
            np.clip(np.asarray(ctrl, float)[:, self.active], *self._limits.T)
            - self.physics.zero_offset
        )
        warm = 25.0 + np.broadcast_to(np.asarray(warmth, float), (self.num_envs,))[:, None]
        self.thermal.reset(np.repeat(warm, len(self.active), axis=1))
        self._idle_temperature = np.repeat(warm, self.n, axis=1)
        self.link.reset(target)
        self.firmware.reset(target)
        self._supply[:], self._chain_gain = 1.0, np.ones_like(target)
        self._time[:], self._qvel[:], self._warmstart[:] = 0.0, 0.0, 0.0
        self._ctrl[:] = target
        if start is None:
            self._settle(target)
        else:
            self._qpos[:] = np.asarray(start)[:, self.active]
        load = self._load()
        self._chain_gain = self.couplings.gain_factor(load)
        self._twist = self._compliance * load
        self._ctrl[:] -= self._twist
        self._push, self._passed = np.zeros_like(target), self._motor_torque() * self.thermal.kt()
        self.bristles.reset(self._passed - load, self._friction_limit(self._passed))
        self.backlash.reset(self._motor_torque())
        self._squares = np.zeros_like(target)

    def set_gains(
        self, kp: Array, kd: Array, effort: Array | None = None, torque: Array | float = 0.0
    ) -> None:
        """Set the drives to other gains than the robot's, (n) or (N, n); each drive delivers its kp_scale and kd_scale.

        Zero stiffness damps: only velocity feedback remains. Call it after reset, which uses the gains in force.

        Args:
            kp, kd: N·m/rad, N·m·s/rad.
            effort: Torque limits, (n) N·m; default: those in force.
            torque: Added torque, N·m.
        """
        p, at = self.physics, self.active
        self._kp = np.broadcast_to(np.asarray(kp, float)[..., at] * p.kp_scale, self._kp.shape)
        self._kd = np.broadcast_to(np.asarray(kd, float)[..., at] * p.kd_scale, self._kd.shape)
        if effort is not None:
            self._effort = np.asarray(effort, float)[at]
        self._added = np.broadcast_to(np.broadcast_to(torque, self.n)[..., at], self._kd.shape)

    def _settle(self, target: Array) -> None:
        """Move to the balance of PD and gravity, with a small offset: friction holds a joint where it stopped."""
        full = (
            self._kp * self.thermal.kt() * motor.derating_factor(self.physics, self.thermal.winding)
        )
        self._qpos[:] = target
        for _ in range(SETTLING_STEPS):
            load = self._load()
            self.couplings.reset()
            stiffness = full * self.couplings.gain_factor(load)
            self._qpos[:] = target - load * (1.0 / stiffness + self._compliance)
            np.clip(self._qpos, *self._limits.T, out=self._qpos)
        rest = np.stack([rng.standard_normal(self.n) for rng in self._rng])[:, self.active]
        band = (self._nominal_friction + self.physics.friction) / stiffness
        self._qpos += REST_STD * band * np.clip(rest, -3, 3)

    def _load(self) -> Array:
        """Return the load of gravity and cables on a joint at rest, (N, active), N·m."""
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        return self.batch.bind("qfrc_bias") - self.batch.bind("qfrc_passive")

    def _friction_limit(self, torque: Array) -> Array:
        """Return the present friction limit under a motor torque at the joint, (N, active), N·m."""
        dry = self._nominal_friction + self.couplings.drag(self._qpos)
        return motor.friction_limit(
            self.physics, dry, self._qvel, torque, self._push, self._thinning
        )

    def _motor_torque(self) -> Array:
        """Return the torque that the drive sets, at the rated torque constant, (N, active), N·m."""
        torque = self._kp * (self._ctrl - self._qpos) - self._kd * self._qvel + self._added
        return np.clip(torque * self._gain_factor(), -self._effort, self._effort)

    def _gain_factor(self) -> Array:
        """Return the factor of the drives' gain by supply, temperature and load of the chain, (N, active)."""
        supply = 1.0 + self.physics.supply_gain * (self._supply - 1.0)
        return supply * motor.derating_factor(self.physics, self.thermal.winding) * self._chain_gain

    def step(self, ctrl: Array, rows: Array | None = None) -> None:
        """Send targets (N, n) rad and simulate one control period, only for `rows` (k,) if given."""
        if self._row == NOISE_PERIODS:
            self._sample_noise()
        target = (
            np.clip(np.asarray(ctrl, float)[:, self.active], *self._limits.T)
            - self.physics.zero_offset
        )
        self.link.send(target, self._now, self._chance[:, self._row])
        count = self.decimation // self.substeps
        period = self.substeps * self.timestep
        self._squares[:] = 0.0
        kt = self.thermal.kt()
        factor = kt * self._gain_factor()
        self._max_torque = self._effort * kt * np.minimum(self._supply, 1.0)
        self._range[:, :, 1], self._range[:, :, 0] = self._max_torque, -self._max_torque
        self._thinning = self.thermal.thinning_factor()
        self._damping[:] = self._cold_damping * self._thinning
        kp, kd, added = self._kp * factor, self._kd * factor, self._added * factor
        for k in range(count):
            target = self.link.read(self._now + k * period)
            if self.firmware.any:
                target = self.firmware.step(target, period)
            if self.couplings.flexes:
                self.couplings.flex(period)
            self._ctrl[:] = target - self._twist
            self._apply_effects(kp, kd, added, kt, period)
            self.batch.step(rows, nstep=self.substeps)
            self._push = -self._constraint
            if self.bristles.any:
                self._push = np.where(self.bristles.soft, self.bristles.torque, self._push)
            if self._lags or self._twists:
                self._passed = self._force.copy()
                self._twist = self._compliance * (self._passed - self._push)
        self._end_period(count)
        self._now += self.dt
        self._row += 1

    def _apply_effects(self, kp: Array, kd: Array, added: Array, kt: Array, period: float) -> None:
        """Set gains, torque limits and friction for the next physics steps, `period` s."""
        torque = self._motor_torque()
        self._squares += torque * torque
        joint_torque = torque * kt
        if self._lags:
            lag = np.exp(-period / np.maximum(self.physics.current_time, 1e-9))
            kp, kd, added = (
                kp * (1.0 - lag),
                kd * (1.0 - lag),
                added * (1.0 - lag) + lag * self._passed,
            )
        if self.backlash.any:
            engaged = self.backlash.step(joint_torque, period)
            kp, kd, added = kp * engaged, kd * engaged, added * engaged
        self._gain[:, :, 0] = kp
        self._bias[:, :, 0] = added
        self._bias[:, :, 1] = -kp
        self._bias[:, :, 2] = -kd
        if self._fast:
            self._range[:, :, 1] = self._max_torque * motor.speed_factor(self.physics, self._qvel)
            self._range[:, :, 0] = -self._max_torque * motor.speed_factor(self.physics, -self._qvel)
        limit = self._friction_limit(joint_torque)
        self._applied[:] = -self.physics.churning * self._qvel * np.abs(self._qvel)
        self._applied += motor.cogging_torque(self.physics, self._qpos)
        if self.bristles.any:
            self._applied -= self.bristles.step(limit, self._qvel, period)
            limit = np.where(self.bristles.soft, 0.0, limit)
        self._frictionloss[:] = limit

    def _end_period(self, count: int) -> None:
        """Advance temperatures and supply by a control period with `count` effect periods."""
        squares = self._squares / count
        self.thermal.step(squares, self.dt)
        work = np.maximum(self._motor_torque() * self._qvel, 0.0)
        self._chain_gain = self.couplings.gain_factor(self._motor_torque())
        self._supply = motor.supply_factor(
            self.physics, (self.thermal.heat(squares) + work).sum(axis=1, keepdims=True)
        )

    def _sample_noise(self) -> None:
        """Sample noise (N, periods, 3, n) and chances of jitter and loss (N, periods, 2)."""
        self._noise = np.stack(
            [rng.standard_normal((NOISE_PERIODS, 3, self.n)) for rng in self._rng]
        )
        self._chance = np.stack([rng.random((NOISE_PERIODS, 2)) for rng in self._rng])
        self._row = 0

    def read(self) -> Reading:
        """Return the readings of the sensors; a second reading within a period has the same noise."""
        if self._row == NOISE_PERIODS:
            self._sample_noise()
        p, noise = self.all_joints, self._noise[:, self._row]
        true = self._full(
            self._qpos + self._twist, self.robot.qpos_home
        )  # the encoder is on the motor's side
        qpos = motor.quantised(true + p.zero_offset + p.encoder_noise * noise[:, 0], p.encoder_step)
        qvel = self._full(self._qvel, 0.0) + p.velocity_noise * noise[:, 1]
        tau = (
            self._full(self._motor_torque(), 0.0) + p.current_offset + p.current_noise * noise[:, 2]
        )
        temperature = self._idle_temperature.copy()
        temperature[:, self.active] = self.thermal.winding
        return Reading(qpos, qvel, tau, temperature)

    def true_qpos(self) -> Array:
        """Return the true joint positions, (N, n) rad, for tests and for the true position of the hand."""
        return self._full(self._qpos, self.robot.qpos_home)

    def _full(self, values: Array, rest: Array | float) -> Array:
        """Return values (N, active) with those of locked joints added, (N, n)."""
        out = np.empty((self.num_envs, self.n))
        out[:] = rest
        out[:, self.active] = values
        return out


def _substeps(decimation: int, timestep: float) -> int:
    """Return the largest number of physics steps per effect period that divides a control period."""
    limit = max(1, int(MAX_EFFECT_PERIOD_S / timestep + 1e-6))
    return next(k for k in range(min(limit, decimation), 0, -1) if decimation % k == 0)


def _models(
    robot: RobotSpec,
    units: list[Physics],
    payloads: list[tuple[float, str]],
    dt: float,
    timestep: float,
    locked: tuple[str, ...],
) -> list[mujoco.MjModel]:
    """Return one model per row, the same object for rows with the same unit and payload."""
    models: dict[tuple[int, float, str], mujoco.MjModel] = {}
    for unit, (mass, side) in zip(units, payloads, strict=True):
        key = (id(unit), mass, side)
        if key not in models:
            model = build_model(robot, mass, side, dt, locked, physics_only=True)
            model.opt.timestep = timestep
            _edit(model, robot, unit, locked)
            models[key] = model
    return [models[id(u), m, s] for u, (m, s) in zip(units, payloads, strict=True)]


def _edit(model: mujoco.MjModel, robot: RobotSpec, unit: Physics, locked: tuple[str, ...]) -> None:
    """Set the effects in a model that MuJoCo simulates itself: damping, cable springs, link masses and centres."""
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
    if roll or pitch:  # gravity as seen from a tilted base
        model.opt.gravity = g * np.array(
            [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
        )
    mujoco.mj_setConst(model, mujoco.MjData(model))
    stiffen_friction(model)
