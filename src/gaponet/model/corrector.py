"""The loop in a free run: one simulation per recording, all joints in and out."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from typing import TYPE_CHECKING

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.model.backends import Network
from gaponet.model.config import ModelConfig
from gaponet.model.loop import Ask, DeltaLoop, Infer
from gaponet.robot import RobotSpec

if TYPE_CHECKING:
    from gaponet.sim.batch import Condition


class DeltaCorrector:
    """Target → target + Δa for the operated joints, clipped to the joint range. Implements sim.replay.Corrector."""

    def __init__(
        self,
        network: Network,
        config: ModelConfig,
        robot: RobotSpec,
        points: Infer | None = None,
        context: Callable[[list[Condition]], Array | None] = lambda conditions: None,
    ) -> None:
        """points: x → offsets of the probes, where config.sensors is learned. context: Which simulator that is."""
        self.context = context
        self.network, self.config, self.robot, self.points = network, config, robot, points
        self.op = robot.operated_index

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin one simulation per sequence at its first row; that frame, with its command, repeated is the history."""
        ask = self._simulator(start) if self.config.asks_simulator else None
        limits = self.robot.qpos_range[self.op]
        from gaponet.sim.batch import Condition

        told = self.context([Condition.of(s, self.robot) for s in start])
        self.loop = DeltaLoop(self.config, limits, len(start), self.network, ask, self.points, told)
        self.payload = np.array([s.meta.payload_mass for s in start], np.float32)
        self.last = np.array([len(s) - 1 for s in start])

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Corrected targets, (k, n_all) rad."""
        op, self._state = self.op, (qpos, qvel)
        self.loop.rest(t >= self.last)
        self.loop.delta(qpos[:, op], qvel[:, op], target[:, op], self.payload)
        out = np.array(target, float)
        out[:, op] = self.loop.applied
        return out

    def _simulator(self, start: ListOf[Sequence]) -> Ask:
        """A simulator to be asked in which idle limbs are clamped; it is asked only while a sequence lasts (`rest`)."""
        from gaponet.model.sensor import ProbeOracle
        from gaponet.sim.batch import Condition
        from gaponet.sim.replay import idle_limbs

        conditions = [Condition.of(s, self.robot) for s in start]
        oracle = ProbeOracle(self.robot, self.config, conditions, locked=idle_limbs(start, self.robot), whole=True)

        def ask(ids: Array, offsets: Array | None) -> Array:
            qpos, qvel = self._state
            return oracle(qpos[ids], qvel[ids], offsets, ids)

        return ask
