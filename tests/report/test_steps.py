"""How the steps from logs to an export are typed."""

from gaponet.report.steps import import_logs, option_words


def test_a_text_that_begins_with_a_dash_stays_the_value_of_its_option():
    assert option_words({"unit_id": "--allow-pickle"}) == ["--unit-id=--allow-pickle"]


def test_a_map_that_begins_with_a_dash_stays_the_value_of_its_option():
    assert option_words({"map": ("-q1=elbow",)}) == ["--map=-q1=elbow"]


def test_options_that_nobody_set_are_not_typed():
    assert option_words({"budget": None, "skip_bad": False, "joints": ()}) == []


def test_joints_of_a_map_are_typed_one_by_one_and_other_lists_together():
    words = option_words({"map": ("a=b", "c=d"), "kp": ("3", "elbow=4")})
    assert words == ["--map", "a=b", "--map", "c=d", "--kp", "3", "elbow=4"]


def test_a_line_can_be_typed_as_it_is_shown():
    step = import_logs("my logs", "./arm", "data", cut="8", skip_bad=True)
    assert step.line == "gaponet import 'my logs' --robot ./arm --cut 8 --skip-bad --out data"
