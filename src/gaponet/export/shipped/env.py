"""EnvHub environment of LeRobot: the robot with its identified servos, in MuJoCo.

It needs no gaponet.

    # this folder, on the Hub
    envs = lerobot.envs.factory.make_env("USER/NAME", n_envs=4, trust_remote_code=True)
    envs = make_env(n_envs=4)  # this file, without LeRobot

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


class JointValues:
    """LeRobot's values of joints: degrees, and 0..100 for a joint whose unit is percent.

    Attributes:
        low, high: Range of the joints, (n) rad.
        zero, scale: Angle of the value 0, and of each unit of it, (n) rad.
    """

    def __init__(self, facts: dict[str, Any]) -> None:
        ranges = []
        for joint in facts["joints"].values():
            ranges.append(joint["range"] or (-np.pi, np.pi))
        percent = np.array([facts["lerobot_units"][name] == "percent" for name in facts["joints"]])
        self.low, self.high = np.array(ranges).T
        self.zero = np.where(percent, self.low, 0.0)
        self.scale = np.where(percent, (self.high - self.low) / 100, np.pi / 180)

    def of(self, qpos: np.ndarray) -> np.ndarray:
        """Return the values of (n) rad."""
        return ((qpos - self.zero) / self.scale).astype(np.float32)

    def in_rad(self, values: np.ndarray) -> np.ndarray:
        """Return the angles of values, (n) rad, within the joints' range."""
        target = self.zero + self.scale * np.asarray(values, float)
        return np.asarray(np.clip(target, self.low, self.high))


class Simulation:
    """The robot in MuJoCo, with the identified servos or with those of a unit.

    Attributes:
        facts: facts.json.
        home: Position in which it starts, (n) rad.
        units: randomization.json, whose units it may become; None: it stays as identified.
    """

    def __init__(self, facts: dict[str, Any], units: dict[str, Any] | None) -> None:
        self.facts = facts
        self.units = units
        self.home = np.array([joint["home"] for joint in facts["joints"].values()])
        self._compiled = mujoco.MjModel.from_xml_path(str(FOLDER / facts["file"]))
        self._compiled.opt.timestep = facts["dt"] / facts["decimation"]
        self._renderer: Any = None
        self._take(copy.copy(self._compiled), facts)

    def _take(self, model: mujoco.MjModel, facts: dict[str, Any]) -> None:
        """Simulate a model whose servos have the numbers of facts."""
        prefix = self.facts["prefix"]
        self.model = model
        self.servos = Servos(model, facts, prefix)
        self.data = mujoco.MjData(model)
        self.at = addresses(model, list(self.facts["joints"]), prefix)
        self.close()

    def draw_unit(self, rng: np.random.Generator) -> None:
        """Become a unit, where there are units."""
        if self.units is None:
            return
        drawing = importlib.import_module("mujoco_randomization")
        row = int(rng.integers(len(self.units["units"]["kp"])))
        model = copy.copy(self._compiled)
        drawing.set_links(model, self.units, row, prefix=self.facts["prefix"])
        self._take(model, drawing.unit_facts(self.facts, self.units, row))

    def start(self) -> None:
        """Stand still at home, as if sent there long ago."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.at.qpos] = self.home
        self.data.ctrl[self.at.servo] = self.home
        fill_delays(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def step(self, target: np.ndarray) -> None:
        """Simulate a control period under targets, (n) rad."""
        self.data.ctrl[self.at.servo] = target
        for _ in range(self.facts["decimation"]):
            self.servos.before(self.data)
            mujoco.mj_step(self.model, self.data)

    @property
    def qpos(self) -> np.ndarray:
        """Position of the joints, (n) rad."""
        return np.asarray(self.data.qpos[self.at.qpos])

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
        facts = read(FOLDER / "facts.json")
        self.robot = Simulation(facts, _read_units() if servos == "drawn" else None)
        self.values = JointValues(facts)
        self.pixels = pixels
        self.metadata = self.metadata | {"render_fps": round(1 / facts["dt"])}
        self._max_episode_steps = round(EPISODE_S / facts["dt"])
        names = list(facts["joints"])
        self._operated = [names.index(name) for name in facts["corrected"]]
        self.goal = self.robot.home
        self._periods = 0
        self._held = 0
        box = partial(gymnasium.spaces.Box, dtype=np.float32)
        low = self.values.of(self.values.low)
        high = self.values.of(self.values.high)
        self.action_space = box(low, high)
        everything = np.full(len(names), np.inf, np.float32)
        spaces: dict[str, Any] = {
            "agent_pos": box(-everything, everything),
            "environment_state": box(low, high),
        }
        if pixels:
            shape = (*IMAGE_SIZE, 3)
            spaces["pixels"] = gymnasium.spaces.Box(0, 255, shape, dtype=np.uint8)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        self.robot.draw_unit(self.np_random)
        self.robot.start()
        goal = self.robot.home.copy()
        away = self.np_random.uniform(-MAX_GOAL_RAD, MAX_GOAL_RAD, len(self._operated))
        goal[self._operated] += away
        self.goal = np.clip(goal, self.values.low, self.values.high)
        self._periods = 0
        self._held = 0
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.robot.step(self.values.in_rad(action))
        away = np.abs(self.robot.qpos - self.goal)[self._operated]
        self._held = self._held + 1 if away.max() < NEAR_RAD else 0
        self._periods += 1
        reached = self._held >= HELD_PERIODS
        is_over = self._periods >= self._max_episode_steps
        reward = -float(away.mean())
        return self._observation(), reward, reached, is_over, {"is_success": reached}

    def render(self) -> np.ndarray:
        """Return an image, (height, width, 3)."""
        return self.robot.render()

    def close(self) -> None:
        self.robot.close()

    def _observation(self) -> dict[str, Any]:
        seen = {
            "agent_pos": self.values.of(self.robot.qpos),
            "environment_state": self.values.of(self.goal),
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
            f"{FOLDER}: holds no randomization.json, so servos='drawn' is not possible; README.md "
            "says why"
        )
    units: dict[str, Any] = importlib.import_module("mujoco_randomization").units()
    return units
