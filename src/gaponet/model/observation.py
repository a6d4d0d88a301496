"""THE observation: the one definition used by training, the aligned simulator and the robot.

o_t = [ q_t | q̇_t | h_{t-1} | … | h_{t-H} | (P / P_max) ],  h_s = [ q_s | q̇_s | u_s ],  u_s the target applied over
[s, s+1), correction included. n operated joints; 2n + 3nH (+1) numbers. With a stride k, the frames are t-1, t-1-k, ….

x = [ o_t | a_t | o_r | S_t ] is what a network is given: o_r, the observation of the last sensor refresh, where sensors
are predicted and held; S_t, the simulator's answers to the probes, where it is asked. Most models have neither.
"""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np

from gaponet.model.config import ModelConfig

Array = np.ndarray


class Layout:
    """Where in x things are, as slices of its columns; [o_t | a_t] of a network's features has the same places."""

    def __init__(self, config: ModelConfig, n: int) -> None:
        self.n, self.history = n, config.history
        o = config.observation_dim(n)
        sizes = (n, n, 3 * n * config.history, int(config.payload_input), n,
                 o * config.keeps_observation, config.sensor_dim(n) * config.asks_simulator)  # fmt: skip
        self.q, self.v, self.past, self.payload, self.action, self.refresh, self.answers = (
            slice(a, b) for a, b in pairwise(accumulate(sizes, initial=0))
        )
        self.state, self.observation, self.query = slice(0, 2 * n), slice(0, o), slice(0, o + n)
        self.dim = config.input_dim(n)


class History:
    """Past frames of num_envs robots and the observation made from them, float32."""

    def __init__(self, config: ModelConfig, num_envs: int, n: int, x: Array | None = None) -> None:
        """Empty history: reset every environment before observing.

        Args:
            config: Of the model.
            num_envs: Robots.
            n: Operated joints.
            x: Where observations will be written, (num_envs, dim) float32, by observe(out=x) alone: frames are kept
                there if they can be, so that they need not be copied.
        """
        self.n = n
        self.payload_max = config.payload_max
        self.payload_input = config.payload_input
        self.depth = (config.history - 1) * config.stride + 1
        self.picked = np.arange(0, self.depth, config.stride)  # newest first
        self.dim = config.observation_dim(n)
        self.place = slice(2 * n, 2 * n + 3 * n * config.history)
        self.inside = x is not None and config.stride == 1
        held = (
            x[:, self.place] if x is not None and self.inside else np.zeros((num_envs, 3 * n * self.depth), np.float32)
        )
        self.frames = held.reshape(num_envs, self.depth, 3 * n)  # of a slice of columns, too, this is a view

    def reset(self, ids: Array | slice, qpos: Array, qvel: Array, u: Array) -> None:
        """Fill histories from real frames before the start index, never with zeros.

        Args:
            ids: Environments, (k,).
            qpos, qvel, u: Frames, (k, depth, n), newest first.
        """
        self.frames[ids] = np.concatenate([qpos, qvel, u], axis=-1)

    def push(self, qpos: Array, qvel: Array, u: Array) -> None:
        """Append the frame just lived through: state at t and target applied over [t, t+1), (num_envs, n) each."""
        frames, n = self.frames, self.n
        if self.depth > 1:
            frames[:, 1:] = frames[:, :-1]
        newest = frames[:, 0]
        newest[:, :n] = qpos
        newest[:, n : 2 * n] = qvel
        newest[:, 2 * n :] = u

    def observe(self, qpos: Array, qvel: Array, payload_mass: Array | float, out: Array | None = None) -> Array:
        """The observation, (num_envs, dim), float32.

        Args:
            qpos, qvel: State now, (num_envs, n).
            payload_mass: (num_envs,) kg.
            out: Where to write it, of the same shape; default a new array.
        """
        n = self.n
        out = np.empty((len(self.frames), self.dim), np.float32) if out is None else out
        out[:, :n] = qpos
        out[:, n : 2 * n] = qvel
        if not self.inside:
            past = self.frames if len(self.picked) == self.depth else self.frames[:, self.picked]
            out[:, self.place] = past.reshape(len(out), -1)
        if self.payload_input:
            out[:, -1] = payload_mass / self.payload_max
        return out


def frames_before(t: Array, depth: int) -> Array:
    """Row indices of the `depth` frames before rows t, newest first, the first row repeated; (k,) → (k, depth)."""
    return np.maximum(np.asarray(t)[:, None] - 1 - np.arange(depth), 0)
