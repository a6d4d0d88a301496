"""What moving asks for beyond holding: inertia, damping and friction at the targets' velocity and acceleration.

Both come from the last targets, so this is causal; a noise of the targets is amplified by inertia / (kp dt²), which the
low-pass of the acceleration lessens.
"""

from __future__ import annotations

import numpy as np

from gaponet.arrays import Array
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim
from gaponet.sim.inverse import Inertia

SPEED, ACCELERATION = 4.0, 40.0  # rad/s, rad/s²: as far as targets are believed; a step of theirs asks for more
FRICTION_SPEED = 0.05  # rad/s at which three quarters of the friction are fed forward; none where nothing moves


class Feedforward:
    """Torques for moving of the first `num` simulations of a batch; all have the same joints."""

    def __init__(self, sim: BatchSim, at: Array, robot: RobotSpec, dt: float, acceleration_time: float) -> None:
        """
        Args:
            sim: Its present state gives the inertia.
            at: Operated joints among the simulation's.
            robot: For its velocity feedback.
            dt: Control period, s.
            acceleration_time: Low-pass, s.
        """
        model = next(iter(sim.models.values()))
        self.dt, self.share = dt, min(1.0, dt / max(acceleration_time, dt))
        self.damping = robot.kd[robot.operated_index] + model.dof_damping[at]
        self.friction = model.dof_frictionloss[at]
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

    def torque(self) -> Array:
        """N·m, (num, n operated)."""
        friction = self.friction * np.tanh(self.qvel / FRICTION_SPEED)
        inertial = np.einsum("kij,kj->ki", self.inertia.matrix(len(self.qacc)), self.qacc)
        return inertial + self.damping * self.qvel + friction
