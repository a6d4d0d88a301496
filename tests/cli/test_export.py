"""gaponet export on a small artifact."""

import json
import shutil

import numpy as np
import pytest
import torch
from arm import write_arm

from gaponet.cli.main import main
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export, sample_inputs
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot

CONFIG = ModelConfig(
    history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
)


@pytest.fixture
def run(tmp_path):
    """A run folder with artifact and checkpoint."""
    robot = write_arm(tmp_path / "arm")
    torch.manual_seed(0)
    net = build_network(CONFIG, 2)
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.1)
    export(net, tmp_path / "run" / "model", make_card(CONFIG, robot, dt=[0.02]), sample_inputs(net))
    torch.save({"best_state": net.state_dict()}, tmp_path / "run" / "checkpoint.pt")
    return tmp_path / "run"


def test_an_artifact_is_written_again_from_the_checkpoint(run, capsys):
    before = GapModel.load(run).loop().delta(np.zeros(2), np.zeros(2), np.ones(2), 0.1)
    (run / "model" / "model.onnx").unlink()
    assert main(["export", str(run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["parity_rad"] < 1e-5
    again = GapModel.load(run).loop().delta(np.zeros(2), np.zeros(2), np.ones(2), 0.1)
    np.testing.assert_allclose(again, before, atol=1e-7)


def test_an_export_elsewhere_can_be_transferred_without_the_run(run, tmp_path):
    robot = load_robot(tmp_path / "arm")
    save_robot(robot, run / "robot")
    assert main(["export", str(run), "--out", str(tmp_path / "shipped")]) == 0
    stiff = robot.with_servo(kp=2.0 * robot.servo.kp)
    there = AlignedSim(stiff, GapModel.load(run), 0.1)
    shutil.rmtree(run)
    sim = AlignedSim(stiff, GapModel.load(tmp_path / "shipped"), 0.1)
    for each in (there, sim):
        each.step(np.full(2, 0.3))
    assert sim.transfer is not None
    np.testing.assert_allclose(sim.target, there.target, atol=1e-7)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--to", "mjcf", "--engine", "mjlab"],
            "--to mjcf does not use --engine, --scope, --units",
        ),
        (["--to", "json", "--into", "scene.xml"], "--to json does not use --into and --prefix"),
        (["--to", "mjcf", "--dynamics"], "--to mjcf does not use --dynamics, --remove, --fps"),
        (
            ["--to", "randomization", "--payload-mass", "0.1"],
            "--to randomization does not use --payload-mass",
        ),
        (
            ["--to", "lerobot", "--into", "policy", "--out", "mine"],
            "--to lerobot does not use --out;",
        ),
    ],
)
def test_options_of_another_form_are_refused(tmp_path, capsys, words, message):
    write_arm(tmp_path / "arm")
    assert main(["export", str(tmp_path / "arm"), *words]) == 2
    assert message in capsys.readouterr().err


def test_without_a_checkpoint_onnx_cannot_be_written_again(run, capsys):
    (run / "checkpoint.pt").unlink()
    assert main(["export", str(run)]) == 2
    assert "no checkpoint.pt" in capsys.readouterr().err


def test_the_help_explains_every_form_and_breaks_lines_at_the_edge_of_the_screen_only(
    capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    text = " ".join(lines)
    for form in (
        "mjcf (plain MuJoCo)",
        "onnx (model.onnx",
        "torch (delta.pt2",
        "actuator-net (one",
        "lerobot: add",
    ):
        assert form in text
    assert "urdf (damping, friction, effort limits)" in text
