"""Shadow: the simulated robot beside the real one, under the targets that this one is to reach."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition


class Shadow:
    """Simulations of num robots.

    Attributes:
        sim: One for each robot, of its free joints: all that are not locked.
        free: The free joints among all, (n_free,).
        operated: The operated joints among the free ones, (n,).
        low, high: Limits of the operated joints, (n,) rad.
    """

    def __init__(
        self,
        robot: RobotSpec,
        condition: Condition,
        num: int,
        nthread: int,
        locked: tuple[str, ...],
    ) -> None:
        """
        Args:
            condition: Control period and payload.
            num: Number of robots.
            nthread: Threads.
            locked: Joints that are clamped at home; no operated one.
        """
        self.sim = BatchSim(robot, [condition] * num, nthread, locked)
        self.free = robot.index(self.sim.joint_names)
        self.operated = np.searchsorted(self.free, robot.operated_index)
        self.low, self.high = robot.qpos_range[robot.operated_index].T

    @property
    def qpos(self) -> Array:
        """Positions of the operated joints, (num, n) rad."""
        positions: Array = self.sim.qpos[:, self.operated]
        return positions

    @property
    def qvel(self) -> Array:
        """Velocities of the operated joints, (num, n) rad/s."""
        velocities: Array = self.sim.qvel[:, self.operated]
        return velocities

    def reset(self, qpos: Array) -> None:
        """Start at positions of the free joints, (num, n_free) rad, without motion."""
        past = qpos[:, None]
        self.sim.reset(slice(None), qpos, np.zeros_like(qpos), past)
        self.sim.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)

    def step(self, targets: Array, operated_targets: Array) -> None:
        """Simulate a control period.

        Args:
            targets: Of the free joints, (num, n_free) rad.
            operated_targets: What the operated joints have instead, (num, n) rad.
        """
        applied = targets.copy()
        applied[:, self.operated] = operated_targets
        self.sim.step(applied)
