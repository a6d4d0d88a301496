"""Actuator networks: the servo as identified, exactly, and what a run's network adds, as torque."""

import json
import re
import subprocess
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from arm import write_arm
from environments import environment
from runs import corrects_by

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.export import actuator_net
from gaponet.export.actuator_net import ActuatorNet
from gaponet.export.export_folder import export_networks
from gaponet.export.plain_servos import own_motions
from gaponet.export.shipped.mujoco_servos import read
from gaponet.nn.artifact import GapModel
from gaponet.nn.training.config import TrainConfig
from gaponet.sim.replay import replay

LATE = {"shoulder": {"delay": 0.007, "offset": 0.02}, "elbow": {"delay": 0.013}}
ADDED = 0.05


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A robot that moves as if every target were 50 mrad higher, and a run that has learned just
    that.
    """
    folder = tmp_path_factory.mktemp("actuator")
    robot = write_arm(folder / "arm").with_identified(LATE)
    asked = [s.rows(slice(0, 150)) for s in own_motions(robot, count=4)]
    told = [replace(s, ctrl=s.ctrl + ADDED) for s in asked]
    moved = zip(asked, replay(told, robot), strict=True)
    data = Dataset.create(folder / "data", robot)
    for s, t in moved:
        data.append(replace(s, qpos=t.qpos, qvel=t.qvel))
    corrects_by(ADDED, robot, folder / "run")
    parts = {"train": data.entries[:3], "val": data.entries[3:], "test": []}
    split = {part: {e.id: e.hash for e in entries} for part, entries in parts.items()}
    (folder / "run" / "split.json").write_text(json.dumps(split))
    config = asdict(TrainConfig()) | {"robot": robot.name, "dataset": "../data", "dataset_hash": ""}
    (folder / "run" / "config.json").write_text(json.dumps(config))
    return folder / "run"


def test_the_torque_of_a_late_servo_follows_from_the_past_of_error_and_speed():
    joint = {"kp": 20.0, "kd": 0.5, "delay": 0.007, "offset": 0.1, "effort_limit": 3.0}
    net = ActuatorNet(joint, 0.005, 4)
    rng = np.random.default_rng(0)
    v = 0.1 * rng.normal(size=4)  # newest first, as the targets
    target = 0.01 * rng.normal(size=4)
    q = 0.005 * (np.cumsum(v[::-1])[::-1])
    late = 0.6 * target[1] + 0.4 * target[2]  # 7 ms are 1.4 steps
    torque = 20.0 * (late + 0.1 - q[0]) - 0.5 * v[0]
    assert net(
        torch.tensor(np.r_[target - q, v][None], dtype=torch.float32)
    ).item() == pytest.approx(torque, abs=1e-5)
    assert net(torch.full((1, 8), 9.0)).item() == 3.0


def test_a_network_adds_no_more_torque_than_the_runs_largest_correction():
    joint = {"kp": 20.0, "kd": 0.0, "delay": 0.0, "offset": 0.0, "effort_limit": 100.0}
    net = ActuatorNet(joint, 0.005, 4, delta_max=0.3)
    torch.nn.init.constant_(net.net[-1].bias, 1e6)
    at_rest = torch.zeros(1, 8)
    assert net(at_rest).item() == pytest.approx(20.0 * 0.3)


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """The folder of `gaponet export`, after a short fit."""
    folder = tmp_path_factory.mktemp("networks") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(actuator_net, "STEPS", 300)
        assert main(["export", str(run), "--to", "actuator-net", "--out", str(folder)]) == 0
    return folder


def test_the_check_for_newton_needs_no_torch(exported):
    used = ("check_newton.py", "mujoco_servos.py")
    text = "".join((exported / name).read_text() for name in used)
    assert "torch" not in re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE)
    assert "gaponet_action" not in text


def test_networks_play_the_run_in_plain_mujoco_and_say_what_they_leave(exported):
    facts = read(exported / "facts.json")
    left = facts["error_mrad"]
    assert left["the run, in gaponet"] < 1
    assert left["actuator networks"] < 5 < 40 < left["of these the servo alone"]
    assert facts["actuator_net"]["gain"] == 1.0
    x = torch.randn(5, 2 * facts["actuator_net"]["length"])
    script = torch.jit.load(exported / "elbow.pt")(x)
    told = {"metadata.json": ""}
    program = torch.export.load(exported / "elbow.pt2", extra_files=told).module()(x)
    torch.testing.assert_close(program, script)
    onnx = pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(exported / "elbow.onnx"))
    np.testing.assert_allclose(session.run(None, {"past": x.numpy()})[0], script.numpy(), atol=1e-4)
    props = {p.key: p.value for p in onnx.load(exported / "elbow.onnx").metadata_props}
    assert props["metadata"] == told["metadata.json"]
    assert json.loads(props["metadata"])["input_order"] == "pos_vel"


def test_what_is_of_robots_is_refused(run, tmp_path, capsys):
    assert (
        main(["export", str(run), "--to", "actuator-net", "--into", str(tmp_path / "scene.xml")])
        == 2
    )
    assert "does not use --into and --prefix" in capsys.readouterr().err


def test_a_payload_that_nobody_recorded_is_refused(run, tmp_path):
    with pytest.raises(UsageError, match=r"0\.2"):
        export_networks(GapModel.load(run), run, tmp_path, payload_mass=0.2)


@pytest.mark.peers
@pytest.mark.parametrize(
    ("name", "package", "check"),
    [("mjlab-1.6", "mjlab==1.6.*", "check.py"), ("newton", "newton[sim,onnx]", "check_newton.py")],
)
def test_engines_play_the_networks_as_plain_mujoco_does_here(run, tmp_path, name, package, check):
    made = export_networks(GapModel.load(run), run, tmp_path)
    python = environment(name, "3.11", (package,))
    said = subprocess.run(
        [python, check], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    there, here = re.findall(r": ([\d.]+) mrad; in gaponet ([\d.]+)", said)[0]
    assert float(here) == pytest.approx(1e3 * made.errors["actuator networks"], abs=0.01)
    assert float(there) == pytest.approx(float(here), rel=0.05, abs=0.05)
