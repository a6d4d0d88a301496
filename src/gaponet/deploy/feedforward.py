"""What moving asks for beyond holding: inertia, damping and friction (by the servo's law where it was identified), at
the targets' velocity and acceleration. The delay of a servo is not compensated: that overshoots.

Both come from the last targets, so this is causal; a noise of the targets is amplified by inertia / (kp dt²), which the
low-pass of the acceleration lessens.
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.inverse import Inertia
from gaponet.sim.servo import friction_limit, present

SPEED, ACCELERATION = 4.0, 40.0  # rad/s, rad/s²: as far as targets are believed; a step of theirs asks for more
FRICTION_SPEED = 0.05  # rad/s at which three quarters of the friction are fed forward; none where nothing moves


class Feedforward:
    """Torques for moving of the first `num` simulations of a batch; all have the same joints."""

    def __init__(self, sim: BatchSim, at: Array, robot: RobotSpec, dt: float, acceleration_time: float) -> None:
        """
        Args:
            sim: Its present state gives the inertia.
            at: Operated joints among the simulation's.
            robot: For its velocity feedback and law of friction.
            dt: Control period, s.
            acceleration_time: Low-pass, s.
        """
        model, op = next(iter(sim.models.values())), robot.operated_index
        self.dt, self.share = dt, min(1.0, dt / max(acceleration_time, dt))
        self.damping = robot.kd[op] + model.dof_damping[at]
        self.friction = model.dof_frictionloss[at]
        self.law = present({name: getattr(robot, name)[op] for name in SERVO_TERMS})
        self.inertia = Inertia(sim.batch, model, at)

    def reset(self, target: Array) -> None:
        """At rest at targets (num, n operated), rad."""
        self.target, self.qvel, self.qacc = target.copy(), np.zeros_like(target), np.zeros_like(target)

    def update(self, target: Array) -> None:
        """The targets of the coming period, rad."""
        before = self.qvel
        self.qvel = np.clip((target - self.target) / self.dt, -SPEED, SPEED)
        qacc = np.clip((self.qvel - before) / self.dt, -ACCELERATION, ACCELERATION)
        self.qacc = self.qacc + self.share * (qacc - self.qacc)
        self.target = target.copy()

    def torque(self, holding: Array | float = 0.0) -> Array:
        """N·m, (num, n operated), on top of `holding`, what gravity asks for."""
        inertial = np.einsum("kij,kj->ki", self.inertia.matrix(len(self.qacc)), self.qacc)
        moving = inertial + self.damping * self.qvel
        most = friction_limit(self.law, self.friction, self.qvel, holding + moving, holding)
        return np.asarray(moving + most * np.tanh(self.qvel / FRICTION_SPEED))
