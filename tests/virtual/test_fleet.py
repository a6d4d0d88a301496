import tomllib
from dataclasses import fields

import numpy as np
import pytest
from arm import TOML, write_arm

from gaponet.base.errors import UsageError
from gaponet.experiments.paper.goals import GoalPlanner
from gaponet.robot.spec import load_robot
from gaponet.virtual.fleet import FLEETS, load_fleet
from gaponet.virtual.physics import Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

DIGESTS = {
    "easy": "470699a7d760",
    "hard": "1d49d40c608d",
    "shifted": "d2cc972792f1",
    "unnamed": "6e07b3021441",
}


@pytest.mark.parametrize("name", DIGESTS)
def test_units_of_a_seed_do_not_change(name):
    """Data sets name this hash: other numbers, as of another random generator, would make another
    fleet of them.
    """
    fleet = load_fleet(name, load_robot("h1_2"))
    assert fleet.digest() == DIGESTS[name]
    assert list(fleet.units) == ["virtual-1", "virtual-2", "virtual-3", "virtual-4"]


@pytest.mark.parametrize("name", DIGESTS)
def test_every_number_has_a_source_and_the_file_says_virtual(name):
    table = tomllib.loads((FLEETS / f"{name}.toml").read_text(encoding="utf-8"))
    assert table["virtual"] is True
    assert {d["name"] for d in table["distribution"]} <= {f.name for f in fields(Physics)}
    assert all(len(d["source"]) > 10 for d in table["distribution"])


def test_a_raw_hand_of_the_firm_fleet_sags_about_2_cm_under_3_kg():
    robot = load_robot("h1_2")
    fleet = load_fleet("firm", robot)
    planner = GoalPlanner(robot, 3.0, 0)
    assert fleet.digest() == load_fleet("hard", robot).digest()
    plans = planner.plans(3)
    held = np.repeat([plan.ctrl[-1] for plan in plans], len(fleet.units), axis=0)
    units = [*fleet.units.values()] * len(plans)
    firm = robot.with_gain_scale(fleet.gain_scale)
    robots = VirtualRobot(firm, units, [(3.0, "both")] * len(units))
    robots.reset(held, list(range(len(units))))
    sag = (planner.hand_positions(held) - planner.hand_positions(robots.true_qpos()))[..., 2]
    assert 0.015 < sag.mean() < 0.025


def test_a_robot_that_the_file_does_not_hold_is_drawn_from_the_same_distributions(arm):
    a = load_fleet("easy", arm)
    b = load_fleet("easy", arm)
    assert a.digest() == b.digest()
    assert a.unit("virtual-1").friction.shape == (2,)
    assert 0.005 * 5 < a.unit("virtual-1").friction.mean() < 0.05 * 5  # parts of the 5 N·m limit


def test_an_effect_alone_leaves_nothing_of_the_others():
    unit = load_fleet("shifted", load_robot("h1_2")).unit("virtual-1")
    none = neutral(27)
    alone = unit.only(["backlash"])
    for f in fields(Physics):
        kept = unit if f.name == "backlash" else none
        assert np.array_equal(getattr(alone, f.name), getattr(kept, f.name)), f.name


def test_a_robot_without_a_known_torque_limit_is_refused(tmp_path):
    unlimited = TOML.replace("effort_limit = 5.0", "effort_limit = 1e6")
    robot = write_arm(tmp_path / "arm", unlimited)
    with pytest.raises(UsageError, match="the torque limit of shoulder is not known"):
        load_fleet("hard", robot)


def test_errors_say_what_there_is(arm, tmp_path):
    with pytest.raises(UsageError, match="lab"):
        load_fleet("lab", arm)
    with pytest.raises(UsageError, match="robot-7"):
        load_fleet("easy", arm).unit("robot-7")
    with pytest.raises(UsageError, match="magic"):
        neutral(2).only(["magic"])
    file = tmp_path / "bad.toml"
    file.write_text('seed = 1\n[[distribution]]\nname = "charm"\nmean = 1\nsource = "none"\n')
    with pytest.raises(UsageError, match="charm"):
        load_fleet(file, arm)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("seed = 20261", "seed = -1", "seed:"),
        ("mean = 0.89", 'mean = "0.89"', r"distribution\[0\]\.mean:"),
        ("type_spread = 0.03", "type_spread = nan", r"distribution\[0\]\.type_spread:"),
        ("low = 0.6", "lov = 0.6", r"distribution\[0\]\.lov:"),
        ('name = "kd_scale"', 'name = "kp_scale"', "'kp_scale'"),
        ("mean = 0.01\nunit_spread = 0.002\nlow = 0.002", "mean = 3600.0", "delay"),
        ("mean = 0.01\nunit_spread = 0.002\nlow = 0.002", "mean = -0.1", "delay"),
        ("mean = 0.002\nunit_spread = 0.0005", "mean = 2.0", "drop"),
    ],
)
def test_a_fleet_of_numbers_that_no_robot_has_is_refused_with_file_and_field(
    arm, tmp_path, old, new, said
):
    file = tmp_path / "mine.toml"
    easy = (FLEETS / "easy.toml").read_text(encoding="utf-8")
    file.write_text(easy.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(UsageError, match=said):
        load_fleet(file, arm)
