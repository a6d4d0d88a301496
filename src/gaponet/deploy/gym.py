"""gymnasium: environments on AlignedSim, and a wrapper that aligns a user's MuJoCo environment.

Needs gymnasium: pip install "gaponet[gym]".
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError, missing_extra
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.mujoco_loop import MujocoAligner
from gaponet.deploy.transfer import Reference
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import load_robot
from gaponet.sysid.motion.library import Library

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(missing_extra(error) or str(error), name=error.name) from None


class TrackingVectorEnv(gymnasium.vector.VectorEnv):
    """Follow joint motions in all worlds of one AlignedSim; a world starts a new one in the step after the end of one.

    Observation [q | q̇ | r_t+1 − q | r_t+2 − q … ], float32, of the operated joints, r the reference. Action in [−1, 1]:
    offset of the target from r_t+1, times `reach`. Reward −mean (q − r)² / 0.01 after the step, so −1 is 0.1 rad.
    """

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self, sim: AlignedSim, references: ListOf[Array], reach: float = 0.2, preview: int = 2, seed: int = 0
    ) -> None:
        """
        Args:
            sim: Any number of simulations.
            references: Joint motions to follow, (T, n) rad each, in the order of sim.joint_names, one row per period.
            reach: Offset of the target for action 1, rad.
            preview: Number of reference rows in the observation.
            seed: Seed of the choice of motions.
        """
        if not len(references) or any(r.shape[1] != sim.n or len(r) < 3 for r in references):
            raise UsageError(f"give motions (T, {sim.n}) of at least 3 rows")
        self.sim, self.reach, self.preview, self.num_envs = sim, reach, preview, sim.num_envs
        self.last = np.array([len(r) - 1 for r in references])
        rows = np.minimum(np.arange(self.last.max() + 1), self.last[:, None])
        self.references = np.stack([r[row] for r, row in zip(references, rows, strict=True)])  # (motions, T, n)
        n, batch = len(sim.op), gymnasium.vector.utils.batch_space
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, ((2 + preview) * n,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (n,), np.float32)
        self.observation_space, self.action_space = (
            batch(space, self.num_envs) for space in (self.single_observation_space, self.single_action_space)
        )
        self.motion, self.t = np.zeros((2, self.num_envs), int)
        self.ended = np.zeros(self.num_envs, bool)
        self.np_random = np.random.default_rng(seed)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a motion in each world at its first row; options: {"motion": 3}, or an array with one per world."""
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, bool), (options or {}).get("motion"))
        return self._observe(), {"motion": self.motion.copy()}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Step one control period. Worlds whose motion has ended are reset instead, with reward 0."""
        op, fresh = self.sim.op, self.ended
        target = self._row(1).copy()
        target[:, op] += self.reach * np.clip(actions, -1.0, 1.0)
        self.sim.step(target[0] if self.sim.single else target)
        self.t += 1
        if fresh.any():
            self._begin(fresh)
        qpos = np.atleast_2d(self.sim.qpos)
        error = np.where(fresh[:, None], 0.0, qpos[:, op] - self._row(0)[:, op])
        self.ended = ~fresh & (self.t >= self.last[self.motion] - 1)
        return self._observe(), -(error**2).mean(1) / 0.01, np.zeros_like(fresh), self.ended, {"error": error}

    def _begin(self, worlds: Array, motion: Any = None) -> None:
        ids = np.flatnonzero(worlds)
        self.motion[ids] = self.np_random.integers(len(self.last), size=len(ids)) if motion is None else motion
        self.t[ids], self.ended = 0, self.ended & ~worlds
        start = self._row(0)[ids]
        self.sim.reset(start[0] if self.sim.single else start, ids=ids)

    def _row(self, ahead: int) -> Array:
        return self.references[self.motion, np.minimum(self.t + ahead, self.last[self.motion])]

    def _observe(self) -> Array:
        op, (q, v) = self.sim.op, map(np.atleast_2d, (self.sim.qpos, self.sim.qvel))
        ahead = [self._row(k)[:, op] - q[:, op] for k in range(1, self.preview + 1)]
        return np.concatenate([q[:, op], v[:, op], *ahead], axis=1).astype(np.float32)


class TrackingEnv(gymnasium.Env):
    """TrackingVectorEnv with a single world, whose simulator has num_envs None. A motion's end truncates."""

    def __init__(
        self, sim: AlignedSim, references: ListOf[Array], reach: float = 0.2, preview: int = 2, seed: int = 0
    ) -> None:
        """Arguments as of TrackingVectorEnv."""
        if not sim.single:
            raise UsageError("TrackingEnv has a single simulation: leave num_envs out, or use TrackingVectorEnv")
        self.sim, self.worlds = sim, TrackingVectorEnv(sim, references, reach, preview, seed)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start a motion at its first row: a random one, or options {"motion": 3}."""
        super().reset(seed=seed)
        observation, info = self.worlds.reset(seed=seed, options=options)
        return observation[0], {"motion": int(info["motion"][0])}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Step one control period; nothing terminates."""
        observation, reward, _, truncated, info = self.worlds.step(action)
        info = {"error": info["error"][0], "delta": self.sim.delta}
        return observation[0], float(reward[0]), False, bool(truncated[0]), info


def _tracking(
    robot: str,
    model: str | None = None,
    motions: ListOf[str] = (),
    payload_mass: float = 0.0,
    num_envs: int | None = None,
    **options: Any,
) -> TrackingEnv | TrackingVectorEnv:
    """gymnasium.make("gaponet.deploy.gym:gaponet/Tracking-v0", robot="so101"): follow the library's motions.

    Args:
        robot: Name, or folder with a slash; an identified one is played as identified.
        model: Run or artifact that aligns; without one the robot is played as it is.
        motions: Names of motions (gaponet.sysid.motion.library); default all.
        payload_mass: kg in each hand.
        num_envs: Worlds of gymnasium.make_vec; None for one environment.
        options: What TrackingEnv takes.
    """
    spec = load_robot(robot)
    library = Library(spec, max_payload=payload_mass)
    references = [library.make(name).sample(spec.dt) for name in motions or library.names()]
    network = None if model is None else GapModel.load(model)
    kind = TrackingEnv if num_envs is None else TrackingVectorEnv
    return kind(AlignedSim(spec, network, payload_mass, num_envs=num_envs), references, **options)


MADE = "gaponet.deploy.gym:_tracking"
gymnasium.register("gaponet/Tracking-v0", entry_point=MADE, vector_entry_point=MADE)


class AlignedActions(gymnasium.Wrapper):
    """Aligns a gymnasium environment on MuJoCo (unwrapped.model, .data, .dt) whose actions are targets in rad."""

    def __init__(
        self, env: gymnasium.Env, model: Reference, payload_mass: float, prefix: str = "", extrapolate: bool = False
    ) -> None:
        """Arguments as of MujocoAligner."""
        super().__init__(env)
        scene: Any = env.unwrapped
        self.align = MujocoAligner(model, scene.model, float(scene.dt), payload_mass, prefix, extrapolate)

    def reset(self, **how: Any) -> tuple[Any, dict[str, Any]]:
        self.align.reset()
        return self.env.reset(**how)

    def step(self, action: Any) -> Any:
        return self.env.step(self.align(self.env.unwrapped.data, action))  # type: ignore[attr-defined]
