"""Feed-forward: targets with which servos give the torque that holds a posture, or moves it too.

The torque of motion is that of inertia, damping and friction. It comes on top of the torque that
holds a posture.

Velocity and acceleration come from the last targets, so the feed-forward is causal. It amplifies
noise of the targets by inertia / (kp dt²); the low-pass of the acceleration reduces that. The delay
of servos is not compensated, because that leads to overshoot.
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array, within
from gaponet.deploy.shadow import Shadow
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.inverse import Inertia
from gaponet.sim.servo import overcome_friction, present

# rad/s, rad/s²; a step of the targets would have more
MAX_SPEED = 4.0
MAX_ACCELERATION = 40.0
# rad/s at which three quarters of the friction are fed forward; at rest none is
FRICTION_SPEED = 0.05


class Feedforward:
    """Targets a + τ / kp − offset, under which the servos of a shadow follow a.

    offset is what the servos add to their targets. All arrays are (num, n operated).
    """

    def __init__(self, shadow: Shadow, robot: RobotSpec, motion: MotionTorque | None) -> None:
        """
        Args:
            shadow: Its present state gives the torque that holds it.
            robot: Servos of the shadow.
            motion: Torque of motion of the same shadow; None for holding alone.
        """
        self._kp = robot.servo.kp[robot.operated_index]
        self._offset = robot.servo.offset[robot.operated_index]
        self._operated = shadow.operated
        self._bias: Array = shadow.sim.batch.bind("qfrc_bias")
        self._motion = motion

    def reset(self, target: Array) -> None:
        """Start at rest at targets, rad."""
        if self._motion is not None:
            self._motion.reset(target)

    def update(self, target: Array) -> None:
        """Set the targets of the coming control period, rad."""
        if self._motion is not None:
            self._motion.update(target)

    def targets(self, wanted: Array) -> Array:
        """Return the targets under which servos follow the wanted positions, rad."""
        torque = self._bias[:, self._operated]
        if self._motion is not None:
            torque = torque + self._motion.torque(torque)
        return np.asarray(wanted + torque / self._kp - self._offset)


class MotionTorque:
    """Torques for the motion of the first `num` simulations of a batch; all have the same joints.

    Attributes:
        target, qvel, qacc: Last targets, their velocity and filtered acceleration, (num, n
            operated).
    """

    def __init__(
        self, sim: BatchSim, operated: Array, robot: RobotSpec, dt: float, acceleration_time: float
    ) -> None:
        """
        Args:
            sim: Its present state gives the inertia.
            operated: Operated joints among the simulation's, (n,).
            robot: Velocity feedback and servo model.
            dt: Control period, s.
            acceleration_time: Time constant of the low-pass, s.
        """
        model = next(iter(sim.models.values()))
        op = robot.operated_index
        self.dt = dt
        self.share = min(1.0, dt / max(acceleration_time, dt))
        self.kd = robot.servo.kd[op]
        self.damping = model.dof_damping[operated]
        self.friction = model.dof_frictionloss[operated]
        self.servo_terms = present({name: robot.servo[name][op] for name in SERVO_TERMS})
        self.inertia = Inertia(sim.batch, model, operated)
        self.target, self.qvel, self.qacc = np.zeros((3, 0, len(op)))

    def reset(self, target: Array) -> None:
        """Start at rest at targets, (num, n operated) rad."""
        self.target = target.copy()
        self.qvel = np.zeros_like(target)
        self.qacc = np.zeros_like(target)

    def update(self, target: Array) -> None:
        """Set the targets of the coming control period, (num, n operated) rad."""
        before = self.qvel
        self.qvel = within((target - self.target) / self.dt, -MAX_SPEED, MAX_SPEED)
        qacc = within((self.qvel - before) / self.dt, -MAX_ACCELERATION, MAX_ACCELERATION)
        self.qacc = self.qacc + self.share * (qacc - self.qacc)
        self.target = target.copy()

    def torque(self, holding: Array | float = 0.0) -> Array:
        """Return the torque to ask of servos for motion, (num, n operated) N·m.

        It includes the torque that the servo's kd takes away again, which never loads the gear.

        Args:
            holding: The torque against gravity, N·m.
        """
        inertial = np.einsum("kij,kj->ki", self.inertia.matrix(len(self.qacc)), self.qacc)
        moving = inertial + self.damping * self.qvel
        share = np.tanh(self.qvel / FRICTION_SPEED)
        friction = overcome_friction(
            self.servo_terms, self.friction, self.qvel, share, holding + moving, holding
        )
        return np.asarray(moving + friction + self.kd * self.qvel)
