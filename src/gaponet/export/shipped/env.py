"""EnvHub environment of LeRobot: the robot with its identified servos, in MuJoCo.

It needs no gaponet.

envs = lerobot.envs.factory.make_env("USER/NAME", n_envs=4, trust_remote_code=True)   # this folder,
on the Hub envs = make_env(n_envs=4)                                                             #
this file, without LeRobot

The task is to bring the joints to angles that are drawn for each episode, and to keep them there.
Values are LeRobot's: degrees, and 0..100 for a joint whose unit in facts.json is percent.
"""

from __future__ import annotations

import copy
import importlib
import sys
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

SERVOS = ("identified", "drawn")  # drawn: each episode has another unit of randomization.json
MAX_GOAL_RAD = 0.5  # of a joint from its home position
NEAR_RAD = 0.05  # from the goal
HELD_PERIODS = 10  # control periods near the goal that end an episode
EPISODE_S = 8.0
IMAGE_SIZE = 480, 640  # height, width


def _folder() -> Path:
    """Return the folder of this file.

    LeRobot fetches env.py alone, so the rest comes from the same repository.
    """
    here = Path(__file__).absolute().parent  # not resolved: files of the Hub's cache are links
    if (here / "facts.json").is_file():
        return here
    from huggingface_hub import snapshot_download

    _, user, name = here.parents[1].name.split("--", 2)  # models--USER--NAME/snapshots/REVISION
    return Path(snapshot_download(f"{user}/{name}", revision=here.name))


FOLDER = _folder()
sys.path.insert(0, str(FOLDER))
from gaponet.export.shipped.mujoco_servos import Servos, addresses, fill_delays, read  # noqa: E402


class RobotEnv(gymnasium.Env[Any, Any]):
    """One robot that is to reach a goal, and stay there.

    Observation: agent_pos (n), environment_state (n), the goal, and with `pixels` an image; action:
    targets (n). Reward: minus the mean distance of the operated joints from the goal, rad.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    render_mode = "rgb_array"
    task = "reach"
    task_description = "Move the joints to the goal angles and keep them there."

    def __init__(self, servos: str = "identified", pixels: bool = False) -> None:
        """
        Args:
            servos: One of SERVOS.
            pixels: Whether an observation has an image.
        """
        if servos not in SERVOS:
            raise ValueError(f"servos '{servos}': one of {', '.join(SERVOS)}")
        self.facts = read(FOLDER / "facts.json")
        self.names = list(self.facts["joints"])
        self.pixels = pixels
        self._units = _read_units() if servos == "drawn" else None
        self._compiled = mujoco.MjModel.from_xml_path(str(FOLDER / self.facts["file"]))
        self._compiled.opt.timestep = self.facts["dt"] / self.facts["decimation"]
        self.metadata = self.metadata | {"render_fps": round(1 / self.facts["dt"])}
        self._max_episode_steps = round(EPISODE_S / self.facts["dt"])
        joints = self.facts["joints"].values()
        ranges = [joint["range"] or (-np.pi, np.pi) for joint in joints]
        self._low, self._high = np.array(ranges).T  # rad
        self._home = np.array([joint["home"] for joint in joints])
        self._operated = [self.names.index(name) for name in self.facts["corrected"]]
        percent = np.array([self.facts["lerobot_units"][name] == "percent" for name in self.names])
        self._scale = np.where(percent, (self._high - self._low) / 100, np.pi / 180)
        self._zero = np.where(percent, self._low, 0.0)
        self._renderer: Any = None
        self._use(self.facts, None)
        box = partial(gymnasium.spaces.Box, dtype=np.float32)
        low = self._shown(self._low)
        high = self._shown(self._high)
        self.action_space = box(low, high)
        everything = np.full(len(self.names), np.inf, np.float32)
        spaces: dict[str, Any] = {
            "agent_pos": box(-everything, everything),
            "environment_state": box(low, high),
        }
        if pixels:
            shape = (*IMAGE_SIZE, 3)
            spaces["pixels"] = gymnasium.spaces.Box(0, 255, shape, dtype=np.uint8)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def _use(self, facts: dict[str, Any], row: int | None) -> None:
        """Give the robot the servos of facts, and the links of a unit, if there is one."""
        self.model = copy.copy(self._compiled)
        if row is not None:
            importlib.import_module("mujoco_randomization").set_links(self.model, self._units, row)
        self.servos = Servos(self.model, facts, self.facts["prefix"])
        self.data = mujoco.MjData(self.model)
        where = addresses(self.model, self.names, self.facts["prefix"])
        self._dof, self._qpos, self._servo = where
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        if self._units is not None:
            row = int(self.np_random.integers(len(self._units["units"]["kp"])))
            drawing = importlib.import_module("mujoco_randomization")
            self._use(drawing.unit_facts(self.facts, self._units, row), row)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._qpos] = self._home
        self.data.ctrl[self._servo] = self._home
        fill_delays(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self._goal = self._home.copy()
        away = self.np_random.uniform(-MAX_GOAL_RAD, MAX_GOAL_RAD, len(self._operated))
        self._goal[self._operated] += away
        self._goal = np.clip(self._goal, self._low, self._high)
        self._periods = 0
        self._held = 0
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        target = self._zero + self._scale * np.asarray(action, float)
        self.data.ctrl[self._servo] = np.clip(target, self._low, self._high)
        for _ in range(self.facts["decimation"]):
            self.servos.before(self.data)
            mujoco.mj_step(self.model, self.data)
        away = np.abs(self.data.qpos[self._qpos] - self._goal)[self._operated]
        self._held = self._held + 1 if away.max() < NEAR_RAD else 0
        self._periods += 1
        reached = self._held >= HELD_PERIODS
        is_over = self._periods >= self._max_episode_steps
        reward = -float(away.mean())
        return self._observation(), reward, reached, is_over, {"is_success": reached}

    def render(self) -> np.ndarray:
        """Return an image, (height, width, 3)."""
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.model, *IMAGE_SIZE)
        self._renderer.update_scene(self.data)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _shown(self, qpos: np.ndarray) -> np.ndarray:
        """Return LeRobot's values of (n,) rad."""
        return ((qpos - self._zero) / self._scale).astype(np.float32)

    def _observation(self) -> dict[str, Any]:
        seen = {
            "agent_pos": self._shown(self.data.qpos[self._qpos]),
            "environment_state": self._shown(self._goal),
        }
        if self.pixels:
            seen["pixels"] = self.render()
        return seen


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    cfg: Any = None,
    servos: str = "identified",
    pixels: bool = False,
) -> dict[str, dict[int, Any]]:
    """Return environments as LeRobot's EnvHub takes them.

    Suite → number of the task → vector environment.

    Args:
        n_envs: Number of robots.
        use_async_envs: Whether each has a process of its own.
        cfg: LeRobot's EnvConfig, if any. Its task may be one of SERVOS; an obs_type that begins
            with pixels adds images.
        servos, pixels: As in RobotEnv, without cfg.
    """
    if getattr(cfg, "task", None) in SERVOS:
        servos = cfg.task
    pixels = pixels or str(getattr(cfg, "obs_type", "")).startswith("pixels")
    one = partial(RobotEnv, servos=servos, pixels=pixels)
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    robots: Any
    if use_async_envs and n_envs > 1:
        robots = gymnasium.vector.AsyncVectorEnv([one] * n_envs, autoreset_mode=mode)
    else:
        robots = gymnasium.vector.SyncVectorEnv([one] * n_envs, autoreset_mode=mode)
    suite = read(FOLDER / "facts.json")["robot"]
    return {suite: {0: robots}}


def _read_units() -> dict[str, Any]:
    """Return randomization.json."""
    if not (FOLDER / "randomization.json").is_file():
        raise ValueError(
            f"{FOLDER}: holds no randomization.json; the robot's uncertainty is unknown"
        )
    units: dict[str, Any] = importlib.import_module("mujoco_randomization").units()
    return units
