"""LeRobot's values of joints and rad, and the newest observation of the arm."""

from collections.abc import Sequence as ListOf
from typing import Any, Literal

import numpy as np

from gaponet.robot.spec import RobotSpec

# Degrees, rad, or -100..100 over the joint's range, as LeRobot's robots have it without
# use_degrees.
JointUnit = Literal["deg", "rad", "signed_percent"]
DEFAULT_RATE = 30.0  # Hz: of LeRobot's own loops


class Units:
    """Conversion between LeRobot's values by name and rad in the robot's order."""

    def __init__(
        self, robot: RobotSpec, unit: JointUnit = "deg", keys: ListOf[str] | None = None
    ) -> None:
        """
        Args:
            unit: Of all joints but those whose unit in robot.toml is fraction, which LeRobot gives
                as 0..100.
            keys: LeRobot's name of each joint's value; default the joint's name and ".pos".
        """
        if keys is None:
            keys = [f"{joint}.pos" for joint in robot.joint_names]
        self.keys = [*keys]
        low, high = robot.qpos_range.T
        scales = {"deg": np.pi / 180, "rad": 1.0, "signed_percent": (high - low) / 200}
        zero = (low + high) / 2 if unit == "signed_percent" else 0.0
        fraction = np.array([given == "fraction" for given in robot.log_joints.units])
        self.scale = np.where(fraction, (high - low) / 100, scales[unit])
        self.zero = np.where(fraction, low, zero)

    def rad(self, action: dict[str, Any]) -> np.ndarray:
        """Convert to (n,) rad; NaN for a joint that is not named."""
        values = [float(action.get(key, np.nan)) for key in self.keys]
        return self.zero + self.scale * np.array(values)

    def named(self, qpos: np.ndarray) -> dict[str, float]:
        """Convert (n,) rad to LeRobot's values."""
        values = (qpos - self.zero) / self.scale
        return dict(zip(self.keys, values.tolist(), strict=True))


_last_observation: dict[str, float] = {}


def set_observation(observation: dict[str, Any]) -> None:
    """Tell gaponet_motion where the arm is.

    The robots of this plug-in call this; for others the program must.
    """
    for key, value in observation.items():
        if key.endswith(".pos"):
            _last_observation[key] = float(value)


def last_observation() -> dict[str, float]:
    """Return the newest values by name."""
    return _last_observation
