"""gaponet robot: what robots there are, and what is wrong with one."""

import json

import pytest
from arm import TOML, XML, write_arm
from vendors import write_mjcf

from gaponet.cli.main import main
from gaponet.robot.spec import packaged_robots


@pytest.mark.parametrize(
    "name", sorted({*packaged_robots()} - {"xl330_bench"})
)  # a bench has no shapes
def test_the_packages_robots_are_listed_and_right(name, capsys):
    assert main(["robot", "list", "--json"]) == 0
    assert name in [r["name"] for r in json.loads(capsys.readouterr().out)["robots"]]
    assert main(["robot", "check", name, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["warnings"] == []
    assert len(result["simulator_hash"]) == 12
    assert result["joints"][0].keys() >= {"kp", "kd", "effort_limit", "range", "operated"}


def test_servo_types_are_printed_with_intervals_and_sources(capsys):
    assert main(["robot", "servos", "sts3215"]) == 0
    text = capsys.readouterr().out
    assert "1.4 (0.48…2.7)" in text
    assert "isaac-sim2real/sage" in text
    assert "GO-M8010-6" not in text
    assert main(["robot", "servos", "no such"]) == 2


def test_a_users_folder_is_checked_and_shown(tmp_path, capsys):
    write_arm(tmp_path / "arm")
    assert main(["robot", "check", str(tmp_path / "arm")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "-1.50…1.50" in told
    assert "hand on fore" in told
    assert "ok: arm compiles" in told


@pytest.mark.parametrize(
    ("toml", "xml", "warning"),
    [
        (
            TOML.replace("kp = 20.0", "kp = 20.0\nhome = 2.0", 1),
            XML,
            "home 2 lies outside its range [-1.50, 1.50]",
        ),
        (
            TOML.replace("kp = 20.0", "kp = 0.0", 1),
            XML,
            "shoulder: kp is 0; a position-controlled joint needs kp > 0",
        ),
        (TOML, XML.replace(' range="-1.5 1.5"', "", 1), "shoulder: has no range in the MJCF"),
        (
            TOML.split("[[payload_mount]]")[0],
            XML,
            "no [[payload_mount]]: payloads other than 0 will be refused",
        ),
    ],
)
def test_what_compiles_and_is_doubtful_is_a_warning(tmp_path, capsys, toml, xml, warning):
    write_arm(tmp_path / "arm", toml=toml, xml=xml)
    assert main(["robot", "check", str(tmp_path / "arm"), "--json"]) == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert any(warning in text for text in warnings)


def test_check_without_a_name_says_which_there_are(capsys):
    assert main(["robot", "check"]) == 2
    message = capsys.readouterr().err
    assert all(name in message for name in packaged_robots())


def test_new_makes_checks_and_shows_a_robot_from_a_vendor_s_model(tmp_path, capsys):
    model = write_mjcf(tmp_path / "repo")
    told = [
        "robot",
        "new",
        str(model),
        "--out",
        str(tmp_path / "mine"),
        "--joints",
        "shoulder",
        "elbow",
    ]
    assert main([*told, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [joint["kp"] for joint in result["joints"]] == [60.0, 40.0]
    assert result["warnings"] == []
    if result["picture"]:  # where something can be rendered
        assert (tmp_path / "mine" / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert main(["robot", "check", str(tmp_path / "mine"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["simulator_hash"] == result["simulator_hash"]


def test_new_may_be_given_again_but_replaces_no_robot_that_a_person_changed(tmp_path, capsys):
    model = write_mjcf(tmp_path / "repo")
    mine = tmp_path / "mine"
    told = ["robot", "new", str(model), "--out", str(mine), "--joints", "shoulder", "elbow"]
    assert main(told) == 0
    (mine / "picture.png").unlink(missing_ok=True)  # as a command leaves it that was killed early
    files = sorted(p.name for p in mine.iterdir())
    assert main(told) == 0
    assert {p.name for p in mine.iterdir()} >= set(files)
    toml = mine / "robot.toml"
    toml.write_text(toml.read_text() + "# mine\n")
    assert main(told) == 2
    assert "holds a robot; choose another --out" in capsys.readouterr().err


def test_new_that_ends_before_its_picture_leaves_no_robot(tmp_path, monkeypatch):
    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("gaponet.report.view.picture.still", stop)
    model = write_mjcf(tmp_path / "repo")
    mine = tmp_path / "mine"
    told = ["robot", "new", str(model), "--out", str(mine), "--joints", "shoulder", "elbow"]
    assert main(told) == 130
    assert not mine.exists()
    monkeypatch.undo()
    assert main(told) == 0


def test_check_says_that_a_payload_hangs_in_each_of_two_mounts(tmp_path, capsys):
    second = '[[payload_mount]]\nside = "elbow"\nbody = "upper"\npos = [0.0, 0.0, 0.0]\n'
    write_arm(tmp_path / "arm", toml=TOML + second)
    assert main(["robot", "check", str(tmp_path / "arm")]) == 0
    assert "1 kg is 1 kg in each of 2 mounts" in " ".join(capsys.readouterr().out.split())
