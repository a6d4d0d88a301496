"""The loop in a free run: one simulation per recording, all joints in and out."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.nn.backends import Network
from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaLoop
from gaponet.robot.spec import RobotSpec


class DeltaCorrector:
    """Target → target + Δa for the operated joints, clipped to the joint range. Implements sim.replay.Corrector."""

    def __init__(self, network: Network, config: ModelConfig, robot: RobotSpec) -> None:
        self.network, self.config, self.robot = network, config, robot
        self.op = robot.operated_index

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin one simulation per sequence at its first row; that frame, with its command, repeated is the history."""
        self.loop = DeltaLoop(self.config, self.robot.qpos_range[self.op], len(start), self.network)
        self.payload = np.array([s.meta.payload_mass for s in start], np.float32)
        if self.config.asks_simulator:
            from gaponet.nn.sensor import ProbeOracle
            from gaponet.sim.batch import Condition

            oracle = ProbeOracle(self.robot, self.config, [Condition.of(s, self.robot) for s in start])
            self.loop.extra = lambda: oracle(*self.now).reshape(len(start), -1)

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Corrected targets, (k, n_all) rad."""
        op, self.now = self.op, (qpos, qvel)
        self.loop.delta(qpos[:, op], qvel[:, op], target[:, op], self.payload)
        out = np.array(target, float)
        out[:, op] = self.loop.applied
        return out
