"""Plays the motions of check.npz in Isaac Lab 3 on Newton's MuJoCo-Warp, in a few worlds, and prints the error beside
gaponet's: python check.py. The USD is made by mujoco-usd-converter.
"""

from pathlib import Path
from typing import Any

import gaponet_action as gaponet
import isaaclab.sim as sim_utils
import mujoco_usd_converter
import numpy as np
import torch
from isaaclab.assets import ArticulationCfg
from isaaclab.envs import ManagerBasedEnv, ManagerBasedEnvCfg, mdp
from isaaclab.managers import EventTermCfg, ObservationGroupCfg, ObservationTermCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import MJWarpSolverCfg, NewtonCfg

from gaponet.export.mujoco_servos import Turns, motions, read

HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names, turns, options = list(facts["plain"]), Turns(played), facts["options"]
usd = mujoco_usd_converter.Converter().convert(str(HERE / "robot.xml"), str(HERE / "usd"))
ctrl = torch.tensor(turns.ctrl, dtype=torch.float)
start = torch.zeros(2, turns.worlds, len(names))  # qpos and qvel that worlds begin with


def begin(env: Any, env_ids: Any) -> None:
    robot = env.scene["robot"]
    order = [names.index(name) for name in robot.joint_names]
    position, velocity = (x[env_ids][:, order] for x in start)
    robot.write_joint_state_to_sim_index(position=position, velocity=velocity, env_ids=env_ids)


@configclass
class Scene(InteractiveSceneCfg):
    robot: ArticulationCfg = ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/Robot",
        spawn=sim_utils.UsdFileCfg(usd_path=usd.path),
        init_state=ArticulationCfg.InitialStateCfg(joint_pos={n: facts["plain"][n]["home"] for n in names}),
        actuators=gaponet.isaaclab_actuators(HERE),
    )


@configclass
class Observations:
    @configclass
    class Policy(ObservationGroupCfg):
        q = ObservationTermCfg(func=mdp.joint_pos)

    policy: Policy = Policy()


@configclass
class Actions:
    joint_pos = gaponet.isaaclab_action(HERE, asset_name="robot", joint_names=[".*"])


@configclass
class Events:
    begin = EventTermCfg(func=begin, mode="reset")


step = float(np.median([m["dt"] for m in played])) / facts["decimation"]
solver = MJWarpSolverCfg(
    integrator=options["integrator"], tolerance=options["tolerance"], iterations=options["iterations"],
    ls_iterations=options["ls_iterations"], disable_contacts=True,
)  # fmt: skip
cfg = ManagerBasedEnvCfg(
    decimation=facts["decimation"], scene=Scene(num_envs=turns.worlds, env_spacing=2.0),
    sim=sim_utils.SimulationCfg(
        dt=step, use_newton_actuators=False, device="cpu", physics=NewtonCfg(solver_cfg=solver)
    ),
    observations=Observations(), actions=Actions(), events=Events(),
)  # fmt: skip
env = ManagerBasedEnv(cfg)
robot, term = env.scene["robot"], env.action_manager.get_term("joint_pos")
asked, qpos = [names.index(name) for name in term._joint_names], []
order = [list(robot.joint_names).index(name) for name in names]
for row, target in enumerate(ctrl):
    if begun := turns.begins.get(row):
        for world, motion in begun.items():
            for field, x in zip(("qpos", "qvel"), start, strict=True):
                x[world] = torch.tensor(played[motion][field][0])
        env.reset(env_ids=torch.tensor(list(begun)))
    term.told = target[:, asked]  # a recording begins under a command that has stood for long; training, at rest
    env.step(target[:, asked])
    qpos.append(robot.data.joint_pos.torch[:, order].clone().numpy())
error = turns.error(qpos, [names.index(name) for name in facts["corrected"]])
print(f"Isaac Lab, {turns.worlds} worlds: {1e3 * error:.2f} mrad; in gaponet {facts['left_mrad']['plain']:.2f}")
