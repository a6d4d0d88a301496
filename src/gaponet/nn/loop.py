"""The loop around a network: past frames, limits. The one state machine of training, free runs, simulators and robots.

It takes numpy arrays or, where its buffers are torch tensors, those; all of operated joints, (num_envs, n).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.arrays import Array, array_module, copy_array, zeros_like
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import History, Layout
from gaponet.nn.onnx_network import Network, OnnxNetwork
from gaponet.robot.spec import RobotSpec


class DeltaLoop:
    """Corrections for num_envs robots or simulations, each with its own past. Buffers are made here, once.

    Attributes:
        x: What the network is given, (num_envs, dim) float32; `observe` brings it up to date.
        applied: ctrl + Δa of the last period, within the joint limits, (num_envs, n) rad: send this.
        extra: Returns what x holds behind [o_t | a_t] now, (num_envs, k): the simulator's answers, then real_state's
            2n + 1 numbers (nn/observation.py). What it leaves out stays zero; so does all of it where extra is None.
    """

    def __init__(
        self,
        config: ModelConfig,
        qpos_range: Array,
        num_envs: int,
        network: Network | None = None,
        of: Any = None,
    ) -> None:
        """
        Args:
            qpos_range: Limits of the operated joints, (n, 2) rad.
            network: The model; None where the correction is found elsewhere, as in training: observe and push.
            of: A float32 array of the kind and device of all buffers; default numpy.
        """
        n = len(qpos_range)
        self.config, self.n, self.num_envs = config, n, num_envs
        self.layout = at = Layout(config, n)
        of = np.empty(0, np.float32) if of is None else of
        x = self.x = zeros_like(of, num_envs, at.dim)
        if network is not None:
            bound = network.bind(x) if isinstance(network, OnnxNetwork) else partial(network, x)
            self.answer: Callable[[], Any] = bound  # x as it is now → Δa
        self.history = History(config, n, x)
        self._q, self._v, self._action = (x[:, part] for part in (at.q, at.v, at.action))
        self._mass, self._most = x[:, at.payload.start], config.payload_max if config.payload_input else None
        self._host, self._xp = isinstance(x, np.ndarray), array_module(x)
        self._shapes = [(num_envs, n), *([(n,)] if num_envs == 1 else [])]
        self.low, self.high = (
            np.array(side[None], float) if self._host else x.new_tensor(side) for side in np.transpose(qpos_range)
        )
        self.applied: Any = zeros_like(self.x, num_envs, n)
        self.holds, self.age = config.holds, zeros_like(self.x, num_envs)  # control periods since the start
        self.held: Any = zeros_like(self.x, num_envs, n)  # the correction that is held
        self.extra: Callable[[], Any] | None = None
        self.fresh = np.ones(num_envs, bool)  # robots without a past
        self.any_fresh = True

    # ---- a past

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Forget the past of robots `ids`: at the next observation their present frame, repeated, is the history."""
        self.fresh[ids] = True
        self.any_fresh = True

    def begin(self, ids: Array | slice, qpos: Any, qvel: Any, u: Any) -> None:
        """Give robots `ids` a past: frames (k, depth, n), newest first, or (k, 1, n), repeated; rad, rad/s, rad."""
        self.history.reset(ids, qpos, qvel, u)
        if self.holds:
            self.age[ids] = 0
        if self.any_fresh:
            self.fresh[ids] = False
            self.any_fresh = bool(self.fresh.any())

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """One control period has passed: the state before it and the target applied over it, (num_envs, n) each."""
        self.history.push(qpos, qvel, u)
        if self.holds:
            self.age += 1

    # ---- a period

    def observe(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """Bring x up to date and return it: this loop's own buffer, to be copied by whoever keeps it.

        Args:
            qpos, qvel: State now, (num_envs, n); rad, rad/s.
            ctrl: Target of the coming period, the same shape, rad.
            payload_mass: kg, one number or (num_envs,).
        """
        if self.any_fresh:
            self.begin(self.fresh.copy(), *(x.reshape(-1, 1, self.n)[self.fresh] for x in (qpos, qvel, ctrl)))
        if self.config.sensor_hold == 1:
            self._q[...], self._v[...], self._action[...] = qpos, qvel, ctrl
            self.history.write()
        else:  # the sensor predictor sees the observation of the last refresh, the trunk the present action
            due = self._due(self.config.sensor_hold)
            self._q[...] = self._xp.where(due[:, None], qpos, self._q)
            self._v[...] = self._xp.where(due[:, None], qvel, self._v)
            self._action[...] = ctrl
            self.history.write(due)
        if self._most is not None:
            self._mass[...] = payload_mass / self._most
        if self.extra is not None and (due := self._due(self.config.sensor_hold)).any():
            extra, start = self.extra(), self.layout.query.stop
            self.x[due, start : start + extra.shape[1]] = extra[due]
        return self.x

    def delta(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """The correction for the coming control period; ask exactly once per period.

        What the history then holds as the target of this period is ctrl + Δa, so apply that. A target that is no
        finite number counts as the last one applied; `applied` is finite then, while ctrl + Δa is not.

        Args:
            qpos, qvel: State now, (num_envs, n) or, for one robot, (n,); rad, rad/s.
            ctrl: Target of the coming period, the same shape, rad.
            payload_mass: kg, one number or (num_envs,).

        Returns:
            Δa of the shape of ctrl, rad, such that ctrl + Δa is within the joint limits.

        Raises:
            UsageError: Arrays of another shape.
        """
        q, v, a = self._rows(qpos, qvel, ctrl)
        if not (self._host and np.vdot(a, a) < np.inf):  # the cheapest test of finite numbers
            a = self._finite(q, a)
        self.observe(q, v, a, payload_mass)
        delta = self.answer()
        if self.config.delta_hold > 1:
            delta = self.held = self._xp.where(self._due(self.config.delta_hold)[:, None], delta, self.held)
        self.applied = self._xp.minimum(self._xp.maximum(a + delta, self.low), self.high)
        if self.holds:
            self.push(q, v, self.applied)
        else:
            self.history.push(None, None, self.applied)
        return (self.applied - a).reshape(ctrl.shape if hasattr(ctrl, "shape") else np.shape(ctrl))

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
        x = self.observe(qpos, qvel, wanted, payload_mass)
        for _ in range(iterations):
            x[:, self.layout.action] = wanted + offset
            offset -= gain * (offset + self.answer())
        self.push(qpos, qvel, wanted)
        return wanted + offset

    # ---- parts

    def _finite(self, q: Any, a: Any) -> Any:
        """Targets, with the last one applied, of robots without a past the state, where they are no finite numbers.

        Else the correction would be none either, would enter the history, and no later one would be a number.
        """
        a, last = a.reshape(-1, self.n), copy_array(self.history.target)
        if self.any_fresh:
            last[self.fresh] = q.reshape(-1, self.n)[self.fresh]
        return self._xp.where(self._xp.isfinite(a), a, last)

    def _due(self, hold: int) -> Any:
        """Robots for which a multiple of `hold` control periods has passed, (num_envs,)."""
        return self.age % hold == 0

    def _rows(self, *given: Any) -> tuple[Any, ...]:
        rows = tuple(map(np.asarray, given)) if self._host else given
        if not rows[0].shape == rows[1].shape == rows[2].shape or rows[0].shape not in self._shapes:
            q, v, a = (tuple(np.shape(values)) for values in given)
            raise UsageError(
                f"delta: qpos {q}, qvel {v}, ctrl {a}; give the {self.n} operated joints of {self.num_envs} robots "
                "each, or make another loop for another number of robots: model.loop(num_envs)"
            )
        return rows


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
