"""In an environment with Isaac Lab: its own train command, two iterations of following sines with an export's robot.

python isaaclab_train.py     # run in the export's folder; logs/ lies there afterwards
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gaponet_action as gaponet  # of the export
import gymnasium
import isaaclab.sim as sim_utils
import mujoco_usd_converter
import torch
from isaaclab.assets import ArticulationCfg
from isaaclab.envs import ManagerBasedRLEnvCfg, mdp
from isaaclab.managers import EventTermCfg, ObservationGroupCfg, ObservationTermCfg, RewardTermCfg, TerminationTermCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.utils import configclass
from isaaclab_newton.physics import MJWarpSolverCfg, NewtonCfg
from isaaclab_rl.entrypoints.api import TrainingRequest, train
from isaaclab_rl.rsl_rl import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg

HERE, TASK = Path.cwd(), "Gaponet-Follow"
FACTS = gaponet.read_facts(HERE)
USD = mujoco_usd_converter.Converter().convert(str(HERE / "robot.xml"), str(HERE / "usd")).path


def reference(env: Any) -> torch.Tensor:
    now = getattr(env, "episode_length_buf", None)  # not there yet where managers are made
    return torch.zeros(env.num_envs, 1) if now is None else 0.3 * torch.sin(3.0 * env.step_dt * now)[:, None]


def follows(env: Any) -> torch.Tensor:
    robot = env.scene["robot"].data
    return -(robot.joint_pos.torch - robot.default_joint_pos.torch - reference(env)).square().mean(dim=1)


@configclass
class Scene(InteractiveSceneCfg):
    robot: ArticulationCfg = ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/Robot",
        spawn=sim_utils.UsdFileCfg(usd_path=USD),
        init_state=ArticulationCfg.InitialStateCfg(joint_pos={n: j["home"] for n, j in FACTS["plain"].items()}),
        actuators=gaponet.isaaclab_actuators(HERE),
    )


@configclass
class Observations:
    @configclass
    class Policy(ObservationGroupCfg):
        q = ObservationTermCfg(func=mdp.joint_pos_rel)
        v = ObservationTermCfg(func=mdp.joint_vel_rel)
        to = ObservationTermCfg(func=reference)

    policy: Policy = Policy()


@configclass
class Actions:
    joint_pos = gaponet.isaaclab_action(
        HERE, asset_name="robot", joint_names=[".*"], scale=0.3, use_default_offset=True
    )


@configclass
class Events:
    begin = EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={"position_range": (-0.05, 0.05), "velocity_range": (0.0, 0.0)},
    )


@configclass
class Rewards:
    follows = RewardTermCfg(func=follows, weight=1.0)


@configclass
class Terminations:
    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)


@configclass
class Follow(ManagerBasedRLEnvCfg):
    decimation = FACTS["decimation"]
    episode_length_s = 0.3
    scene: Scene = Scene(num_envs=6, env_spacing=2.0)
    observations: Observations = Observations()
    actions: Actions = Actions()
    events: Events = Events()
    rewards: Rewards = Rewards()
    terminations: Terminations = Terminations()
    sim: sim_utils.SimulationCfg = sim_utils.SimulationCfg(
        dt=FACTS["options"]["timestep"],
        device="cpu",
        use_newton_actuators=False,
        physics=NewtonCfg(solver_cfg=MJWarpSolverCfg(integrator="implicitfast", disable_contacts=True)),
    )


@configclass
class Agent(RslRlOnPolicyRunnerCfg):
    device = "cpu"
    num_steps_per_env = 24
    max_iterations = 2
    save_interval = 1
    experiment_name = "follow"
    logger = "tensorboard"
    actor = RslRlMLPModelCfg(
        hidden_dims=[32, 32],
        activation="elu",
        distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=1.0),
    )
    critic = RslRlMLPModelCfg(hidden_dims=[32, 32], activation="elu")
    algorithm = RslRlPpoAlgorithmCfg(
        num_mini_batches=2, num_learning_epochs=2, value_loss_coef=1.0, use_clipped_value_loss=True, clip_param=0.2,
        entropy_coef=0.005, learning_rate=1e-3, schedule="adaptive", gamma=0.99, lam=0.95, desired_kl=0.01,
        max_grad_norm=1.0,
    )  # fmt: skip


if __name__ == "__main__":
    sys.modules["isaaclab_train"] = sys.modules["__main__"]  # Isaac Lab looks classes up by their module's name
    gymnasium.register(
        TASK,
        entry_point="isaaclab.envs:ManagerBasedRLEnv",
        disable_env_checker=True,
        kwargs={"env_cfg_entry_point": "isaaclab_train:Follow", "rsl_rl_cfg_entry_point": "isaaclab_train:Agent"},
    )
    sys.exit(train(TrainingRequest(backend="rsl_rl", task=TASK, num_envs=6, device="cpu", max_iterations=2)))
