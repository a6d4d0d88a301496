"""Networks: shapes, bounds, what they can and cannot see."""

import pytest
import torch

from gaponet.model.config import ModelConfig
from gaponet.model.deeponet import build_network
from gaponet.model.sensor import probe_offsets


def x(config, n, batch=7, scale=1.0):
    torch.manual_seed(0)
    return scale * torch.randn(batch, config.input_dim(n))


@pytest.mark.parametrize(
    "config",
    [ModelConfig(), ModelConfig(kind="mlp"), ModelConfig(sensors="off"), ModelConfig(branch_history=False, history=2),
     ModelConfig(payload_input=False, stride=2), ModelConfig(coupling="full"),
     ModelConfig(coupling="full", sensors="off", payload_input=False), ModelConfig(kind="transformer"),
     ModelConfig(kind="fno", payload_input=False), ModelConfig(branch="stacked"),
     ModelConfig(branch="stacked", coupling="full", sensors="oracle"), ModelConfig(sensors="learned", sensor_hold=2),
     ModelConfig(sensor_hold=3, payload_predictor=False), ModelConfig(payload_trunk=False)],
    ids=["gaponet", "mlp", "sensors-off", "sensors-only", "no-payload", "full", "full-off", "transformer", "fno",
         "stacked", "stacked-oracle", "learned", "held", "no-payload-trunk"],
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


def test_one_branch_net_serves_all_joints_and_the_size_is_the_papers():
    config = ModelConfig(
        payload_input=False, coupling="full", branch_hidden=(256, 256, 256), trunk_hidden=(128, 128, 128)
    )
    net = build_network(config, 10)
    assert net.branch[-1].out_features == 10 * 16
    assert net.branch[0].in_features == 20 * 2 * 10 + 140
    assert net.trunk[-1].out_features == 10 * 16


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


def test_sampling_sensors_changes_the_answer_and_the_mean_does_not():
    config = ModelConfig()
    net = build_network(config, 2)
    torch.nn.init.normal_(net.trunk[-1].weight)
    data = x(config, 2)
    assert torch.equal(net(data), net(data))
    net.sample_sensors = True
    assert not torch.equal(net(data), net(data))


def test_joints_meet_only_through_their_sensors():
    config, n = ModelConfig(sensors="off", history=2), 3
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight)
    a = x(config, n)
    b = a.clone()
    b[:, [1, n + 1]] += 0.5  # joint 1's position and velocity
    changed = (net(b) - net(a)).abs().max(dim=0).values
    assert changed[1] > 1e-3
    assert changed[[0, 2]].max() == 0


def test_a_joint_reads_its_own_sensors():
    config, n = ModelConfig(num_probes=4), 3
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight)
    z = torch.zeros(1, config.observation_dim(n) + n)
    sensors = torch.zeros(1, 4, 2, n)
    before = net._joint_inputs(z, sensors.reshape(1, -1))[0]
    sensors[0, 2, 1, 2] = 1.0  # probe 2, velocity, joint 2
    after = net._joint_inputs(z, sensors.reshape(1, -1))[0]
    assert [int(i) for i in (after - before).nonzero()[0]] == [0, 2, n + 2 * 2 + 1]


@pytest.mark.parametrize(("trunk", "predictor"), [(True, False), (False, True), (False, False)])
def test_the_payload_reaches_trunk_and_predictor_only_where_it_may(trunk, predictor):
    config = ModelConfig(branch_history=False, payload_trunk=trunk, payload_predictor=predictor)
    torch.manual_seed(0)
    net = build_network(config, 2)
    torch.nn.init.normal_(net.trunk[-1].weight)
    a = x(config, 2)
    b = a.clone()
    b[:, net.features.layout.payload] += 1.0
    assert torch.equal(net(a), net(b)) == (not trunk and not predictor)


@pytest.mark.parametrize("coupling", ["joint", "full"])
def test_a_stacked_branch_has_a_net_for_each_feature(coupling):
    config = ModelConfig(branch="stacked", num_basis=3, coupling=coupling)
    net = build_network(config, 2)
    assert len(net.branch.nets) == 3
    see = torch.randn(5, *([2] if coupling == "joint" else []), net.branch.nets[0][0].in_features)
    before = net.branch(see).reshape(-1, 2, 3)
    torch.nn.init.zeros_(net.branch.nets[1][-1].weight)
    changed = (net.branch(see).reshape(-1, 2, 3) - before).abs().amax(dim=(0, 1)) > 0
    assert changed.tolist() == [False, True, False]


def test_held_sensors_do_not_look_at_the_present():
    config = ModelConfig(sensor_hold=2, history=1)
    net = build_network(config, 2)
    a = x(config, 2)
    b = a.clone()
    b[:, net.features.layout.query] += 1.0
    assert torch.equal(net.sensors(a, net.features(a)), net.sensors(b, net.features(b)))
    b[:, net.features.layout.refresh] -= 1.0
    assert not torch.equal(net.sensors(a, net.features(a)), net.sensors(b, net.features(b)))


def test_learned_points_start_near_the_fixed_probes_and_the_supervised_loss_moves_them():
    config = ModelConfig(sensors="learned", num_probes=4)
    net = build_network(config, 2)
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.1)
    data = x(config, 2)
    fixed = torch.from_numpy(probe_offsets(config, 2)).float()
    assert (net.offsets(data) - fixed).abs().max() <= 0.05 * config.probe_large + 1e-6
    net(data).sum().backward()
    assert net.points.net[-1].weight.grad is None  # the simulator has no gradient
    net.sample_sensors = True
    net(data).sum().backward()
    assert net.points.net[-1].weight.grad.abs().max() > 0
