"""The training environment: many simulations chase recorded motions; the action is Δa, the reward is staying close."""

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
from gaponet.sim.replay import idle_limbs
from gaponet.sysid.robot_rollouts import IMMOVABLE

ROWS = ("row", "first", "last", "elapsed")  # of each environment
AHEAD = (1, 2, 5, 10, 20)  # rows of the recording that the critic looks ahead


class DeltaEnv:
    """num_envs simulations, each following one recording from a random frame on.

    Observation groups: "actor" = x = [o_t | a_t]; "critic" = the recorded state now, recorded
    positions and commands to come, payload, rate (training only). The recorded state reaches the actor with
    model.real_state alone, in a random half of the episodes (`shown`). An
    environment keeps its payload, rate and gains for life, in proportion to the frames recorded under them. A motion's
    end is a time-out, not a failure.
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
        """Every sequence needs a row more than a correction is held; `episode_steps` counts control periods.

        On "cpu" C MuJoCo steps and arrays are numpy's; elsewhere mujoco_warp's (sim/warp.py), tensors that stay there.
        """
        if not sequences:
            raise UsageError("no sequences to train on; the split left the training set empty")
        self.robot, self.config, self.reward_config = robot, config, reward
        self.num_envs = num_envs
        self.num_actions = len(robot.operated)
        self.max_episode_length = episode_steps
        self.rng = np.random.default_rng(seed)
        self._load(sequences)
        conditions = [self.conditions[g] for g in self.group]
        sim = BatchSim(robot, conditions, nthread, self.locked)
        if self.unknown.any():  # stands where it was said to, as in identification
            sim.batch.expand("dof_armature")[:] += IMMOVABLE * self.unknown[self.group]
        self._place(sim, device)
        self.loop = DeltaLoop(config, sim.range[self.op], num_envs, of=self.now)
        if config.asks_simulator:
            if device != "cpu":
                raise UsageError(f"--model.sensor-source fixed asks C MuJoCo: use --device cpu, not {device}")
            self.oracle = ProbeOracle(robot, config, conditions, nthread, self.locked)
        if config.asks_simulator or config.real_state:
            self.loop.extra = self._extra
        shortest = min(c[2] for c in self.conditions)
        # Periods whose command a late servo has not met yet.
        under_way = 1 + int(np.ceil(self.sim.robot.delay.max() / shortest))
        self.depth = max(self.loop.history.depth, under_way)
        self.reward_sum, self.reward_count = 0.0, 0
        self.reset()

    def _load(self, sequences: ListOf[Sequence]) -> None:
        # Limbs that no command moves are clamped: on a fixed base they change nothing but the time it takes.
        self.locked = idle_limbs(sequences, self.robot)
        free = [j for j in self.robot.joint_names if j not in self.locked]
        self.op = np.array([free.index(j) for j in self.robot.operated])
        self.ctrl, self.qpos, self.qvel = (
            np.ascontiguousarray(np.concatenate([getattr(s, name)[:, self.robot.index(free)] for s in sequences]))
            for name in ("ctrl", "qpos", "qvel")
        )
        # What every step looks up, of the operated joints: [q | q̇ | a], one row per recorded row.
        recorded = [x[:, self.op] for x in (self.qpos, self.qvel, self.ctrl)]
        self.track = np.ascontiguousarray(np.concatenate(recorded, axis=1), np.float32)  # take() copies anything else
        length = np.array([len(s) for s in sequences])
        if length.min() <= self.config.delta_hold:
            short, needed = sequences[int(length.argmin())], self.config.delta_hold + 1
            raise UsageError(
                f"motion {short.meta.motion} has {len(short)} of the {needed} rows that a step needs: drop the motion"
            )
        self.seq_last = np.cumsum(length) - 1
        self.seq_first = self.seq_last - length + 1
        keys = [(Condition.of(s, self.robot), s.meta.unrecorded) for s in sequences]
        groups = list(dict.fromkeys(keys))
        seq_group = np.array([groups.index(k) for k in keys])
        self.conditions = [condition for condition, _ in groups]
        self.unknown = np.array([[j in unrecorded for j in free] for _, unrecorded in groups])
        frames = np.bincount(seq_group, length)
        if self.num_envs < len(frames):
            raise UsageError(
                f"{self.num_envs} environments for {len(frames)} conditions of payload, rate and gains; use more"
            )
        share = np.cumsum(frames) / frames.sum() * self.num_envs
        self.group = np.searchsorted(share, np.arange(self.num_envs) + 0.5).astype(int)
        # Sequences group by group, and where in its group, plus the group's number, the share of each ends.
        members = [np.flatnonzero(seq_group == g) for g in range(len(frames))]
        shares = [np.cumsum(length[m] / length[m].sum()) for m in members]
        self.members, self.ends = np.concatenate(members), np.concatenate([g + s / s[-1] for g, s in enumerate(shares)])
        self.payload = np.array([c[0] for c in self.conditions], np.float32)[self.group]
        rate = np.array([1 / c[2] for c in self.conditions], np.float32)[self.group]
        self.unsaid = np.where(self.unknown[self.group][:, self.op], np.nan, 0).astype(np.float32)  # counts nowhere
        self.condition_features = np.stack([self.payload / self.config.payload_max, rate / 100], axis=1)

    def _place(self, sim: BatchSim, device: str) -> None:
        """Put the simulations, and all that a step looks up or writes, on the device; in numpy nothing is copied."""
        self.sim: Any = sim
        if device != "cpu":
            from gaponet.sim.warp import WarpSim

            self.sim = WarpSim(sim, device)
        place, num = self.sim.array, self.num_envs
        for name in ("ctrl", "qpos", "qvel", "track", "payload", "condition_features", "unsaid"):
            setattr(self, name, place(getattr(self, name)))
        self.at, self.ahead = place(self.op), place(AHEAD)
        self.low, self.high = place(sim.range[self.op].T)
        # Of each simulation the row that it stands at, its recording's first and last, and periods since the reset: on
        # the host, which thus need not ask the device who ended; the row and the last are there as well.
        self.row, self.first, self.last, self.elapsed = (np.zeros(num, np.int64) for _ in ROWS)
        self.here, self.until = (copy_array(place(x)) for x in (self.row, self.last))
        self.now = zeros_like(self.track, num, self.track.shape[1])  # the recorded row, as in track
        self.target = zeros_like(self.sim.qpos, *sim.qpos.shape)
        self.shown = zeros_like(self.track, num, 1)  # 1 where the actor sees the recorded state

    def reset(self, ids: Any = slice(None)) -> None:
        """Put environments at uniformly drawn recorded frames, with the frames before as history; ids on the host."""
        group = self.group[ids]
        drawn = np.minimum(group + self.rng.random(len(group)), np.nextafter(group + 1.0, 0.0))  # in its group
        seq = self.members[np.searchsorted(self.ends, drawn, side="right")]
        first, last = self.seq_first[seq], self.seq_last[seq]
        t = self.rng.integers(first, last - self.config.delta_hold + 1)
        before = first[:, None] + History.rows_before(t - first, self.depth)
        self.first[ids], self.last[ids], self.row[ids], self.elapsed[ids] = first, last, t, 0
        t, last, before = (self.sim.array(x) for x in (t, last, before))
        ids = ids if isinstance(ids, slice) else self.sim.array(ids)
        self.here[ids], self.until[ids], self.now[ids] = t, last, self.track[t]
        if self.config.real_state:
            self.shown[ids] = self.sim.array((self.rng.random((len(group), 1)) < 0.5).astype(np.float32))
        self.sim.reset(ids, self.qpos[t], self.qvel[t], past=self.ctrl[before])
        before = before[:, : self.loop.history.depth]
        self.loop.begin(ids, *(x[before][..., self.at] for x in (self.qpos, self.qvel, self.ctrl)))

    def get_observations(self) -> dict[str, torch.Tensor]:
        """Actor and critic observations of the present row."""
        n, sim = self.num_actions, self.sim
        q, v = sim.qpos[:, self.at], sim.qvel[:, self.at]
        actor = copy_array(self.loop.observe(q, v, self.now[:, 2 * n :], self.payload))
        rows = array_module(self.here).minimum(self.here[:, None] + self.ahead, self.until[:, None])
        ahead = _rows_of(self.track, rows)  # (num_envs, rows ahead, 3n)
        # Relative to where the simulation stands: an error of 5 mrad is invisible in angles that span a radian.
        seen = [self.now[:, :n] - q, self.now[:, n : 2 * n] - v, (ahead[..., :n] - q[:, None]).reshape(len(q), -1),
                (ahead[..., 2 * n :] - q[:, None]).reshape(len(q), -1), self.condition_features]  # fmt: skip
        critic = _single(array_module(ahead).concatenate(seen, 1))
        return {"actor": torch.as_tensor(actor), "critic": torch.as_tensor(critic)}

    def _extra(self) -> Any:
        """What x holds behind [o_t | a_t] (nn/observation.py), (num_envs, …)."""
        sim, join, parts = self.sim, array_module(self.now).concatenate, []
        if self.config.asks_simulator:
            parts.append(self.oracle(sim.qpos, sim.qvel).reshape(self.num_envs, -1))
        if self.config.real_state:
            state = join([sim.qpos[:, self.at], sim.qvel[:, self.at]], 1)
            parts.append(join([self.now[:, : 2 * self.num_actions] - state, self.shown], 1) * self.shown)
        return join(parts, 1)

    def step(self, delta: Any) -> tuple[Any, Any]:
        """Correct targets for delta_hold control periods, and compare each with the recording one row on.

        Args:
            delta: (num_envs, n) rad, numpy or torch.

        Returns:
            Mean reward of each joint, (num_envs, n), and whose motion or time ended and who begins anew, (num_envs,);
            arrays of the simulator's kind.
        """
        delta = self.sim.array(delta).clip(-self.config.delta_max, self.config.delta_max)
        hold, reward = self.config.delta_hold, 0.0
        for _ in range(hold):
            self.advance(delta)
            reward = reward + self._reward()
        return reward / hold, self.sim.array(self.restart())

    def restart(self) -> Array:
        """Reset whose recording or time is over; returns whose, (num_envs,), on the host."""
        done = (self.row > self.last - self.config.delta_hold) | (self.elapsed >= self.max_episode_length)
        if done.any():
            self.reset(np.flatnonzero(done))
        return done

    def advance(self, delta: Any) -> None:
        """Step all simulations by one control period, without reward or reset; delta (num_envs, n_operated)."""
        at, n, target = self.at, self.sim, self.target
        target[:] = _rows_of(self.ctrl, self.here)
        target[:, at] = (target[:, at] + n.array(delta)).clip(self.low, self.high)
        self.loop.push(n.qpos[:, at], n.qvel[:, at], target[:, at])
        n.step(target)
        self.row += 1
        self.elapsed += 1
        self.here += 1
        _rows_of(self.track, self.here, out=self.now)

    def _reward(self) -> Any:
        c, n = self.reward_config, self.num_actions
        cost = (abs(self.sim.qpos[:, self.at] - self.now[:, :n]) / c.position).clip(max=c.cap)
        cost = array_module(cost).nan_to_num(cost + self.unsaid)
        self.reward_sum = self.reward_sum - cost.mean()
        self.reward_count += 1
        return -_single(cost)

    def mean_reward(self) -> float:
        """Per step, environment and joint since last asked."""
        mean = float(self.reward_sum) / max(self.reward_count, 1)
        self.reward_sum, self.reward_count = 0.0, 0
        return mean

    # ---- what a checkpoint holds

    @property
    def rng_state(self) -> str:
        """State of the random numbers; its integers have 128 bits."""
        return json.dumps(self.rng.bit_generator.state)

    @rng_state.setter
    def rng_state(self, text: str) -> None:
        self.rng.bit_generator.state = json.loads(text)

    def state(self) -> dict[str, Any]:
        """Where every simulation stands in its motion, what its servos have still under way, and what comes next."""
        arrays = {name: getattr(self, name) for name in ROWS} | {"frames": self.loop.history.frames} | self.sim.state()
        arrays |= {"shown": self.shown} if self.config.real_state else {}
        arrays |= {"age": self.loop.age, "x": self.loop.x} if self.loop.holds else {}
        return {
            "arrays": {name: torch.as_tensor(x).cpu().clone() for name, x in arrays.items()},
            "reward": (float(self.reward_sum), self.reward_count),
            "rng": self.rng_state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Undo `state` in an environment made alike."""
        arrays = {name: x.numpy() for name, x in state["arrays"].items()}
        for name in ROWS:
            getattr(self, name)[:] = arrays[name]
        self.here[:], self.until[:] = self.sim.array(self.row), self.sim.array(self.last)
        self.now[:] = self.track[self.here]
        self.loop.history.frames[:] = array_like(self.loop.history.frames, arrays["frames"])
        for name in ("age", "x") if self.loop.holds else ():
            getattr(self.loop, name)[:] = array_like(getattr(self.loop, name), arrays[name])
        if self.config.real_state:
            self.shown[:] = array_like(self.shown, arrays["shown"])
        self.sim.set_state(arrays)
        self.reward_sum, self.reward_count = state["reward"]
        self.rng_state = state["rng"]


def _rows_of(x: Any, rows: Any, out: Any = None) -> Any:
    """x[rows], or the same written into out for rows (k,)."""
    if isinstance(x, np.ndarray):
        return x.take(rows, axis=0, out=out)  # quicker than an index
    return x[rows] if out is None else array_module(x).index_select(x, 0, rows, out=out)


def _single(x: Any) -> Any:
    """The same values as float32."""
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()
