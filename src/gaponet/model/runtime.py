"""One step of the correction as a control loop asks for it: history, observation, network, limits."""

from __future__ import annotations

import numpy as np

from gaponet.errors import ModelError, UsageError
from gaponet.model.backends import Network
from gaponet.model.config import ModelConfig
from gaponet.model.observation import History

Array = np.ndarray


class DeltaLoop:
    """Δa of one robot or of num_envs of them, each with its own history. Buffers are made here, once."""

    def __init__(self, network: Network, config: ModelConfig, qpos_range: Array, num_envs: int) -> None:
        """
        Args:
            network: The model.
            config: Its shape.
            qpos_range: Limits of the operated joints, (n, 2) rad.
            num_envs: Robots side by side.
        """
        if config.asks_simulator or config.keeps_observation or config.delta_hold > 1:
            raise ModelError(
                "this model asks the simulator, or holds sensors or corrections: only sim.replay runs it; train with "
                "sensors predicted or off, sensor_hold 1 and delta_hold 1 to use it in a loop"
            )
        self.low, self.high = np.array(qpos_range.T, float, order="C")
        self.n, self.num_envs = len(qpos_range), num_envs
        self.bound = network.bind(num_envs)
        self.observation, self.action = np.split(self.bound.x, [config.observation_dim(self.n)], axis=1)
        self.history = History(config, num_envs, self.n, self.observation)
        self.applied = np.zeros((num_envs, self.n))
        self.fresh = np.ones(num_envs, bool)
        self.any_fresh = True

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Forget the past of robots `ids`: at the next delta their present frame, repeated, is the history."""
        self.fresh[ids] = True
        self.any_fresh = True

    def delta(self, qpos: Array, qvel: Array, ctrl: Array, payload_mass: Array | float) -> Array:
        """The correction for the coming control period; ask exactly once per period.

        What the history then holds as the target of this period is ctrl + Δa, so apply that.

        Args:
            qpos, qvel: State now, (num_envs, n) or, for one robot, (n,); rad, rad/s.
            ctrl: Target of the coming period, the same shape, rad.
            payload_mass: kg, one number or (num_envs,).

        Returns:
            Δa of the shape of ctrl, rad, such that ctrl + Δa is within the joint limits.
        """
        q, v, a = np.asarray(qpos), np.asarray(qvel), np.asarray(ctrl)
        if q.ndim == 1 and self.num_envs == 1:
            q, v, a = q[None], v[None], a[None]
        if not q.shape == v.shape == a.shape == self.applied.shape:
            raise UsageError(
                f"delta: qpos {np.shape(qpos)}, qvel {np.shape(qvel)}, ctrl {np.shape(ctrl)}; give the {self.n} "
                f"operated joints of {self.num_envs} robots each; for another number of robots, reset() first"
            )
        if self.any_fresh:
            self._begin(q, v, a)
        self.history.observe(q, v, payload_mass, out=self.observation)
        self.action[:] = a
        self.bound.run()
        applied = self.applied
        np.add(a, self.bound.delta, out=applied)
        np.maximum(applied, self.low, out=applied)
        np.minimum(applied, self.high, out=applied)
        self.history.push(q, v, applied)
        return (applied - a).reshape(np.shape(ctrl))

    def solve(
        self, qpos: Array, qvel: Array, wanted: Array, payload_mass: Array, offset: Array, gain: float, iterations: int
    ) -> Array:
        """The inverse: u with u + Δa(u) = wanted, by u ← u + gain (wanted − u − Δa(u)); once per period.

        Args:
            qpos, qvel, wanted: (num_envs, n) rad, rad/s, rad.
            payload_mass: (num_envs,) kg.
            offset: u − wanted of the period before, (num_envs, n) rad; becomes this period's.
            gain: In (0, 1].
            iterations: Answers of the network.
        """
        if self.any_fresh:
            self._begin(qpos, qvel, wanted)
        self.history.observe(qpos, qvel, payload_mass, out=self.observation)
        for _ in range(iterations):
            self.action[:] = wanted + offset
            self.bound.run()
            offset -= gain * (offset + self.bound.delta)
        self.history.push(qpos, qvel, wanted)
        return wanted + offset

    def answer(self, qpos: Array, qvel: Array, wanted: Array, payload_mass: Array) -> Array:
        """What `solve` gives, where this network was fitted to it (train/learned_inverse.py): wanted + its answer."""
        if self.any_fresh:
            self._begin(qpos, qvel, wanted)
        self.history.observe(qpos, qvel, payload_mass, out=self.observation)
        self.action[:] = wanted
        self.bound.run()
        self.history.push(qpos, qvel, wanted)
        return wanted + self.bound.delta

    def _begin(self, q: Array, v: Array, a: Array) -> None:
        ids = np.flatnonzero(self.fresh)
        self.history.reset(ids, *(np.repeat(x[ids, None], self.history.depth, axis=1) for x in (q, v, a)))
        self.fresh[:] = False
        self.any_fresh = False
