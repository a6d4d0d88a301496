"""Parameters of servos: what they may be, and what changes with them."""

from dataclasses import replace

import numpy as np
import pytest

from gaponet.base.errors import RobotError
from gaponet.robot.servo_parameters import ServoParameters

TWO = ServoParameters(
    kp=np.array([20.0, 10.0]), kd=np.array([1.0, 0.5]), effort_limit=np.array([5.0, 5.0])
)


def test_one_number_stands_for_all_joints(arm):
    assert arm.with_servo(delay=0.03).servo.delay.tolist() == [0.03, 0.03]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kp": [20.0, np.nan]}, "kp"),
        ({"kd": [1.0, np.inf]}, "kd"),
        ({"effort_limit": 5.0}, "effort_limit"),
        ({"delay": [0.0, np.nan]}, "delay"),
        ({"delay": [0.0, 0.0, 0.0]}, "delay"),
        ({"backlash": [0.0, -0.01]}, "backlash"),
    ],
)
def test_a_value_that_no_servo_has_is_refused(arm, values, message):
    with pytest.raises(RobotError, match=message):
        arm.with_servo(**values)


def test_servos_of_fewer_joints_than_the_robot_has_are_refused(so101):
    with pytest.raises(RobotError, match="servos"):
        replace(so101, servo=TWO)


def test_negative_damping_reduces_kd():
    changed = TWO.with_joints({0: {"damping": -0.4}, 1: {"damping": -2.0}})
    np.testing.assert_allclose(changed.kd, [0.6, 0.0])
    np.testing.assert_array_equal(changed.damping, 0.0)


def test_identified_gains_keep_their_ratio_to_the_nominal_ones():
    fitted = TWO.with_joints({0: {"kp": 10.0}})
    doubled = fitted.with_gains(2 * TWO.kp, TWO.kd, TWO)
    np.testing.assert_allclose(doubled.kp, [20.0, 20.0])


def test_friction_falls_as_the_joint_warms():
    cold = TWO.with_joints(
        {0: {"frictionloss": 0.2, "friction_per_kelvin": -0.01, "friction_temperature": 25.0}}
    )
    warm = cold.at_temperature(np.array([35.0, np.nan]))
    assert warm.frictionloss[0] == pytest.approx(0.18)


def test_stops_only_narrow_a_range():
    stopped = TWO.with_joints({0: {"stop_low": -0.5}, 1: {"stop_low": -9.0, "stop_high": 0.7}})
    ranges = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(stopped.within_stops(ranges), [[-0.5, 1.0], [-1.0, 0.7]])


def test_only_identified_values_leave_the_robot_before_behind(arm):
    assert arm.with_servo(kp=[9.0, 9.0]).nominal is None
    assert arm.with_identified({"elbow": {"kp": 9.0}}).nominal is arm
