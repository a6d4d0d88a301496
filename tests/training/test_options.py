"""A run's command says its configuration, and a shell that types it trains the same."""

import shlex
from dataclasses import replace

import pytest

from gaponet import api
from gaponet.cli.main import main
from gaponet.errors import UsageError
from gaponet.model.config import ModelConfig
from gaponet.training.config import PPOConfig, TrainConfig, WarmStartConfig

CHANGED = TrainConfig(
    ModelConfig(kind="mlp", history=8, payload_input=False, mlp_hidden=(64, 32)),
    warm_start=WarmStartConfig(noise=0.1), ppo=PPOConfig(num_envs=7), seed=3, mixed_gains=True,
    rates=(50.0, 100.0),
)  # fmt: skip


@pytest.mark.parametrize("config", [TrainConfig(), CHANGED, replace(TrainConfig(), seed=9).fast()])
def test_the_options_of_a_configuration_give_it_back(monkeypatch, config):
    heard = []

    def train(dataset, out, budget, config, model, *_):
        heard.append(replace(config, model=replace(config.model, kind=model)))
        raise UsageError("heard")

    monkeypatch.setattr(api, "train", train)
    words = shlex.split(shlex.join(["train", "data", "--out", "run", *config.options()]))
    assert main(words) == 2
    assert heard == [config]
