"""Networks: shapes, bounds, what they can and cannot see."""

import pytest
import torch

from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network


def x(config, n, batch=7, scale=1.0):
    torch.manual_seed(0)
    return scale * torch.randn(batch, config.input_dim(n))


@pytest.mark.parametrize(
    "config",
    [ModelConfig(), ModelConfig(kind="mlp"), ModelConfig(sensors="predicted"),
     ModelConfig(payload_input=False, stride=2)],
    ids=["gaponet", "mlp", "sensors", "no-payload"],
)  # fmt: skip
def test_corrections_are_bounded_whatever_comes_in(config):
    net = build_network(config, 3)
    for p in net.parameters():
        p.data.mul_(5)
    delta = net(x(config, 3, scale=1e6))
    assert delta.shape == (7, 3)
    assert delta.abs().max() <= config.delta_max


def test_an_untrained_operator_hardly_corrects():
    config = ModelConfig()
    assert build_network(config, 5)(x(config, 5)).abs().max() < 0.05


def test_features_do_not_change_when_all_positions_shift_but_the_pose_itself():
    config, n = ModelConfig(payload_input=False), 2
    features = build_network(config, n).features
    a = x(config, n)
    b = a.clone()
    positions = [0, 1] + [4 + 6 * k + i for k in range(4) for i in (0, 1, 4, 5)] + [-2, -1]
    b[:, positions] += 0.7
    difference = (features.relative(b) - features.relative(a)).abs().max(dim=0).values
    assert torch.allclose(difference[:2], torch.tensor(0.7))
    assert difference[2:].max() < 1e-5


def test_noise_on_the_inputs_changes_the_answer_and_none_does_not():
    config = ModelConfig()
    net = build_network(config, 2)
    torch.nn.init.normal_(net.trunk[-1].weight)
    data = x(config, 2)
    assert torch.equal(net(data), net(data))
    net.features.noise_std = 0.4
    assert not torch.equal(net(data), net(data))


def test_a_joint_is_told_the_posture_of_the_others_but_not_their_past():
    config, n = ModelConfig(history=2), 3
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
    config, n = ModelConfig(sensors="predicted", num_probes=4), 3
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight)
    sensors = torch.zeros(1, 4, 2, n)
    net.sensors = lambda z: sensors.reshape(1, -1)
    before = net.prepare(x(config, n, 1))
    sensors[0, 2, 1, 2] = 1.0  # probe 2, velocity, joint 2
    assert (net.prepare(x(config, n, 1)) - before).nonzero().tolist() == [[0, 2, n + 2 * 2 + 1]]
