"""Control loop around a network: history, held values and joint limits.

Training, rollouts, simulators and robots share it.

Arrays are numpy's or, if the loop's buffers are tensors, torch's. They have the operated joints,
(num_envs, n).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.arrays import Array, array_like, array_module, copy_array, zeros_like
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.nn.bound import AnswerBound
from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import History, Layout
from gaponet.nn.onnx_network import Network, OnnxNetwork
from gaponet.robot.spec import RobotSpec


class DeltaLoop:
    """Corrections for num_envs robots or simulations, each with its own history.

    Attributes:
        x: Input of the network, (num_envs, dim) float32; `observe` updates it.
        extra: Returns the columns of x after [o_t | a_t], (num_envs, k): the simulator's answers,
            then the recorded state's 2n + 1 numbers (nn/observation.py). Missing columns stay zero;
            all do if extra is None.
        held: The correction that is held, (num_envs, n) rad, or (n,) for one robot.
        age: Control periods since the start, (num_envs,).
        fresh: Robots without a history, (num_envs,).
    """

    def __init__(
        self,
        config: ModelConfig,
        qpos_range: Array,
        num_envs: int,
        network: Network | None = None,
        like: Any = None,
    ) -> None:
        """
        Args:
            qpos_range: Limits of the operated joints, (n, 2) rad.
            network: The model. Without one, call `observe` and `history.push` only, as in training.
            like: A float32 array or tensor. All buffers are of its kind and device; default numpy.
        """
        n = len(qpos_range)
        self.config = config
        self.n = n
        self.num_envs = num_envs
        layout = Layout(config, n)
        self.layout = layout
        if like is None:
            like = np.empty(0, np.float32)
        x = zeros_like(like, num_envs, layout.dim)
        self.x = x
        self.history = History(config, n, x)
        self._numpy = isinstance(x, np.ndarray)
        self._xp = array_module(x)
        # Internal arrays of one robot have one dimension: numpy needs half the time.
        shape = (n,) if num_envs == 1 else (num_envs, n)
        self._shapes = {shape, (num_envs, n)}
        rows = x[0] if num_envs == 1 else x
        self._q = rows[..., layout.q]
        self._v = rows[..., layout.v]
        self._action = rows[..., layout.action]
        self._payload = x[:, layout.payload.start] if config.payload_input else None
        self._bound = AnswerBound(config.delta_max)
        self.answer = self._bind(network, shape)
        low, high = np.transpose(qpos_range)
        self.low = np.array(low, float) if self._numpy else x.new_tensor(low)
        self.high = np.array(high, float) if self._numpy else x.new_tensor(high)
        self._applied: Any = zeros_like(x, *shape)
        self.holds = config.holds
        self.age = zeros_like(x, num_envs)
        self.held: Any = zeros_like(x, *shape)
        self.extra: Callable[[], Any] | None = None
        self.fresh = np.ones(num_envs, bool)
        self.any_fresh = True

    @property
    def applied(self) -> Any:
        """Targets of the last period: ctrl + Δa within the joint limits, (num_envs, n) rad.

        Send these.
        """
        return self._applied.reshape(self.num_envs, self.n)

    @property
    def refused_answers(self) -> int:
        """Number of the network's answers that were not finite, for which no correction was used
        (nn/bound.py).
        """
        return self._bound.refused

    def set_context(self, context: Any) -> None:
        """Set the answers of each robot's simulator to fixed probes, (num_envs, 8n) or (8n) rad
        (sim/context.py).
        """
        if self._numpy:
            self.x[:, self.layout.context] = context
        else:
            self.x[:, self.layout.context] = array_like(self.x, context)

    # ---- history

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Delete the history of robots `ids`.

        At the next observation, their present frame is repeated as history.
        """
        self.fresh[ids] = True
        self.any_fresh = True

    def begin(self, ids: Array | slice, qpos: Any, qvel: Any, u: Any) -> None:
        """Set the history of robots `ids`: frames (k, depth, n), newest first, or (k, 1, n),
        repeated; rad, rad/s, rad.

        u: Applied targets.
        """
        self.history.reset(ids, qpos, qvel, u)
        if self.holds:
            self.age[ids] = 0
        if self.any_fresh:
            self.fresh[ids] = False
            self.any_fresh = bool(self.fresh.any())

    def push(self, qpos: Any, qvel: Any, u: Any) -> None:
        """End a control period: append the state before it and its target, (num_envs, n) each, to
        the history.
        """
        self.history.push(qpos, qvel, u)
        if self.holds:
            self.age += 1

    # ---- a control period

    def observe(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """Update x and return it. It is the loop's buffer: copy it to keep it.

        Args:
            qpos, qvel: Present state, (num_envs, n) rad, rad/s.
            ctrl: Target of the coming period, (num_envs, n) rad.
            payload_mass: kg, one number or (num_envs,).
        """
        if self.any_fresh:
            q = qpos.reshape(-1, 1, self.n)[self.fresh]
            v = qvel.reshape(-1, 1, self.n)[self.fresh]
            u = ctrl.reshape(-1, 1, self.n)[self.fresh]
            self.begin(self.fresh.copy(), q, v, u)
        if self.config.sensor_hold == 1:
            self._q[...] = qpos
            self._v[...] = qvel
            self.history.write()
        else:  # the sensor predictor's input is the observation of the last refresh
            due, column = self._due(self.config.sensor_hold)
            self._q[...] = self._xp.where(column, qpos, self._q)
            self._v[...] = self._xp.where(column, qvel, self._v)
            self.history.write(due)
        self._action[...] = ctrl
        if self._payload is not None:
            self._payload[...] = payload_mass / self.config.payload_max
        if self.extra is not None:
            due, _ = self._due(self.config.sensor_hold)
            if due.any():
                extra = self.extra()
                start = self.layout.query.stop
                self.x[due, start : start + extra.shape[1]] = extra[due]
        return self.x

    def delta(self, qpos: Any, qvel: Any, ctrl: Any, payload_mass: Any) -> Any:
        """Return the correction of the coming control period. Call this once per period.

        The history then contains ctrl + Δa as the target of this period, so apply that. A target
        that is not finite is replaced by the last applied one: `applied` is finite, while ctrl + Δa
        is not.

        Args:
            qpos, qvel: Present state, (num_envs, n) or, for one robot, (n,); rad, rad/s.
            ctrl: Target of the coming period, same shape, rad.
            payload_mass: kg, one number or (num_envs,).

        Returns:
            Δa, shape of ctrl, rad. It is within ±delta_max of the model, and ctrl + Δa is within
            the joint limits. Where the network's answer is not finite, it is zero.

        Raises:
            UsageError: Arrays have another shape.
        """
        if self._numpy:
            qpos = np.asarray(qpos)
            qvel = np.asarray(qvel)
            ctrl = np.asarray(ctrl)
        if not qpos.shape == qvel.shape == ctrl.shape or ctrl.shape not in self._shapes:
            raise UsageError(
                f"delta: qpos {tuple(qpos.shape)}, qvel {tuple(qvel.shape)}, ctrl "
                f"{tuple(ctrl.shape)}; give the {self.n} operated joints of "
                f"{self.num_envs} robots each, or make another loop for another number of robots: "
                "model.loop(num_envs)"
            )
        # The fastest test for finite numbers.
        if not (self._numpy and np.vdot(ctrl, ctrl) < np.inf):
            ctrl = self._finite(qpos, ctrl)
        self.observe(qpos, qvel, ctrl, payload_mass)
        delta = self.answer()
        if self.config.delta_hold > 1:
            _, due = self._due(self.config.delta_hold)
            delta = self._xp.where(due, delta, self.held)
            self.held = delta
        applied = self._xp.minimum(self._xp.maximum(ctrl + delta, self.low), self.high)
        self._applied = applied
        if self.holds:
            self.push(qpos, qvel, applied)
        else:
            self.history.push(None, None, applied)
        return applied - ctrl

    def solve(
        self,
        qpos: Array,
        qvel: Array,
        wanted: Array,
        payload_mass: Array,
        offset: Array,
        gain: float,
        iterations: int,
    ) -> Array:
        """Invert the correction: return u with u + Δa(u) = wanted.

        Call this instead of `delta`, once per period.

        The fixed-point iteration is u ← u + gain (wanted − u − Δa(u)).

        Args:
            qpos, qvel, wanted: (num_envs, n) rad, rad/s, rad.
            payload_mass: (num_envs,) kg.
            offset: u − wanted of the last period, (num_envs, n) rad; changed in place to that of
                this period.
            gain: In (0, 1].
            iterations: Number of evaluations of the network.
        """
        self.observe(qpos, qvel, wanted, payload_mass)
        for _ in range(iterations):
            self._action[...] = wanted + offset
            offset -= gain * (offset + self.answer())
        self.push(qpos, qvel, wanted)
        result: Array = wanted + offset
        return result

    # ---- internals

    def _bind(self, network: Network | None, shape: tuple[int, ...]) -> Callable[[], Any]:
        """Return a function without arguments: present x → Δa of this shape, rad, finite and
        within ±delta_max.
        """
        if network is None:
            return partial(zeros_like, self.x, *shape)
        bound = self._bound
        if isinstance(network, OnnxNetwork):
            evaluate = network.bind(self.x, shape)
            return lambda: bound(evaluate())
        return lambda: bound(network(self.x).reshape(shape))

    def _finite(self, qpos: Any, ctrl: Any) -> Any:
        """Replace targets that are not finite by the last applied ones, or by the positions of
        robots without history.

        Without this, the correction and the history would stay NaN.
        """
        rows = ctrl.reshape(-1, self.n)
        last = copy_array(self.history.frames[:, 0, 2 * self.n :])
        if self.any_fresh:
            last[self.fresh] = qpos.reshape(-1, self.n)[self.fresh]
        return self._xp.where(self._xp.isfinite(rows), rows, last).reshape(ctrl.shape)

    def _due(self, hold: int) -> tuple[Any, Any]:
        """Return the mask of robots at a multiple of `hold` control periods, (num_envs,), and the
        mask for joints.
        """
        due = self.age % hold == 0
        return due, due if self.num_envs == 1 else due[:, None]


class DeltaCorrector:
    """Corrections in rollouts of sim.replay: target → target + Δa, within the joint range.

    One loop per rollout.
    """

    def __init__(self, network: Network, config: ModelConfig, robot: RobotSpec) -> None:
        self.network = network
        self.config = config
        self.robot = robot
        self.operated = robot.operated_index
        self.loop: DeltaLoop | None = None
        self.payload = np.zeros(0, np.float32)
        self._state: tuple[Array, Array] | None = None

    def reset(self, start: ListOf[Sequence]) -> None:
        """Start one simulation per sequence at its first row. That row is repeated as history."""
        from gaponet.sim.batch import Condition
        from gaponet.sim.context import contexts

        loop = DeltaLoop(
            self.config, self.robot.qpos_range[self.operated], len(start), self.network
        )
        self.payload = np.array([sequence.meta.payload_mass for sequence in start], np.float32)
        conditions = [Condition.of(sequence, self.robot) for sequence in start]
        if self.config.context:
            loop.set_context(contexts(self.robot, conditions, loaded=self.config.context_is_loaded))
        if self.config.needs_simulator:
            from gaponet.nn.sensor import ProbeOracle

            oracle = ProbeOracle(self.robot, self.config, conditions)

            def answers() -> Array:
                assert self._state is not None
                return oracle(*self._state).reshape(len(start), -1)

            loop.extra = answers
        self.loop = loop

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Return corrected targets, (k, n_all) rad."""
        assert self.loop is not None
        op = self.operated
        self._state = (qpos, qvel)
        self.loop.delta(qpos[:, op], qvel[:, op], target[:, op], self.payload)
        corrected = np.array(target, float)
        corrected[:, op] = self.loop.applied
        return corrected
