"""Motors of virtual robots with all that is hidden in them and in their joints."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch
from gaponet.virtual import motor
from gaponet.virtual.drives import Drives, Gains, Transmission
from gaponet.virtual.physics import Physics

# Of the friction band: a joint that always arrives in the same way stops in nearly the same place.
REST_STD = 0.1
SETTLING_STEPS = 40  # each reduces the error by gravity stiffness / kp, 0.4 at worst on H1-2


class BatchArrays:
    """Arrays of MuJoCo, (N, active) if not stated; a write counts from the next physics step on."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch
        self.qpos = batch.bind("qpos")  # rad
        self.qvel = batch.bind("qvel")  # rad/s
        self.ctrl = batch.bind("ctrl")  # rad
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
        """Set time and velocity to zero, and forget the solution of the last step."""
        self._batch.bind("time")[:] = 0.0
        self._batch.bind("qacc_warmstart")[:] = 0.0
        self.qvel[:] = 0.0


@dataclass(frozen=True)
class ControlPeriod:
    """What stays the same during a control period, and what adds up in it, (N, active) each.

    Attributes:
        gains: Of the drives.
        kt: Torque constant over the rated one.
        max_torque: N·m.
        squares: Sum of squared torques so far.
    """

    gains: Gains
    kt: Array
    max_torque: Array
    squares: Array


class JointMotors:
    """Motors of the active joints of N robots.

    Attributes:
        physics: Hidden parameters of the active joints.
        arrays: Of the simulations.
        drives: Their PD control; gains may be set.
        cold_damping: Damping of the joints at 25 °C, (N, active) N·m·s/rad.
    """

    def __init__(
        self, physics: Physics, robot: RobotSpec, active: Array, model: mujoco.MjModel, batch: Batch
    ) -> None:
        """
        Args:
            physics: Hidden parameters of the active joints.
            robot: Type of the robots.
            active: Joints that are not locked, (active,).
            model: Of the first robot.
            batch: Simulations of all robots.
        """
        servo = robot.servo
        effort = servo.effort_limit[active]
        self.physics = physics
        self._batch = batch
        self.arrays = BatchArrays(batch)
        self.cold_damping = self.arrays.damping.copy()
        self._thermal = motor.Thermal(physics)
        self.drives = Drives(physics, self._thermal, servo.kp[active], servo.kd[active], effort)
        self._transmission = Transmission(physics, effort)
        self._friction = motor.Friction(physics, model.dof_frictionloss.copy())
        self._backlash = motor.Backlash(physics, model.dof_armature)
        self._couplings = motor.Couplings(physics, model, batch, effort)
        self._speed_limits_torque = bool(np.isfinite(physics.no_load_speed).any())

    @property
    def angle(self) -> Array:
        """Angle of the motors, (N, active) rad; a joint turns less where its gear twists."""
        result: Array = self.arrays.qpos + self._transmission.twist
        return result

    @property
    def winding(self) -> Array:
        """Temperature of the windings, (N, active) °C."""
        return self._thermal.winding

    def torque(self) -> Array:
        """Return the torque that the drive sets, at the rated torque constant, (N, active), N·m."""
        arrays = self.arrays
        return self.drives.torque(arrays.ctrl, arrays.qpos, arrays.qvel)

    def reset(self, temperature: Array) -> None:
        """Start with a temperature, (N, active) °C, full supply and no load on the chains."""
        self._thermal.reset(temperature)
        self.drives.supply[:] = 1.0
        self.drives.chain_gain = np.ones_like(temperature)

    def settle(self, target: Array, limits: Array, rest: Array) -> None:
        """Move to the balance of PD and gravity, with a small offset.

        Friction holds a joint where it stopped.

        Args:
            target: (N, active) rad.
            limits: Range of the joints, (active, 2) rad.
            rest: Where a joint stops in the friction band, (N, active), standard normal.
        """
        qpos = self.arrays.qpos
        full = self.drives.gains.kp * self._thermal.kt() * self.drives.derating()
        qpos[:] = target
        for _ in range(SETTLING_STEPS):
            load = self._load()
            self._couplings.reset()
            stiffness = full * self._couplings.gain_factor(load)
            qpos[:] = target - load * (1.0 / stiffness + self._transmission.compliance)
            np.clip(qpos, *limits.T, out=qpos)
        band = (self._friction.nominal + self.physics.friction) / stiffness
        qpos += REST_STD * band * np.clip(rest, -3, 3)

    def rest_under_load(self) -> None:
        """Hold the joints where they are, as after a long rest under the target in force."""
        load = self._load()
        self.drives.chain_gain = self._couplings.gain_factor(load)
        self._transmission.load(load, np.zeros_like(load))
        self.arrays.ctrl[:] -= self._transmission.twist
        motor_torque = self.torque()
        passed = motor_torque * self._thermal.kt()
        self._transmission.passed = passed
        self._friction.push = np.zeros_like(passed)
        self._friction.bristles.reset(passed - load, self._friction_limit(passed))
        self._backlash.reset(motor_torque)

    def begin_period(self) -> ControlPeriod:
        """Set what stays the same during a control period, and return it."""
        kt = self._thermal.kt()
        gains = self.drives.gains.times(kt * self.drives.gain_factor())
        max_torque = self.drives.max_torque()
        self.arrays.set_torque_range(-max_torque, max_torque)
        self._friction.thinning = self._thermal.thinning_factor()
        self.arrays.damping[:] = self.cold_damping * self._friction.thinning
        return ControlPeriod(gains, kt, max_torque, np.zeros_like(self.arrays.qpos))

    def apply_effects(self, target: Array, now: ControlPeriod, period: float) -> None:
        """Set target, gains, torque limits and friction for the physics steps of an effect period.

        Args:
            target: (N, active) rad.
            now: Of the control period.
            period: Effect period, s.
        """
        if self._couplings.flexes:
            self._couplings.flex(period)
        arrays = self.arrays
        arrays.ctrl[:] = target - self._transmission.twist
        torque = self.torque()
        now.squares[:] += torque * torque
        joint_torque = torque * now.kt
        gains = now.gains
        if self._transmission.lags:
            gains = self._transmission.delayed(gains, period)
        if self._backlash.any:
            gains = gains.times(self._backlash.step(joint_torque, period))
        arrays.set_gains(gains)
        if self._speed_limits_torque:
            forward = motor.speed_factor(self.physics, arrays.qvel)
            backward = motor.speed_factor(self.physics, -arrays.qvel)
            arrays.set_torque_range(-now.max_torque * backward, now.max_torque * forward)
        limit = self._friction_limit(joint_torque)
        arrays.applied_torque[:] = -self.physics.churning * arrays.qvel * np.abs(arrays.qvel)
        arrays.applied_torque += motor.cogging_torque(self.physics, arrays.qpos)
        bristles = self._friction.bristles
        if bristles.any:
            arrays.applied_torque -= bristles.step(limit, arrays.qvel, period)
            limit = np.where(bristles.soft, 0.0, limit)
        arrays.friction[:] = limit

    def note_steps(self) -> None:
        """Note the torques of the last physics step."""
        self._friction.note_constraint(self.arrays.constraint_torque)
        if self._transmission.lags or self._transmission.twists:
            self._transmission.load(self.arrays.motor_torque.copy(), self._friction.push)

    def end_period(self, mean_square: Array, period: float) -> None:
        """Advance temperatures and supply by a control period, s.

        mean_square: Of the torques in it, (N, active).
        """
        self._thermal.step(mean_square, period)
        torque = self.torque()
        work = np.maximum(torque * self.arrays.qvel, 0.0)  # W
        power = (self._thermal.heat(mean_square) + work).sum(axis=1, keepdims=True)
        self.drives.chain_gain = self._couplings.gain_factor(torque)
        self.drives.supply = motor.supply_factor(self.physics, power)

    def _load(self) -> Array:
        """Return the load of gravity and cables on a joint at rest, (N, active), N·m."""
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        result: Array = self._batch.bind("qfrc_bias") - self._batch.bind("qfrc_passive")
        return result

    def _friction_limit(self, torque: Array) -> Array:
        """Return the present friction limit under a motor torque at the joint, (N, active), N·m."""
        drag = self._couplings.drag(self.arrays.qpos)
        return self._friction.limit(drag, self.arrays.qvel, torque)
