"""Identified robots of the package: found by name, complete, small, with a card, exported without
data.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from shipping import markdown_cards

import gaponet as gp
from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.robot.by_name import IDENTIFIED, identified_catalogue
from gaponet.robot.card import ROBOT_HEADINGS, RobotCard, folder_size, robot_cards
from gaponet.robot.spec import named_robots, robot_argument
from gaponet.sysid.uncertainty import ParameterUncertainty

PAGE = Path(__file__).parents[2] / "docs" / "robots.md"
SHIPPED = identified_catalogue().names()
MAX_TOTAL_BYTES = 1_000_000
MAY_BE_SHIPPED = {"Apache-2.0", "BSD-3-Clause", "MIT"}
NAME = "so101@sage"


@pytest.fixture
def place(monkeypatch, tmp_path):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_robot_loads_with_its_nominal_one_and_its_uncertainty(name):
    robot = gp.load_robot(name)
    assert robot.nominal is not None
    assert name.startswith(f"{robot.name}@")
    assert ParameterUncertainty.load(robot) is not None


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_robot_follows_its_test_motions_better_than_the_nominal_one(name):
    test = RobotCard.read(IDENTIFIED / name).facts.published.test
    assert test.model_mrad < test.nominal_mrad


@pytest.mark.parametrize("name", SHIPPED)
def test_the_data_of_a_shipped_robot_may_be_used_by_everybody(name):
    published = RobotCard.read(IDENTIFIED / name).facts.published
    assert published.data.licence in MAY_BE_SHIPPED
    assert RobotCard.read(IDENTIFIED / name).facts.model.split(" ")[0] in MAY_BE_SHIPPED


def test_all_shipped_robots_are_small():
    assert sum(folder_size(folder) for folder in identified_catalogue().folders()) < MAX_TOTAL_BYTES


def test_the_page_lists_the_shipped_robots():
    table = markdown_cards(robot_cards(), ROBOT_HEADINGS)
    assert table in PAGE.read_text(encoding="utf-8")


def test_a_path_from_the_command_line_is_a_name_too(place):
    assert gp.load_robot(Path(NAME)).folder == IDENTIFIED / NAME


def test_a_folder_of_that_name_is_not_confused_with_it(place):
    shutil.copytree(IDENTIFIED / NAME, place / NAME)
    with pytest.raises(UsageError, match="directory"):
        gp.load_robot(NAME)
    assert gp.load_robot(f"./{NAME}").folder == place / NAME


def test_an_unknown_name_lists_what_there_is(place):
    with pytest.raises(RobotError, match=NAME):
        gp.load_robot("so101@nobody")


def test_its_folder_is_written_as_its_name():
    assert robot_argument(IDENTIFIED / NAME) == NAME


def test_list_names_every_robot(capsys):
    assert main(["robot", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    names = [robot["name"] for robot in (*listed["robots"], *listed["identified"])]
    assert names == named_robots()


def test_show_takes_the_name(place, capsys):
    assert main(["robot", "show", NAME, "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["joints"]) == set(gp.load_robot(NAME).operated)


def test_an_export_needs_a_folder_outside_of_the_package(place):
    with pytest.raises(UsageError, match="--out"):
        gp.export_robot(NAME, to="json")


def test_an_export_needs_no_recordings(place):
    made = gp.export_robot(NAME, to="json", out="exported")
    facts = json.loads((made.path / "facts.json").read_text())
    robot = gp.load_robot(NAME)
    assert [facts["joints"][j]["delay"] for j in robot.joint_names] == pytest.approx(
        robot.servo.delay
    )
    assert "recordings that were not fitted" in made.notes[-1]


def test_a_report_is_not_written_into_the_package(place, capsys):
    assert main(["report", NAME]) == 2
    assert "package" in capsys.readouterr().err


def test_nothing_writes_into_the_package(place):
    before = sorted((IDENTIFIED / NAME).iterdir())
    gp.export_robot(NAME, to="json", out="exported")
    assert sorted((IDENTIFIED / NAME).iterdir()) == before
    assert np.isfinite(gp.AlignedSim(gp.load_robot(NAME)).qpos).all()
