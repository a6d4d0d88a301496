"""A network in a running simulation: history, observation, inference, bounds."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.model.config import ModelConfig
from gaponet.model.observation import History
from gaponet.robot import RobotSpec

Array = np.ndarray
Infer = Callable[[Array], Array]  # [o_t | a_t] (B, dim) float32 → Δa (B, n) rad


class DeltaCorrector:
    """Target → target + Δa for the operated joints, clipped to the joint range. Implements sim.replay.Corrector."""

    def __init__(self, infer: Infer, config: ModelConfig, robot: RobotSpec) -> None:
        self.infer, self.config = infer, config
        self.op = robot.operated_index
        self.range = robot.qpos_range[self.op]

    def reset(self, start: ListOf[Sequence]) -> None:
        """One simulation per sequence, at its first row: that frame repeated, with its command, is the history."""
        self.begin(
            np.stack([s.qpos[0] for s in start]),
            np.stack([s.qvel[0] for s in start]),
            np.stack([s.ctrl[0] for s in start]),
            np.array([s.meta.payload_mass for s in start], np.float32),
        )

    def begin(self, qpos: Array, qvel: Array, ctrl: Array, payload_mass: Array) -> None:
        """Start from a state, all joints: (k, n_all) each, payload (k,) kg."""
        op, self.payload = self.op, np.asarray(payload_mass, np.float32)
        self.history = History(self.config, len(qpos), len(op))
        frame = [np.repeat(x[:, None, op], self.history.depth, axis=1) for x in (qpos, qvel, ctrl)]
        self.history.reset(slice(None), *frame)

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Corrected targets, (k, n_all) rad."""
        op = self.op
        q, v, a = qpos[:, op], qvel[:, op], target[:, op]
        x = np.concatenate([self.history.observe(q, v, self.payload), a], axis=1, dtype=np.float32)
        delta = self.infer(x)
        out = np.array(target, float)
        out[:, op] = np.clip(a + delta, self.range[:, 0], self.range[:, 1])
        self.history.push(q, v, out[:, op])
        return out
