"""What PPO is given is prepared once, and corrects as the network itself does."""

import torch
from arm import recordings, write_arm

from gaponet.model.config import ModelConfig
from gaponet.model.deeponet import build_network
from gaponet.training.config import PPOConfig, RewardConfig
from gaponet.training.env import DeltaEnv
from gaponet.training.ppo import Correct, PreparedEnv, make_runner, trained_by, update

MODEL = ModelConfig(history=2, num_probes=4, sensor_hidden=(16,), branch_hidden=(16,), trunk_hidden=(16,))
PPO = PPOConfig(num_envs=16, num_steps=8, epochs=1, mini_batches=2, critic_warmup=0, learning_rate=1e-3)


def test_the_prepared_observation_corrects_as_the_network_does(tmp_path):
    robot = write_arm(tmp_path)
    env = DeltaEnv(recordings(robot, 4), robot, MODEL, 16, 100, RewardConfig(), nthread=1)
    net = build_network(MODEL, 2)
    torch.nn.init.normal_(net.trunk[-1].weight)
    before = {name: p.clone() for name, p in net.named_parameters()}
    prepared = PreparedEnv(env, net).get_observations()["actor"]
    with torch.inference_mode():
        assert torch.allclose(Correct(net)(prepared), net(env.get_observations()["actor"]), atol=1e-6)
    runner = make_runner(env, net, PPO)
    update(runner)
    changed = {
        name.split(".")[0] for name, p in trained_by(runner).named_parameters() if not torch.equal(p, before[name])
    }
    assert changed == {"branch", "trunk", "bias"}
