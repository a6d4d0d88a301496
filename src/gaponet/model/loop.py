"""The loop around a network: past frames, sensors, holds, limits. The one state machine of training, free runs,
simulators and robots.

It takes numpy arrays or, where the network's buffers are torch tensors, those; all of operated joints, (num_envs, n).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gaponet.arrays import Array, library, zeros_like
from gaponet.errors import ModelError, UsageError
from gaponet.model.backends import Bound, Network
from gaponet.model.config import ModelConfig
from gaponet.model.observation import History, Layout

Infer = Callable[[Array], Array]  # x (B, dim) float32 → Δa (B, n) rad, or offsets (B, m, n) rad
Ask = Callable[[Array, Array | None], Array]  # environments (k,), offsets (k, m, n) rad → answers (k, m, 2n)


class DeltaLoop:
    """Corrections for num_envs robots or simulations, each with its own past. Buffers are made here, once.

    Attributes:
        x: What the network is given, (num_envs, dim) float32; `observe` brings it up to date.
        applied: ctrl + Δa of the last period, within the joint limits, (num_envs, n) rad: send this.
    """

    def __init__(
        self,
        config: ModelConfig,
        qpos_range: Array,
        num_envs: int,
        network: Network | None = None,
        ask: Ask | None = None,
        points: Infer | None = None,
        context: Array | None = None,
        of: Any = None,
    ) -> None:
        """
        Args:
            qpos_range: Limits of the operated joints, (n, 2) rad.
            network: The model; None where the correction is found elsewhere, as in training: observe and push.
            ask: The simulator, where config.asks_simulator.
            points: x → offsets, where these are learned; without it the fixed probes are asked.
            context: Which simulators they are, (num_envs, n · config.context_dim), where the model is told.
            of: A float32 array of the kind and device of all buffers, where there is no network; default numpy.

        Raises:
            ModelError: The model asks the simulator, or is told which it is, and there is none.
        """
        if config.asks_simulator and ask is None:
            raise ModelError(
                f"this model's sensors are the simulator's own answers (sensors = {config.sensors}): to compare with, "
                "of no use outside a simulator; train with --model.sensors predicted"
            )
        if config.context_dim and context is None:
            raise ModelError(
                f"this model is told which simulator it is in ({config.context}), and here is none; use it with "
                "AlignedSim, gaponet eval or transfer, or train without --model.context"
            )
        n = len(qpos_range)
        self.config, self.n, self.num_envs, self.ask, self.points = config, n, num_envs, ask, points
        self.layout = at = Layout(config, n)
        of = np.empty(0, np.float32) if of is None else of
        nothing = Bound(zeros_like(of, num_envs, at.dim), zeros_like(of, num_envs, n), lambda: None)
        self.bound = network.bind(num_envs) if network else nothing
        self.x, self.history = self.bound.x, History(config, n, self.bound.x)
        self.more = self.x[
            :, at.query.stop : at.answers.stop
        ]  # [o_r | S_t]: what belongs to the last refresh of the sensors
        self._host = isinstance(self.x, np.ndarray)
        if context is not None:
            self.x[:, at.context] = context if self._host else self.x.new_tensor(context)
        self._xp = library(self.x)
        self._counts = config.delta_hold > 1 or self.more.shape[1] > 0
        self.low, self.high = (
            np.array(side, float) if self._host else self.x.new_tensor(side) for side in np.transpose(qpos_range)
        )
        self.age = np.full(num_envs, config.sensor_hold)  # control periods since the sensors were refreshed
        self.held = np.full(num_envs, config.delta_hold)  # control periods since the correction was decided
        self.kept = zeros_like(self.x, num_envs, n)  # the correction decided then
        self.applied: Any = zeros_like(self.x, num_envs, n)
        self.fresh = np.ones(num_envs, bool)  # robots without a past
        self.any_fresh = True

    # ---- a past

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Forget the past of robots `ids`: at the next observation their present frame, repeated, is the history."""
        self.age[ids], self.held[ids], self.fresh[ids] = self.config.sensor_hold, self.config.delta_hold, True
        self.any_fresh = True

    def begin(self, ids: Array | slice, qpos: Any, qvel: Any, u: Any) -> None:
        """Give robots `ids` a past: frames (k, depth, n), newest first, or (k, 1, n), repeated; rad, rad/s, rad."""
        self.reset(ids)
        self.history.reset(ids, qpos, qvel, u)
        self.fresh[ids] = False
        self.any_fresh = bool(self.fresh.any())

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """One control period has passed: the state before it and the target applied over it, (num_envs, n) each."""
        self.history.push(qpos, qvel, u)
        if self._counts:
            self.age += 1
            self.held += 1

    def rest(self, ended: Array) -> None:
        """Let the sensors of robots be that will not be looked at again; (num_envs,) bool."""
        self.age[ended] = 0

    # ---- a period

    def observe(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any, deciding: Array | None = None) -> Any:
        """Bring x up to date and return it: this loop's own buffer, to be copied by whoever keeps it.

        Args:
            qpos, qvel: State now, (num_envs, n); rad, rad/s.
            ctrl: Target of the coming period, the same shape, rad.
            payload_mass: kg, one number or (num_envs,).
            deciding: Robots whose sensors may be refreshed, (num_envs,) bool; default all.
        """
        x, at = self.x, self.layout
        if self.any_fresh:
            new = self.fresh.copy()
            self.begin(new, *(values[new][:, None] for values in (qpos, qvel, ctrl)))
        x[:, at.q], x[:, at.v], x[:, at.action] = qpos, qvel, ctrl
        self.history.write()
        if self.config.payload_input:
            x[:, at.payload.start] = payload_mass / self.config.payload_max
        if self.more.shape[1]:
            due = self.age >= self.config.sensor_hold
            self._refresh(np.flatnonzero(due if deciding is None else due & deciding))
        return x

    def delta(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """The correction for the coming control period; ask exactly once per period.

        What the history then holds as the target of this period is ctrl + Δa, so apply that.

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
        free = a + self._decide(q, v, a, payload_mass)
        self.applied = self._xp.minimum(self._xp.maximum(free, self.low), self.high)
        self.push(q, v, self.applied)
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
            self.bound.run()
            offset -= gain * (offset + self.bound.delta)
        self.push(qpos, qvel, wanted)
        return wanted + offset

    def answer(self, qpos: Array, qvel: Array, wanted: Array, payload_mass: Array) -> Array:
        """What `solve` gives, by a network that was fitted to it (training/learned_inverse.py): wanted + its answer."""
        self.observe(qpos, qvel, wanted, payload_mass)
        self.bound.run()
        self.push(qpos, qvel, wanted)
        return wanted + self.bound.delta

    # ---- parts

    def _decide(self, q: Any, v: Any, a: Any, payload_mass: Any) -> Any:
        """This period's Δa before limits: the network's, or what it said when it was last asked."""
        if self.config.delta_hold == 1:
            self.observe(q, v, a, payload_mass)
            self.bound.run()
            return self.bound.delta
        due = self.held >= self.config.delta_hold
        if due.any():
            self.observe(q, v, a, payload_mass, due)
            self.bound.run()
            self.kept[due] = self.bound.delta[due]
            self.held[due] = 0
        return self.kept

    def _refresh(self, due: Array) -> None:
        if not due.size:
            return
        at = self.layout
        kept = at.refresh.stop - at.refresh.start
        if kept:
            self.more[due, :kept] = self.x[due, at.observation]
        if self.config.asks_simulator:
            assert self.ask
            offsets = None
            if self.points is not None:
                known = self.x[due]
                known[:, at.action] = 0.0
                offsets = self.points(known)
            self.more[due, kept:] = self.ask(due, offsets).reshape(len(due), -1)
        self.age[due] = 0

    def _rows(self, *given: Any) -> tuple[Any, ...]:
        rows = tuple(np.asarray(values) if self._host else values for values in given)
        if self.num_envs == 1 and rows[0].ndim == 1:
            rows = tuple(values[None] for values in rows)
        if not rows[0].shape == rows[1].shape == rows[2].shape == (self.num_envs, self.n):
            q, v, a = (tuple(np.shape(values)) for values in given)
            raise UsageError(
                f"delta: qpos {q}, qvel {v}, ctrl {a}; give the {self.n} operated joints of {self.num_envs} robots "
                "each, or make another loop for another number of robots: model.loop(num_envs)"
            )
        return rows
