"""gymnasium: an environment on AlignedSim, and a wrapper that aligns a user's MuJoCo environment.

Needs gymnasium, of the extra `gym`.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.installation import missing_package
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.mujoco_loop import MujocoAligner
from gaponet.deploy.transfer import Reference
from gaponet.motion.library import Library
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import load_robot

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(missing_package(error) or str(error), name=error.name) from None


class TrackingEnv(gymnasium.Env):
    """Follow joint motions with an AlignedSim. The end of a motion truncates; nothing terminates.

    Observation [q | q̇ | r_t+1 − q | r_t+2 − q … ], float32, of the operated joints, r the
    reference. Action in [−1, 1]: offset of the target from r_t+1, times `reach`. Reward −mean (q −
    r)² / 0.01 after the step, so −1 is 0.1 rad.
    """

    def __init__(
        self,
        sim: AlignedSim,
        references: ListOf[Array],
        reach: float = 0.2,
        preview: int = 2,
        seed: int = 0,
    ) -> None:
        """
        Args:
            sim: A single simulation, without num_envs.
            references: Joint motions to follow, (T, n) rad each, in the order of sim.joint_names,
                one row per period.
            reach: Offset of the target for action 1, rad.
            preview: Number of reference rows in the observation.
            seed: Seed of the choice of motions.
        """
        if not sim.single:
            raise UsageError(
                "TrackingEnv has a single simulation: leave num_envs out; gymnasium.make_vec "
                "copies it"
            )
        joints = len(sim.joint_names)
        if not len(references) or any(r.shape[1] != joints or len(r) < 3 for r in references):
            raise UsageError(f"give motions (T, {joints}) of at least 3 rows")
        self.sim = sim
        self.references = references
        self.reach = reach
        self.preview = preview
        self.motion = 0
        self.t = 0
        self.np_random = np.random.default_rng(seed)
        n = len(sim.op)
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, ((2 + preview) * n,), np.float32
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (n,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start a motion at its first row: a random one, or options {"motion": 3}."""
        super().reset(seed=seed)
        chosen = (options or {}).get("motion")
        self.motion = int(
            self.np_random.integers(len(self.references)) if chosen is None else chosen
        )
        self.t = 0
        self.sim.reset(self._row(0))
        return self._observe(), {"motion": self.motion}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Step one control period."""
        target = self._row(1).copy()
        op = self.sim.op
        target[op] += self.reach * np.clip(action, -1.0, 1.0)
        self.sim.step(target)
        self.t += 1
        error = self.sim.qpos[op] - self._row(0)[op]
        truncated = self.t >= len(self.references[self.motion]) - 2
        reward = -float(np.mean(error**2)) / 0.01
        return self._observe(), reward, False, truncated, {"error": error, "delta": self.sim.delta}

    def _row(self, ahead: int) -> Array:
        motion = self.references[self.motion]
        row: Array = motion[min(self.t + ahead, len(motion) - 1)]
        return row

    def _observe(self) -> Array:
        q = self.sim.qpos
        v = self.sim.qvel
        op = self.sim.op
        ahead = [self._row(k)[op] - q[op] for k in range(1, self.preview + 1)]
        return np.concatenate([q[op], v[op], *ahead]).astype(np.float32)


def _tracking(
    robot: str,
    model: str | None = None,
    motions: ListOf[str] = (),
    payload_mass: float = 0.0,
    **options: Any,
) -> TrackingEnv:
    """Make an environment that follows the library's motions.

    gymnasium.make("gaponet.deploy.gym:gaponet/Tracking-v0", robot="so101")

    Args:
        robot: Name, or folder with a slash; an identified one is played as identified.
        model: Run or artifact that aligns; without one the robot is played as it is.
        motions: Names of motions (gaponet.motion.library); default all.
        payload_mass: kg in each hand.
        options: What TrackingEnv takes.
    """
    spec = load_robot(robot)
    library = Library(spec, max_payload=payload_mass)
    references = [library.make(name).sample(spec.dt) for name in motions or library.names()]
    network = None if model is None else GapModel.load(model)
    return TrackingEnv(AlignedSim(spec, network, payload_mass), references, **options)


gymnasium.register("gaponet/Tracking-v0", entry_point="gaponet.deploy.gym:_tracking")


class AlignedActions(gymnasium.Wrapper):
    """Aligns a gymnasium environment on MuJoCo whose actions are targets in rad.

    It needs unwrapped.model, .data and .dt.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        model: Reference,
        payload_mass: float,
        prefix: str = "",
        extrapolate: bool = False,
    ) -> None:
        """Arguments as of MujocoAligner."""
        super().__init__(env)
        scene: Any = env.unwrapped
        self.align = MujocoAligner(
            model,
            scene.model,
            dt=float(scene.dt),
            payload_mass=payload_mass,
            prefix=prefix,
            extrapolate=extrapolate,
        )

    def reset(self, **how: Any) -> tuple[Any, dict[str, Any]]:
        self.align.reset()
        return self.env.reset(**how)

    def step(self, action: Any) -> Any:
        scene: Any = self.env.unwrapped
        return self.env.step(self.align(scene.data, action))
