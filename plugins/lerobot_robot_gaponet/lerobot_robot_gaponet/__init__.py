"""LeRobot plug-in: robots with compensation, a teleoperator of motions, and a processor step.

LeRobot discovers this module by the name of its distribution (register_third_party_plugins) and the
classes by the names of their configurations. Angles use LeRobot's units outside (degrees, gripper
0..100) and rad inside.
"""

from .any_robot import GaponetRobot, GaponetRobotConfig
from .correct import Corrector, GaponetCorrect
from .motions import GaponetMotion, GaponetMotionConfig
from .so101 import GaponetSO101, GaponetSO101Config
from .units import Units, set_observation

__all__ = [
    "Corrector",
    "GaponetCorrect",
    "GaponetMotion",
    "GaponetMotionConfig",
    "GaponetRobot",
    "GaponetRobotConfig",
    "GaponetSO101",
    "GaponetSO101Config",
    "Units",
    "set_observation",
]
