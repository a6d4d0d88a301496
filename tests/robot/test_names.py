"""Models by name: found on this disk, in the folders where their collections lie; never
downloaded.
"""

import pytest
from vendors import MJCF, URDF

from gaponet.base.errors import RobotError
from gaponet.cli.main import main
from gaponet.robot.vendor import find_model


@pytest.fixture
def menagerie(tmp_path, monkeypatch):
    """A small collection with the layout of MuJoCo Menagerie."""
    for file in (
        "franka_fr3/fr3.xml",
        "franka_fr3/scene.xml",
        "unitree_g1/g1.xml",
        "unitree_g1/g1_with_hands.xml",
        "two/a.xml",
        "two/b.xml",
    ):
        place = tmp_path / "collection" / file
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(MJCF)
    monkeypatch.setenv("MUJOCO_MENAGERIE", str(tmp_path / "collection"))
    return tmp_path / "collection"


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("franka_fr3", "franka_fr3/fr3.xml"),
        ("unitree_g1", "unitree_g1/g1.xml"),
        ("unitree_g1/g1_with_hands.xml", "unitree_g1/g1_with_hands.xml"),
    ],
)
def test_a_folder_of_menagerie_has_one_main_model(menagerie, name, file):
    assert find_model(f"menagerie:{name}") == menagerie / file


def test_a_folder_with_several_models_asks_which(menagerie):
    with pytest.raises(RobotError, match=r"a\.xml, b\.xml"):
        find_model("menagerie:two")


def test_menagerie_is_found_in_the_cache_of_robot_descriptions(menagerie, tmp_path, monkeypatch):
    (tmp_path / "cache").mkdir()
    menagerie.rename(tmp_path / "cache" / "mujoco_menagerie")
    monkeypatch.delenv("MUJOCO_MENAGERIE")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    found = find_model("menagerie:franka_fr3")
    assert found == tmp_path / "cache" / "mujoco_menagerie" / "franka_fr3" / "fr3.xml"


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("menagerie:franka_fr3", "MUJOCO_MENAGERIE"),
        ("robot_descriptions:fr3", "robot_descriptions"),
        ("example-robot-data:panda", "EXAMPLE_ROBOT_DATA"),
        ("elsewhere:panda", "menagerie:NAME"),
        ("menagerie:../../etc", "menagerie:NAME"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line_with_the_way_to_it(
    tmp_path, monkeypatch, name, hint
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "none"))
    with pytest.raises(RobotError, match=hint) as refusal:
        find_model(name)
    assert "\n" not in str(refusal.value)


def test_a_urdf_of_example_robot_data_is_found_by_the_robots_name(tmp_path, monkeypatch):
    for file in ("panda_description/urdf/panda.urdf", "ur_description/robots/ur5_robot.urdf"):
        place = tmp_path / "robots" / file
        place.parent.mkdir(parents=True)
        place.write_text(URDF)
    monkeypatch.setenv("EXAMPLE_ROBOT_DATA_MODEL_DIR", str(tmp_path / "robots"))
    assert find_model("example-robot-data:panda").name == "panda.urdf"
    assert find_model("example-robot-data:ur5").name == "ur5_robot.urdf"


def test_a_description_is_read_from_the_cache_without_a_download(menagerie, tmp_path, monkeypatch):
    pytest.importorskip("robot_descriptions")
    (tmp_path / "cache").mkdir()
    menagerie.rename(tmp_path / "cache" / "mujoco_menagerie")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    for name in ("fr3", "fr3_mj_description"):
        found = find_model(f"robot_descriptions:{name}")
        assert found == tmp_path / "cache" / "mujoco_menagerie" / "franka_fr3" / "fr3.xml"
    with pytest.raises(RobotError, match="pull"):
        find_model("robot_descriptions:panda_description")


def test_the_command_makes_a_robot_of_a_name(menagerie, tmp_path, capsys):
    told = ["robot", "new", "--from", "menagerie:franka_fr3", "--joints", "shoulder", "elbow"]
    assert main([*told, "--out", str(tmp_path / "mine")]) == 0
    assert (tmp_path / "mine" / "robot.toml").is_file()
    assert main(["robot", "new", "--out", str(tmp_path / "other")]) == 2
    assert "--from" in capsys.readouterr().err
