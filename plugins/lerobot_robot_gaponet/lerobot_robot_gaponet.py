"""LeRobot plug-in: an SO-101 whose targets are corrected and watched, motions to record, a processor step.

LeRobot finds this module by the name of its distribution (register_third_party_plugins) and the classes by the names of
their configurations. Angles are LeRobot's outside (degrees, gripper 0..100) and rad inside. The robot is commanded by
`gaponet run --targets zmq` in a process of its own: compensator, limits, checks and watchdog are those of gaponet, and
a policy that stalls leaves the arm held, then damped.
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
FOLLOWERS = ("so_follower", "so101_follower")  # LeRobot's names of it, newest first
PAST = 50  # periods after which a correction has forgotten where it began
START, BACK = 180.0, 60.0  # s: until the first state; until the arm is back where it was found


class Units:
    """LeRobot's values by name ↔ rad in the robot's order."""

    def __init__(self, robot: RobotSpec) -> None:
        self.keys = [f"{joint}.pos" for joint in robot.joint_names]
        low, high = robot.qpos_range.T
        share = np.array([unit == "fraction" for unit in robot.log_units])
        self.scale = np.where(share, (high - low) / 100, np.pi / 180)
        self.zero = np.where(share, low, 0.0)

    def rad(self, action: dict[str, Any]) -> np.ndarray:
        """(n,) rad; NaN where a joint is not named."""
        return self.zero + self.scale * np.array([float(action.get(key, np.nan)) for key in self.keys])

    def named(self, qpos: np.ndarray) -> dict[str, float]:
        """(n,) rad as LeRobot has it."""
        return dict(zip(self.keys, ((qpos - self.zero) / self.scale).tolist(), strict=True))


_seen: dict[str, float] = {}


def saw(observation: dict[str, Any]) -> None:
    """Where the arm of this process is, for gaponet_motion: gaponet_so101 says it; for another robot a program does."""
    _seen.update({key: float(value) for key, value in observation.items() if key.endswith(".pos")})


@RobotConfig.register_subclass("gaponet_so101")
@dataclass
class GaponetSO101Config(RobotConfig):
    """SO-101 follower; its calibration is what so101_follower's lerobot-calibrate wrote."""

    port: str = "/dev/ttyACM0"
    # That file, compared with what the servos hold; default that of --robot.id, without one the servos' counts.
    calibration: Path | None = None
    known: Path | None = None  # robot folder of gaponet identify: targets are compensated by what is known of the arm
    model: Path | None = None  # run of gaponet train, on top; without both targets go to the arm as they are
    fps: float | None = None  # control rate, Hz, the same as LeRobot's: default what the model was trained at, else 30
    yes: bool = False  # do not ask before the arm moves
    options: str = ""  # further options of gaponet run: "--payload-mass 0.1 --safety.speed 2"
    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class GaponetSO101(Robot):
    """Targets go through compensator and limits to the arm; observations are the newest state of each period."""

    config_class = GaponetSO101Config
    name = "gaponet_so101"

    def __init__(self, config: GaponetSO101Config) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = make_cameras_from_configs(config.cameras)
        self.spec = load_robot("so101")
        self.units = Units(self.spec)
        self._process: subprocess.Popen[bytes] | None = None

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        return self.action_features | {name: shape for name, shape, _ in self._pictures()}

    def _pictures(self) -> Iterator[tuple[str, tuple[int, int, int], Callable[[], Any]]]:
        """Key, shape and reading of each camera's colours and depth, named as LeRobot's followers name them."""
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
        return self._process is not None and all(camera.is_connected for camera in self.cameras.values())

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """lerobot-calibrate --robot.type=so101_follower does it; the servos hold what it found."""
        raise NotImplementedError(
            "gaponet_so101 calibrates nothing: lerobot-calibrate --robot.type=so101_follower, with "
            f"--robot.id={self.config.id or 'NAME'}; gaponet_so101 takes its file by that id"
        )

    def _calibration(self) -> Path | None:
        """The file that was named, or the one that LeRobot's own follower wrote for this id."""
        if self.config.calibration is not None or not self.config.id:
            return self.config.calibration
        own = Path(self.calibration_fpath)
        places = [own, *(own.parent.parent / name / own.name for name in FOLLOWERS)]
        return next((place for place in places if place.is_file()), None)

    def configure(self) -> None:
        """Servos are left as they are set; the limits and the model's card ask what they have."""

    def connect(self, calibrate: bool = True) -> None:
        from gaponet.hw.control.consent import require_consent
        from gaponet.hw.control.driver import DriverError
        from gaponet.hw.targets.client import RemoteRobot

        if not self.config.yes:
            require_consent(f"The SO-101 at {self.config.port} will move as LeRobot says.", option="--robot.yes=true")
        self._folder = tempfile.TemporaryDirectory(prefix="gaponet-lerobot-")
        address, said = f"ipc://{self._folder.name}/targets", Path(self._folder.name, "said")
        with said.open("wb") as log:
            self._process = subprocess.Popen(self._command(address), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self._remote = RemoteRobot(address, patience=0.5)
        began, self._log = time.monotonic(), said
        while True:  # until the first state
            try:
                self._states = iter(self._remote)
                next(self._states)
                break
            except (DriverError, StopIteration):
                if self._process.poll() is not None or time.monotonic() - began > START:
                    self._remote.close(end=False)
                    self._leave()
                    raise DeviceNotConnectedError(f"gaponet run: {said.read_text(errors='replace').strip()}") from None
        self._remote.patience = 5.0
        for camera in self.cameras.values():
            camera.connect()

    def _command(self, address: str) -> list[str]:
        config, rate = self.config, self.config.fps
        if rate is None and config.model is not None:
            from gaponet.nn.artifact import GapModel

            rate = 1 / GapModel.load(config.model).card["dt"][0]
        words = ["--driver", "so101", "--port", config.port, "--rate", str(rate or DEFAULT_RATE), "--yes"]
        words += ["--targets", "zmq", "--live.address", address]
        words += ["--robot", str(config.known.absolute()), "--compensate"] if config.known else []
        words += ["--model", str(config.model)] if config.model else []
        calibration = self._calibration()
        words += ["--calibration", str(calibration)] if calibration else []
        return child_process.module_command("gaponet", "run", *words, *shlex.split(config.options))

    def get_observation(self) -> dict[str, Any]:
        state = next(self._states, None) if self._process else None
        if state is None:
            said = self._log.read_text(errors="replace").strip().splitlines() if self._process else []
            raise DeviceNotConnectedError(f"{self} is not connected, or was stopped: {' '.join(said[-2:])}")
        saw(self.units.named(state.qpos))
        return self.units.named(state.qpos) | {name: read() for name, _, read in self._pictures()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        if self._process is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        target = self.units.rad(action)
        named = zip(self.spec.joint_names, target.tolist(), strict=True)
        self._remote.send({joint: rad for joint, rad in named if np.isfinite(rad)})
        return action

    def disconnect(self) -> None:
        """The arm goes back to where it was found and is held there."""
        if self._process is not None:
            self._remote.close()
            try:
                self._process.wait(BACK)
            except subprocess.TimeoutExpired:
                self._process.terminate()  # it damps
            self._leave()
        for camera in self.cameras.values():
            camera.disconnect()

    def _leave(self) -> None:
        process, self._process = self._process, None
        if process and process.poll() is None:
            process.terminate()
            process.wait()


@TeleoperatorConfig.register_subclass("gaponet_motion")
@dataclass
class GaponetMotionConfig(TeleoperatorConfig):
    """Motions instead of a leader arm: what gaponet excite wrote, a motion file, or names of the library."""

    motions: str = ""  # a folder, or files and names with commas between; each begins where the last one ended
    fps: float = DEFAULT_RATE  # as --dataset.fps
    lead: float = 4.0  # s for which it stands where it was found, until the controller is there
    payload_mass: float = 0.0  # kg in the gripper that the plan is for


class GaponetMotion(Teleoperator):
    """Says one row of its motions a call, the last one for ever.

    One plan from where the arm was found through all of them, checked before the first row is said, as of gaponet run:
    joints that a motion does not name stay where they are, and ways from one to the next keep clear.
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
        self._said = 0

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
        self._connected, self._rows, self._said = True, None, 0

    def plan(self, found: np.ndarray) -> np.ndarray:
        """All rows (T, n) rad from where the arm was found, (n,) rad.

        Raises:
            UsageError: Some part of it would touch arm or table, or needs too much; the message says which.
        """
        from gaponet.hw.control.phases import ControlConfig
        from gaponet.hw.control.plan import Planner
        from gaponet.sysid.motion.files import SUFFIXES, read_motion
        from gaponet.sysid.motion.library import Library

        given, dt = self.config.motions, 1 / self.config.fps
        files = sorted(str(f) for f in Path(given).iterdir() if f.suffix in SUFFIXES) if Path(given).is_dir() else []
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
            found = self.units.rad(_seen)
            if not np.isfinite(found).all():
                raise DeviceNotConnectedError(
                    "gaponet_motion plans from where the arm is, and nobody has said that: use it with gaponet_so101, "
                    "or call lerobot_robot_gaponet.saw(observation) with your robot's first observation"
                )
            self._rows = self.plan(found)
        row = self._rows[min(self._said, len(self._rows) - 1)]
        self._said += 1
        return self.units.named(row)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nobody feels it."""

    def disconnect(self) -> None:
        self._connected = False


@ProcessorStepRegistry.register("gaponet_correct")
@dataclass
class GaponetCorrect(ProcessorStep):
    """Corrects joint targets, once per control period, by a model at its rate, or by an identified robot at its.

    For a robot that is not gaponet_so101: the correction is bounded in size and rate, but nothing watches the arm. As
    last step of a policy's postprocessor (gaponet export --to lerobot) actions are tensors (..., n) of all joints, one
    or a chunk (1, T, n) to be sent one a period, and no state is known; as a robot action processor they are named, and
    the observation is used.
    """

    model: str = ""
    known: str = ""  # instead of a model, a robot folder of gaponet identify
    payload_mass: float = 0.0
    dynamics: bool = False  # feed forward what moving asks for: for planned, smooth targets alone

    def __post_init__(self) -> None:
        from gaponet.deploy.compensator import Compensator, CompensatorConfig
        from gaponet.hw.control.safety import Limits, SafetyConfig, limit_delta
        from gaponet.nn.artifact import GapModel

        if bool(self.model) == bool(self.known):
            raise ValueError("gaponet_correct: give either model, a run, or known, a robot folder of gaponet identify")
        network = GapModel.load(self.model) if self.model else None
        self.spec = load_robot(Path(self.known)) if network is None else network.simulator()
        self.units, self.dt = Units(self.spec), self.spec.dt if network is None else network.card["dt"][0]
        self.compensator = Compensator(self.spec, network, CompensatorConfig(dynamics=self.dynamics), self.dt)
        self.limits = Limits.from_robot(self.spec, self.spec.joint_names, SafetyConfig())
        self._bounded = limit_delta
        self.reset()

    def reset(self) -> None:
        self._delta: np.ndarray | None = None
        self._chunk: np.ndarray | None = None  # rows of the last one, and before them those of which it was the sequel

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        action = transition[TransitionKey.ACTION]
        named = isinstance(action, dict)
        if not named and action.reshape(-1, len(self.units.keys)).shape[0] > 1:
            transition[TransitionKey.ACTION] = self._corrected_chunk(action)
            return transition
        given = action if named else dict(zip(self.units.keys, action.flatten().tolist(), strict=True))
        seen = transition.get(TransitionKey.OBSERVATION) or {}
        state = self.units.rad(seen) if all(key in seen for key in self.units.keys) else None
        sent = self.units.named(self._corrected(self.units.rad(given), state))
        transition[TransitionKey.ACTION] = (
            action | sent if named else torch.tensor(list(sent.values()), dtype=action.dtype).reshape(action.shape)
        )
        return transition

    def _corrected_chunk(self, action: torch.Tensor) -> torch.Tensor:
        """All rows of one chunk. Nobody says how many of the last one were sent: it goes on at the nearest of them, as
        the correction would have gone on after those before it."""
        if action.ndim > 2 and action.shape[:-2].numel() != 1:
            raise ValueError(f"gaponet_correct corrects one robot's chunk, not {tuple(action.shape)}")
        keys = self.units.keys
        rows = [self.units.rad(dict(zip(keys, x.tolist(), strict=True))) for x in action.reshape(-1, len(keys))]
        chunk = np.array(rows)
        before = chunk[:0]
        if self._chunk is not None:
            nearest = int(np.abs(self._chunk - chunk[0]).max(axis=1).argmin())
            before = self._chunk[max(0, nearest - PAST) : nearest]
        self._delta = None
        sent = np.array([self._corrected(row, None) for row in (*before, *chunk)])[len(before) :]
        self._chunk = np.concatenate([before, chunk])
        out = [list(self.units.named(row).values()) for row in sent]
        return torch.tensor(out, dtype=action.dtype, device=action.device).reshape(action.shape)

    def _corrected(self, target: np.ndarray, qpos: np.ndarray | None) -> np.ndarray:
        if not np.isfinite(target).all():
            raise ValueError("gaponet_correct: the action holds something that is not a number, or lacks a joint")
        if self._delta is None:
            self.compensator.reset(target, self.payload_mass)
            self._delta = np.zeros_like(target)
        wanted = self.compensator.step(target, qpos) - target
        self._delta = self._bounded(wanted, self._delta, self.dt, self.limits)
        return np.clip(target + self._delta, self.limits.low, self.limits.high)

    def get_config(self) -> dict[str, Any]:
        return {"model": self.model, "known": self.known, "payload_mass": self.payload_mass, "dynamics": self.dynamics}

    def transform_features(self, features: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        return features
