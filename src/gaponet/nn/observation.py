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

from collections.abc import Callable
from typing import Any

import numpy as np

from gaponet.base.arrays import Array, array_like, array_module, copy_array, zeros_like
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
        self.depth = config.history_depth
        self._observed = slice(0, self.depth, config.stride)
        self._past = x[:, layout.past]
        self._in_x = config.stride == config.sensor_hold == 1
        memory = self._past if self._in_x else zeros_like(x, len(x), 3 * n * self.depth)
        self.frames = memory.reshape(len(x), self.depth, 3 * n)  # a view
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
        n = self.frames.shape[2] // 3
        self.frames[ids, :, :n] = qpos
        self.frames[ids, :, n : 2 * n] = qvel
        self.frames[ids, :, 2 * n :] = u

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """Append a frame: state at t and target applied over [t, t+1), (num_envs, n) each.

        None is the state in x.
        """
        newer = self._newer
        if not isinstance(newer, np.ndarray):
            newer = newer.clone()  # numpy copies overlapping memory correctly, torch does not
        self._older[...] = newer
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


class NetworkInput:
    """Input x of a network for num_envs robots or simulations, each with its own history.

    `update` writes the present state, the history and the target of a control period into x, and
    `push` ends the period.

    Arrays are numpy's or, if the buffers are tensors, torch's. They have the operated joints,
    (num_envs, n).

    Attributes:
        x: The input, (num_envs, dim) float32.
        action: Columns a_t of x, the target, rad; (num_envs, n), or (n,) for one robot.
        extra: Returns the columns of x after [o_t | a_t], (num_envs, k): the simulator's answers,
            then the recorded state's 2n + 1 numbers. Missing columns stay zero; all do if extra is
            None.
        age: Control periods since the start, (num_envs,); None if nothing is held.
    """

    def __init__(self, config: ModelConfig, n: int, num_envs: int, like: Any = None) -> None:
        """like: A float32 array or tensor. All buffers are of its kind and device; default
        numpy.
        """
        layout = Layout(config, n)
        self.config = config
        self.layout = layout
        if like is None:
            like = np.empty(0, np.float32)
        x = zeros_like(like, num_envs, layout.dim)
        self.x = x
        self.history = History(config, n, x)
        # Internal arrays of one robot have one dimension: numpy needs half the time.
        rows = x[0] if num_envs == 1 else x
        self._q = rows[..., layout.q]
        self._v = rows[..., layout.v]
        self._payload = x[:, layout.payload.start] if config.payload_input else None
        self.action = rows[..., layout.action]
        self.extra: Callable[[], Any] | None = None
        self.age: Any = zeros_like(x, num_envs) if config.holds else None
        # Mask of the robots without a history, (num_envs,); None if all have one.
        self._fresh: Array | None = np.ones(num_envs, bool)

    def set_context(self, context: Any) -> None:
        """Set the answers of each robot's simulator to fixed probes, (num_envs, 8n) or (8n) rad
        (sim/context.py).
        """
        self.x[:, self.layout.context] = array_like(self.x, context)

    # ---- history

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Delete the history of robots `ids`.

        At the next `update`, their present frame is repeated as history.
        """
        if self._fresh is None:
            self._fresh = np.zeros(len(self.x), bool)
        self._fresh[ids] = True

    def begin(self, ids: Array | slice, qpos: Any, qvel: Any, u: Any) -> None:
        """Set the history of robots `ids`: frames (k, depth, n), newest first, or (k, 1, n),
        repeated; rad, rad/s, rad.

        u: Applied targets.
        """
        self.history.reset(ids, qpos, qvel, u)
        if self.age is not None:
            self.age[ids] = 0
        if self._fresh is not None:
            self._fresh[ids] = False
            if not self._fresh.any():
                self._fresh = None

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """End a control period: append the state before it and its target, (num_envs, n) each, to
        the history.

        None is the state in x.
        """
        self.history.push(qpos, qvel, u)
        if self.age is not None:
            self.age += 1

    def last_targets(self, qpos: Any) -> Any:
        """Return the targets of the last period, or the positions of robots without history,
        (num_envs, n) rad.
        """
        n = self.layout.q.stop
        last = copy_array(self.history.frames[:, 0, 2 * n :])
        if self._fresh is not None:
            last[self._fresh] = qpos.reshape(-1, n)[self._fresh]
        return last

    # ---- a control period

    def update(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """Update x and return it. It is the buffer: copy it to keep it.

        Args:
            qpos, qvel: Present state, (num_envs, n) rad, rad/s.
            ctrl: Target of the coming period, (num_envs, n) rad.
            payload_mass: kg, one number or (num_envs,).
        """
        if self._fresh is not None:
            self._begin_at(qpos, qvel, ctrl)
        hold = self.config.sensor_hold
        if hold == 1:
            self._q[...] = qpos
            self._v[...] = qvel
            self.history.write()
        else:  # the sensor predictor's input is the observation of the last refresh
            due = self.due(hold)
            joints_due = per_joint(due)
            where = array_module(self.x).where
            self._q[...] = where(joints_due, qpos, self._q)
            self._v[...] = where(joints_due, qvel, self._v)
            self.history.write(due)
        self.action[...] = ctrl
        if self._payload is not None:
            self._payload[...] = payload_mass / self.config.payload_max
        if self.extra is not None:
            self._write_extra(self.extra)
        return self.x

    def due(self, hold: int) -> Any:
        """Return the mask of robots at a multiple of `hold` control periods, (num_envs,)."""
        return self.age % hold == 0

    def _begin_at(self, qpos: Any, qvel: Any, ctrl: Any) -> None:
        """Repeat the present frame as history of robots without one."""
        assert self._fresh is not None
        fresh = self._fresh.copy()
        n = self.layout.q.stop
        q = qpos.reshape(-1, 1, n)[fresh]
        v = qvel.reshape(-1, 1, n)[fresh]
        u = ctrl.reshape(-1, 1, n)[fresh]
        self.begin(fresh, q, v, u)

    def _write_extra(self, extra: Callable[[], Any]) -> None:
        """Write the columns after [o_t | a_t] of robots whose sensor values are not held."""
        due = slice(None)
        if self.config.sensor_hold > 1:
            due = self.due(self.config.sensor_hold)
            if not due.any():
                return
        columns = extra()
        start = self.layout.query.stop
        self.x[due, start : start + columns.shape[1]] = columns[due]

    # ---- checkpoint

    def state(self) -> dict[str, Any]:
        """Return the history, and x where it is held, for a checkpoint."""
        arrays = {"frames": self.history.frames}
        if self.age is not None:
            arrays["age"] = self.age
            arrays["x"] = self.x
        return arrays

    def set_state(self, arrays: dict[str, Array]) -> None:
        """Restore a `state`."""
        for name, buffer in self.state().items():
            buffer[:] = array_like(buffer, arrays[name])


def per_joint(mask: Any) -> Any:
    """Return a mask of robots, (num_envs,), for arrays of their joints, (num_envs, n), or (n,) for
    one robot.
    """
    return mask if len(mask) == 1 else mask[:, None]
