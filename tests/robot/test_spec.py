"""Robot folders: names, gains and limits; errors name the field."""

import json
from pathlib import Path

import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.base.errors import JointMismatchError, RobotError
from gaponet.base.files import write_json
from gaponet.export.plain_servos import lost_recordings
from gaponet.robot.folder import PROVENANCE_FILE, save_robot
from gaponet.robot.spec import load_robot, packaged_robots, robot_argument
from gaponet.sim.model import build_model, model_hash


def test_packaged_robots_are_listed():
    names = packaged_robots()
    assert {"fr3", "g1_23", "g1_29", "h1_2", "so101", "ur10e", "xl330_bench"} <= set(names)
    assert [
        load_robot(name).name for name in names
    ] == names  # datasets find their robot by its name


def test_h1_2_operates_the_ten_arm_joints_of_27():
    robot = load_robot("h1_2")
    assert len(robot.joint_names) == 27
    assert len(robot.operated) == 10
    assert robot.joint_names[robot.operated_index[3]] == "left_elbow_joint"


def test_so101_does_not_operate_its_gripper(so101):
    assert so101.joint_names[-1] == "gripper"
    assert "gripper" not in so101.operated
    assert so101.log_joints.units[-1] == "fraction"
    assert so101.decimation == 4  # 20 ms in steps of 5 ms


def test_gains_cannot_be_changed_after_loading(so101):
    with pytest.raises(ValueError, match="read-only"):
        so101.servo.kp[0] = 1.0


def test_an_unlimited_joint_has_an_infinite_range(tmp_path):
    robot = write_arm(tmp_path / "arm", xml=XML.replace(' range="-1.5 1.5"', "", 1))
    assert robot.qpos_range.tolist() == [[-np.inf, np.inf], [-1.5, 1.5]]


@pytest.mark.parametrize(
    "name", ["Pitch", "shoulder_lift", "/so101/upper_arm/shoulder_lift", " Pitch "]
)
def test_joints_resolve_by_alias_and_by_the_end_of_a_path(so101, name):
    assert so101.resolve(name, "a.csv") == "shoulder_lift"


def test_the_users_map_has_priority_over_aliases(so101):
    assert so101.resolve("Pitch", "a.csv", {"Pitch": "elbow_flex"}) == "elbow_flex"


def test_an_unknown_joint_error_names_the_file_and_similar_joints(so101):
    with pytest.raises(
        JointMismatchError,
        match=r"a\.csv names joint 'elbow', which robot 'so101' does not have; "
        r"nearest: elbow_flex, \w+, \w+\. Correct it there; of logs, map it with --map elbow=elbow_flex, ",
    ):
        so101.resolve("elbow", "a.csv")
    with pytest.raises(JointMismatchError, match="elbow_flex"):  # nothing to map there
        so101.index(["elbow"])


def test_an_unknown_robot_error_lists_the_packaged_ones():
    with pytest.raises(
        RobotError,
        match=r"nope.*xl330_bench",
    ):
        load_robot("nope")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "arm"', "", "name:"),
        ('name = "arm"', 'name = "../arm"', "name:"),
        ("kp = 20.0", "", r"joint\[0\]\.kp:"),
        ("kp = 20.0", 'kp = "much"', "much"),
        ("kp = 20.0", "kp = -20.0", r"joint\[0\]\.kp:"),
        ("kp = 20.0", "kp = 20.0\nkdd = 1.0", r"joint\[0\]\.kdd:"),
        ("kp = 20.0", 'kp = 20.0\nkd = "0.1"', r"joint\[0\]\.kd:"),
        ("dt = 0.02", "dt = nan", "dt:"),
        ("timestep = 0.005", "timestep = 0", "timestep:"),
        ('name = "elbow"', 'name = "shoulder"', "twice"),
        ('name = "elbow"', 'name = "elbow"\naliases = ["shoulder"]', "twice"),
        ("pos = [0.2,", "pos = [20.0,", r"payload_mount\[0\]\.pos\[0\]:"),
        ("timestep = 0.005", "timestep = 0.003", r"6\.667"),
        ("kp = 20.0", 'kp = 20.0\nlog_unit = "grad"', r"joint\[0\]\.log_unit:"),
        ("kp = 20.0", "kp = 20.0\noperated = false", "operated"),
        ("dt = 0.02", "dt = ", "TOML"),
        ("[[joint]]", "[[joints]]", "joint:"),
        ('body = "fore"\n', "", r"payload_mount\[0\]\.body:"),
        (
            "[[payload_mount]]",
            '[[payload_mount]]\nside = "hand"\nbody = "upper"\npos = [0.0, 0.0, 0.0]\n'
            "[[payload_mount]]",
            "two .* side = 'hand'",
        ),
    ],
)
def test_an_invalid_robot_toml_error_names_the_field(tmp_path, old, new, message):
    toml = TOML.replace(old, new)
    if "operated" not in new and old == "kp = 20.0":
        toml = TOML.replace(old, new, 1)
    with pytest.raises(RobotError, match=message):
        write_arm(tmp_path / "arm", toml=toml)


def test_a_missing_mjcf_error_names_its_place(tmp_path):
    write_arm(tmp_path / "arm")
    (tmp_path / "arm" / "robot.xml").unlink()
    with pytest.raises(RobotError, match=r"robot\.xml"):
        load_robot(tmp_path / "arm")


def test_a_folder_stores_identified_values_and_the_nominal_robot(tmp_path):
    robot = write_arm(tmp_path / "arm")
    fitted = robot.with_identified(
        {"elbow": {"kp": 12.5, "frictionloss": 0.11, "delay": 0.03, "offset": -0.01}}
    )
    save_robot(fitted, tmp_path / "fitted")
    back = load_robot(tmp_path / "fitted")
    assert model_hash(back) == model_hash(fitted) != model_hash(robot)
    assert model_hash(back.nominal) == model_hash(robot)
    model = build_model(back)
    np.testing.assert_allclose(model.dof_frictionloss, [0.05, 0.11])
    np.testing.assert_allclose(model.actuator_biasprm[1, :2], [-0.125, -12.5])
    np.testing.assert_allclose(model.actuator_delay, [0.0, 0.03])
    save_robot(back.nominal, tmp_path / "again")
    assert load_robot(tmp_path / "again").nominal is None


def test_a_folder_stores_scaled_gains_once(tmp_path):
    fitted = (
        write_arm(tmp_path / "arm").with_identified({"elbow": {"kp": 12.5}}).with_gain_scale(10.0)
    )
    save_robot(fitted, tmp_path / "firm")
    back = load_robot(tmp_path / "firm").with_gain_scale(10.0)
    assert model_hash(back) == model_hash(fitted)
    assert (back.servo.kp.tolist(), back.nominal.servo.kp.tolist()) == (
        [200.0, 125.0],
        [200.0, 200.0],
    )


def test_an_unknown_identified_joint_or_field_is_refused(tmp_path):
    with pytest.raises(RobotError, match=r"identified\.wing"):
        write_arm(tmp_path, TOML + "[identified.wing]\nkp = 3.0\n")
    with pytest.raises(RobotError, match=r"identified\.elbow\.mass"):
        write_arm(tmp_path, TOML + "[identified.elbow]\nmass = 3.0\n")


def test_robot_argument_leads_to_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_arm(Path("mine"))
    for folder in (Path("mine"), tmp_path / "mine", Path("..") / tmp_path.name / "mine"):
        assert load_robot(robot_argument(folder)).name == "arm"


def test_names_are_packaged_robots_and_paths_are_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_arm(tmp_path / "arm")
    with pytest.raises(RobotError, match=r"\./arm"):
        load_robot("arm")
    for way in ("./arm", str(tmp_path / "arm"), Path("arm")):
        assert load_robot(way).name == "arm"
    with pytest.raises(RobotError, match=r"so101@sage, .*, or a folder"):
        load_robot("./so101")
    with pytest.raises(RobotError, match=r"robot\.toml"):
        load_robot("./mine")
    with pytest.raises(RobotError, match="nearest: so101;"):
        load_robot("so110")


def test_an_ambiguous_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_arm(tmp_path / "so101")
    with pytest.raises(RobotError, match=r"write (.*) or \./so101") as refused:
        load_robot("so101")
    packaged = str(refused.value).split("write ")[1].split(" or ")[0]
    assert load_robot(packaged).name == "so101"
    assert load_robot("./so101").name == "arm"
    monkeypatch.chdir(Path(packaged).parent)
    assert load_robot("so101").name == "so101"  # one and the same


def test_collision_shapes_are_copied(tmp_path):
    save_robot(load_robot("h1_2"), tmp_path / "h1_2")
    assert (tmp_path / "h1_2" / "collision.toml").is_file()


def test_identified_tables_belong_to_the_identified_robot_only(tmp_path):
    robot = write_arm(
        tmp_path / "arm", TOML.replace("[[payload", "[identified.elbow]\nkp = 9.0\n[[payload")
    )
    save_robot(robot, tmp_path / "both")
    save_robot(robot.nominal, tmp_path / "nominal")
    assert load_robot(tmp_path / "both").servo.kp.tolist() == [20.0, 9.0]
    assert load_robot(tmp_path / "nominal").servo.kp.tolist() == [20.0, 20.0]
    assert load_robot(tmp_path / "nominal").payload_mounts == robot.payload_mounts


def test_a_copy_of_an_identified_robot_finds_its_recordings_from_where_it_lies(arm, tmp_path):
    (tmp_path / "data").mkdir()
    save_robot(arm.with_identified({"elbow": {"kp": 9.0}}), tmp_path / "identified")
    origin = {
        "dataset": "../data",
        "parts": {"train": {}, "val": {}, "test": {}},
        "motions": {"train": ["wave"]},
        "val_mpjae": {"identified": 0.003},
    }
    write_json(tmp_path / "identified" / PROVENANCE_FILE, origin)
    copy = tmp_path / "runs" / "first" / "robot"
    save_robot(load_robot(tmp_path / "identified"), copy)
    stored = json.loads((copy / PROVENANCE_FILE).read_text())
    assert stored == origin | {"dataset": "../../../data"}
    assert lost_recordings(copy, data=None) == ""


def test_a_saved_robot_has_the_gains_of_its_recordings(arm, tmp_path):
    recorded = arm.with_gains((30.0, 20.0), (1.5, 0.5))
    save_robot(recorded.with_identified({"elbow": {"kp": 25.0}}), tmp_path / "fitted")
    back = load_robot(tmp_path / "fitted")
    assert (back.nominal.servo.kp.tolist(), back.nominal.servo.kd.tolist()) == (
        [30.0, 20.0],
        [1.5, 0.5],
    )
    assert back.servo.kp.tolist() == [30.0, 25.0]
