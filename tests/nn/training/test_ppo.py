"""PPO by joint: the estimates by hand, what is trained, and that it learns where there is
something to learn.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.config import PPOConfig
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.ppo import PPO, advantages
from gaponet.nn.training.sensor_fit import fit_inputs

MODEL = ModelConfig(
    history=2, num_probes=4, sensor_hidden=(16,), branch_hidden=(16,), trunk_hidden=(16,)
)
SETTINGS = PPOConfig(
    num_envs=16,
    num_steps=8,
    epochs=1,
    mini_batches=2,
    critic_warmup=0,
    explained=-1e9,
    critic_hidden=(32,),
)


@pytest.fixture
def env(tmp_path):
    robot = write_arm(tmp_path)
    options = EnvOptions(num_envs=16, episode_s=2.0, nthread=1)
    return DeltaEnv(recordings(robot, 4, kp=0.5), robot, MODEL, options)


def test_advantages_by_hand():
    reward = torch.tensor([1.0, 2.0, 4.0]).reshape(3, 1, 1)
    value = torch.tensor([0.5, 1.0, 2.0]).reshape(3, 1, 1)
    done = torch.tensor([0.0, 1.0, 0.0]).reshape(3, 1, 1)  # a motion ends after the second step
    found = advantages(reward, value, torch.full((1, 1), 8.0), done, gamma=0.5, lam=0.5).flatten()
    # δ = 1 + 0.5·1 − 0.5 = 1;  2 − 1 = 1;  4 + 0.5·8 − 2 = 6;  the first adds 0.25 of the second's,
    # which adds nothing.
    assert found.tolist() == [1.25, 1.0, 6.0]


def test_the_actor_is_trained_after_the_critic_explains_the_returns(env):
    torch.manual_seed(0)
    net = build_network(MODEL, 2)
    before = {name: p.clone() for name, p in net.named_parameters()}
    waiting = PPO(
        env,
        net,
        PPOConfig(num_envs=16, num_steps=8, critic_warmup=2, explained=1.0, critic_hidden=(32,)),
    )
    for _ in range(4):
        found = waiting.update()
    assert all(torch.equal(p, before[name]) for name, p in net.named_parameters())
    assert found.explained_variance < 1
    assert found.learning_rate == 0.0
    PPO(env, net, SETTINGS).update()
    changed = {
        name.split(".")[0] for name, p in net.named_parameters() if not torch.equal(p, before[name])
    }
    assert changed == {"branch", "trunk", "bias"}


def test_joints_that_do_not_explore_are_masked_out(env):
    """Without noise on a joint its ratio is 1 whatever its advantage: it must be left out, not
    averaged in.
    """
    torch.manual_seed(0)
    learner = PPO(env, build_network(MODEL, 2), SETTINGS)
    batch = learner.collect()
    still = batch.exploration_mask == 0
    assert 0.2 < still.float().mean() < 0.8
    assert torch.equal(batch.actions[still], batch.mean[still])
    moved = batch.actions - batch.mean
    assert moved[~still].std().item() == pytest.approx(learner.innovation_std, rel=0.2)


def test_exploration_has_the_set_correlation_and_width(env):
    torch.manual_seed(0)
    learner = PPO(
        env,
        build_network(MODEL, 2),
        PPOConfig(num_envs=16, num_steps=32, noise_share=1.0, std=0.01),
    )
    seen = []
    for _ in range(8):
        learner.collect()
        seen.append(learner.noise.clone())
    assert torch.stack(seen).std().item() == pytest.approx(0.01, rel=0.15)
    assert learner.noise_correlation == pytest.approx(np.exp(-0.02 / 0.2))


def test_exploration_lasts_as_long_at_another_control_rate(tmp_path):
    robot = write_arm(tmp_path)
    fast = [replace(recording, dt=0.01) for recording in recordings(robot, 4, kp=0.5)]
    options = EnvOptions(num_envs=16, episode_s=2.0, nthread=1)
    env = DeltaEnv(fast, robot, MODEL, options)
    learner = PPO(env, build_network(MODEL, 2), SETTINGS)
    assert learner.noise_correlation == pytest.approx(np.exp(-0.01 / 0.2))


def test_ppo_increases_the_reward_in_a_wrong_simulator(env):
    torch.manual_seed(0)
    net = build_network(MODEL, 2)
    fit_inputs(net, env, env.get_observations()["actor"], 64, seed=0)
    learner = PPO(
        env,
        net,
        PPOConfig(
            num_envs=16,
            num_steps=32,
            epochs=5,
            std=0.01,
            explained=0.0,
            critic_warmup=2,
            learning_rate=3e-4,
            critic_hidden=(32,),
        ),
    )
    rewards = [learner.update().reward for _ in range(40)]
    assert np.mean(rewards[-5:]) > 0.8 * np.mean(rewards[:3])
