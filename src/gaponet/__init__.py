"""gaponet: close the gap between simulated and real motors from joint logs.

    import gaponet as gp

    gp.import_logs("LOGS", robot="so101", out="data", unit_id="lab", payload_mass=0.0)
    gp.identify("data", out="my_so101")
    print(gp.evaluate("./my_so101", "data").mpjae)

The names below are public. `import gaponet` loads numpy alone; simulator, torch and file formats
are imported by the functions that use them.
"""

from __future__ import annotations

from importlib import import_module

from gaponet.base.errors import GAPONetError as GAPONetError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from gaponet.api import *  # noqa: F403
    from gaponet.api.options import CollectOptions as CollectOptions
    from gaponet.api.options import ExciteOptions as ExciteOptions
    from gaponet.api.options import IdentifyOptions as IdentifyOptions
    from gaponet.api.options import ImportOptions as ImportOptions
    from gaponet.api.options import TrainOptions as TrainOptions
    from gaponet.api.paper import paper_experiment as paper_experiment
    from gaponet.api.results import *  # noqa: F403
    from gaponet.api.run_options import Connection as Connection
    from gaponet.api.run_options import RunOptions as RunOptions
    from gaponet.api.run_robot import run_robot as run_robot
    from gaponet.base.progress import progress_bar as progress_bar
    from gaponet.data.doctor import DoctorResult as DoctorResult
    from gaponet.data.importer import ImportResult as ImportResult
    from gaponet.data.store import Dataset as Dataset
    from gaponet.deploy.aligned_sim import AlignedSim as AlignedSim
    from gaponet.deploy.aligned_sim import AlignedSimOptions as AlignedSimOptions
    from gaponet.deploy.compensator import Compensator as Compensator
    from gaponet.deploy.mujoco_loop import MujocoAligner as MujocoAligner
    from gaponet.experiments.paper.experiment import PaperResult as PaperResult
    from gaponet.experiments.paper.options import PaperOptions as PaperOptions
    from gaponet.export.scene import Applied as Applied
    from gaponet.export.scene import apply as apply
    from gaponet.hw.control.controller import Controller as Controller
    from gaponet.hw.targets.client import RemoteRobot as RemoteRobot
    from gaponet.nn.artifact import GapModel as GapModel
    from gaponet.nn.config import ModelConfig as ModelConfig
    from gaponet.nn.network_card import NetworkCard as NetworkCard
    from gaponet.nn.training.config import TrainConfig as TrainConfig
    from gaponet.robot.servo_parameters import ServoParameters as ServoParameters
    from gaponet.robot.spec import RobotSpec as RobotSpec
    from gaponet.robot.spec import load_robot as load_robot
    from gaponet.sim.dataset_robot import open_dataset as open_dataset
    from gaponet.virtual.collect import CollectResult as CollectResult
else:
    _MODULES = {  # public name → module
        **dict.fromkeys(
            ("adapt_model", "adapt_robot", "check", "collect", "doctor", "evaluate", "excite",
             "export_network", "export_robot", "gap", "identify", "identify_torque",
             "import_logs", "networks", "pair", "randomization", "replay", "train"),
            "gaponet.api",
        ),
        **dict.fromkeys(
            ("AdaptResult", "CheckResult", "EvalResult", "ExciteResult", "ExportResult",
             "GapResult", "IdentifyResult", "PairResult", "ReplayResult", "RunResult",
             "TorqueResult", "TrainResult"),
            "gaponet.api.results",
        ),
        **dict.fromkeys(
            ("CollectOptions", "ExciteOptions", "IdentifyOptions", "ImportOptions",
             "TrainOptions"),
            "gaponet.api.options",
        ),
        "paper_experiment": "gaponet.api.paper",
        "PaperOptions": "gaponet.experiments.paper.options",
        "PaperResult": "gaponet.experiments.paper.experiment",
        "run_robot": "gaponet.api.run_robot",
        "RunOptions": "gaponet.api.run_options",
        "Connection": "gaponet.api.run_options",
        "progress_bar": "gaponet.base.progress",
        "CollectResult": "gaponet.virtual.collect",
        "DoctorResult": "gaponet.data.doctor",
        "ImportResult": "gaponet.data.importer",
        "Dataset": "gaponet.data.store",
        "open_dataset": "gaponet.sim.dataset_robot",
        "load_robot": "gaponet.robot.spec",
        "RobotSpec": "gaponet.robot.spec",
        "ServoParameters": "gaponet.robot.servo_parameters",
        "ModelConfig": "gaponet.nn.config",
        "TrainConfig": "gaponet.nn.training.config",
        "GapModel": "gaponet.nn.artifact",
        "NetworkCard": "gaponet.nn.network_card",
        "AlignedSim": "gaponet.deploy.aligned_sim",
        "AlignedSimOptions": "gaponet.deploy.aligned_sim",
        "MujocoAligner": "gaponet.deploy.mujoco_loop",
        "Compensator": "gaponet.deploy.compensator",
        "apply": "gaponet.export.scene",
        "Applied": "gaponet.export.scene",
        "Controller": "gaponet.hw.control.controller",
        "RemoteRobot": "gaponet.hw.targets.client",
    }  # fmt: skip

    def __getattr__(name: str) -> object:
        """Import a public name at its first use (PEP 562)."""
        if name in _MODULES:
            return getattr(import_module(_MODULES[name]), name)
        raise AttributeError(
            f"module 'gaponet' has no attribute '{name}'; it offers {', '.join(_MODULES)}"
        )

    def __dir__() -> list[str]:
        return ["GAPONetError", "__version__", *_MODULES]


__version__ = "0.1.0"
