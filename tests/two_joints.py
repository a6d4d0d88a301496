"""A VIRTUAL robot of LeRobot that is not the SO-101: two joints with names of its own, in degrees,
and a lamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig

JOINTS = {"lift": "shoulder", "bend": "elbow"}  # name in LeRobot → in robot.toml
KEYS = [f"{name}.pos" for name in JOINTS]


@RobotConfig.register_subclass("two_joints")
@dataclass
class TwoJointsConfig(RobotConfig):
    simulated: Any = None  # gp.AlignedSim


class TwoJoints(Robot):
    config_class = TwoJointsConfig
    name = "two_joints"

    def __init__(self, config: TwoJointsConfig) -> None:
        super().__init__(config)
        self.sim = config.simulated
        self.lamp: list[float] = []
        self.connected = False
        self.calibrated = False

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys([*KEYS, "lamp.pos", "lamp.colour"], float)

    @property
    def observation_features(self) -> dict[str, type]:
        return self.action_features

    @property
    def is_connected(self) -> bool:
        return self.connected

    @property
    def is_calibrated(self) -> bool:
        return self.calibrated

    def connect(self, calibrate: bool = True) -> None:
        self.connected = True

    def calibrate(self) -> None:
        self.calibrated = True

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, float]:
        degrees = np.degrees(self.sim.qpos).tolist()
        return dict(zip(KEYS, degrees, strict=True)) | {"lamp.pos": 1.0, "lamp.colour": 2.0}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.lamp = [action["lamp.pos"], action["lamp.colour"]]
        self.sim.step(np.radians([action[key] for key in KEYS]))
        return action

    def disconnect(self) -> None:
        self.connected = False
