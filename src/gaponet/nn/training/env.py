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

from gaponet.base.arrays import Array, array_module, float32, zeros_like
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence, is_same_rate
from gaponet.nn.config import ModelConfig
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.config import RewardConfig
from gaponet.nn.training.observations import Observations
from gaponet.nn.training.playback import Playback
from gaponet.nn.training.recorded_rows import EnvGroups, RecordedRows
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, longest_delay
from gaponet.sim.context import contexts
from gaponet.sysid.robot_rollouts import IMMOVABLE_ARMATURE

UNLIMITED = float("inf")  # s of an episode


@dataclass(frozen=True)
class EnvOptions:
    """How many environments play recordings, for how long, and where."""

    num_envs: int
    """Simulations that run together."""
    episode_s: float = UNLIMITED
    """Longest episode, s."""
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

    The action is a correction of the recorded targets, and the reward of a joint is a small
    position error one control period later. An environment never changes its payload, rate and
    gains. The end of a recording is a time-out, not a failure.

    Arrays are numpy's on device "cpu", where C MuJoCo steps. Elsewhere they are tensors on the
    device, and mujoco_warp steps (sim/warp.py).

    Attributes:
        rows: Recordings, on the host.
        groups: Which environment plays which recordings; payload, rate and gains of each.
        sim: Simulations.
        playback: Row of its recording that each environment has reached.
        observations: What actor and critic observe.
        reward: Reward of the joints.
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
        rows = RecordedRows(sequences, robot, min_rows=config.delta_hold + 1)
        groups = EnvGroups(sequences, robot, rows, options.num_envs)
        self.rows = rows
        self.groups = groups
        sim = _simulations(robot, rows, groups, options.nthread)
        self.sim: Any = _on_device(sim, options.device)
        to_device = self.sim.array
        past_rows = max(config.history_depth, 1 + _delay_periods(robot, groups))
        self.playback = Playback(rows, options.num_envs, past_rows, to_device)
        self.observations = Observations(
            config, self.sim, self.playback, groups.conditions_of_envs, self._oracle()
        )
        if config.context:
            self.observations.network_input.set_context(self._context())
        self._longest_episode = _episode_periods(options.episode_s, groups)[groups.of_env]
        unobserved = groups.unobserved[groups.of_env][:, rows.operated]
        self.reward = PositionReward(options.reward, to_device(_nan_where(unobserved)))
        self.reset()

    def _oracle(self) -> ProbeOracle | None:
        """Return the simulator's answers to probes, for a network that observes them."""
        if not self.config.needs_simulator:
            return None
        options = self.options
        if options.device != "cpu":
            raise UsageError(
                f"--model.sensor-source fixed asks C MuJoCo: use --device cpu, not {options.device}"
            )
        conditions = self.groups.conditions_of_envs
        return ProbeOracle(self.robot, self.config, conditions, options.nthread, self.rows.locked)

    def _context(self) -> Array:
        """Return the simulators' answers to fixed probes at rest, (num_envs, 8n) rad."""
        conditions = self.groups.conditions_of_envs
        loaded = self.config.context_is_loaded
        return contexts(self.robot, conditions, self.options.nthread, loaded=loaded)

    def reset(self, ids: Any = slice(None)) -> None:
        """Restart environments at uniformly drawn recorded rows; ids on the host.

        The rows before are the history.
        """
        first, last = self.groups.sample(self.groups.of_env[ids], self.rng)
        row = self.rng.integers(first, last - self.config.delta_hold + 1)
        self.playback.start(ids, row, first, last)
        before = self.playback.rows_before(ids)  # (k, rows), newest first

        on_device = ids if isinstance(ids, slice) else self.sim.array(ids)
        row_on_device = self.sim.array(row)
        recorded = self.playback.rows
        qpos = recorded.qpos[row_on_device]
        qvel = recorded.qvel[row_on_device]
        self.sim.reset(on_device, qpos, qvel, past=recorded.ctrl[before])
        self.observations.reset(on_device, before, self.rng)

    def get_observations(self) -> dict[str, torch.Tensor]:
        """Return the observations of actor and critic, float32."""
        return self.observations.get()

    def step(self, delta: Any) -> tuple[Any, Any]:
        """Correct targets for delta_hold control periods, and reset environments that have ended.

        Args:
            delta: Corrections, (num_envs, n) rad, numpy or torch.

        Returns:
            Mean reward of each joint, (num_envs, n), and the mask of the environments that were
            reset, (num_envs,).
        """
        largest = self.config.delta_max
        hold = self.config.delta_hold
        delta = self.sim.array(delta).clip(-largest, largest)
        reward = 0.0
        for _ in range(hold):
            self.advance(delta)
            reward = reward + self._rewards()
        done = self.restart()
        return reward / hold, self.sim.array(done)

    def advance(self, delta: Any) -> None:
        """Step all simulations by one control period, without reward or reset.

        delta: (num_envs, n) rad.
        """
        sim = self.sim
        op = self.playback.rows.operated
        target = self._targets(delta)
        network_input = self.observations.network_input
        network_input.push(sim.qpos[:, op], sim.qvel[:, op], target[:, op])
        sim.step(target)
        self.playback.advance()

    def restart(self) -> Array:
        """Reset the environments that have ended.

        Return their mask, (num_envs,), on the host.
        """
        done = self._dones()
        if done.any():
            self.reset(np.flatnonzero(done))
        return done

    def _targets(self, delta: Any) -> Any:
        """Return the recorded targets, corrected within the joint limits, (num_envs, n_free)
        rad.
        """
        op = self.playback.rows.operated
        low, high = self.sim.commands.range[op].T
        target = zeros_like(self.sim.qpos, *self.sim.qpos.shape)  # float32 on a device
        target[:] = self.playback.commanded()
        corrected = target[:, op] + self.sim.array(delta)
        target[:, op] = corrected.clip(low, high)
        return target

    def _rewards(self) -> Any:
        """Return the reward of each joint in the last control period, (num_envs, n) float32."""
        q = self.sim.qpos[:, self.playback.rows.operated]
        recorded_q = self.playback.recorded[:, : self.num_actions]
        return self.reward(q, recorded_q)

    def _dones(self) -> Array:
        """Return the environments whose recording or time has ended, (num_envs,), on the host."""
        return self.playback.ended(self.config.delta_hold, self._longest_episode)

    # ---- checkpoint

    def rng_state(self) -> str:
        """Return the state of the random numbers as JSON, because its integers have 128 bits."""
        return json.dumps(self.rng.bit_generator.state)

    def set_rng_state(self, text: str) -> None:
        """Restore an `rng_state`."""
        self.rng.bit_generator.state = json.loads(text)

    def state(self) -> dict[str, Any]:
        """Return rows, simulations (with delayed commands), histories and random numbers."""
        arrays = self.playback.state() | self.observations.state() | self.sim.state()
        return {
            "arrays": {name: torch.as_tensor(x).cpu().clone() for name, x in arrays.items()},
            "reward": self.reward.state(),
            "rng": self.rng_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a `state` of an environment with the same arguments."""
        arrays = {name: x.numpy() for name, x in state["arrays"].items()}
        self.playback.set_state(arrays)
        self.observations.set_state(arrays)
        self.sim.set_state(arrays)
        self.reward.set_state(state["reward"])
        self.set_rng_state(state["rng"])


class PositionReward:
    """Reward of each joint: minus its position error, in units of config.position, up to
    config.cap.

    It keeps the sum of the rewards since the last `take_mean`, which may stay on the device.

    Attributes:
        nan_where_unobserved: 0, or NaN for joints whose positions were not recorded, (num_envs, n).
            Their reward is zero, and pre-training has no labels for them.
    """

    def __init__(self, config: RewardConfig, nan_where_unobserved: Any) -> None:
        self.config = config
        self.nan_where_unobserved = nan_where_unobserved
        self._sum: Any = 0.0
        self._periods = 0

    def __call__(self, qpos: Any, recorded: Any) -> Any:
        """Return the reward of a control period, (num_envs, n) float32.

        Args:
            qpos: Simulated positions, (num_envs, n) rad.
            recorded: Recorded ones.
        """
        error = abs(qpos - recorded)
        cost = (error / self.config.position).clip(max=self.config.cap)
        cost = array_module(cost).nan_to_num(cost + self.nan_where_unobserved)
        reward = -cost
        self._sum = self._sum + reward.mean()
        self._periods += 1
        return float32(reward)

    def take_mean(self) -> float:
        """Return the mean reward per control period, environment and joint since the last call, 0
        without a period.
        """
        mean = float(self._sum) / max(self._periods, 1)
        self._sum = 0.0
        self._periods = 0
        return mean

    def state(self) -> tuple[float, int]:
        """Return sum and number of periods, for a checkpoint: numbers, and tensors on the CPU."""
        return float(self._sum), self._periods

    def set_state(self, state: tuple[float, int]) -> None:
        """Restore a `state`."""
        self._sum, self._periods = state


def _simulations(robot: RobotSpec, rows: RecordedRows, groups: EnvGroups, nthread: int) -> BatchSim:
    """Return the simulations in C MuJoCo.

    Joints without recorded positions stay where the recording says, as in identification: their
    armature is so large that nothing moves them. Backlash would part it from the link.
    """
    sim = BatchSim(robot, groups.conditions_of_envs, nthread, rows.locked)
    if groups.unobserved.any():
        held = IMMOVABLE_ARMATURE * groups.unobserved[groups.of_env]
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


def _delay_periods(robot: RobotSpec, groups: EnvGroups) -> int:
    """Return the longest delay of commands, control periods of the fastest recording."""
    shortest_dt = min(condition.dt for condition in groups.conditions)
    return int(np.ceil(longest_delay(robot, groups.conditions) / shortest_dt))


def _episode_periods(episode_s: float, groups: EnvGroups) -> Array:
    """Return the control periods of the longest episode of each group, (groups,); nearly equal
    rates have as many.
    """
    first_dt = groups.conditions[0].dt
    periods = []
    for condition in groups.conditions:
        dt = first_dt if is_same_rate(condition.dt, first_dt) else condition.dt
        periods.append(np.rint(episode_s / dt))
    return np.array(periods)


def _nan_where(mask: Array) -> Array:
    """Return NaN where the mask is true, else 0, float32."""
    return np.where(mask, np.nan, 0).astype(np.float32)
