"""Learned baselines: size, what they see."""

from dataclasses import replace

import pytest
import torch

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import num_parameters
from gaponet.nn.networks import build_network

KINDS = ("mlp", "shared_mlp")


def x(config, n, batch=7):
    torch.manual_seed(0)
    return torch.randn(batch, config.input_dim(n))


@pytest.mark.parametrize("kind", [*KINDS, "inverse"])
def test_an_untrained_baseline_corrects_nothing(kind):
    config = ModelConfig(kind=kind)
    assert build_network(config, 5)(x(config, 5)).abs().max() == 0


@pytest.mark.parametrize("kind", KINDS)
def test_every_number_of_the_observation_and_the_action_is_seen(kind):
    config, n = ModelConfig(kind=kind, history=3), 2
    net = build_network(config, n)
    torch.nn.init.normal_(net.net[-1].weight, std=0.01)
    data = x(config, n, batch=1).requires_grad_(True)
    net(data).sum().backward()
    assert (data.grad != 0).all()


def test_a_matched_mlp_has_the_operators_parameters_within_one_percent():
    operator = num_parameters(build_network(ModelConfig(), 10))
    matched = build_network(ModelConfig(kind="mlp", mlp_match=True), 10)
    assert abs(num_parameters(matched) / operator - 1) < 0.01


@pytest.mark.parametrize("n", [2, 10])
def test_the_shared_mlp_has_the_weights_of_branch_and_trunk_and_of_other_joints_no_past(n):
    config = ModelConfig()
    operator, shared = (build_network(replace(config, kind=kind), n) for kind in ("gaponet", "shared_mlp"))
    assert abs(num_parameters(shared) / num_parameters(operator) - 1) < 0.02
    torch.nn.init.normal_(shared.net[-1].weight)
    data = x(shared.config, n, batch=1).requires_grad_(True)
    shared(data)[0, 0].backward()
    past = data.grad[0, 2 * n : 2 * n + 3 * n * config.history].reshape(-1, n)
    assert (past[:, 0] != 0).all()
    assert (past[:, 1:] == 0).all()


def test_building_a_matched_mlp_leaves_the_seed_alone():
    config = ModelConfig(kind="mlp", mlp_match=True)
    torch.manual_seed(0)
    first = build_network(config, 2).net[0].weight
    torch.manual_seed(0)
    assert torch.equal(torch.nn.Linear(first.shape[1], first.shape[0]).weight, first)


def test_proportions_are_needed_to_match():
    with pytest.raises(UsageError, match="give the proportions"):
        ModelConfig(kind="mlp", mlp_match=True, mlp_hidden=())
