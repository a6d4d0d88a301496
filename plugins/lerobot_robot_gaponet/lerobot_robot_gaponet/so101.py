"""An SO-101 behind `gaponet run`, which commands it with compensator, limits, checks and watchdog.

A separate process, `gaponet run --targets zmq`, talks to the servos. If a policy stalls, the arm is
held, then damped.
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
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceNotConnectedError

from gaponet.base import child_process
from gaponet.robot.spec import load_robot

from .units import DEFAULT_RATE, Units, set_observation

FOLLOWERS = ("so_follower", "so101_follower")  # LeRobot's names of its own robot, newest first
MAX_START_S = 180.0  # until the first state
MAX_RETURN_S = 60.0  # until the arm is back at its first position


@dataclass
class Controller:
    """Process of gaponet run, with the connection to it and the file of its messages."""

    process: "subprocess.Popen[bytes]"
    remote: Any
    states: Iterator[Any]
    folder: "tempfile.TemporaryDirectory[str]"

    @classmethod
    def start(cls, command: Callable[[str], list[str]]) -> "Controller":
        """Start the command for an address and wait for the first state.

        Raises:
            DeviceNotConnectedError: The process ended, or sent no state within MAX_START_S; with
                its messages.
        """
        from gaponet.hw.control.driver import DriverError
        from gaponet.hw.targets.client import RemoteRobot

        folder = tempfile.TemporaryDirectory(prefix="gaponet-lerobot-")
        address = f"ipc://{folder.name}/targets"
        start = time.monotonic()
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
    # Calibration file, compared with the servos; default that of --robot.id, without an id the
    # servos' counts.
    calibration: Path | None = None
    known: Path | None = None  # robot folder of gaponet identify, for compensation
    # Move as the nominal simulator does, for a policy that was trained there; needs known, and
    # takes no model. The policy then observes the nominal simulator's positions.
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
        self.controller: Controller | None = None

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        return self.action_features | {name: shape for name, shape, _ in self.pictures()}

    def pictures(self) -> Iterator[tuple[str, tuple[int, int, int], Callable[[], Any]]]:
        """Yield key, shape and reader of each camera's colour and depth images.

        Keys are those of LeRobot's robots.
        """
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
        return self.controller is not None and all(
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
        """Return the given calibration file, or that of LeRobot's own follower for this id."""
        if self.config.calibration is not None or not self.config.id:
            return self.config.calibration
        own = Path(self.calibration_fpath)
        places = [own, *(own.parent.parent / name / own.name for name in FOLLOWERS)]
        return next((place for place in places if place.is_file()), None)

    def configure(self) -> None:
        """Keep the settings of the servos; gaponet run compares them with the robot."""

    def connect(self, calibrate: bool = True) -> None:
        from gaponet.hw.control.consent import require_consent

        if self.config.follow and (self.config.known is None or self.config.model is not None):
            raise ValueError("gaponet_so101: follow needs known, and takes no model")
        if not self.config.yes:
            require_consent(
                f"The SO-101 at {self.config.port} will move as LeRobot commands.",
                option="--robot.yes=true",
            )
        self.controller = Controller.start(self.command)
        for camera in self.cameras.values():
            camera.connect()

    def command(self, address: str) -> list[str]:
        config = self.config
        rate = config.fps
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
        state = next(self.controller.states, None) if self.controller else None
        if state is None:
            end = self.controller.messages().splitlines()[-2:] if self.controller else []
            raise DeviceNotConnectedError(
                f"{self} is not connected, or was stopped: {' '.join(end)}"
            )
        set_observation(self.units.named(state.qpos))
        seen = state.qpos
        if self.config.follow:
            seen = self.controller.remote.nominal_qpos
        return self.units.named(seen) | {name: read() for name, _, read in self.pictures()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        if self.controller is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        target = self.units.rad(action)
        named = zip(self.spec.joint_names, target.tolist(), strict=True)
        self.controller.remote.send({joint: rad for joint, rad in named if np.isfinite(rad)})
        return action

    def disconnect(self) -> None:
        """Return the arm to its first position, where it is held."""
        if self.controller is not None:
            self.controller.stop()
            self.controller = None
        for camera in self.cameras.values():
            camera.disconnect()
