"""Plays the motions of check.npz in mjlab, a world each, and prints the error beside gaponet's: python check.py"""

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

from gaponet_interop.engine.mujoco_servos import motions, read

HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names, rows = list(facts["joints"]), max(len(m["ctrl"]) for m in played)
held = lambda x: np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])  # noqa: E731
ctrl = torch.tensor(np.stack([held(m["ctrl"]) for m in played], axis=1), dtype=torch.float)
start = [torch.tensor(np.stack([m[field][0] for m in played]), dtype=torch.float) for field in ("qpos", "qvel")]


def begin(env: Any, env_ids: Any) -> None:
    robot = env.scene["robot"]
    order = [names.index(name) for name in robot.joint_names]
    robot.write_joint_state_to_sim(*(x[env_ids][:, order] for x in start), env_ids=env_ids)


options, decimation = gaponet.mjlab_options(HERE)
options = dataclasses.replace(options, timestep=float(np.median([m["dt"] for m in played])) / decimation)
cfg = ManagerBasedRlEnvCfg(
    decimation=decimation,
    scene=SceneCfg(num_envs=len(played), entities={"robot": gaponet.mjlab_entity(HERE)}),
    actions={"joint_pos": gaponet.mjlab_action(HERE, check=False, entity_name="robot", actuator_names=(".*",))},
    events={"begin": EventTermCfg(func=begin, mode="reset")},
    sim=SimulationCfg(mujoco=options),
)
env = ManagerBasedRlEnv(cfg, device="cpu")
env.reset()
robot, term = env.scene["robot"], env.action_manager.get_term("joint_pos")
asked = [names.index(name) for name in term.target_names]
order = [list(robot.joint_names).index(name) for name in facts["corrected"]]
columns, qpos = [names.index(name) for name in facts["corrected"]], []
for target in ctrl[:-1]:
    env.step(target[:, asked])
    qpos.append(robot.data.joint_pos[:, order].clone().numpy())
found = np.stack(qpos)
errors = [np.abs(found[: len(m["qpos"]) - 1, i] - m["qpos"][1:, columns]).mean() for i, m in enumerate(played)]
print(f"mjlab, {len(played)} worlds: {1e3 * np.mean(errors):.2f} mrad; in gaponet {facts['left_mrad']['joints']:.2f}")
