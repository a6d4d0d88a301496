"""Training environment: simulations follow recorded motions; the action is Δa, the reward is a small position error."""

from __future__ import annotations

import json
from collections.abc import Sequence as ListOf
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
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.context import contexts
from gaponet.sim.replay import idle_limbs
from gaponet.sysid.robot_rollouts import IMMOVABLE_ARMATURE

COUNTERS = ("row", "first", "last", "elapsed")  # per environment, in checkpoints
CRITIC_PREVIEW = (1, 2, 5, 10, 20)  # rows of the recording ahead that the critic observes


class RecordedRows:
    """Recordings as arrays of rows, and their assignment to environments. All arrays are numpy's.

    Environments are divided into groups in proportion to the recorded rows. A group has one payload, rate, gains and
    set of recorded joints.

    Attributes:
        locked: Joints of limbs that no recording commands; they are clamped at home.
        operated: Operated joints among those that are not locked, (n,).
        ctrl, qpos, qvel: Joints that are not locked, (rows, n_free) rad, rad, rad/s.
        track: [q | q̇ | a] of the operated joints, (rows, 3n) float32.
        first, last: First and last row of each recording.
        conditions, unobserved: Condition of each group, and the joints without recorded positions, (groups, n_free).
        group: Group of each environment, (num_envs,).
    """

    def __init__(
        self, sequences: ListOf[Sequence], robot: RobotSpec, min_rows: int, num_envs: int
    ) -> None:
        """
        Args:
            min_rows: Least number of rows of a recording.

        Raises:
            UsageError: No recording, a recording that is too short, or fewer environments than groups.
        """
        if not sequences:
            raise UsageError("no sequences to train on; the split left the training set empty")
        self.locked = idle_limbs(sequences, robot)
        free = [j for j in robot.joint_names if j not in self.locked]
        self.operated = np.array([free.index(j) for j in robot.operated])
        self.ctrl, self.qpos, self.qvel = (
            np.ascontiguousarray(
                np.concatenate([getattr(s, name)[:, robot.index(free)] for s in sequences])
            )
            for name in ("ctrl", "qpos", "qvel")
        )
        operated = [x[:, self.operated] for x in (self.qpos, self.qvel, self.ctrl)]
        self.track = np.ascontiguousarray(
            np.concatenate(operated, axis=1), np.float32
        )  # take() copies anything else
        length = np.array([len(s) for s in sequences])
        if length.min() < min_rows:
            short = sequences[int(length.argmin())]
            raise UsageError(
                f"motion {short.meta.motion} has {len(short)} of the {min_rows} rows that a step needs: drop the motion"
            )
        self.last = np.cumsum(length) - 1
        self.first = self.last - length + 1
        keys = [(Condition.of(s, robot), s.meta.unrecorded) for s in sequences]
        groups = list(dict.fromkeys(keys))
        sequence_group = np.array([groups.index(k) for k in keys])
        self.conditions = [condition for condition, _ in groups]
        self.unobserved = np.array([[j in unrecorded for j in free] for _, unrecorded in groups])
        rows = np.bincount(sequence_group, length)
        if num_envs < len(rows):
            raise UsageError(
                f"{num_envs} environments for {len(rows)} conditions of payload, rate and gains; use more"
            )
        quota = np.cumsum(rows) / rows.sum() * num_envs
        self.group = np.searchsorted(quota, np.arange(num_envs) + 0.5).astype(int)
        # Recordings by group, and the group number plus the cumulative share of rows in the group.
        members = [np.flatnonzero(sequence_group == g) for g in range(len(rows))]
        shares = [np.cumsum(length[m] / length[m].sum()) for m in members]
        self._members = np.concatenate(members)
        self._cumulative = np.concatenate([g + s / s[-1] for g, s in enumerate(shares)])

    def sample(self, group: Array, rng: Any) -> tuple[Array, Array]:
        """Draw a recording for each of these groups, in proportion to its rows; return its first and last row, (k,)."""
        drawn = np.minimum(
            group + rng.random(len(group)), np.nextafter(group + 1.0, 0.0)
        )  # stay in the group
        sequence = self._members[np.searchsorted(self._cumulative, drawn, side="right")]
        return self.first[sequence], self.last[sequence]


class DeltaEnv:
    """num_envs simulations; each follows one recording from a random row on.

    Observation groups: "actor" is x = [o_t | a_t]. "critic" has the recorded state, recorded positions and commands
    ahead, payload and rate. The actor observes the recorded state only with model.real_state or equation 1 as written
    (model.predictor_inputs), and then in a random half of the episodes. An environment never changes its payload, rate
    and gains. The end of a recording is a time-out, not a failure.

    Arrays are numpy's on device "cpu", where C MuJoCo steps. Elsewhere they are tensors on the device, and
    mujoco_warp steps (sim/warp.py).

    Attributes:
        row, first, last: Present, first and last row of each environment's recording, (num_envs,), on the host.
        elapsed: Control periods since the reset, (num_envs,), on the host.
        row_on_device, last_on_device: Copies of row and last on the device: a step needs no transfer.
        recorded: Present row of track, (num_envs, 3n).
        nan_where_unobserved: 0, or NaN for joints whose positions were not recorded, (num_envs, n).
    """

    def __init__(
        self,
        sequences: ListOf[Sequence],
        robot: RobotSpec,
        config: ModelConfig,
        num_envs: int,
        episode_steps: int,
        reward: RewardConfig,
        seed: int = 0,
        nthread: int = 0,
        device: str = "cpu",
    ) -> None:
        """
        Args:
            sequences: Recordings with more rows than control periods of a held correction.
            episode_steps: Longest episode, control periods.
            nthread: Threads of C MuJoCo; 0 for all cores.

        Raises:
            UsageError: The recordings or the device do not fit.
        """
        self.robot, self.config, self.reward_config, self.num_envs = robot, config, reward, num_envs
        self.num_actions = len(robot.operated)
        self.max_episode_length = episode_steps
        self.rng = np.random.default_rng(seed)
        self.rows = rows = RecordedRows(sequences, robot, config.delta_hold + 1, num_envs)
        conditions = [rows.conditions[g] for g in rows.group]
        sim = BatchSim(robot, conditions, nthread, rows.locked)
        # these joints stay where the recording says, as in identification
        if rows.unobserved.any():
            held = IMMOVABLE_ARMATURE * rows.unobserved[rows.group]
            sim.batch.expand("dof_armature")[:] += held
            if sim.servo_model is not None:
                sim.servo_model.armature += held
                sim.servo_model.values["backlash"][held > 0] = 0.0
        self.sim: Any = sim
        if device != "cpu":
            from gaponet.sim.warp import WarpSim

            self.sim = WarpSim(sim, device)
        place = self.sim.array
        self.ctrl, self.qpos, self.qvel, self.track = map(
            place, (rows.ctrl, rows.qpos, rows.qvel, rows.track)
        )
        payload = np.array([c[0] for c in conditions], np.float32)
        rate = np.array([1 / c[2] for c in conditions], np.float32)
        self.payload = place(payload)
        self.condition_features = place(
            np.stack([payload / config.payload_max, rate / 100], axis=1)
        )
        unobserved = rows.unobserved[rows.group][:, rows.operated]
        self.nan_where_unobserved = place(np.where(unobserved, np.nan, 0).astype(np.float32))
        self.operated, self.preview = place(rows.operated), place(CRITIC_PREVIEW)
        self.low, self.high = place(sim.range[rows.operated].T)
        self.row, self.first, self.last, self.elapsed = (
            np.zeros(num_envs, np.int64) for _ in COUNTERS
        )
        self.row_on_device, self.last_on_device = (
            copy_array(place(x)) for x in (self.row, self.last)
        )
        self.recorded = zeros_like(self.track, num_envs, self.track.shape[1])
        self.target = zeros_like(self.sim.qpos, *sim.qpos.shape)
        self.real_state_visible = zeros_like(
            self.track, num_envs, 1
        )  # 1 where the actor observes the recorded state
        self.loop = DeltaLoop(config, sim.range[rows.operated], num_envs, like=self.recorded)
        if config.needs_simulator:
            if device != "cpu":
                raise UsageError(
                    f"--model.sensor-source fixed asks C MuJoCo: use --device cpu, not {device}"
                )
            self.oracle = ProbeOracle(robot, config, conditions, nthread, rows.locked)
        if config.context:
            self.loop.set_context(
                contexts(robot, conditions, nthread, loaded=config.context_is_loaded)
            )
        if config.needs_simulator or config.observes_real_state:
            self.loop.extra = self._extra_inputs
        max_delay_periods = int(np.ceil(sim.longest_delay / min(c[2] for c in rows.conditions)))
        self.depth = max(
            self.loop.history.depth, 1 + max_delay_periods
        )  # rows before the start that are used
        self.reward_sum, self.reward_count = 0.0, 0
        self.reset()

    def reset(self, ids: Any = slice(None)) -> None:
        """Restart environments at uniformly drawn recorded rows, with the rows before as history; ids on the host."""
        group = self.rows.group[ids]
        first, last = self.rows.sample(group, self.rng)
        t = self.rng.integers(first, last - self.config.delta_hold + 1)
        before = first[:, None] + History.rows_before(t - first, self.depth)
        self.first[ids], self.last[ids], self.row[ids], self.elapsed[ids] = first, last, t, 0
        t, last, before = (self.sim.array(x) for x in (t, last, before))
        ids = ids if isinstance(ids, slice) else self.sim.array(ids)
        self.row_on_device[ids], self.last_on_device[ids], self.recorded[ids] = (
            t,
            last,
            self.track[t],
        )
        if self.config.observes_real_state:
            visible = (self.rng.random((len(group), 1)) < 0.5).astype(np.float32)
            self.real_state_visible[ids] = self.sim.array(visible)
        self.sim.reset(ids, self.qpos[t], self.qvel[t], past=self.ctrl[before])
        before = before[:, : self.loop.history.depth]
        self.loop.begin(
            ids, *(x[before][..., self.operated] for x in (self.qpos, self.qvel, self.ctrl))
        )

    def get_observations(self) -> dict[str, torch.Tensor]:
        """Return the observations of actor and critic, float32."""
        n, sim = self.num_actions, self.sim
        q, v = sim.qpos[:, self.operated], sim.qvel[:, self.operated]
        actor = copy_array(self.loop.observe(q, v, self.recorded[:, 2 * n :], self.payload))
        rows = array_module(self.row_on_device).minimum(
            self.row_on_device[:, None] + self.preview, self.last_on_device[:, None]
        )
        ahead = _take(self.track, rows)  # (num_envs, rows ahead, 3n)
        # Relative to the simulation: an error of 5 mrad is hard to see in angles that span a radian.
        parts = [
            self.recorded[:, :n] - q,
            self.recorded[:, n : 2 * n] - v,
            (ahead[..., :n] - q[:, None]).reshape(len(q), -1),
            (ahead[..., 2 * n :] - q[:, None]).reshape(len(q), -1),
            self.condition_features,
        ]
        critic = _float32(array_module(ahead).concatenate(parts, 1))
        return {"actor": torch.as_tensor(actor), "critic": torch.as_tensor(critic)}

    def _extra_inputs(self) -> Any:
        """Return the columns of x after [o_t | a_t] (nn/observation.py), (num_envs, …)."""
        sim, concatenate, parts = self.sim, array_module(self.recorded).concatenate, []
        if self.config.needs_simulator:
            parts.append(self.oracle(sim.qpos, sim.qvel).reshape(self.num_envs, -1))
        if self.config.observes_real_state:
            state = concatenate([sim.qpos[:, self.operated], sim.qvel[:, self.operated]], 1)
            difference = self.recorded[:, : 2 * self.num_actions] - state
            parts.append(
                concatenate([difference, self.real_state_visible], 1) * self.real_state_visible
            )
        return concatenate(parts, 1)

    def step(self, delta: Any) -> tuple[Any, Any]:
        """Correct targets for delta_hold control periods, and reset environments that have ended.

        Args:
            delta: Corrections, (num_envs, n) rad, numpy or torch.

        Returns:
            Mean reward of each joint, (num_envs, n), and the mask of the environments that were reset, (num_envs,).
        """
        delta = self.sim.array(delta).clip(-self.config.delta_max, self.config.delta_max)
        hold, reward = self.config.delta_hold, 0.0
        for _ in range(hold):
            self.advance(delta)
            reward = reward + self._reward()
        return reward / hold, self.sim.array(self.restart())

    def restart(self) -> Array:
        """Reset the environments whose recording or time has ended. Return their mask, (num_envs,), on the host."""
        done = (self.row > self.last - self.config.delta_hold) | (
            self.elapsed >= self.max_episode_length
        )
        if done.any():
            self.reset(np.flatnonzero(done))
        return done

    def advance(self, delta: Any) -> None:
        """Step all simulations by one control period, without reward or reset; delta (num_envs, n) rad."""
        operated, sim, target = self.operated, self.sim, self.target
        target[:] = _take(self.ctrl, self.row_on_device)
        target[:, operated] = (target[:, operated] + sim.array(delta)).clip(self.low, self.high)
        self.loop.push(sim.qpos[:, operated], sim.qvel[:, operated], target[:, operated])
        sim.step(target)
        self.row += 1
        self.elapsed += 1
        self.row_on_device += 1
        _take(self.track, self.row_on_device, out=self.recorded)

    def _reward(self) -> Any:
        config, n = self.reward_config, self.num_actions
        error = abs(self.sim.qpos[:, self.operated] - self.recorded[:, :n])
        cost = (error / config.position).clip(max=config.cap)
        cost = array_module(cost).nan_to_num(cost + self.nan_where_unobserved)
        self.reward_sum = self.reward_sum - cost.mean()
        self.reward_count += 1
        return -_float32(cost)

    def mean_reward(self) -> float:
        """Return the mean reward per control period, environment and joint since the last call."""
        mean = float(self.reward_sum) / max(self.reward_count, 1)
        self.reward_sum, self.reward_count = 0.0, 0
        return mean

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
        arrays = {name: getattr(self, name) for name in COUNTERS} | {
            "frames": self.loop.history.frames
        }
        arrays |= self.sim.state()
        arrays |= {"shown": self.real_state_visible} if self.config.observes_real_state else {}
        arrays |= {"age": self.loop.age, "x": self.loop.x} if self.loop.holds else {}
        return {
            "arrays": {name: torch.as_tensor(x).cpu().clone() for name, x in arrays.items()},
            "reward": (float(self.reward_sum), self.reward_count),
            "rng": self.rng_state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a `state` of an environment with the same arguments."""
        arrays = {name: x.numpy() for name, x in state["arrays"].items()}
        for name in COUNTERS:
            getattr(self, name)[:] = arrays[name]
        self.row_on_device[:], self.last_on_device[:] = (
            self.sim.array(self.row),
            self.sim.array(self.last),
        )
        self.recorded[:] = self.track[self.row_on_device]
        self.loop.history.frames[:] = array_like(self.loop.history.frames, arrays["frames"])
        for name in ("age", "x") if self.loop.holds else ():
            getattr(self.loop, name)[:] = array_like(getattr(self.loop, name), arrays[name])
        if self.config.observes_real_state:
            self.real_state_visible[:] = array_like(self.real_state_visible, arrays["shown"])
        self.sim.set_state(arrays)
        self.reward_sum, self.reward_count = state["reward"]
        self.rng_state = state["rng"]


def _take(x: Any, rows: Any, out: Any = None) -> Any:
    """Return x[rows], written into out if that is given; rows (k,) then."""
    if isinstance(x, np.ndarray):
        return x.take(rows, axis=0, out=out)  # faster than an index
    return x[rows] if out is None else array_module(x).index_select(x, 0, rows, out=out)


def _float32(x: Any) -> Any:
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()
