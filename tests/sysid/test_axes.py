"""Axes of a search: units in which torques are multiples of kp, bounds, and what is said at
them.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, recordings, write_arm

from gaponet.sysid.axes import CLASSIC, Axes, Bounds, Changes, first_values, from_axis, to_axis


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    toml = TOML.replace("kp = 20.0", "kp = 20.0\nkd = 0.5")
    return write_arm(tmp_path_factory.mktemp("arm"), toml)


@pytest.fixture(scope="module")
def bounds(robot):
    return Bounds(robot, recordings(robot, 2, rows=60))


def test_torques_are_multiples_of_kp():
    kp = np.array([10.0, 40.0])
    x = {"kp": to_axis("kp", kp, kp), "frictionloss": to_axis("frictionloss", 0.1 * kp, kp)}
    assert x["frictionloss"].tolist() == [0.1, 0.1]
    doubled = from_axis(x | {"kp": x["kp"] + np.log(2)})
    np.testing.assert_allclose(doubled["frictionloss"], 0.2 * kp)


def test_a_motor_without_a_torque_speed_line_is_zero_on_its_axis_and_back():
    speeds = np.array([0.0, 4.0])
    x = to_axis("no_load_speed", speeds, np.ones(2))
    assert x.tolist() == [0.0, 0.25]
    assert from_axis({"no_load_speed": x}, np.ones(2))["no_load_speed"].tolist() == [0.0, 4.0]


def test_values_survive_their_axes_and_others_stay(bounds):
    values = bounds.start | {"damping": np.array([-0.2, 0.3])}
    axes = Axes(bounds, ("kp", "damping"), values)
    back = axes.values(axes.normalize(values))
    for field in CLASSIC:
        np.testing.assert_allclose(back[field], values[field], atol=1e-12)


def test_damping_may_take_all_of_the_servos_kd_and_no_more(bounds):
    axes = Axes(bounds, ("damping",), bounds.start)
    least = axes.values(axes.low)["damping"]
    np.testing.assert_allclose(least, -bounds.kd)


def test_a_joint_that_no_command_moves_keeps_what_only_its_own_motion_shows(robot):
    moving = recordings(robot, 1, rows=60)[0]
    ctrl = moving.ctrl.copy()
    ctrl[:, 1] = ctrl[0, 1]
    axes = Axes(Bounds(robot, [replace(moving, ctrl=ctrl)]), CLASSIC, first_values(robot))
    fixed = [f for f, a, b in zip(axes.names, axes.low[1], axes.high[1], strict=True) if a == b]
    assert fixed == ["armature", "delay"]


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("damping", -0.5, "clock"),
        ("delay", 0.15, "most"),
        ("delay", 0.0, ""),
        ("frictionloss", 0.0, ""),
        ("frictionloss", 4.0, "most"),
    ],
)
def test_a_value_at_its_bound_is_named_unless_zero_is_ordinary(bounds, field, value, word):
    values = bounds.start | {field: np.array([value, bounds.start[field][1]])}
    said = bounds.warnings(values, CLASSIC)
    assert len(said) == (1 if word else 0)
    assert all(word in text and field in text for text in said)


def test_no_change_is_the_robots_own_and_a_bound_of_zero_is_met_exactly(robot):
    first = first_values(robot)
    changes = Changes(first, ("kp", "frictionloss", "delay"))
    same = changes.values(np.zeros((2, 3)))
    assert all(np.array_equal(same[f], first[f]) for f in CLASSIC)
    least = changes.values(changes.low)
    assert least["frictionloss"].tolist() == [0.0, 0.0]
    late = changes.values(changes.start(0.02))
    np.testing.assert_allclose(late["delay"], 0.02)
