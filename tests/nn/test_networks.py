"""Networks: shapes, bounds, what they can and cannot see."""

from dataclasses import replace

import pytest
import torch

from gaponet.base.errors import UsageError
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import num_parameters
from gaponet.nn.networks import NETWORKS, build_network


def x(config, n, batch=7, scale=1.0):
    torch.manual_seed(0)
    return scale * torch.randn(batch, config.input_dim(n))


@pytest.mark.parametrize("kind", NETWORKS)
def test_corrections_of_every_network_are_bounded_whatever_comes_in(kind):
    config = ModelConfig(kind=kind)
    assert largest_correction_of_large_weights(config) == pytest.approx(config.delta_max)


@pytest.mark.parametrize(
    "config",
    [ModelConfig(sensors="predicted"), ModelConfig(payload_input=False, stride=2)],
    ids=["sensors", "no-payload"],
)
def test_corrections_are_bounded_whatever_comes_in(config):
    assert largest_correction_of_large_weights(config) == pytest.approx(config.delta_max)


def largest_correction_of_large_weights(config):
    """Return max |Δa| of a network with large weights, for large inputs, rad."""
    torch.manual_seed(1)
    net = build_network(config, 3).eval()
    for weights in net.parameters():
        torch.nn.init.normal_(weights, std=5)
    delta = net(x(config, 3, scale=1e6))
    assert delta.shape == (7, 3)
    return delta.abs().max().item()


def test_features_do_not_change_when_all_positions_shift_but_the_pose_itself():
    config = ModelConfig(payload_input=False)
    n = 2
    features = build_network(config, n).features
    a = x(config, n)
    b = a.clone()
    positions = [0, 1] + [4 + 6 * k + i for k in range(4) for i in (0, 1, 4, 5)] + [-2, -1]
    b[:, positions] += 0.7
    difference = (features.relative(b) - features.relative(a)).abs().max(dim=0).values
    assert torch.allclose(difference[:2], torch.tensor(0.7))
    assert difference[2:].max() < 1e-5


def test_a_joint_observes_the_state_of_the_others_but_not_their_history():
    config = ModelConfig(history=2)
    n = 3
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight)
    a = x(config, n)
    b = a.clone()
    b[:, 2 * n + 1 : -n - 1 : n] += 0.5  # joint 1's past
    changed = (net(b) - net(a)).abs().max(dim=0).values
    assert changed[1] > 1e-3
    assert changed[[0, 2]].max() == 0
    b = a.clone()
    b[:, n + 1] += 0.5  # its speed
    assert (net(b) - net(a)).abs().max(dim=0).values.min() > 1e-4


def test_a_joint_reads_its_own_sensors():
    config = ModelConfig(sensors="predicted", num_probes=4)
    n = 3
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight)
    sensors = torch.zeros(1, 4, 2, n)
    net.sensors = lambda z: sensors.reshape(1, -1)
    before = net.prepare(x(config, n, 1))
    sensors[0, 2, 1, 2] = 1.0  # probe 2, velocity, joint 2
    assert (net.prepare(x(config, n, 1)) - before).nonzero().tolist() == [[0, 2, n + 2 * 2 + 1]]


BASELINES = ("mlp", "shared_mlp")


@pytest.mark.parametrize("kind", ["gaponet", *BASELINES])
def test_an_untrained_network_corrects_nothing(kind):
    config = ModelConfig(kind=kind)
    assert build_network(config, 5)(x(config, 5)).abs().max() == 0


@pytest.mark.parametrize("kind", BASELINES)
def test_every_number_of_the_observation_and_the_action_is_seen(kind):
    config = ModelConfig(kind=kind, history=3)
    n = 2
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
    operator, shared = (
        build_network(replace(config, kind=kind), n) for kind in ("gaponet", "shared_mlp")
    )
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


def test_a_matched_mlp_needs_hidden_layers():
    with pytest.raises(UsageError, match="proportions"):
        ModelConfig(kind="mlp", mlp_match=True, mlp_hidden=())
