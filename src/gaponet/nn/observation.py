"""THE observation: the one definition used by training, the aligned simulator and the robot.

o_t = [ q_t | q̇_t | h_{t-1} | … | h_{t-H} | (P / P_max) ],  h_s = [ q_s | q̇_s | u_s ],  u_s the target applied over
[s, s+1), correction included. n operated joints; 2n + 3nH (+1) numbers. With a stride k, the frames are t-1, t-1-k, ….

x = [ o_t | a_t ] is what a network is given. The paper's network (nn/paper.py) can have more: with fixed probes S_t,
then with real_state [ q_real − q | q̇_real − q̇ | known ], known 1 or, with all else zero, 0.
"""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from gaponet.base.arrays import Array, copy_array, zeros_like
from gaponet.nn.config import ModelConfig


class Layout:
    """Where in x things are, as slices of its columns; a network's features have the same places."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        self.n, self.history = n, config.history
        o = config.observation_dim(n)
        answers, real = config.sensor_dim(n) * config.asks_simulator, (2 * n + 1) * config.real_state
        sizes = (n, n, 3 * n * config.history, int(config.payload_input), n, answers, real)
        places = (slice(a, b) for a, b in pairwise(accumulate(sizes, initial=0)))
        self.q, self.v, self.past, self.payload, self.action, self.sensors, self.real = places
        self.state, self.observation, self.query = slice(0, 2 * n), slice(0, o), slice(0, o + n)
        self.dim = config.input_dim(n)

    def shifted(self, shift: Array) -> Array:
        """What moving every position and target of [o_t | a_t] by shift (k, n) rad adds to x, (k, dim)."""
        k, n = shift.shape
        out = np.zeros((k, self.dim))
        out[:, self.q] = out[:, self.action] = shift
        out[:, self.past] = np.tile(np.concatenate([shift, np.zeros((k, n)), shift], axis=1), (1, self.history))
        return out


class History:
    """The past frames of num_envs robots, written into x; numpy and torch arrays alike."""

    def __init__(self, config: ModelConfig, n: int, x: Any) -> None:
        """
        Args:
            x: The network's input, (num_envs, dim). Without a stride or held sensors the frames are kept there and
                nothing is copied.
        """
        layout = Layout(config, n)
        self.n = n
        self.depth = (config.history - 1) * config.stride + 1
        self.picked = slice(0, self.depth, config.stride)  # newest first
        self.place, self.present = x[:, layout.past], x[:, layout.state]
        self.inside = config.stride == config.sensor_hold == 1
        held = self.place if self.inside else zeros_like(x, len(x), 3 * n * self.depth)
        self.frames = held.reshape(len(x), self.depth, 3 * n)  # a view, of a slice of columns too
        self.state, self.target = held[:, : 2 * n], held[:, 2 * n : 3 * n]  # of the newest
        self.older, self.younger, self.host = held[:, 3 * n :], held[:, : -3 * n], isinstance(x, np.ndarray)

    def reset(self, ids: Any, qpos: Any, qvel: Any, u: Any) -> None:
        """Fill histories from real frames before the start, never with zeros.

        Args:
            ids: Environments: indices, a slice or a mask that picks k.
            qpos, qvel, u: Frames, (k, depth, n), newest first, or (k, 1, n), repeated.
        """
        n = self.n
        self.frames[ids, :, :n] = qpos
        self.frames[ids, :, n : 2 * n] = qvel
        self.frames[ids, :, 2 * n :] = u

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """Append the frame just lived through: state at t and target applied over [t, t+1), (num_envs, n) each; None,
        None is the state that x shows."""
        self.older[...] = self.younger if self.host else copy_array(self.younger)  # torch would overwrite what it reads
        if qpos is None:
            self.state[...] = self.present
        else:
            self.state[:, : self.n], self.state[:, self.n :] = qpos, qvel
        self.target[...] = u

    def write(self, ids: Any = slice(None)) -> None:
        """Bring x up to date, for environments `ids`."""
        if not self.inside:
            frames = self.frames[ids][:, self.picked]
            self.place[ids] = frames.reshape(len(frames), self.place.shape[1])

    @staticmethod
    def rows_before(t: Array, depth: int) -> Array:
        """Row indices of the `depth` frames before rows t, newest first, the first row repeated; (k,) → (k, depth)."""
        return np.maximum(np.asarray(t)[:, None] - 1 - np.arange(depth), 0)
