"""Play the motions of check.npz in Isaac Lab 3, and print the error beside gaponet's.

A few worlds run on Newton's MuJoCo-Warp. The USD is made by mujoco-usd-converter.

    python check.py                         # robot_cfg.py: Isaac Lab's own classes
    python check.py action                  # the action term of gaponet_action.py
    python check.py randomization.json ROW  # the action term, with a unit of the file

Isaac Lab's native actuators play its own classes; they are off with the action term.
`gaponet export ROBOT --to randomization` writes the file; a unit is a row of it.
"""

import sys
from pathlib import Path

import gaponet_action as gaponet
import isaaclab.sim as sim_utils
import make_usd
import robot_cfg
from isaaclab.assets import ArticulationCfg
from isaaclab.envs import ManagerBasedEnv, ManagerBasedEnvCfg, mdp
from isaaclab.managers import EventTermCfg, ObservationGroupCfg, ObservationTermCfg, SceneEntityCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import MJWarpSolverCfg, NewtonCfg

from gaponet.export.shipped.mujoco_servos import Check
from gaponet.export.shipped.unit_events import apply_units

HERE = Path(__file__).parent
check = Check(HERE)
player = gaponet.CheckPlayer(check)
reset = player.reset_event()
usd = make_usd.convert(HERE / "usd")
is_native = not sys.argv[1:]
form = "native" if is_native else "plain"
actuators = robot_cfg.ACTUATORS if is_native else gaponet.isaaclab_actuators(HERE)
of_all = {"asset_name": "robot", "joint_names": [".*"]}
own_action = mdp.JointPositionActionCfg(
    **of_all, offset=robot_cfg.OFFSETS, use_default_offset=False
)


@configclass
class Scene(InteractiveSceneCfg):
    robot: ArticulationCfg = ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/Robot",
        spawn=sim_utils.UsdFileCfg(usd_path=usd),
        init_state=ArticulationCfg.InitialStateCfg(joint_pos=robot_cfg.HOME),
        actuators=actuators,
    )


@configclass
class Observations:
    @configclass
    class Policy(ObservationGroupCfg):
        q = ObservationTermCfg(func=mdp.joint_pos)

    policy: Policy = Policy()


@configclass
class Actions:
    joint_pos = own_action if is_native else gaponet.isaaclab_action(HERE, **of_all)


@configclass
class Events:
    start = EventTermCfg(func=reset, mode="reset")
    unit: EventTermCfg | None = None


events = Events()
if sys.argv[2:]:
    unit = {
        "file": sys.argv[1],
        "rows": [int(sys.argv[2])] * check.worlds,
        "asset_cfg": SceneEntityCfg("robot"),
    }
    events.unit = EventTermCfg(func=apply_units, mode="reset", params=unit)
fields = ("integrator", "tolerance", "iterations", "ls_iterations")
solver = MJWarpSolverCfg(
    disable_contacts=True, **{field: check.facts["options"][field] for field in fields}
)
simulation = sim_utils.SimulationCfg(
    dt=check.step,
    use_newton_actuators=is_native,
    device="cpu",
    physics=NewtonCfg(solver_cfg=solver),
)
cfg = ManagerBasedEnvCfg(
    decimation=check.facts["decimation"],
    scene=Scene(num_envs=check.worlds, env_spacing=2.0),
    sim=simulation,
    observations=Observations(),
    actions=Actions(),
    events=events,
)
env = ManagerBasedEnv(cfg)
path = player.run(env, env.action_manager.get_term("joint_pos")._joint_names)
what = "'s own classes" if is_native else ", action term"
check.report(f"Isaac Lab{what}", path, form)
