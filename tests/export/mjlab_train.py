"""In an environment with mjlab: its own train command, two iterations of following sines with an export's robot.

python mjlab_train.py LOGS     # run in the export's folder
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gaponet_action as gaponet  # of the export
import torch
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import joint_pos_rel, joint_vel_rel, reset_joints_by_offset, time_out
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.scene import SceneCfg
from mjlab.scripts import train
from mjlab.sim import SimulationCfg
from mjlab.tasks.registry import register_mjlab_task

TASK = "Gaponet-Follow"


def reference(env: Any) -> torch.Tensor:
    return 0.3 * torch.sin(3.0 * env.step_dt * env.episode_length_buf)[:, None]


def follows(env: Any) -> torch.Tensor:
    robot = env.scene["robot"]
    return -(robot.data.joint_pos - robot.data.default_joint_pos - reference(env)).square().mean(dim=1)


def configuration(folder: Path) -> ManagerBasedRlEnvCfg:
    options, decimation = gaponet.mjlab_options(folder)
    seen = {"q": ObservationTermCfg(func=joint_pos_rel), "v": ObservationTermCfg(func=joint_vel_rel),
            "to": ObservationTermCfg(func=reference)}  # fmt: skip
    anywhere = {"position_range": (-0.05, 0.05), "velocity_range": (0.0, 0.0)}
    return ManagerBasedRlEnvCfg(
        decimation=decimation,
        scene=SceneCfg(num_envs=4, entities={"robot": gaponet.mjlab_entity(folder)}),
        observations={who: ObservationGroupCfg(dict(seen)) for who in ("actor", "critic")},
        actions={"joint_pos": gaponet.mjlab_action(folder, entity_name="robot", actuator_names=(".*",), scale=0.3,
                                                   use_default_offset=True)},
        events={"begin": EventTermCfg(func=reset_joints_by_offset, mode="reset", params=anywhere)},
        rewards={"follows": RewardTermCfg(func=follows, weight=1.0)},
        terminations={"time_out": TerminationTermCfg(func=time_out, time_out=True)},
        sim=SimulationCfg(mujoco=options),
        episode_length_s=0.3,
    )  # fmt: skip


def main(logs: str) -> None:
    network = RslRlModelCfg(hidden_dims=(32, 32), distribution_cfg={
        "class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"})  # fmt: skip
    agent = RslRlOnPolicyRunnerCfg(
        actor=network, critic=RslRlModelCfg(hidden_dims=(32, 32)), algorithm=RslRlPpoAlgorithmCfg(num_mini_batches=2),
        experiment_name="follow", num_steps_per_env=24, logger="tensorboard", save_interval=1,
    )  # fmt: skip
    cfg = configuration(Path.cwd())
    register_mjlab_task(task_id=TASK, env_cfg=cfg, play_env_cfg=cfg, rl_cfg=agent)
    sys.argv = [
        "train",
        TASK,
        "--agent.max-iterations",
        "2",
        "--env.scene.num-envs",
        "6",
        "--log-root",
        logs,
        "--gpu-ids",
        "None",
    ]
    train.main()


if __name__ == "__main__":
    main(sys.argv[1])
