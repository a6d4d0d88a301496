"""A run's command says its configuration, and a shell that types it trains the same."""

import shlex
from dataclasses import replace
from types import SimpleNamespace

import pytest

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import PAPER_PPO, Budget, PPOConfig, PretrainingConfig, TrainConfig

CHANGED = TrainConfig(
    ModelConfig(kind="mlp", history=8, payload_input=False, mlp_hidden=(64, 32)),
    pretraining=PretrainingConfig(noise=0.1),
    ppo=PPOConfig(num_envs=7),
    seed=3,
    mixed_gains=True,
    rates=(50.0, 100.0),
)


def test_the_paper_s_recipe_has_no_supervised_start_and_keeps_what_was_changed():
    config = TrainConfig(ModelConfig(kind="paper"), ppo=PPOConfig(std=0.03), seed=4).paper_recipe()
    assert config.pretraining.rounds == 0
    assert config.ppo == replace(PAPER_PPO, std=0.03)
    assert (config.model.kind, config.seed) == ("paper", 4)


def test_the_default_number_of_simulations_depends_on_the_device():
    cuda = TrainConfig(ppo=PPOConfig(num_envs=256), device="cuda")
    assert (TrainConfig().sized().pretraining.num_envs, TrainConfig().sized().ppo.num_envs) == (
        256,
        256,
    )
    assert (cuda.sized().pretraining.num_envs, cuda.sized().ppo.num_envs) == (4096, 256)
    assert (
        cuda.options()
        == cuda.sized().options()
        == ["--pretraining.num-envs", "4096", "--device", "cuda"]
    )
    assert TrainConfig().options() == TrainConfig().sized().options() == []


@pytest.mark.parametrize(
    "config",
    [
        TrainConfig(),
        CHANGED,
        TrainConfig(ModelConfig(kind="paper", delta_hold=3)).paper_recipe(),
        replace(TrainConfig(), seed=9),
    ],
)
def test_the_options_of_a_configuration_give_it_back(monkeypatch, config):
    heard = []

    def train(dataset, *, config, options, **_):
        heard.append(replace(config, model=replace(config.model, kind=options.model)))
        raise UsageError("heard")

    monkeypatch.setattr(api, "train", train)
    words = shlex.split(
        shlex.join(["train", "data", "--out", "run", "--model", "gaponet", *config.options()])
    )
    assert main(words) == 2
    assert heard == [config]


@pytest.mark.parametrize("rate", [25.0, 49.85, 50.0, 100.2])
def test_no_option_is_short_near_the_rate_that_the_defaults_are_made_for(rate):
    assert TrainConfig().short_options(1 / rate) == []


def test_options_that_count_periods_are_short_at_200_hz_until_they_are_scaled():
    scaled = TrainConfig(ModelConfig(stride=4), ppo=PPOConfig(gamma=0.99))
    assert TrainConfig().short_options(1 / 200) == ["--model.history", "--ppo.gamma"]
    assert scaled.short_options(1 / 200) == []


def trained_at(rate, kind="gaponet"):
    """What gaponet train prints of a network that was trained at a rate, Hz."""
    errors = {"nominal": 0.02, "start": 0.01, "model": 0.005}
    card = {"dt": [1 / rate], "interrupted": False, "steps": 100, "seconds": 1.0}
    return SimpleNamespace(
        candidates={},
        val_mpjae=errors,
        card=card,
        kind=kind,
        how_trained="",
        gain=SimpleNamespace(text="half", helps=True),
        doctor=SimpleNamespace(findings=()),
        model=SimpleNamespace(path="run"),
        to_dict=dict,
    )


@pytest.mark.parametrize(
    ("rate", "kind", "warned"), [(200, "gaponet", True), (200, "trees", False), (50, "mlp", False)]
)
def test_training_names_the_options_to_scale_at_a_high_rate(
    monkeypatch, capsys, rate, kind, warned
):
    monkeypatch.setattr(api, "train", lambda dataset, **_: trained_at(rate, kind))
    assert main(["train", "data", "--out", "run"]) == 0
    assert ("--ppo.gamma" in capsys.readouterr().out) == warned


@pytest.mark.parametrize(
    ("text", "seconds", "steps"), [("90s", 90, None), ("10m", 600, None), ("2e6", None, 2_000_000)]
)
def test_budgets(text, seconds, steps):
    assert Budget.parse(text) == Budget(seconds, steps)


@pytest.mark.parametrize("text", ["", "-5m", "ten", "5 weeks", "0s", "10"])
def test_an_invalid_budget_is_refused(text):
    with pytest.raises(UsageError, match="--budget"):
        Budget.parse(text)
