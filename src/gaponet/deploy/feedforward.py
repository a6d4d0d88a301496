"""What moving asks for beyond holding: inertia, damping and friction at the targets' velocity and acceleration.

Both come from the last targets, so this is causal; a noise of the targets is amplified by inertia / (kp dt²), which the
low-pass of the acceleration lessens.
"""

from __future__ import annotations

import numpy as np

from gaponet.arrays import Array
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim

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
        place = np.full(model.nv, -1)
        place[at] = np.arange(len(at))
        row = place[np.repeat(np.arange(model.nv), model.M_rownnz)]  # MuJoCo keeps the lower triangle, row by row
        column = place[model.M_colind]
        self.kept = np.flatnonzero((row >= 0) & (column >= 0))
        self.row, self.column = row[self.kept], column[self.kept]
        self.sparse: Array = sim.batch.bind("M")

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
        return self._times_inertia(self.qacc) + self.damping * self.qvel + friction

    def _times_inertia(self, qacc: Array) -> Array:
        num, n = qacc.shape
        full = np.zeros((num, n, n))
        values = self.sparse[:num, self.kept]
        full[:, self.row, self.column] = values
        full[:, self.column, self.row] = values
        return np.einsum("kij,kj->ki", full, qacc)
