"""Inverse of a network's correction: commands that a robot must get to move as wanted."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.deploy.transfer import own_context
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition


class NetworkInverse:
    """Commands u with u + G(u) = a′ for num robots, G being the correction of a network.

    The equation is solved by u ← u + γ (a′ − u − G(u)). The iteration goes on from one control
    period to the next one.

    Attributes:
        loop: The network, with the history of each robot.
    """

    def __init__(
        self,
        model: GapModel,
        robot: RobotSpec,
        loads: list[Condition],
        num: int,
        gain: float,
        iterations: int,
    ) -> None:
        """
        Args:
            robot: Simulator of training.
            loads: Its condition with each payload that it can carry.
            num: Number of robots.
            gain: γ, in (0, 1].
            iterations: Evaluations of the network in a control period.
        """
        self.loop = model.loop(num)
        self._contexts = own_context(model, robot, loads)
        self._gain = gain
        self._iterations = iterations
        self._offset = np.zeros((num, self.loop.n))  # u − a′, rad

    def carry(self, mass: Array) -> None:
        """Let each robot carry one of the loads, (num,) indices."""
        if self._contexts is not None:
            self.loop.network_input.set_context(self._contexts[mass])

    def reset(self) -> None:
        """Start without history and correction."""
        self.loop.reset()
        self._offset[:] = 0.0

    def command(self, qpos: Array, qvel: Array, wanted: Array, payload_mass: Array) -> Array:
        """Return u, (num, n) rad. Call this once per control period.

        Args:
            qpos, qvel: State at its start, (num, n) rad, rad/s.
            wanted: a′, (num, n) rad.
            payload_mass: (num,) kg.
        """
        return self.loop.solve(
            qpos, qvel, wanted, payload_mass, self._offset, self._gain, self._iterations
        )
