"""Observation of the networks: the same code for training, aligned simulators and robots.

    o_t = [ q_t | q̇_t | h_{t-1} | … | h_{t-H} | (P / P_max) ]
    h_s = [ q_s | q̇_s | u_s ]

u_s is the target applied over [s, s+1), correction included. With n operated joints, o_t has
2n + 3nH (+1) numbers. With a stride k, the frames are t-1, t-1-k, ….

x = [ o_t | a_t ] is the input of a network. The paper's network (nn/paper.py) can have more
columns: with fixed probes S_t, then, if it observes the recorded state,
[ q_real − q | q̇_real − q̇ | 1 ], all zero where that state is hidden. A network for many
simulators has the context of sim/context.py as last columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gaponet.base.arrays import Array, copy_array, zeros_like
from gaponet.nn.config import ModelConfig


class Layout:
    """Columns of x as slices. Features of a network have the same columns.

    Attributes:
        q, v, past, payload, action, sensors, real, context: The parts of x in their order. A part
            that a network does not have is empty.
        dim: Number of columns.
    """

    def __init__(self, config: ModelConfig, n: int) -> None:
        self.q = slice(0, n)
        self.v = _after(self.q, n)
        self.past = _after(self.v, 3 * n * config.history)
        self.payload = _after(self.past, int(config.payload_input))
        self.action = _after(self.payload, n)
        answers = config.sensor_dim(n) if config.needs_simulator else 0
        self.sensors = _after(self.action, answers)
        self.real = _after(self.sensors, config.real_state_dim(n))
        self.context = _after(self.real, config.context_dim(n))
        self.dim = self.context.stop

    @property
    def state(self) -> slice:
        """[q | q̇]."""
        return slice(0, self.v.stop)

    @property
    def observation(self) -> slice:
        """o_t."""
        return slice(0, self.payload.stop)

    @property
    def query(self) -> slice:
        """[o_t | a_t]."""
        return slice(0, self.action.stop)

    def shifted(self, shift: Array) -> Array:
        """Return the change of x, (k, dim), when positions and targets of [o_t | a_t] change by
        shift, (k, n) rad.
        """
        k, n = shift.shape
        frame = np.concatenate([shift, np.zeros((k, n)), shift], axis=1)  # [q | q̇ | u]
        history = (self.past.stop - self.past.start) // (3 * n)  # frames
        out = np.zeros((k, self.dim))
        out[:, self.q] = shift
        out[:, self.action] = shift
        out[:, self.past] = np.tile(frame, (1, history))
        return out


def _after(part: slice, size: int) -> slice:
    """Return the next `size` columns."""
    return slice(part.stop, part.stop + size)


class History:
    """Past frames of num_envs robots in the columns `past` of x, a numpy array or a torch tensor.

    Without a stride or held sensors, the frames are stored in x itself, and `write` does nothing.

    Attributes:
        depth: Number of stored frames.
        frames: [q | q̇ | u] of each, newest first, (num_envs, depth, 3n).
    """

    def __init__(self, config: ModelConfig, n: int, x: Any) -> None:
        """x: Input of the network, (num_envs, dim)."""
        layout = Layout(config, n)
        self.n = n
        self.depth = (config.history - 1) * config.stride + 1
        self._observed = slice(0, self.depth, config.stride)
        self._past = x[:, layout.past]
        self._in_x = config.stride == config.sensor_hold == 1
        memory = self._past if self._in_x else zeros_like(x, len(x), 3 * n * self.depth)
        self.frames = memory.reshape(len(x), self.depth, 3 * n)  # a view
        self._numpy = isinstance(x, np.ndarray)
        self._present = x[:, layout.state]
        if len(x) == 1:
            # Internal arrays of one robot have one dimension: numpy needs half the time.
            memory = memory[0]
            self._present = self._present[0]
        self._q = memory[..., :n]
        self._v = memory[..., n : 2 * n]
        self._u = memory[..., 2 * n : 3 * n]
        self._state = memory[..., : 2 * n]
        self._newer = memory[..., : -3 * n]
        self._older = memory[..., 3 * n :]

    def reset(self, ids: Any, qpos: Any, qvel: Any, u: Any) -> None:
        """Fill histories with frames from before the start, never with zeros.

        Args:
            ids: k environments: indices, a slice or a mask.
            qpos, qvel, u: Frames, (k, depth, n), newest first, or (k, 1, n), repeated.
        """
        n = self.n
        self.frames[ids, :, :n] = qpos
        self.frames[ids, :, n : 2 * n] = qvel
        self.frames[ids, :, 2 * n :] = u

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """Append a frame: state at t and target applied over [t, t+1), (num_envs, n) each.

        None is the state in x.
        """
        # numpy copies overlapping memory correctly, torch does not.
        self._older[...] = self._newer if self._numpy else copy_array(self._newer)
        if qpos is None:
            self._state[...] = self._present
        else:
            self._q[...] = qpos
            self._v[...] = qvel
        self._u[...] = u

    def write(self, ids: Any = slice(None)) -> None:
        """Write the observed frames of environments `ids` into x."""
        if not self._in_x:
            frames = self.frames[ids][:, self._observed]
            self._past[ids] = frames.reshape(len(frames), self._past.shape[1])

    @staticmethod
    def rows_before(t: Array, depth: int) -> Array:
        """Return rows of the `depth` frames before rows t, newest first, not below 0: (k,) → (k,
        depth).
        """
        return np.maximum(np.asarray(t)[:, None] - 1 - np.arange(depth), 0)
