"""gaponet: close the gap between simulated and real motors from joint logs.

`import gaponet` loads numpy alone; simulator, torch and file formats are imported by the functions that use them.
"""

from gaponet.errors import GAPONetError
from gaponet.robot import RobotSpec, load_robot

__version__ = "0.1.0"
__all__ = ["GAPONetError", "RobotSpec", "__version__", "load_robot"]
