"""gaponet: close the gap between simulated and real motors from joint logs.

`import gaponet` loads numpy alone; simulator, torch and file formats are imported by the functions that use them.
"""

from typing import TYPE_CHECKING, Any

from gaponet.errors import GAPONetError

if TYPE_CHECKING:
    from gaponet.robot import RobotSpec, load_robot

__version__ = "0.1.0"
__all__ = ["GAPONetError", "RobotSpec", "__version__", "load_robot"]


def __getattr__(name: str) -> Any:
    if name not in ("RobotSpec", "load_robot"):
        raise AttributeError(f"module 'gaponet' has no attribute '{name}'")
    from gaponet import robot

    return getattr(robot, name)
