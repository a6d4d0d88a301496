"""VirtualRobot: N virtual robots, each with hidden physics and a payload, stepped together.

It is used like a robot: send targets for one control period, then read encoders, current sensors
and thermometers.
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch, expand_differences
from gaponet.sim.model import qpos_range
from gaponet.virtual import motor
from gaponet.virtual.joint_motors import JointMotors
from gaponet.virtual.noise import Noise
from gaponet.virtual.physics import Physics, stack
from gaponet.virtual.sensors import Reading, Sensors
from gaponet.virtual.time_steps import TimeSteps
from gaponet.virtual.unit_model import unit_models


class Targets:
    """Targets on the way from the program to the servos: the bus, and the servos' firmware."""

    def __init__(self, physics: Physics, limits: Array, period: float) -> None:
        """
        Args:
            physics: Of the joints that are not locked.
            limits: Their range, (active, 2) rad.
            period: Control period, s.
        """
        self.limits = limits
        self._zero_offset = physics.zero_offset
        self._link = motor.CommandLink(physics, period)
        self._firmware = motor.Firmware(physics)

    def reset(self, target: Array) -> None:
        """Start as if a target, (N, active) rad, had been in force for long."""
        self._link.reset(target)
        self._firmware.reset(target)

    def of_servos(self, ctrl: Array) -> Array:
        """Return targets (N, active) rad as the encoders see them."""
        within = np.clip(ctrl, *self.limits.T)
        result: Array = within - self._zero_offset
        return result

    def send(self, target: Array, now: float, chances: Array) -> None:
        """Send targets (N, active) rad at `now` s; chances (N, 2) of jitter and loss."""
        self._link.send(target, now, chances)

    def at(self, now: float, period: float) -> Array:
        """Return the target of the servos at `now` s for the next `period` s."""
        target = self._link.read(now)
        if self._firmware.any:
            target = self._firmware.step(target, period)
        return target


class VirtualRobot:
    """N robots of one type. A row's result does not depend on the other rows, bit for bit.

    Attributes:
        num_envs: N.
        active: Joints that are not locked, (active,); they are what MuJoCo simulates.
        steps: Control period, effect period and physics step.
        batch: Simulations of the N robots.
        motors: Of the active joints.
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
        self.num_envs = len(units)
        n = len(robot.joint_names)
        free = [i for i, name in enumerate(robot.joint_names) if name not in locked]
        self.active = np.array(free)
        physics = stack(units, self.active)
        self.steps = TimeSteps.choose(physics, robot.dt if dt is None else dt, timestep)

        models = unit_models(robot, units, payloads, self.steps, locked)
        model = models[0]
        self.batch = Batch(model, nsim=len(units), nthread=nthread)
        expand_differences(self.batch, models)

        self.motors = JointMotors(physics, robot, self.active, model, self.batch)
        self._targets = Targets(physics, qpos_range(model), self.steps.control)
        self._noise = Noise(n)
        self._sensors = Sensors(
            stack(units, np.arange(n)), self.active, robot.qpos_home, self._noise
        )
        self._now = 0.0  # s since the reset

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
        target = self._targets.of_servos(np.asarray(ctrl, float)[:, self.active])
        warm = 25.0 + np.broadcast_to(np.asarray(warmth, float), (self.num_envs,))[:, None]
        self.motors.reset(np.repeat(warm, len(self.active), axis=1))
        self._sensors.reset(warm)
        self._targets.reset(target)
        arrays = self.motors.arrays
        arrays.stand_still()
        arrays.ctrl[:] = target
        if start is None:
            rest = self._noise.of_rest()[:, self.active]
            self.motors.settle(target, self._targets.limits, rest)
        else:
            arrays.qpos[:] = np.asarray(start)[:, self.active]
        self.motors.rest_under_load()

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
        kp = np.asarray(kp, float)
        self.motors.drives.set_gains(
            kp[..., active],
            np.asarray(kd, float)[..., active],
            None if effort is None else np.asarray(effort, float)[active],
            np.broadcast_to(torque, kp.shape[-1])[..., active],
        )

    def step(self, ctrl: Array, rows: Array | None = None) -> None:
        """Send targets (N, n) rad and simulate one control period, only for `rows` (k,) if
        given.
        """
        target = self._targets.of_servos(np.asarray(ctrl, float)[:, self.active])
        self._targets.send(target, self._now, self._noise.chances())
        motors = self.motors
        period = self.steps.effect
        current = motors.begin_period()
        for k in range(self.steps.effects_per_control):
            wanted = self._targets.at(self._now + k * period, period)
            motors.apply_effects(wanted, current, period)
            self.batch.step(rows, nstep=self.steps.physics_per_effect)
            motors.note_steps()
        motors.end_period(current.squares / self.steps.effects_per_control, self.steps.control)
        self._now += self.steps.control
        self._noise.next_period()

    def read(self) -> Reading:
        """Return the readings of the sensors.

        A second reading within a period has the same noise.
        """
        motors = self.motors
        return self._sensors.read(motors.angle, motors.arrays.qvel, motors.torque(), motors.winding)

    def true_qpos(self) -> Array:
        """Return the true joint positions, (N, n) rad.

        For tests, and for the true position of the hand.
        """
        return self._sensors.true_qpos(self.motors.arrays.qpos)
