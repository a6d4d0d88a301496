"""Options that Python and the command line share."""

import pytest

from gaponet.api.options import IdentifyOptions, parse_joint_map
from gaponet.api.start import StartOptions
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


def test_what_start_is_told_of_joints_and_units_holds_for_the_first_recording_too():
    read = StartOptions(map=("a=b",), time_unit="ms").read_options()
    assert read.joint_map == {"a": "b"}
    assert read.time_unit == "ms"
