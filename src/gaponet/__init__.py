"""gaponet: close the gap between simulated and real motors from joint logs.

    import gaponet as gp

    gp.import_logs("LOGS", "so101", "data", unit_id="lab", payload_mass=0.0)
    gp.train("data", "run", budget="10m")
    gp.evaluate("run", "data").result["methods"]

The names below are what is public. `import gaponet` loads numpy alone; simulator, torch and file formats are imported
by the functions that use them.
"""

from __future__ import annotations

from importlib import import_module

from gaponet.base.errors import GAPONetError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

__version__ = "0.1.0"

_HOMES = {  # name → module
    **dict.fromkeys(
        ("import_logs", "doctor", "pair", "gap", "identify", "train", "evaluate", "adapt_model", "adapt_robot"),
        "gaponet.api",
    ),
    "Dataset": "gaponet.data.store",
    "open_dataset": "gaponet.share.reading",
    "load_robot": "gaponet.robot.spec",
    "RobotSpec": "gaponet.robot.spec",
    "GapModel": "gaponet.nn.artifact",
    "AlignedSim": "gaponet.deploy.aligned_sim",
    "MujocoAligner": "gaponet.deploy.mujoco_loop",
    "Compensator": "gaponet.deploy.compensator",
    "Controller": "gaponet.hw.control.controller",
    "RemoteRobot": "gaponet.hw.targets.client",
}
__all__ = ["GAPONetError", "__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for (PEP 562)."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'gaponet' has no attribute '{name}'; it offers {', '.join(_HOMES)}")


def __dir__() -> list[str]:
    return __all__
