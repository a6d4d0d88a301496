"""Options that Python and the command line share."""

import pytest

from gaponet.api.options import IdentifyOptions, parse_joint_map
from gaponet.api.steps import StartOptions
from gaponet.base.errors import UsageError


def test_a_budget_is_a_time():
    assert IdentifyOptions(budget="4m").seconds() == 240.0
    assert IdentifyOptions().seconds() is None


def test_a_budget_in_control_steps_is_refused():
    with pytest.raises(UsageError, match="--budget"):
        IdentifyOptions(budget="100000").seconds()


def test_joints_are_mapped_by_pairs():
    assert parse_joint_map(("a=b", "c = d")) == {"a": "b", "c": "d"}
    assert parse_joint_map(()) is None


@pytest.mark.parametrize("pairs", [("a",), ("a=",), ("=b",), ("a=b=c",), ("a=b", "a=c")])
def test_a_pair_that_says_nothing_or_too_much_is_refused(pairs):
    with pytest.raises(UsageError, match="--map"):
        parse_joint_map(pairs)


def test_a_robot_that_is_driven_by_torque_refuses_options_of_servos():
    IdentifyOptions(windows=3).require_none_for_torque("data")
    with pytest.raises(UsageError, match="--terms"):
        IdentifyOptions(terms=("stribeck",)).require_none_for_torque("data")


def test_what_start_is_told_reaches_the_commands():
    options = StartOptions(map=("a=b",), time_unit="ms", cut=3.0, skip_bad=True, budget="4m")
    words = options.import_words()
    assert words[:4] == ["--unit-id", "lab", "--payload-mass", "0"]
    assert set(words[4:]) == {"--map=a=b", "--time-unit=ms", "--cut=3.0", "--skip-bad"}
    assert options.identify_words() == ["--budget", "4m"]
    assert options.read_options().joint_map == {"a": "b"}
