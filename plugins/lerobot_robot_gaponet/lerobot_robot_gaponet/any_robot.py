"""Any robot of LeRobot with position targets, whose targets gaponet corrects."""

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig, make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from .correct import Corrector
from .units import DEFAULT_RATE, JointUnit, Units, set_observation

POSITION = ".pos"  # end of LeRobot's name of a joint's position and position target


@RobotConfig.register_subclass("gaponet_robot")
@dataclass
class GaponetRobotConfig(RobotConfig):
    """A robot of LeRobot behind gaponet's correction.

    --robot.type=gaponet_robot --robot.robot="{type: koch_follower, port: /dev/ttyACM0, id: mine}"
    """

    # Configuration of LeRobot's own robot: its type, and its port, cameras, id and other fields. It
    # is no RobotConfig, because a choice of robots that contains itself has no end for LeRobot's
    # command line.
    robot: dict[str, Any]
    # Robot folder of gaponet identify, or a name of the package; its joints are matched by name.
    known: str = ""
    # Instead of it, a run of gaponet train.
    model: str = ""
    # Move as the nominal simulator of `known` does, for a policy that was trained there. The policy
    # then observes the nominal simulator's positions.
    follow: bool = False
    payload_mass: float = 0.0  # kg in each hand
    dynamics: bool = False  # feed forward accelerations: only for planned, smooth targets
    fps: float = DEFAULT_RATE  # control rate, Hz, equal to LeRobot's
    # deg, rad, or signed_percent: -100..100 over the joint's range, as robots without use_degrees
    # have it.
    unit: JointUnit = "deg"
    # LeRobot's name of a joint → its name in robot.toml, where they differ.
    joints: dict[str, str] = field(default_factory=dict)


class GaponetRobot(Robot):
    """LeRobot's own robot, with corrected position targets.

    Calibration, motors and cameras stay with LeRobot's robot. Targets that are no positions, and
    joints that robot.toml does not have, pass unchanged. The correction is limited in size and
    rate, but no watchdog protects the robot.
    """

    config_class = GaponetRobotConfig
    name = "gaponet_robot"

    def __init__(self, config: GaponetRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot = make_robot_from_config(inner_config(config.robot))
        self.corrector = Corrector.load(
            known=config.known,
            model=config.model,
            payload_mass=config.payload_mass,
            dynamics=config.dynamics,
            follow=config.follow,
            fps=config.fps,
        )
        spec = self.corrector.spec
        keys = joint_keys(self.robot.action_features, spec.joint_names, self._joint_name)
        self.units = Units(spec, config.unit, keys)
        self._measured: np.ndarray | None = None  # newest positions, (n,) rad

    def _joint_name(self, name: str) -> str:
        """Return robot.toml's name of a joint of LeRobot, or the name itself."""
        spec = self.corrector.spec
        name = self.config.joints.get(name, name)
        return spec.log_joints.aliases.get(name, name)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return self.robot.observation_features

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return self.robot.action_features

    @property
    def cameras(self) -> dict[str, Any]:
        """Cameras of LeRobot's robot, which lerobot-record counts."""
        cameras: dict[str, Any] = getattr(self.robot, "cameras", {})
        return cameras

    @property
    def is_connected(self) -> bool:
        return self.robot.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.robot.is_calibrated

    def calibrate(self) -> None:
        """Calibrate LeRobot's robot, as lerobot-calibrate does for its own type."""
        self.robot.calibrate()

    def configure(self) -> None:
        self.robot.configure()

    def connect(self, calibrate: bool = True) -> None:
        self.robot.connect(calibrate)
        self.corrector.restart()
        self._measured = None

    def get_observation(self) -> dict[str, Any]:
        observation = self.robot.get_observation()
        set_observation(observation)
        self._measured = self.units.rad(observation)
        if self.config.follow and self.corrector.started:
            nominal, _ = self.corrector.compensator.observe(self._measured)
            return observation | self.units.named(nominal)
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        corrected = self.corrector(self.units.rad(action), self._measured)
        self.robot.send_action(action | self.units.named(corrected))
        return action

    def disconnect(self) -> None:
        self.robot.disconnect()


def inner_config(given: Any) -> RobotConfig:
    """Return the configuration of LeRobot's robot from its fields, or one that is made already."""
    if isinstance(given, RobotConfig):
        return given
    import draccus

    decoded: RobotConfig = draccus.decode(RobotConfig, given)
    return decoded


def joint_keys(features: dict[str, Any], joints: ListOf[str], joint_name: Any) -> list[str]:
    """Return LeRobot's name of the position target of each joint.

    Args:
        features: Action features of LeRobot's robot.
        joints: Joints of robot.toml.
        joint_name: Function from LeRobot's name of a joint to robot.toml's.

    Raises:
        ValueError: A joint has no position target.
    """
    names = [key.removesuffix(POSITION) for key in features if key.endswith(POSITION)]
    keys = {joint_name(name): name + POSITION for name in names}
    missing = [joint for joint in joints if joint not in keys]
    if missing:
        raise ValueError(
            f"gaponet_robot: LeRobot's robot has no position target for joint '{missing[0]}'; it "
            f"has {', '.join(names)}: name it with --robot.joints='{{LEROBOT_NAME: {missing[0]}}}'"
        )
    return [keys[joint] for joint in joints]
