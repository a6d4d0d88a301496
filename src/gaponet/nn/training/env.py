"""Training environment: simulations follow recorded motions.

The action is Δa, and the reward is a small position error.
"""

from __future__ import annotations

import json
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gaponet.base.arrays import Array, array_like, array_module, copy_array, zeros_like
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaLoop
from gaponet.nn.observation import History
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.config import RewardConfig
from gaponet.nn.training.playback import Playback, take_rows
from gaponet.nn.training.recorded_rows import RecordedRows
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition, longest_delay
from gaponet.sim.context import contexts
from gaponet.sysid.robot_rollouts import IMMOVABLE_ARMATURE

CRITIC_PREVIEW = (1, 2, 5, 10, 20)  # rows of the recording ahead that the critic observes
UNLIMITED = 10**9  # control periods of an episode


@dataclass(frozen=True)
class EnvOptions:
    """How many environments play recordings, for how long, and where."""

    num_envs: int
    """Simulations that run together."""
    episode_steps: int = UNLIMITED
    """Longest episode, control periods."""
    reward: RewardConfig = RewardConfig()  # noqa: RUF009
    """Scale and cap of the position error."""
    seed: int = 0
    """Seed of the recordings that are drawn."""
    nthread: int = 0
    """Threads of C MuJoCo; 0 for all cores."""
    device: str = "cpu"
    """cpu, where C MuJoCo steps, or a device of torch, where mujoco_warp steps."""


class DeltaEnv:
    """num_envs simulations; each follows one recording from a random row on.

    Observation groups: "actor" is x = [o_t | a_t]. "critic" has the recorded state, recorded
    positions and commands ahead, payload and rate. The actor observes the recorded state only with
    model.real_state or equation 1 as written (model.predictor_inputs), and then in a random half of
    the episodes. An environment never changes its payload, rate and gains. The end of a recording
    is a time-out, not a failure.

    Arrays are numpy's on device "cpu", where C MuJoCo steps. Elsewhere they are tensors on the
    device, and mujoco_warp steps (sim/warp.py).

    Attributes:
        rows: Recordings, and the condition of each environment, on the host.
        playback: Row of its recording that each environment has reached.
        ctrl, qpos, qvel: Recordings, (rows, n_free) rad, rad, rad/s.
        payload: Payload of each environment, (num_envs,) kg.
        nan_where_unobserved: 0, or NaN for joints whose positions were not recorded, (num_envs, n).
    """

    def __init__(
        self,
        sequences: ListOf[Sequence],
        robot: RobotSpec,
        config: ModelConfig,
        options: EnvOptions,
    ) -> None:
        """
        Args:
            sequences: Recordings with more rows than control periods of a held correction.

        Raises:
            UsageError: The recordings or the device do not fit.
        """
        self.robot = robot
        self.config = config
        self.options = options
        self.num_envs = options.num_envs
        self.num_actions = len(robot.operated)
        self.rng = np.random.default_rng(options.seed)
        rows = RecordedRows(sequences, robot, config.delta_hold + 1, options.num_envs)
        conditions = [rows.conditions[group] for group in rows.group]
        host_sim = _simulations(robot, rows, conditions, options.nthread)
        self.rows = rows
        self.sim: Any = _on_device(host_sim, options.device)

        place = self.sim.array
        self.ctrl = place(rows.ctrl)
        self.qpos = place(rows.qpos)
        self.qvel = place(rows.qvel)
        self.playback = Playback(place(rows.track), options.num_envs, place)
        payload = np.array([c.payload_mass for c in conditions], np.float32)
        self.payload = place(payload)
        self._condition_features = place(_condition_features(payload, conditions, config))
        unobserved = rows.unobserved[rows.group][:, rows.operated]
        self.nan_where_unobserved = place(np.where(unobserved, np.nan, 0).astype(np.float32))
        self._operated = place(rows.operated)
        self._preview = place(CRITIC_PREVIEW)
        self._low, self._high = place(host_sim.commands.range[rows.operated].T)
        self._target = zeros_like(self.sim.qpos, *host_sim.qpos.shape)
        # 1 where the actor observes the recorded state
        self._real_state_visible = zeros_like(self.playback.track, options.num_envs, 1)
        self._rewards = MeanReward()

        joint_limits = host_sim.commands.range[rows.operated]
        like = self.playback.recorded
        self.loop = DeltaLoop(config, joint_limits, options.num_envs, like=like)
        self._connect_inputs(conditions)
        self._history_rows = max(self.loop.history.depth, 1 + _delay_periods(host_sim, rows))
        self.reset()

    def _connect_inputs(self, conditions: list[Condition]) -> None:
        """Give the loop the inputs of the network that come from the simulator or the recording."""
        config = self.config
        options = self.options
        if config.needs_simulator:
            if options.device != "cpu":
                raise UsageError(
                    "--model.sensor-source fixed asks C MuJoCo: use --device cpu, not "
                    f"{options.device}"
                )
            self.oracle = ProbeOracle(
                self.robot, config, conditions, options.nthread, self.rows.locked
            )
        if config.context:
            loaded = config.context_is_loaded
            context = contexts(self.robot, conditions, options.nthread, loaded=loaded)
            self.loop.set_context(context)
        if config.needs_simulator or config.observes_real_state:
            self.loop.extra = self._extra_inputs

    def reset(self, ids: Any = slice(None)) -> None:
        """Restart environments at uniformly drawn recorded rows; ids on the host.

        The rows before are the history.
        """
        group = self.rows.group[ids]
        first, last = self.rows.sample(group, self.rng)
        row = self.rng.integers(first, last - self.config.delta_hold + 1)
        before = first[:, None] + History.rows_before(row - first, self._history_rows)
        self.playback.start(ids, row, first, last)
        row = self.sim.array(row)
        before = self.sim.array(before)  # (k, rows), newest first
        ids = ids if isinstance(ids, slice) else self.sim.array(ids)
        if self.config.observes_real_state:
            visible = (self.rng.random((len(group), 1)) < 0.5).astype(np.float32)
            self._real_state_visible[ids] = self.sim.array(visible)
        self.sim.reset(ids, self.qpos[row], self.qvel[row], past=self.ctrl[before])
        before = before[:, : self.loop.history.depth]
        self.loop.begin(
            ids,
            self.qpos[before][..., self._operated],
            self.qvel[before][..., self._operated],
            self.ctrl[before][..., self._operated],
        )

    def get_observations(self) -> dict[str, torch.Tensor]:
        """Return the observations of actor and critic, float32."""
        n = self.num_actions
        recorded = self.playback.recorded
        q = self.sim.qpos[:, self._operated]
        v = self.sim.qvel[:, self._operated]
        actor = copy_array(self.loop.observe(q, v, recorded[:, 2 * n :], self.payload))
        ahead = self.playback.ahead(self._preview)  # (num_envs, rows ahead, 3n)
        # Relative to the simulation: an error of 5 mrad is hard to see in angles that span a
        # radian.
        parts = [
            recorded[:, :n] - q,
            recorded[:, n : 2 * n] - v,
            (ahead[..., :n] - q[:, None]).reshape(len(q), -1),
            (ahead[..., 2 * n :] - q[:, None]).reshape(len(q), -1),
            self._condition_features,
        ]
        critic = _float32(array_module(ahead).concatenate(parts, 1))
        return {"actor": torch.as_tensor(actor), "critic": torch.as_tensor(critic)}

    def _extra_inputs(self) -> Any:
        """Return the columns of x after [o_t | a_t] (nn/observation.py), (num_envs, …)."""
        sim = self.sim
        concatenate = array_module(self.playback.recorded).concatenate
        parts = []
        if self.config.needs_simulator:
            parts.append(self.oracle(sim.qpos, sim.qvel).reshape(self.num_envs, -1))
        if self.config.observes_real_state:
            q = sim.qpos[:, self._operated]
            v = sim.qvel[:, self._operated]
            recorded_state = self.playback.recorded[:, : 2 * self.num_actions]
            difference = recorded_state - concatenate([q, v], 1)
            visible = self._real_state_visible
            parts.append(concatenate([difference, visible], 1) * visible)
        return concatenate(parts, 1)

    def step(self, delta: Any) -> tuple[Any, Any]:
        """Correct targets for delta_hold control periods, and reset environments that have ended.

        Args:
            delta: Corrections, (num_envs, n) rad, numpy or torch.

        Returns:
            Mean reward of each joint, (num_envs, n), and the mask of the environments that were
            reset, (num_envs,).
        """
        delta = self.sim.array(delta).clip(-self.config.delta_max, self.config.delta_max)
        hold = self.config.delta_hold
        reward = 0.0
        for _ in range(hold):
            self.advance(delta)
            reward = reward + self._reward()
        return reward / hold, self.sim.array(self.restart())

    def restart(self) -> Array:
        """Reset the environments whose recording or time has ended.

        Return their mask, (num_envs,), on the host.
        """
        done = self.playback.ended(self.config.delta_hold, self.options.episode_steps)
        if done.any():
            self.reset(np.flatnonzero(done))
        return done

    def advance(self, delta: Any) -> None:
        """Step all simulations by one control period, without reward or reset.

        delta: (num_envs, n) rad.
        """
        operated = self._operated
        sim = self.sim
        target = self._target
        target[:] = take_rows(self.ctrl, self.playback.row_on_device)
        corrected = target[:, operated] + sim.array(delta)
        target[:, operated] = corrected.clip(self._low, self._high)
        self.loop.push(sim.qpos[:, operated], sim.qvel[:, operated], target[:, operated])
        sim.step(target)
        self.playback.advance()

    def _reward(self) -> Any:
        """Return minus the cost of each joint's position error, (num_envs, n) float32."""
        config = self.options.reward
        recorded = self.playback.recorded[:, : self.num_actions]
        error = abs(self.sim.qpos[:, self._operated] - recorded)
        cost = (error / config.position).clip(max=config.cap)
        cost = array_module(cost).nan_to_num(cost + self.nan_where_unobserved)
        reward = -cost
        self._rewards.add(reward)
        return _float32(reward)

    def mean_reward(self) -> float:
        """Return the mean reward per control period, environment and joint since the last call."""
        return self._rewards.take()

    # ---- checkpoint

    @property
    def rng_state(self) -> str:
        """State of the random numbers as JSON, because its integers have 128 bits."""
        return json.dumps(self.rng.bit_generator.state)

    @rng_state.setter
    def rng_state(self, text: str) -> None:
        self.rng.bit_generator.state = json.loads(text)

    def state(self) -> dict[str, Any]:
        """Return rows, simulations (with delayed commands), histories and random numbers."""
        arrays = dict(self.playback.state())
        arrays["frames"] = self.loop.history.frames
        arrays |= self.sim.state()
        if self.config.observes_real_state:
            arrays["shown"] = self._real_state_visible
        if self.loop.holds:
            arrays["age"] = self.loop.age
            arrays["x"] = self.loop.x
        return {
            "arrays": {name: torch.as_tensor(x).cpu().clone() for name, x in arrays.items()},
            "reward": self._rewards.state(),
            "rng": self.rng_state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a `state` of an environment with the same arguments."""
        arrays = {name: x.numpy() for name, x in state["arrays"].items()}
        self.playback.set_state(arrays)
        loop = self.loop
        loop.history.frames[:] = array_like(loop.history.frames, arrays["frames"])
        if loop.holds:
            loop.age[:] = array_like(loop.age, arrays["age"])
            loop.x[:] = array_like(loop.x, arrays["x"])
        if self.config.observes_real_state:
            self._real_state_visible[:] = array_like(self._real_state_visible, arrays["shown"])
        self.sim.set_state(arrays)
        self._rewards.set_state(state["reward"])
        self.rng_state = state["rng"]


class MeanReward:
    """Mean reward over periods, environments and joints. The sum may stay on the device."""

    def __init__(self) -> None:
        self._sum: Any = 0.0
        self._periods = 0

    def add(self, reward: Any) -> None:
        """Add a period, (num_envs, n)."""
        self._sum = self._sum + reward.mean()
        self._periods += 1

    def take(self) -> float:
        """Return the mean, 0 without a period, and start again."""
        mean = float(self._sum) / max(self._periods, 1)
        self._sum = 0.0
        self._periods = 0
        return mean

    def state(self) -> tuple[float, int]:
        """Return sum and number of periods."""
        return float(self._sum), self._periods

    def set_state(self, state: tuple[float, int]) -> None:
        """Restore a `state`."""
        self._sum, self._periods = state


def _simulations(
    robot: RobotSpec, rows: RecordedRows, conditions: list[Condition], nthread: int
) -> BatchSim:
    """Return the simulations in C MuJoCo.

    Joints without recorded positions stay where the recording says, as in identification.
    """
    sim = BatchSim(robot, conditions, nthread, rows.locked)
    if rows.unobserved.any():
        held = IMMOVABLE_ARMATURE * rows.unobserved[rows.group]
        sim.batch.expand("dof_armature")[:] += held
        if sim.servo_model is not None:
            sim.servo_model.servos.armature += held
            sim.servo_model.servos.terms["backlash"][held > 0] = 0.0
    return sim


def _on_device(sim: BatchSim, device: str) -> Any:
    """Return the simulations on a device."""
    if device == "cpu":
        return sim
    from gaponet.sim.warp import WarpSim

    return WarpSim(sim, device)


def _condition_features(payload: Array, conditions: list[Condition], config: ModelConfig) -> Array:
    """Return what the critic is told of payload and rate, about 1 at most, (num_envs, 2)."""
    rate = np.array([1 / c.dt for c in conditions], np.float32)  # Hz
    return np.stack([payload / config.payload_max, rate / 100], axis=1)


def _delay_periods(sim: BatchSim, rows: RecordedRows) -> int:
    """Return the longest delay of commands, control periods of the fastest recording."""
    shortest_dt = min(condition.dt for condition in rows.conditions)
    return int(np.ceil(longest_delay(sim.robot, rows.conditions) / shortest_dt))


def _float32(x: Any) -> Any:
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()
