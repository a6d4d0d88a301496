"""VirtualRobot: N virtual robots, each with hidden physics and a payload, stepped together.

It is used like a robot: send targets for one control period, then read encoders, current sensors
and thermometers.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, expand_differences
from gaponet.sim.model import qpos_range
from gaponet.virtual import motor
from gaponet.virtual.drives import Drives, Gains, Transmission
from gaponet.virtual.noise import Noise
from gaponet.virtual.physics import Physics, stack
from gaponet.virtual.time_steps import TimeSteps
from gaponet.virtual.unit_model import unit_models

# Of the friction band: a joint that always arrives in the same way stops in nearly the same place.
REST_STD = 0.1
SETTLING_STEPS = 40  # each reduces the error by gravity stiffness / kp, 0.4 at worst on H1-2


@dataclass(frozen=True)
class Reading:
    """Readings of the sensors, (N, n) each.

    Attributes:
        qpos, qvel: rad, rad/s.
        tau: Current times the rated torque constant, N·m.
        temperature: Of the winding, °C.
    """

    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array


class BatchArrays:
    """Arrays of MuJoCo, (N, active) if not stated; a write counts from the next physics step on."""

    def __init__(self, batch: Batch) -> None:
        self.qpos = batch.bind("qpos")  # rad
        self.qvel = batch.bind("qvel")  # rad/s
        self.ctrl = batch.bind("ctrl")  # rad
        self.warmstart = batch.bind("qacc_warmstart")
        self.time = batch.bind("time")  # (N, 1) s
        self.constraint_torque = batch.bind("qfrc_constraint")  # N·m
        self.gain = batch.expand("actuator_gainprm")  # (N, active, 10)
        self.bias = batch.expand("actuator_biasprm")  # (N, active, 10)
        self.torque_range = batch.expand("actuator_forcerange")  # (N, active, 2) N·m
        self.friction = batch.expand("dof_frictionloss")  # N·m
        self.applied_torque = batch.bind("qfrc_applied")  # N·m
        self.motor_torque = batch.bind("actuator_force")  # N·m
        self.damping = batch.expand("dof_damping")  # N·m·s/rad

    def set_gains(self, gains: Gains) -> None:
        """Set the PD control that MuJoCo evaluates in each physics step."""
        self.gain[:, :, 0] = gains.kp
        self.bias[:, :, 0] = gains.added
        self.bias[:, :, 1] = -gains.kp
        self.bias[:, :, 2] = -gains.kd

    def set_torque_range(self, low: Array, high: Array) -> None:
        """Set the torque limits, (N, active) N·m."""
        self.torque_range[:, :, 0] = low
        self.torque_range[:, :, 1] = high

    def stand_still(self) -> None:
        """Set time and velocity to zero."""
        self.time[:] = 0.0
        self.qvel[:] = 0.0
        self.warmstart[:] = 0.0


class VirtualRobot:
    """N robots of one type. A row's result does not depend on the other rows, bit for bit.

    Attributes:
        active: Joints that are not locked, (active,); they are what MuJoCo simulates.
        physics: Hidden parameters of the active joints.
        cold_damping: Damping of the joints at 25 °C, (N, active) N·m·s/rad.
    """

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
        self.num_envs = len(units)
        self.n = len(robot.joint_names)
        free = [i for i, name in enumerate(robot.joint_names) if name not in locked]
        self.active = np.array(free)
        self.physics = stack(units, self.active)
        self._sensor_physics = stack(units, np.arange(self.n))
        self.steps = TimeSteps.choose(self.physics, robot.dt if dt is None else dt, timestep)

        models = unit_models(robot, units, payloads, self.steps, locked)
        model = models[0]
        self.batch = Batch(model, nsim=len(units), nthread=nthread)
        expand_differences(self.batch, models)
        self._arrays = BatchArrays(self.batch)
        self.cold_damping = self._arrays.damping.copy()
        self._limits = qpos_range(model)  # (active, 2) rad

        physics = self.physics
        effort = robot.servo.effort_limit[self.active]
        self._thermal = motor.Thermal(physics)
        self._drives = Drives(
            physics, self._thermal, robot.servo.kp[self.active], robot.servo.kd[self.active], effort
        )
        self._transmission = Transmission(physics, effort)
        self._friction = motor.Friction(physics, model.dof_frictionloss.copy())
        self._backlash = motor.Backlash(physics, model.dof_armature)
        self._couplings = motor.Couplings(physics, model, self.batch, effort)
        self._link = motor.CommandLink(physics, self.steps.control)
        self._firmware = motor.Firmware(physics)
        self._speed_limits_torque = bool(np.isfinite(physics.no_load_speed).any())

        self._noise = Noise(self.n)
        self._now = 0.0  # s since the reset
        self._squares = np.zeros_like(self._arrays.qpos)  # sum of squared torques of a period
        self._max_torque = np.zeros_like(self._arrays.qpos)  # N·m
        self._idle_temperature = np.zeros((self.num_envs, self.n))  # °C

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
        self._noise.reset(seeds)
        self._now = 0.0
        target = self._servo_target(ctrl)
        warm = 25.0 + np.broadcast_to(np.asarray(warmth, float), (self.num_envs,))[:, None]
        self._thermal.reset(np.repeat(warm, len(self.active), axis=1))
        self._idle_temperature = np.repeat(warm, self.n, axis=1)
        self._link.reset(target)
        self._firmware.reset(target)
        self._drives.supply[:] = 1.0
        self._drives.chain_gain = np.ones_like(target)
        arrays = self._arrays
        arrays.stand_still()
        arrays.ctrl[:] = target
        if start is None:
            self._settle(target)
        else:
            arrays.qpos[:] = np.asarray(start)[:, self.active]
        load = self._load()
        self._drives.chain_gain = self._couplings.gain_factor(load)
        self._transmission.load(load, np.zeros_like(load))
        arrays.ctrl[:] -= self._transmission.twist
        motor_torque = self._motor_torque()
        passed = motor_torque * self._thermal.kt()
        self._transmission.passed = passed
        self._friction.push = np.zeros_like(target)
        self._friction.bristles.reset(passed - load, self._friction_limit(passed))
        self._backlash.reset(motor_torque)
        self._squares = np.zeros_like(target)

    def set_gains(
        self, kp: Array, kd: Array, effort: Array | None = None, torque: Array | float = 0.0
    ) -> None:
        """Set the drives to other gains than the robot's, (n) or (N, n).

        Each drive delivers its kp_scale and kd_scale. Zero stiffness damps: only velocity feedback
        remains. Call it after reset, which uses the gains in force.

        Args:
            kp, kd: N·m/rad, N·m·s/rad.
            effort: Torque limits, (n) N·m; default: those in force.
            torque: Added torque, N·m.
        """
        active = self.active
        self._drives.set_gains(
            np.asarray(kp, float)[..., active],
            np.asarray(kd, float)[..., active],
            None if effort is None else np.asarray(effort, float)[active],
            np.broadcast_to(torque, self.n)[..., active],
        )

    def step(self, ctrl: Array, rows: Array | None = None) -> None:
        """Send targets (N, n) rad and simulate one control period, only for `rows` (k,) if
        given.
        """
        arrays = self._arrays
        self._link.send(self._servo_target(ctrl), self._now, self._noise.chances())
        self._squares[:] = 0.0
        kt = self._thermal.kt()
        gains = self._drives.gains.times(kt * self._drives.gain_factor())
        self._max_torque = self._drives.max_torque()
        arrays.set_torque_range(-self._max_torque, self._max_torque)
        self._friction.thinning = self._thermal.thinning_factor()
        arrays.damping[:] = self.cold_damping * self._friction.thinning
        for k in range(self.steps.effects_per_control):
            arrays.ctrl[:] = self._target_at(k * self.steps.effect) - self._transmission.twist
            self._apply_effects(gains, kt)
            self.batch.step(rows, nstep=self.steps.physics_per_effect)
            self._friction.note_constraint(arrays.constraint_torque)
            if self._transmission.lags or self._transmission.twists:
                self._transmission.load(arrays.motor_torque.copy(), self._friction.push)
        self._end_period()
        self._now += self.steps.control
        self._noise.next_period()

    def read(self) -> Reading:
        """Return the readings of the sensors.

        A second reading within a period has the same noise.
        """
        physics = self._sensor_physics
        arrays = self._arrays
        noise = self._noise.sensors()
        motor_angle = arrays.qpos + self._transmission.twist  # the encoder is on the motor's side
        encoder = self._all_joints(motor_angle, self.robot.qpos_home) + physics.zero_offset
        qpos = motor.quantised(encoder + physics.encoder_noise * noise[:, 0], physics.encoder_step)
        qvel = self._all_joints(arrays.qvel, 0.0) + physics.velocity_noise * noise[:, 1]
        current = self._all_joints(self._motor_torque(), 0.0) + physics.current_offset
        tau = current + physics.current_noise * noise[:, 2]
        temperature = self._idle_temperature.copy()
        temperature[:, self.active] = self._thermal.winding
        return Reading(qpos, qvel, tau, temperature)

    def true_qpos(self) -> Array:
        """Return the true joint positions, (N, n) rad.

        For tests, and for the true position of the hand.
        """
        return self._all_joints(self._arrays.qpos, self.robot.qpos_home)

    # ---- parts of a period

    def _servo_target(self, ctrl: Array) -> Array:
        """Return targets (N, n) rad as the encoders of the active joints see them."""
        within = np.clip(np.asarray(ctrl, float)[:, self.active], *self._limits.T)
        result: Array = within - self.physics.zero_offset
        return result

    def _target_at(self, elapsed: float) -> Array:
        """Return the target of the servos `elapsed` s after the start of the control period."""
        period = self.steps.effect
        target = self._link.read(self._now + elapsed)
        if self._firmware.any:
            target = self._firmware.step(target, period)
        if self._couplings.flexes:
            self._couplings.flex(period)
        return target

    def _apply_effects(self, gains: Gains, kt: Array) -> None:
        """Set gains, torque limits and friction for the physics steps of an effect period.

        kt: Torque constant over the rated one, (N, active).
        """
        arrays = self._arrays
        period = self.steps.effect
        torque = self._motor_torque()
        self._squares += torque * torque
        joint_torque = torque * kt
        if self._transmission.lags:
            gains = self._transmission.delayed(gains, period)
        if self._backlash.any:
            gains = gains.times(self._backlash.step(joint_torque, period))
        arrays.set_gains(gains)
        if self._speed_limits_torque:
            forward = motor.speed_factor(self.physics, arrays.qvel)
            backward = motor.speed_factor(self.physics, -arrays.qvel)
            arrays.set_torque_range(-self._max_torque * backward, self._max_torque * forward)
        limit = self._friction_limit(joint_torque)
        arrays.applied_torque[:] = -self.physics.churning * arrays.qvel * np.abs(arrays.qvel)
        arrays.applied_torque += motor.cogging_torque(self.physics, arrays.qpos)
        bristles = self._friction.bristles
        if bristles.any:
            arrays.applied_torque -= bristles.step(limit, arrays.qvel, period)
            limit = np.where(bristles.soft, 0.0, limit)
        arrays.friction[:] = limit

    def _end_period(self) -> None:
        """Advance temperatures and supply by a control period."""
        mean_square = self._squares / self.steps.effects_per_control
        self._thermal.step(mean_square, self.steps.control)
        torque = self._motor_torque()
        work = np.maximum(torque * self._arrays.qvel, 0.0)  # W
        power = (self._thermal.heat(mean_square) + work).sum(axis=1, keepdims=True)
        self._drives.chain_gain = self._couplings.gain_factor(torque)
        self._drives.supply = motor.supply_factor(self.physics, power)

    def _settle(self, target: Array) -> None:
        """Move to the balance of PD and gravity, with a small offset.

        Friction holds a joint where it stopped.
        """
        qpos = self._arrays.qpos
        full = self._drives.gains.kp * self._thermal.kt() * self._drives.derating()
        qpos[:] = target
        for _ in range(SETTLING_STEPS):
            load = self._load()
            self._couplings.reset()
            stiffness = full * self._couplings.gain_factor(load)
            qpos[:] = target - load * (1.0 / stiffness + self._transmission.compliance)
            np.clip(qpos, *self._limits.T, out=qpos)
        rest = self._noise.of_rest()[:, self.active]
        band = (self._friction.nominal + self.physics.friction) / stiffness
        qpos += REST_STD * band * np.clip(rest, -3, 3)

    def _load(self) -> Array:
        """Return the load of gravity and cables on a joint at rest, (N, active), N·m."""
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        result: Array = self.batch.bind("qfrc_bias") - self.batch.bind("qfrc_passive")
        return result

    def _friction_limit(self, torque: Array) -> Array:
        """Return the present friction limit under a motor torque at the joint, (N, active), N·m."""
        drag = self._couplings.drag(self._arrays.qpos)
        return self._friction.limit(drag, self._arrays.qvel, torque)

    def _motor_torque(self) -> Array:
        """Return the torque that the drive sets, at the rated torque constant, (N, active), N·m."""
        arrays = self._arrays
        return self._drives.torque(arrays.ctrl, arrays.qpos, arrays.qvel)

    def _all_joints(self, values: Array, rest: Array | float) -> Array:
        """Return values (N, active) with those of locked joints added, (N, n)."""
        out = np.empty((self.num_envs, self.n))
        out[:] = rest
        out[:, self.active] = values
        return out
