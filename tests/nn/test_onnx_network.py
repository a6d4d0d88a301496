"""The model at run time: onnxruntime answers as torch does; the loop is the corrector's."""

import sys

import numpy as np
import pytest
import torch
from arm import write_arm

from gaponet.base.errors import ModelError, UsageError
from gaponet.export.torch_program import export_program
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import MAX_DIFFERENCE_RAD, export, onnx_content, sample_inputs
from gaponet.nn.onnx_network import OnnxNetwork

SMALL = {
    "history": 2,
    "num_probes": 4,
    "branch_hidden": (16, 8),
    "trunk_hidden": (16,),
    "sensor_hidden": (16, 12),
}


def trained(n: int = 2, **how) -> torch.nn.Module:
    """A network with no weight left at zero or one."""
    torch.manual_seed(0)
    net = build_network(ModelConfig(**SMALL | how), n)
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1 * torch.randn_like(p))
    net.features.standardise.mean.normal_()
    net.features.standardise.std.uniform_(0.05, 1.0)
    net.bounded.gain.fill_(0.75)
    return net.eval()


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def artifact(robot, tmp_path_factory):
    net = trained(stride=2)
    folder = tmp_path_factory.mktemp("run") / "model"
    export(net, folder, make_card(net.config, robot, dt=[0.02]), sample_inputs(net))
    return folder


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"sensors": "predicted"},
        {"payload_input": False},
        {"branch_hidden": ()},
        {"kind": "mlp", "mlp_hidden": (16, 8)},
        {"kind": "mlp", "mlp_match": True},
        {"kind": "shared_mlp"},
        {"kind": "shared_mlp", "sensors": "predicted", "payload_input": False},
        {"kind": "paper"},
        {
            "kind": "paper",
            "branch_observation": True,
            "relative_action": True,
            "payload_trunk": False,
        },
        {"kind": "paper", "delta_hold": 3},
        {"kind": "paper", "sensor_hold": 5},
        {"kind": "paper", "stride": 2},
        {"kind": "paper", "sensor_source": "learned"},
        {"kind": "paper", "real_state": True},
    ],
)
def test_the_onnx_file_equals_the_network(how):
    net = trained(n=3, **how)
    x = sample_inputs(net, 20)
    with torch.inference_mode():
        expected = net(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(OnnxNetwork(onnx_content(net))(x), expected, atol=MAX_DIFFERENCE_RAD)
    assert np.abs(expected).mean() > 1e-3


def test_without_onnxruntime_a_model_says_what_to_install(artifact, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ModelError, match=r"\[deploy\]"):
        GapModel.load(artifact)


def test_a_correction_never_leaves_the_joint_limits(artifact, robot):
    model = GapModel.load(artifact)
    np.testing.assert_array_equal(model.qpos_range, robot.qpos_range)
    edge = robot.qpos_range[:, 1]
    loop = model.loop()
    for _ in range(5):
        delta = loop.delta(edge - 0.1, np.zeros(2), edge, 0.0)
        assert (edge + delta <= edge).all()


def test_other_shapes_are_refused(artifact):
    loop = GapModel.load(artifact).loop()
    loop.delta(np.zeros(2), np.zeros(2), np.zeros(2), 0.0)
    with pytest.raises(UsageError, match="num_envs"):
        loop.delta(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2)), 0.0)
    with pytest.raises(UsageError, match="operated"):
        loop.delta(np.zeros(3), np.zeros(2), np.zeros(2), 0.0)


def test_a_torch_export_of_other_weights_is_refused(artifact, tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    for file in artifact.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    torch.save(
        {"best_state": {k: 0.9 * v for k, v in trained(stride=2).state_dict().items()}},
        tmp_path / "checkpoint.pt",
    )
    with pytest.raises(ModelError, match="differ"):
        export_program(GapModel.load(folder), tmp_path, tmp_path)
    assert not (tmp_path / "delta.pt2").exists()
