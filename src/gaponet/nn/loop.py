"""Control loop around a network: held corrections, joint limits and the bound of its answers.

Rollouts, simulators and robots share it. The network's input is that of training
(nn/observation.py).

Arrays are numpy's or, if the loop's buffers are tensors, torch's. They have the operated joints,
(num_envs, n).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from gaponet.base.arrays import Array, array_like, array_module, zeros_like
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.nn.bound import AnswerBound
from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import NetworkInput, per_joint
from gaponet.nn.onnx_network import Network, OnnxNetwork
from gaponet.robot.spec import RobotSpec


class DeltaLoop:
    """Corrections for num_envs robots or simulations, each with its own history.

    Attributes:
        network_input: Input of the network. Its `extra` gives the columns that a robot does not
            have by itself.
        held: The correction that is held, (num_envs, n) rad, or (n,) for one robot.
    """

    def __init__(
        self,
        config: ModelConfig,
        qpos_range: Array,
        num_envs: int,
        network: Network,
        like: Any = None,
    ) -> None:
        """
        Args:
            qpos_range: Limits of the operated joints, (n, 2) rad.
            network: The model.
            like: A float32 array or tensor. All buffers are of its kind and device; default numpy.
        """
        n = len(qpos_range)
        self.config = config
        self.n = n
        self.num_envs = num_envs
        self.network_input = NetworkInput(config, n, num_envs, like)
        x = self.network_input.x
        self._xp = array_module(x)
        # Internal arrays of one robot have one dimension: numpy needs half the time.
        shape = (n,) if num_envs == 1 else (num_envs, n)
        self._shapes = {shape, (num_envs, n)}
        self._bound = AnswerBound(config.delta_max)
        self._answer = self._bind(network, shape)
        low, high = np.transpose(qpos_range)
        self._low = array_like(x, np.array(low, float))
        self._high = array_like(x, np.array(high, float))
        self.held: Any = zeros_like(x, *shape)
        self._applied: Any = zeros_like(x, *shape)

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

    def reset(self, ids: Array | slice = slice(None)) -> None:
        """Delete the history of robots `ids`.

        At the next correction, their present frame is repeated as history.
        """
        self.network_input.reset(ids)

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
        numpy = self._xp is np
        if numpy:
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
        if not (numpy and np.vdot(ctrl, ctrl) < np.inf):
            ctrl = self._finite(qpos, ctrl)
        network_input = self.network_input
        network_input.update(qpos, qvel, ctrl, payload_mass)
        delta = self._answer()
        if self.config.delta_hold > 1:
            due = per_joint(network_input.due(self.config.delta_hold))
            delta = self._xp.where(due, delta, self.held)
            self.held = delta
        applied = self._xp.minimum(self._xp.maximum(ctrl + delta, self._low), self._high)
        self._applied = applied
        if network_input.age is None:
            network_input.push(None, None, applied)  # the state in x
        else:
            network_input.push(qpos, qvel, applied)
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
        self.network_input.update(qpos, qvel, wanted, payload_mass)
        for _ in range(iterations):
            self.network_input.action[...] = wanted + offset
            offset -= gain * (offset + self._answer())
        self.network_input.push(qpos, qvel, wanted)
        result: Array = wanted + offset
        return result

    def _bind(self, network: Network, shape: tuple[int, ...]) -> Callable[[], Any]:
        """Return a function without arguments: present x → Δa of this shape, rad, finite and
        within ±delta_max.
        """
        x = self.network_input.x
        bound = self._bound
        if isinstance(network, OnnxNetwork):
            evaluate = network.bind(x, shape)
            return lambda: bound(evaluate())
        return lambda: bound(network(x).reshape(shape))

    def _finite(self, qpos: Any, ctrl: Any) -> Any:
        """Replace targets that are not finite by the last applied ones, or by the positions of
        robots without history.

        Without this, the correction and the history would stay NaN.
        """
        rows = ctrl.reshape(-1, self.n)
        last = self.network_input.last_targets(qpos)
        return self._xp.where(self._xp.isfinite(rows), rows, last).reshape(ctrl.shape)


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
            loaded = self.config.context_is_loaded
            context = contexts(self.robot, conditions, loaded=loaded)
            loop.network_input.set_context(context)
        if self.config.needs_simulator:
            from gaponet.nn.sensor import ProbeOracle

            oracle = ProbeOracle(self.robot, self.config, conditions)

            def answers() -> Array:
                assert self._state is not None
                return oracle(*self._state).reshape(len(start), -1)

            loop.network_input.extra = answers
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
