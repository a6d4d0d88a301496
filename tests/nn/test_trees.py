"""Boosted trees as a network."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gaponet.base.errors import UsageError
from gaponet.nn import trees
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import onnx_content
from gaponet.nn.onnx_network import OnnxNetwork

LIMIT = np.nextafter(np.float64(np.float32(0.1)), 0)  # just below a float32 number


def ensemble(base=0.01):
    """An ensemble as scikit-learn stores it: one tree that splits input 2 at LIMIT and its right
    half again.
    """
    fields = {
        "value": float,
        "feature_idx": int,
        "num_threshold": float,
        "left": int,
        "right": int,
        "is_leaf": bool,
    }
    rows = [
        (9.0, 2, LIMIT, 1, 2, False),
        (-0.02, 0, 0, 0, 0, True),
        (9.0, 2, 0.5, 4, 3, False),
        (0.05, 0, 0, 0, 0, True),
        (0.03, 0, 0, 0, 0, True),
    ]
    nodes = np.array(rows, list(fields.items()))
    return SimpleNamespace(
        _predictors=[(SimpleNamespace(nodes=nodes),)], _baseline_prediction=np.array([[base]])
    )


def test_stored_trees_answer_as_they_are_written_in_torch_and_onnx():
    config = ModelConfig("trees")
    net = build_network(config, 2).eval()
    with torch.no_grad():
        net.store(1, ensemble())
    x = torch.zeros(4, config.input_dim(2))
    # Velocity of the first joint; 0.1 is above LIMIT in float64.
    x[:, 2] = torch.tensor([-1.0, 0.1, 0.3, 0.6])
    expected = [[0, -0.01], [0, 0.04], [0, 0.04], [0, 0.06]]
    np.testing.assert_allclose(net(x).detach().numpy(), expected, atol=1e-7)
    np.testing.assert_allclose(OnnxNetwork(onnx_content(net))(x.numpy()), expected, atol=1e-7)


def test_the_correction_is_clipped_and_has_a_gain():
    net = build_network(ModelConfig("trees", delta_max=0.03), 1).eval()
    with torch.no_grad():
        net.store(0, ensemble())
        x = torch.full((1, net.config.input_dim(1)), 0.6)
        assert net(x).item() == pytest.approx(-0.01)  # input 2 is a − q = 0
        net.base.fill_(0.2)
        assert net(x).item() == pytest.approx(0.03)
        net.bounded.gain.fill_(0.1)
        assert net(x).item() == pytest.approx(0.1 * (0.2 - 0.02))


def test_without_scikit_learn_there_is_one_sentence(monkeypatch):
    monkeypatch.setattr(trees, "find_spec", lambda name: None)
    net = build_network(ModelConfig("trees"), 1)
    with pytest.raises(UsageError, match="scikit-learn"):
        net.fit(torch.zeros(100, net.config.input_dim(1)), torch.zeros(100, 1), 0)


def test_trees_fit_labels_and_leave_a_joint_without_labels_alone(monkeypatch):
    pytest.importorskip("sklearn")
    monkeypatch.setattr(trees, "TREES", 20)
    net = build_network(ModelConfig("trees"), 2).eval()
    net.bounded.scale.fill_(0.05)
    x = torch.from_numpy(
        np.random.default_rng(0).normal(size=(2000, net.config.input_dim(2))).astype(np.float32)
    )
    labels = torch.stack([0.1 * torch.sign(x[:, 2]), torch.full((2000,), torch.nan)], dim=1)
    assert net.fit(x, labels, 0)[0] < 0.1 * 0.1**2
    delta = net(x)
    assert (delta[:, 0] - labels[:, 0]).abs().mean() < 0.02
    assert delta[:, 1].abs().max() == 0
