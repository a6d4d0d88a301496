"""Robots and networks of the Hub: what was pushed is loaded by its address, with a card that the
Hub understands.
"""

import json

import numpy as np
import pytest
from arm import write_arm
from runs import small_model

import gaponet as gp
from gaponet.base.errors import RobotError, UsageError
from gaponet.base.network import RemoteError
from gaponet.cli.main import main
from gaponet.robot.folder import save_robot
from gaponet.share.push_pull import pull, push

NOWHERE = "/home/anna/logs"


@pytest.fixture
def robot(tmp_path):
    """A robot folder as gaponet identify writes it."""
    folder = tmp_path / "my_arm"
    arm = write_arm(tmp_path / "nominal")
    save_robot(arm.with_identified({"elbow": {"damping": 0.25}}), folder)
    parts = {part: {part: "0" * 64} for part in ("train", "val", "test")}
    origin = {
        "dataset": NOWHERE,
        "parts": parts,
        "motions": {part: [part] for part in parts},
        "val_mpjae": {"nominal": 0.02, "identified": 0.003},
    }
    (folder / "identified.json").write_text(json.dumps(origin))
    return folder


def header(hub, repository):
    """The fields between the rules of a README."""
    text = hub.files(repository)["README.md"].decode()
    lines = text.split("---\n")[1].splitlines()
    return {name: json.loads(value) for name, value in (line.split(": ", 1) for line in lines)}


def test_a_robot_is_loaded_by_its_address(hub, robot):
    push(robot, "me/arm")
    loaded = gp.load_robot("hf://me/arm")
    np.testing.assert_array_equal(loaded.servo.damping, gp.load_robot(robot).servo.damping)
    assert loaded.nominal is not None


def test_a_command_takes_the_address_though_paths_lose_a_slash(hub, robot, tmp_path, capsys):
    push(robot, "me/arm")
    out = tmp_path / "exported"
    assert main(["export", "hf://me/arm", "--to", "json", "--out", str(out)]) == 0
    assert (out / "facts.json").is_file()


def test_an_older_state_is_loaded_by_its_commit(hub, robot):
    push(robot, "me/arm")
    commit = hub.repos["models/me/arm"][-1][0]
    save_robot(
        gp.load_robot(robot).with_identified({"elbow": {"damping": 0.5}}), robot.parent / "new"
    )
    push(robot.parent / "new", "me/arm", replace=True)
    assert gp.load_robot(f"hf://me/arm@{commit}").servo.damping[1] == 0.25
    assert gp.load_robot("hf://me/arm").servo.damping[1] == 0.5


def test_a_robot_comes_back_with_all_its_files(hub, robot, tmp_path):
    push(robot, "me/arm")
    pull("me/arm", tmp_path / "back")
    np.testing.assert_array_equal(
        gp.load_robot(tmp_path / "back").servo.kp, gp.load_robot(robot).servo.kp
    )
    push(tmp_path / "back", "me/arm")


def test_another_robot_replaces_it_only_when_asked(hub, robot):
    push(robot, "me/arm")
    save_robot(
        gp.load_robot(robot).with_identified({"elbow": {"damping": 0.5}}), robot.parent / "new"
    )
    with pytest.raises(RemoteError, match="robot"):
        push(robot.parent / "new", "me/arm")


def test_the_card_of_a_robot_has_licence_datasets_and_metrics(hub, robot):
    push(robot, "me/arm", licence="Apache-2.0", trained_on="me/logs")
    fields = header(hub, "models/me/arm")
    assert fields["license"] == "apache-2.0"
    assert fields["datasets"] == ["me/logs"]
    assert fields["metrics"] == ["mae"]
    assert "3.00 mrad identified" in hub.files("models/me/arm")["README.md"].decode()


def test_a_card_says_that_a_licence_is_unknown(hub, robot):
    push(robot, "me/arm")
    assert header(hub, "models/me/arm")["license"] == "unknown"


def test_no_path_of_this_machine_is_pushed(hub, robot):
    push(robot, "me/arm")
    for content in hub.files("models/me/arm").values():
        assert NOWHERE.encode() not in content


def test_a_nominal_robot_is_not_pushed(hub, tmp_path):
    write_arm(tmp_path / "nominal")
    with pytest.raises(UsageError, match="identified"):
        push(tmp_path / "nominal", "me/arm")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("robot.xml", b"<worldbody>", b'<include file="/etc/passwd"/><worldbody>'),
        ("robot.toml", b"name =", b'mjcf = "/etc/passwd"\nname ='),
    ],
)
def test_a_robot_that_names_files_of_this_machine_is_refused(hub, robot, name, old, new):
    push(robot, "me/arm")
    files = dict(hub.files("models/me/arm"))
    files[name] = files[name].replace(old, new)
    assert files != hub.files("models/me/arm")
    hub.commit("models/me/arm", files)
    with pytest.raises(RobotError, match="names"):
        gp.load_robot("hf://me/arm")


def test_what_is_not_there_is_one_line(hub):
    with pytest.raises(RemoteError, match="me/nobody"):
        gp.load_robot("hf://me/nobody")


def test_a_network_is_loaded_by_its_address(hub, robot, arm, tmp_path):
    model = small_model(arm, tmp_path / "run")
    files = {
        file.relative_to(model.path).as_posix(): file.read_bytes()
        for file in model.path.glob("*.*")
    }
    hub.commit("models/me/net", {f"model/{name}": content for name, content in files.items()})
    assert gp.GapModel.load("hf://me/net").weights_hash() == model.weights_hash()
