"""Plays the motions of check.npz in mjlab, in a few worlds, and prints the error beside gaponet's: python check.py"""

import dataclasses
from pathlib import Path
from typing import Any

import gaponet_action as gaponet
import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import SimulationCfg

from gaponet.export.mujoco_servos import Turns, motions, read

HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names, turns = list(facts["joints"]), Turns(played)
ctrl = torch.tensor(turns.ctrl, dtype=torch.float)
start = torch.zeros(2, turns.worlds, len(names))  # qpos and qvel that worlds begin with


def begin(env: Any, env_ids: Any) -> None:
    robot = env.scene["robot"]
    order = [names.index(name) for name in robot.joint_names]
    robot.write_joint_state_to_sim(*(x[env_ids][:, order] for x in start), env_ids=env_ids)


options, decimation = gaponet.mjlab_options(HERE)
options = dataclasses.replace(options, timestep=float(np.median([m["dt"] for m in played])) / decimation)
cfg = ManagerBasedRlEnvCfg(
    decimation=decimation,
    scene=SceneCfg(num_envs=turns.worlds, entities={"robot": gaponet.mjlab_entity(HERE)}),
    actions={"joint_pos": gaponet.mjlab_action(HERE, check=False, entity_name="robot", actuator_names=(".*",))},
    events={"begin": EventTermCfg(func=begin, mode="reset")},
    sim=SimulationCfg(mujoco=options),
)
env = ManagerBasedRlEnv(cfg, device="cpu")
robot, term = env.scene["robot"], env.action_manager.get_term("joint_pos")
asked, qpos = [names.index(name) for name in term.target_names], []
order = [list(robot.joint_names).index(name) for name in names]
for row, target in enumerate(ctrl):
    if begun := turns.begins.get(row):
        for world, motion in begun.items():
            for field, x in zip(("qpos", "qvel"), start, strict=True):
                x[world] = torch.tensor(played[motion][field][0])
        env.reset(env_ids=torch.tensor(list(begun)))
    term.told = target[:, asked]  # a recording begins under a command that has stood for long; training, at rest
    env.step(target[:, asked])
    qpos.append(robot.data.joint_pos[:, order].clone().numpy())
error = turns.error(qpos, [names.index(name) for name in facts["corrected"]])
print(f"mjlab, {turns.worlds} worlds: {1e3 * error:.2f} mrad; in gaponet {facts['left_mrad']['joints']:.2f}")
