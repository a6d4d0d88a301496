"""What the actor and the critic observe of the training environments."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gaponet.base.arrays import Array, array_like, array_module, copy_array, float32, zeros_like
from gaponet.nn.config import ModelConfig
from gaponet.nn.observation import NetworkInput
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.playback import Playback
from gaponet.sim.batch import Condition

CRITIC_PREVIEW = (1, 2, 5, 10, 20)  # rows of the recording ahead that the critic observes
VISIBLE_SHARE = 0.5  # of the episodes in which the actor observes the recorded state, if ever


class Observations:
    """Observation groups of the environments.

    "actor" is x = [o_t | a_t]. "critic" has the recorded state, recorded positions and commands
    ahead, payload and rate. The actor observes the recorded state only with model.real_state or
    equation 1 as written (model.predictor_inputs), and then in a random half of the episodes.

    Attributes:
        network_input: x of the actor, with its history.
        payload: Payload that the actor is told, (num_envs,) kg.
    """

    def __init__(
        self,
        config: ModelConfig,
        sim: Any,
        playback: Playback,
        conditions: list[Condition],
        oracle: ProbeOracle | None,
    ) -> None:
        """
        Args:
            sim: Simulations: a BatchSim or a WarpSim.
            conditions: Payload and rate of each simulation.
            oracle: Answers of the simulator, for a network that observes them.
        """
        self.config = config
        self._sim = sim
        self._playback = playback
        self._oracle = oracle
        num_envs, columns = playback.recorded.shape
        self._n = columns // 3  # of [q | q̇ | a]
        self.network_input = NetworkInput(config, self._n, num_envs, like=playback.recorded)
        if config.needs_simulator or config.observes_real_state:
            self.network_input.extra = self._extra_inputs
        payload = np.array([c.payload_mass for c in conditions], np.float32)
        self.payload = sim.array(payload)
        self._condition_features = sim.array(_condition_features(payload, conditions, config))
        self._preview = sim.array(CRITIC_PREVIEW)
        # 1 where the actor observes the recorded state
        self._real_state_visible = zeros_like(playback.recorded, num_envs, 1)

    def reset(self, ids: Any, before: Any, rng: np.random.Generator) -> None:
        """Start the history of k environments; arrays on the device.

        before: Rows of the recordings before the start, (k, depth) or more, newest first.
        """
        if self.config.observes_real_state:
            visible = rng.random((len(before), 1)) < VISIBLE_SHARE
            self._real_state_visible[ids] = self._sim.array(visible.astype(np.float32))
        rows = self._playback.rows
        op = rows.operated
        before = before[:, : self.network_input.history.depth]
        self.network_input.begin(
            ids, rows.qpos[before][..., op], rows.qvel[before][..., op], rows.ctrl[before][..., op]
        )

    def get(self) -> dict[str, torch.Tensor]:
        """Return the observations by group, (num_envs, …) float32."""
        q, v = self._state()
        actor = self._actor(q, v)
        critic = self._critic(q, v)
        return {"actor": torch.as_tensor(actor), "critic": torch.as_tensor(critic)}

    def _actor(self, q: Any, v: Any) -> Any:
        """Return x; q and v are the present state, (num_envs, n) rad, rad/s."""
        command = self._playback.recorded[:, 2 * self._n :]
        x = self.network_input.update(q, v, command, self.payload)
        return copy_array(x)

    def _critic(self, q: Any, v: Any) -> Any:
        """Return what the critic observes beside x.

        Positions are relative to the simulation: an error of 5 mrad is hard to see in angles that
        span a radian.
        """
        n = self._n
        recorded = self._playback.recorded
        ahead = self._playback.ahead(self._preview)  # (num_envs, rows ahead, 3n)
        parts = [
            recorded[:, :n] - q,
            recorded[:, n : 2 * n] - v,
            (ahead[..., :n] - q[:, None]).reshape(len(q), -1),
            (ahead[..., 2 * n :] - q[:, None]).reshape(len(q), -1),
            self._condition_features,
        ]
        return float32(array_module(ahead).concatenate(parts, 1))

    def _extra_inputs(self) -> Any:
        """Return the columns of x after [o_t | a_t] (nn/observation.py), (num_envs, …)."""
        recorded = self._playback.recorded
        concatenate = array_module(recorded).concatenate
        parts = []
        if self._oracle is not None:
            answers = self._oracle(self._sim.qpos, self._sim.qvel)
            parts.append(answers.reshape(len(answers), -1))
        if self.config.observes_real_state:
            difference = recorded[:, : 2 * self._n] - concatenate(self._state(), 1)
            visible = self._real_state_visible
            parts.append(concatenate([difference, visible], 1) * visible)
        return concatenate(parts, 1)

    def _state(self) -> tuple[Any, Any]:
        """Return positions and velocities of the operated joints, (num_envs, n) rad, rad/s."""
        op = self._playback.rows.operated
        return self._sim.qpos[:, op], self._sim.qvel[:, op]

    # ---- checkpoint

    def state(self) -> dict[str, Any]:
        """Return the histories, and which environments see the recorded state."""
        arrays = self.network_input.state()
        if self.config.observes_real_state:
            arrays["shown"] = self._real_state_visible
        return arrays

    def set_state(self, arrays: dict[str, Array]) -> None:
        """Restore a `state`."""
        self.network_input.set_state(arrays)
        if self.config.observes_real_state:
            self._real_state_visible[:] = array_like(self._real_state_visible, arrays["shown"])


def _condition_features(payload: Array, conditions: list[Condition], config: ModelConfig) -> Array:
    """Return what the critic is told of payload and rate, about 1 at most, (num_envs, 2)."""
    rate = np.array([1 / c.dt for c in conditions], np.float32)  # Hz
    return np.stack([payload / config.payload_max, rate / 100], axis=1)
