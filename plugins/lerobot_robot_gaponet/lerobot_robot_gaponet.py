"""LeRobot plug-in: an SO-101 with compensation and safety limits, a teleoperator of motions, and a processor step.

LeRobot discovers this module by the name of its distribution (register_third_party_plugins) and the classes by the
names of their configurations. Angles use LeRobot's units outside (degrees, gripper 0..100) and rad inside. A separate
process, `gaponet run --targets zmq`, commands the robot with gaponet's compensator, limits, checks and watchdog. If a
policy stalls, the arm is held, then damped.
"""

import shlex
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceNotConnectedError

from gaponet.base import child_process
from gaponet.robot.spec import RobotSpec, load_robot

DEFAULT_RATE = 30.0  # Hz: LeRobot's own
FOLLOWERS = ("so_follower", "so101_follower")  # LeRobot's names of its own robot, newest first
MEMORY_PERIODS = 50  # control periods after which a correction no longer depends on its start
MAX_START_S, MAX_RETURN_S = (
    180.0,
    60.0,
)  # until the first state; until the arm is back at its first position


class Units:
    """Conversion between LeRobot's values by name and rad in the robot's order."""

    def __init__(self, robot: RobotSpec) -> None:
        self.keys = [f"{joint}.pos" for joint in robot.joint_names]
        low, high = robot.qpos_range.T
        fraction = np.array([unit == "fraction" for unit in robot.log_units])
        self.scale = np.where(fraction, (high - low) / 100, np.pi / 180)
        self.zero = np.where(fraction, low, 0.0)

    def rad(self, action: dict[str, Any]) -> np.ndarray:
        """Convert to (n,) rad; NaN for a joint that is not named."""
        return self.zero + self.scale * np.array(
            [float(action.get(key, np.nan)) for key in self.keys]
        )

    def named(self, qpos: np.ndarray) -> dict[str, float]:
        """Convert (n,) rad to LeRobot's values."""
        return dict(zip(self.keys, ((qpos - self.zero) / self.scale).tolist(), strict=True))


_last_observation: dict[str, float] = {}


def set_observation(observation: dict[str, Any]) -> None:
    """Tell gaponet_motion where the arm is. gaponet_so101 calls this; with another robot, the program must."""
    _last_observation.update(
        {key: float(value) for key, value in observation.items() if key.endswith(".pos")}
    )


@dataclass
class _Controller:
    """Process of gaponet run, with the connection to it and the file of its messages."""

    process: "subprocess.Popen[bytes]"
    remote: Any
    states: Iterator[Any]
    folder: "tempfile.TemporaryDirectory[str]"

    @classmethod
    def start(cls, command: Callable[[str], list[str]]) -> "_Controller":
        """Start the command for an address and wait for the first state.

        Raises:
            DeviceNotConnectedError: The process ended, or sent no state within MAX_START_S; with its messages.
        """
        from gaponet.hw.control.driver import DriverError
        from gaponet.hw.targets.client import RemoteRobot

        folder = tempfile.TemporaryDirectory(prefix="gaponet-lerobot-")
        address, start = f"ipc://{folder.name}/targets", time.monotonic()
        with Path(folder.name, "messages").open("wb") as log:
            process = subprocess.Popen(
                command(address), stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        remote = RemoteRobot(address, patience=0.5)
        controller = cls(process, remote, iter(remote), folder)
        try:
            while True:
                try:
                    next(controller.states)
                    break
                except (DriverError, StopIteration):
                    if process.poll() is not None or time.monotonic() - start > MAX_START_S:
                        raise DeviceNotConnectedError(
                            f"gaponet run: {controller.messages()}"
                        ) from None
                    controller.states = iter(remote)
        except BaseException:  # Ctrl-C, too: nobody else knows the process
            remote.close(end=False)
            controller.end()
            raise
        remote.patience = 5.0
        return controller

    def messages(self) -> str:
        return Path(self.folder.name, "messages").read_text(errors="replace").strip()

    def stop(self) -> None:
        """End the run: the arm returns to its first position; after MAX_RETURN_S it is damped."""
        self.remote.close()
        try:
            self.process.wait(MAX_RETURN_S)
        except subprocess.TimeoutExpired:
            self.end()

    def end(self) -> None:
        """Terminate the process, if it runs: the arm is damped."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait()


@RobotConfig.register_subclass("gaponet_so101")
@dataclass
class GaponetSO101Config(RobotConfig):
    """SO-101 follower with the calibration that lerobot-calibrate wrote for so101_follower."""

    port: str = "/dev/ttyACM0"
    # Calibration file, compared with the servos; default that of --robot.id, without an id the servos' counts.
    calibration: Path | None = None
    known: Path | None = None  # robot folder of gaponet identify, for compensation
    # Move as the nominal simulator does, for a policy that was trained there; needs known, and takes no model. The
    # policy then observes the nominal simulator's positions.
    follow: bool = False
    # run of gaponet train, in addition; without both, targets are not corrected
    model: Path | None = None
    # control rate, Hz, equal to LeRobot's; default that of the model, else 30
    fps: float | None = None
    yes: bool = False  # do not ask before the arm moves
    options: str = ""  # further options of gaponet run: "--payload-mass 0.1 --safety.speed 2"
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class GaponetSO101(Robot):
    """SO-101 behind compensator and limits; observations are the newest state of each period."""

    config_class = GaponetSO101Config
    name = "gaponet_so101"

    def __init__(self, config: GaponetSO101Config) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self.spec = load_robot("so101")
        self.units = Units(self.spec)
        self._controller: _Controller | None = None

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        return self.action_features | {name: shape for name, shape, _ in self._pictures()}

    def _pictures(self) -> Iterator[tuple[str, tuple[int, int, int], Callable[[], Any]]]:
        """Yield key, shape and reader of each camera's colour and depth images; keys are those of LeRobot's robots."""
        for name, camera in self.cameras.items():
            size = camera.height, camera.width
            if getattr(camera, "use_rgb", True):
                yield name, (*size, 3), camera.read_latest
            if getattr(camera, "use_depth", False):
                yield f"{name}_depth", (*size, 1), camera.read_latest_depth

    @cached_property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.units.keys, float)

    @property
    def is_connected(self) -> bool:
        return self._controller is not None and all(
            camera.is_connected for camera in self.cameras.values()
        )

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Refuse: lerobot-calibrate --robot.type=so101_follower calibrates the servos."""
        raise NotImplementedError(
            "gaponet_so101 calibrates nothing: lerobot-calibrate --robot.type=so101_follower, with "
            f"--robot.id={self.config.id or 'NAME'}; gaponet_so101 takes its file by that id"
        )

    def _calibration(self) -> Path | None:
        """Return the given calibration file, or the one that LeRobot's own follower wrote for this id."""
        if self.config.calibration is not None or not self.config.id:
            return self.config.calibration
        own = Path(self.calibration_fpath)
        places = [own, *(own.parent.parent / name / own.name for name in FOLLOWERS)]
        return next((place for place in places if place.is_file()), None)

    def configure(self) -> None:
        """Keep the settings of the servos; gaponet run compares them with the robot and the model."""

    def connect(self, calibrate: bool = True) -> None:
        from gaponet.hw.control.consent import require_consent

        if self.config.follow and (self.config.known is None or self.config.model is not None):
            raise ValueError("gaponet_so101: follow needs known, and takes no model")
        if not self.config.yes:
            require_consent(
                f"The SO-101 at {self.config.port} will move as LeRobot commands.",
                option="--robot.yes=true",
            )
        self._controller = _Controller.start(self._command)
        for camera in self.cameras.values():
            camera.connect()

    def _command(self, address: str) -> list[str]:
        config, rate = self.config, self.config.fps
        if rate is None and config.model is not None:
            from gaponet.nn.artifact import GapModel

            rate = 1 / GapModel.load(config.model).card["dt"][0]
        words = [
            "--driver",
            "so101",
            "--port",
            config.port,
            "--rate",
            str(rate or DEFAULT_RATE),
            "--yes",
        ]
        words += ["--targets", "zmq", "--live.address", address]
        if config.known:
            words += ["--robot", str(config.known.absolute())]
            words += ["--follow", "nominal"] if config.follow else ["--compensate"]
        words += ["--model", str(config.model)] if config.model else []
        calibration = self._calibration()
        words += ["--calibration", str(calibration)] if calibration else []
        return child_process.module_command("gaponet", "run", *words, *shlex.split(config.options))

    def get_observation(self) -> dict[str, Any]:
        state = next(self._controller.states, None) if self._controller else None
        if state is None:
            end = self._controller.messages().splitlines()[-2:] if self._controller else []
            raise DeviceNotConnectedError(
                f"{self} is not connected, or was stopped: {' '.join(end)}"
            )
        set_observation(self.units.named(state.qpos))
        seen = state.qpos
        if self.config.follow:
            seen = self._controller.remote.nominal_qpos
        return self.units.named(seen) | {name: read() for name, _, read in self._pictures()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        if self._controller is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        target = self.units.rad(action)
        named = zip(self.spec.joint_names, target.tolist(), strict=True)
        self._controller.remote.send({joint: rad for joint, rad in named if np.isfinite(rad)})
        return action

    def disconnect(self) -> None:
        """Return the arm to its first position, where it is held."""
        if self._controller is not None:
            self._controller.stop()
            self._controller = None
        for camera in self.cameras.values():
            camera.disconnect()


@TeleoperatorConfig.register_subclass("gaponet_motion")
@dataclass
class GaponetMotionConfig(TeleoperatorConfig):
    """Motions instead of a leader arm: a folder of gaponet excite, motion files, or names of the library."""

    motions: str = ""  # a folder, or files and names separated by commas; each starts where the previous one ended
    fps: float = DEFAULT_RATE  # as --dataset.fps
    lead: float = 4.0  # s at the first position, until the controller has started
    payload_mass: float = 0.0  # kg in the gripper, for the plan


class GaponetMotion(Teleoperator):
    """Teleoperator that returns one row of its motions per call, at the end always the last one.

    One plan leads from the arm's first position through all motions. It is checked before the first row, as in gaponet
    run: joints that a motion does not name keep their position, and moves between motions avoid collisions.
    """

    config_class = GaponetMotionConfig
    name = "gaponet_motion"

    def __init__(self, config: GaponetMotionConfig) -> None:
        super().__init__(config)
        self.config = config
        self.spec = load_robot("so101")
        self.units = Units(self.spec)
        self._connected = False
        self._rows: np.ndarray | None = None
        self._next_row = 0

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self.units.keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        self._connected, self._rows, self._next_row = True, None, 0

    def plan(self, found: np.ndarray) -> np.ndarray:
        """Plan all rows (T, n) rad from the arm's position, (n,) rad.

        Raises:
            UsageError: A part would collide with arm or table, or exceeds a limit; the message names it.
        """
        from gaponet.hw.control.phases import ControlConfig
        from gaponet.hw.control.plan import Planner
        from gaponet.motion.files import SUFFIXES, read_motion
        from gaponet.motion.library import Library

        given, dt = self.config.motions, 1 / self.config.fps
        files = (
            sorted(str(f) for f in Path(given).iterdir() if f.suffix in SUFFIXES)
            if Path(given).is_dir()
            else []
        )
        library = Library(self.spec, max_payload=self.config.payload_mass)
        one = ControlConfig(blend=1.0, blend_out=False)
        planner = Planner(self.spec, self.spec.joint_names, one, limits=library.limits)
        parts = [np.repeat(found[None], max(1, round(self.config.lead / dt)), axis=0)]
        for word in files or given.split(","):
            motion = read_motion(word, self.spec) if word.endswith(SUFFIXES) else library.make(word)
            plan = planner.plan(motion, parts[-1][-1])
            assert plan.motion
            parts += [plan.approach.rows(dt)[1:], plan.motion.sample(dt)]
        return np.concatenate(parts)

    def get_action(self) -> dict[str, float]:
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        if self._rows is None:
            found = self.units.rad(_last_observation)
            if not np.isfinite(found).all():
                raise DeviceNotConnectedError(
                    "gaponet_motion plans from the arm's position, which is unknown: use it with gaponet_so101, "
                    "or call lerobot_robot_gaponet.set_observation(observation) with your robot's first observation"
                )
            self._rows = self.plan(found)
        row = self._rows[min(self._next_row, len(self._rows) - 1)]
        self._next_row += 1
        return self.units.named(row)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Ignore feedback."""

    def disconnect(self) -> None:
        self._connected = False


@ProcessorStepRegistry.register("gaponet_correct")
@dataclass
class GaponetCorrect(ProcessorStep):
    """Processor step that corrects joint targets once per control period, by a model or an identified robot.

    It is for robots other than gaponet_so101: the correction is limited in size and rate, but no watchdog protects the
    arm. As last step of a policy's postprocessor (gaponet attach), actions are tensors (..., n) of all joints, or a
    chunk (1, T, n) that is sent one row per period, and the state is unknown. As a robot action processor, actions are
    named, and the observation is used.
    """

    model: str = ""
    known: str = ""  # instead of a model, a robot folder of gaponet identify
    payload_mass: float = 0.0
    dynamics: bool = False  # feed forward accelerations: only for planned, smooth targets
    # Move as the nominal simulator of `known` does. The policy sees the measured state, whose delay a policy with a
    # high gain may not bear (docs/deploy.md): gaponet_so101 gives it the nominal simulator's instead.
    follow: bool = False

    def __post_init__(self) -> None:
        from gaponet.deploy.compensator import Compensator, CompensatorConfig
        from gaponet.hw.control.safety import Limits, SafetyConfig, limit_delta
        from gaponet.nn.artifact import GapModel

        if bool(self.model) == bool(self.known):
            raise ValueError(
                "gaponet_correct: give either model, a run, or known, a robot folder of gaponet identify"
            )
        if self.follow and self.model:
            raise ValueError("gaponet_correct: follow needs known, and takes no model")
        network = GapModel.load(self.model) if self.model else None
        self.spec = load_robot(Path(self.known)) if network is None else network.simulator()
        self.units, self.dt = (
            Units(self.spec),
            self.spec.dt if network is None else network.card["dt"][0],
        )
        self.compensator = Compensator(
            self.spec,
            network,
            CompensatorConfig(dynamics=self.dynamics),
            self.dt,
            follow="nominal" if self.follow else None,
        )
        self.limits = Limits.from_robot(self.spec, self.spec.joint_names, SafetyConfig())
        self._bounded = limit_delta
        self.reset()

    def reset(self) -> None:
        self._delta: np.ndarray | None = None
        # rows of the last chunk, after those that it continued
        self._chunk: np.ndarray | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        action = transition[TransitionKey.ACTION]
        named = isinstance(action, dict)
        if not named and action.reshape(-1, len(self.units.keys)).shape[0] > 1:
            transition[TransitionKey.ACTION] = self._corrected_chunk(action)
            return transition
        given = (
            action if named else dict(zip(self.units.keys, action.flatten().tolist(), strict=True))
        )
        seen = transition.get(TransitionKey.OBSERVATION) or {}
        state = self.units.rad(seen) if all(key in seen for key in self.units.keys) else None
        sent = self.units.named(self._corrected(self.units.rad(given), state))
        transition[TransitionKey.ACTION] = (
            action | sent
            if named
            else torch.tensor(list(sent.values()), dtype=action.dtype).reshape(action.shape)
        )
        return transition

    def _corrected_chunk(self, action: torch.Tensor) -> torch.Tensor:
        """Correct all rows of a chunk. LeRobot does not tell how many rows of the last chunk were sent: the correction
        continues after the rows before the nearest one of that chunk."""
        if action.ndim > 2 and action.shape[:-2].numel() != 1:
            raise ValueError(
                f"gaponet_correct corrects one robot's chunk, not {tuple(action.shape)}"
            )
        keys = self.units.keys
        rows = [
            self.units.rad(dict(zip(keys, x.tolist(), strict=True)))
            for x in action.reshape(-1, len(keys))
        ]
        chunk = np.array(rows)
        before = chunk[:0]
        if self._chunk is not None:
            nearest = int(np.abs(self._chunk - chunk[0]).max(axis=1).argmin())
            before = self._chunk[max(0, nearest - MEMORY_PERIODS) : nearest]
        self._delta = None
        sent = np.array([self._corrected(row, None) for row in (*before, *chunk)])[len(before) :]
        self._chunk = np.concatenate([before, chunk])
        out = [list(self.units.named(row).values()) for row in sent]
        return torch.tensor(out, dtype=action.dtype, device=action.device).reshape(action.shape)

    def _corrected(self, target: np.ndarray, qpos: np.ndarray | None) -> np.ndarray:
        if not np.isfinite(target).all():
            raise ValueError(
                "gaponet_correct: the action lacks a joint, or holds a value that is not a number"
            )
        if self._delta is None:
            self.compensator.reset(target, self.payload_mass)
            self._delta = np.zeros_like(target)
        wanted = self.compensator.step(target, qpos) - target
        self._delta = self._bounded(wanted, self._delta, self.dt, self.limits)
        return np.clip(target + self._delta, self.limits.low, self.limits.high)

    def get_config(self) -> dict[str, Any]:
        return {
            "model": self.model,
            "known": self.known,
            "payload_mass": self.payload_mass,
            "dynamics": self.dynamics,
            "follow": self.follow,
        }

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        return features
