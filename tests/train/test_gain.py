import numpy as np
import pytest
import torch

from gaponet.model.config import ModelConfig
from gaponet.model.deeponet import build_network
from gaponet.train.gain import choose_gain


@pytest.mark.parametrize("kind", ["gaponet", "mlp"])
def test_each_joint_gets_as_much_of_its_correction_as_helps(kind):
    net = build_network(ModelConfig(kind=kind), 3)
    ideal = torch.tensor([1.0, 0.5, 0.0])
    error = choose_gain(net, lambda: (net.bounded.gain - ideal).abs().numpy())
    assert error == 0.0
    assert torch.equal(net.bounded.gain, ideal)


def test_gains_that_only_help_alone_are_not_taken():
    net = build_network(ModelConfig(kind="mlp"), 2)

    def errors():
        g = net.bounded.gain.numpy()
        return np.array([g[0] != g[1], g[0] != g[1]]) + 0.1 * np.array([g[0], 1 - g[1]])

    choose_gain(net, errors)
    assert net.bounded.gain.tolist() == [1.0, 1.0]


def test_the_gain_scales_a_small_correction():
    net = build_network(ModelConfig(kind="mlp"), 2)
    torch.nn.init.constant_(net.net[-1].bias, 0.01)
    net.bounded.gain.copy_(torch.tensor([0.5, 1.0]))
    x = torch.zeros(1, net.features.dim)
    assert net(x)[0].tolist() == pytest.approx([0.005, 0.01], rel=1e-3)
