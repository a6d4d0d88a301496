"""Motions of gaponet as a teleoperator: excitation for identification, and any motion file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceNotConnectedError

from gaponet.robot.spec import load_robot

from .units import DEFAULT_RATE, JointUnit, Units, last_observation


@TeleoperatorConfig.register_subclass("gaponet_motion")
@dataclass
class GaponetMotionConfig(TeleoperatorConfig):
    """Motions instead of a leader arm: a folder of gaponet excite, files, or names."""

    # A folder, or files and names of the library, separated by commas; each motion starts where
    # the previous one ended.
    motions: str = ""
    robot: str = "so101"  # robot folder, or a name of the package
    unit: JointUnit = "deg"  # of the robot's joints in LeRobot
    fps: float = DEFAULT_RATE  # as --dataset.fps
    lead: float = 4.0  # s at the first position, until the controller has started
    payload_mass: float = 0.0  # kg in the gripper, for the plan


class GaponetMotion(Teleoperator):
    """Teleoperator that returns one row of its motions per call, at the end always the last one.

    One plan leads from the arm's first position through all motions. It is checked before the first
    row, as in gaponet run: joints that a motion does not name keep their position, and moves
    between motions avoid collisions.
    """

    config_class = GaponetMotionConfig
    name = "gaponet_motion"

    def __init__(self, config: GaponetMotionConfig) -> None:
        super().__init__(config)
        self.config = config
        self.spec = load_robot(config.robot)
        self.units = Units(self.spec, config.unit)
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
        self._connected = True
        self._rows = None
        self._next_row = 0

    def plan(self, found: np.ndarray) -> np.ndarray:
        """Plan all rows (T, n) rad from the arm's position, (n,) rad.

        Raises:
            UsageError: A part would collide with arm or table, or exceeds a limit; the message
                names it.
        """
        from gaponet.hw.control.phases import ControlConfig
        from gaponet.hw.control.plan import Planner
        from gaponet.motion.files import SUFFIXES, read_motion
        from gaponet.motion.library import Library

        dt = 1 / self.config.fps
        words = self.config.motions.split(",")
        folder = Path(self.config.motions)
        if folder.is_dir():
            files = sorted(str(f) for f in folder.iterdir() if f.suffix in SUFFIXES)
            words = files or words
        library = Library(self.spec, max_payload=self.config.payload_mass)
        one = ControlConfig(blend=1.0, blend_out=False)
        planner = Planner(self.spec, self.spec.joint_names, one, limits=library.limits)
        parts = [np.repeat(found[None], max(1, round(self.config.lead / dt)), axis=0)]
        for word in words:
            motion = read_motion(word, self.spec) if word.endswith(SUFFIXES) else library.make(word)
            plan = planner.plan(motion, parts[-1][-1])
            assert plan.motion
            parts += [plan.approach.rows(dt)[1:], plan.motion.sample(dt)]
        return np.concatenate(parts)

    def get_action(self) -> dict[str, float]:
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        if self._rows is None:
            found = self.units.rad(last_observation())
            if not np.isfinite(found).all():
                raise DeviceNotConnectedError(
                    "gaponet_motion plans from the arm's position, which is unknown: use it with "
                    "gaponet_so101 or gaponet_robot, or call "
                    "lerobot_robot_gaponet.set_observation(observation) with your robot's first "
                    "observation"
                )
            self._rows = self.plan(found)
        row = self._rows[min(self._next_row, len(self._rows) - 1)]
        self._next_row += 1
        return self.units.named(row)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Ignore feedback."""

    def disconnect(self) -> None:
        self._connected = False
