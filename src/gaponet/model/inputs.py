"""x, made from running simulations: the one state machine behind training, free runs and the robot.

It remembers the past frames and, for models that are given more (Layout), what belongs to the last sensor refresh.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from gaponet.model.config import ModelConfig
from gaponet.model.observation import History, Layout

Array = np.ndarray
Infer = Callable[[Array], Array]  # x (B, dim) float32 → Δa (B, n) rad, or offsets (B, m, n) rad


class Oracle(Protocol):
    """The simulator, asked; model.sensor.ProbeOracle."""

    def __call__(self, qpos: Array, qvel: Array, offsets: Array | None = None, ids: Array | None = None) -> Array:
        """Answers (k, m, 2n) at states (k, n_all) of slots ids to targets q + offsets (k, m, n)."""


class Inputs:
    """History and sensors of num_envs simulations, and x made from them."""

    def __init__(
        self,
        config: ModelConfig,
        num_envs: int,
        operated: Array,
        oracle: Oracle | None = None,
        points: Infer | None = None,
    ) -> None:
        """Reset every environment before observing.

        Args:
            config: Of the model.
            num_envs: Simulations.
            operated: Columns of the operated joints in the states given later, (n,).
            oracle: Of as many slots, needed where config.asks_simulator.
            points: x → offsets, where these are learned; without it the fixed probes are asked.
        """
        self.op, self.oracle, self.points = operated, oracle, points
        self.layout = Layout(config, len(operated))
        self.history = History(config, num_envs, len(operated))
        self.hold = config.sensor_hold
        self.age = np.full(num_envs, self.hold)  # control periods since the sensors were refreshed
        self.more = np.zeros((num_envs, self.layout.dim - self.layout.query.stop), np.float32)  # [o_r | S_t]

    def reset(self, ids: Array | slice, qpos: Array, qvel: Array, u: Array) -> None:
        """Past frames of environments, (k, depth, n_all) each, newest first; their sensors are due."""
        op = self.op
        self.history.reset(ids, qpos[..., op], qvel[..., op], u[..., op])
        self.age[ids] = self.hold

    def push(self, qpos: Array, qvel: Array, target: Array) -> None:
        """One control period has passed: state before it and target applied over it, (num_envs, n_all) each."""
        op = self.op
        self.history.push(qpos[:, op], qvel[:, op], target[:, op])
        self.age += 1

    def rest(self, ended: Array) -> None:
        """Their sensors are not due; (num_envs,) bool."""
        self.age[ended] = 0

    def x(self, qpos: Array, qvel: Array, action: Array, payload_mass: Array) -> Array:
        """What the network is given, (num_envs, dim), float32.

        Args:
            qpos, qvel: State now, (num_envs, n_all).
            action: Commanded targets of the operated joints, (num_envs, n) rad.
            payload_mass: (num_envs,) kg.
        """
        o = self.history.observe(qpos[:, self.op], qvel[:, self.op], payload_mass)
        if not self.more.shape[1]:
            return np.concatenate([o, action], axis=1, dtype=np.float32)
        due = np.flatnonzero(self.age >= self.hold)
        if due.size:
            self._refresh(due, o, qpos, qvel)
        return np.concatenate([o, action, self.more], axis=1, dtype=np.float32)

    def _refresh(self, due: Array, o: Array, qpos: Array, qvel: Array) -> None:
        at, n = self.layout, self.layout.n
        kept = at.refresh.stop - at.refresh.start
        self.more[due, :kept] = o[due, :kept]
        if self.oracle is not None:
            offsets = None
            if self.points is not None:
                known = np.concatenate([o[due], np.zeros((len(due), n)), self.more[due]], axis=1, dtype=np.float32)
                offsets = self.points(known)
            self.more[due, kept:] = self.oracle(qpos[due], qvel[due], offsets, due).reshape(len(due), -1)
        self.age[due] = 0
