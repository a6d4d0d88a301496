"""Records of servo parameters: the servos have an attribute for each, and every reader gets what it
needs.
"""

import dataclasses

import numpy as np
import pytest
from arm import recordings

from gaponet.robot.folder import save_robot
from gaponet.robot.servo_fields import SERVO_FIELDS, TERMS
from gaponet.robot.servo_parameters import ServoParameters
from gaponet.robot.spec import load_robot
from gaponet.sysid.axes import Bounds, from_axis, to_axis


def test_servos_have_an_attribute_with_the_default_of_each_record():
    attributes = {f.name: f for f in dataclasses.fields(ServoParameters)}
    for name, record in SERVO_FIELDS.items():
        if record.default is not None:
            np.testing.assert_equal(attributes[name].default_factory(), record.default)


def test_a_value_of_each_record_survives_robot_toml(arm, tmp_path):
    values = {name: 0.5 * min(field.limits[1], 2.0) for name, field in SERVO_FIELDS.items()}
    save_robot(arm.with_identified(dict.fromkeys(arm.joint_names, values)), tmp_path / "out")
    back = load_robot(tmp_path / "out")
    for name, value in values.items():
        np.testing.assert_allclose(back.servo[name], value, err_msg=name)


MEASURED = "friction_temperature"


@pytest.mark.parametrize("name", [f for fields in TERMS.values() for f in fields if f != MEASURED])
def test_a_term_starts_inside_its_bounds(arm, name):
    bounds = Bounds(arm, recordings(arm, 1, rows=20))
    low, high, large = bounds.limits[name]
    start = to_axis(name, bounds.guess[name], bounds.first["kp"])
    assert (low <= start).all()
    assert (start <= high).all()
    assert (large > 0).all()


def test_axes_are_undone():
    values = {name: np.array([0.3, 2.0]) for name in SERVO_FIELDS}
    axes = {name: to_axis(name, x, values["kp"]) for name, x in values.items()}
    for name, x in from_axis(axes).items():
        np.testing.assert_allclose(x, values[name], err_msg=name)
