"""Supervised pre-training: the baseline's recipe, the sensor predictor's features."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.training.config import PretrainingConfig, RewardConfig, TrainConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.nn.training.pretraining import Pretraining, pretraining_config


def test_the_label_baseline_is_one_round():
    warm = PretrainingConfig(rounds=4, gradient_steps=50)
    assert pretraining_config(TrainConfig(pretraining=warm)) == warm
    once = pretraining_config(TrainConfig(ModelConfig(kind="inverse"), pretraining=warm))
    assert (once.rounds, once.gradient_steps) == (1, 200)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    torch.manual_seed(0)
    robot = write_arm(tmp_path_factory.mktemp("arm"))
    config = ModelConfig(history=2, num_probes=4, sensor_hidden=(32,), branch_hidden=(16,), trunk_hidden=(16,))
    env = DeltaEnv(recordings(robot, 4), robot, config, 32, 10**9, RewardConfig(), nthread=1)
    net = build_network(config, 2)
    settings = PretrainingConfig(num_envs=32, steps=64, gradient_steps=2)
    warm = Pretraining(net, env, np.zeros((len(env.qpos), 2), np.float32), settings, seed=0)
    warm.fit_inputs()
    return warm


def test_the_predictor_is_fitted_on_the_features_that_it_is_asked_with(fitted):
    net, before = fitted.net, fitted.net.features.standardise.mean.clone()
    assert before.abs().max() > 0
    fitted.round(lambda: 0.0)
    assert torch.equal(net.features.standardise.mean, before)
    assert fitted.pool_x[0].shape == (32 * 64, net.config.input_dim(2))


def test_of_too_many_states_the_pool_keeps_a_part_of_every_environment(fitted, monkeypatch):
    env, rows = fitted.env, []
    fitted.config = replace(fitted.config, rounds=2, steps=6)
    for most in (10**6, 2 * 6 * 32 // 3):
        monkeypatch.setattr("gaponet.nn.training.pretraining.MAX_POOL_STATES", most)
        env.rng = np.random.default_rng(0)
        x, labels = fitted.rollout(follow_labels=True)
        rows.append(x.numpy())
        assert len(labels) == len(x)
    every, some = rows
    assert len(every) == 6 * 32
    kept = np.arange(6 * 32).reshape(6, 32)
    np.testing.assert_array_equal(some, every[np.concatenate([kept[t, t % 3 :: 3] for t in range(6)])])
