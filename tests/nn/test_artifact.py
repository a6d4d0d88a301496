"""What ships answers as what was trained, and refuses what it was not made for."""

import copy
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from arm import write_arm

from gaponet.base.errors import ModelError
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def artifact(robot, tmp_path_factory):
    torch.manual_seed(0)
    config = ModelConfig(
        history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
    )
    net = build_network(config, 2)
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.1)
    folder = tmp_path_factory.mktemp("run") / "model"
    samples = (
        np.random.default_rng(0).normal(size=(32, config.observation_dim(2) + 2)).astype(np.float32)
    )
    export(net, folder, make_card(config, robot, dt=[0.02]), samples)
    return folder, net, samples


def test_export_refuses_to_write_what_differs(artifact, robot, tmp_path, monkeypatch):
    _, net, samples = artifact
    monkeypatch.setattr("gaponet.nn.onnx_export.MAX_DIFFERENCE_RAD", -1.0)
    with pytest.raises(ModelError, match="differ"):
        export(net, tmp_path / "out", {}, samples)
    assert not (tmp_path / "out").exists()


def test_files_of_two_exports_are_refused_as_one_model(artifact, robot, tmp_path):
    """An export that was killed between its files."""
    folder, net, samples = artifact
    card = json.loads((folder / "card.json").read_text())
    other = copy.deepcopy(net)
    torch.nn.init.zeros_(other.trunk[-1].weight)
    export(other, tmp_path / "out", card, samples)
    (tmp_path / "out" / "card.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="short"):
        GapModel.load(tmp_path / "out")


@pytest.mark.parametrize(
    "changed",
    [
        {"joint_names": ["elbow", "shoulder"]},
        {"dt": [0.01]},
        {"payload_seen": [0.0, 50.0]},
        {"qpos_range": [[-9.0, 9.0], [-9.0, 9.0]]},
        {"kp": [1.0, 1.0]},
        {"recorded": {"kp": [1.0, 1.0], "kd": None}},
        {"model": {"delta_max": 3.0}},
        {"model": {"payload_max": 50.0}},
    ],
)
def test_a_card_that_contradicts_its_network_is_refused_by_field(copied, changed):
    card = json.loads((copied / "card.json").read_text())
    model = card["model"] | changed.get("model", {})
    (copied / "card.json").write_text(json.dumps(card | changed | {"model": model}))
    field = next(iter(changed))
    with pytest.raises(ModelError, match=f"{field} is "):
        GapModel.load(copied)


def test_another_rate_is_refused(artifact, robot):
    model = GapModel.load(artifact[0])
    model.require(robot, 0.02006)  # the clock of a real 50 Hz loop
    with pytest.raises(ModelError, match=r"100\.0"):
        model.require(robot, 0.01)


def test_a_model_of_another_simulator_is_read_and_refused(copied, robot):
    card = json.loads((copied / "card.json").read_text())
    (copied / "card.json").write_text(json.dumps(card | {"simulator": "a127234c3d89"}))
    with pytest.raises(ModelError, match="a127234c3d89"):
        GapModel.load(copied).require(robot)


def test_another_joint_set_is_refused(artifact, robot):
    with pytest.raises(ModelError, match="joints"):
        GapModel.load(artifact[0]).require(dataclasses.replace(robot, operated=("elbow",)))


@pytest.fixture
def copied(artifact, tmp_path):
    return Path(shutil.copytree(artifact[0], tmp_path / "model"))


@pytest.mark.parametrize("damage", ["missing", "cut", "newer", "onnx"])
def test_a_damaged_artifact_says_what_to_do(copied, damage):
    card = copied / "card.json"
    if damage == "missing":
        card.unlink()
    elif damage == "cut":
        card.write_text(card.read_text()[:100])
    elif damage == "newer":
        card.write_text(json.dumps(json.loads(card.read_text()) | {"format": 99}))
    else:
        (copied / "model.onnx").write_bytes(b"nothing")
    with pytest.raises(ModelError, match=r"give|restore|upgrade|train"):
        GapModel.load(copied)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"qpos_range": [[float("nan"), 1.0], [-1.0, 1.0]]}, r"qpos_range\[0\]\[0\]:"),
        ({"qpos_range": [[-1.0, 1.0]]}, "qpos_range:"),
        ({"qpos_range": [[1.0, -1.0], [-1.0, 1.0]]}, "range"),
        ({"joint_names": "ab"}, "joint_names:"),
        ({"dt": [0]}, r"dt\[0\]:"),
        ({"payload_seen": []}, "payload_seen: "),
        ({"model": {"history": 1e9}}, "history:"),
        ({"model": {"history": 10**9}}, "history:"),
        ({"model": {"branch_hidden": [10**9]}}, r"branch_hidden\[0\]:"),
        ({"model": {"colour": "red"}}, "colour:"),
        ({"model": {"kind": "transformer"}}, "kind:"),
        ({"model": {"history": 3}}, "fit"),
        ({"model": {"delta_max": 1e-9}}, "fit"),
        ({"joint_names": ["a"], "kp": [1.0], "kd": [1.0], "qpos_range": [[-1, 1]]}, "fit"),
    ],
)
def test_a_card_that_asks_for_another_network_is_refused_with_file_and_field(copied, changed, said):
    card = json.loads((copied / "card.json").read_text())
    model = card["model"] | changed.get("model", {})
    (copied / "card.json").write_text(json.dumps(card | changed | {"model": model}))
    with pytest.raises(ModelError, match=said) as error:
        GapModel.load(copied)
    assert "\n" not in str(error.value)
