"""Servos of one type: published values, and values taken over from another robot."""

import pytest
from arm import TOML, write_arm

from gaponet.base.errors import RobotError, UsageError
from gaponet.sysid.servo_types import far_from_published, mirrored, servos_like

SERVO = '[[servo]]\nname = "S1"\nsource = "a bench"\narmature = 0.02\ndamping = 0.5\n'
TWO = (
    TOML.replace("timestep = 0.005", "timestep = 0.02").replace(
        "effort_limit = 5.0", 'effort_limit = 5.0\nservo = "S1"'
    )
    + SERVO
)


def test_a_value_an_order_of_magnitude_off_is_named(tmp_path):
    robot = write_arm(tmp_path, TWO)
    assert far_from_published(robot) == []
    odd = robot.with_servos({"elbow": {"armature": 0.25, "damping": 0.4}})
    assert far_from_published(odd) == ["elbow: armature 0.25 is 12 times the 0.02 published for the S1 (a bench)"]


def test_an_undefined_servo_type_is_refused(tmp_path):
    with pytest.raises(RobotError, match="joint 'shoulder': servo 'S1' is no"):
        write_arm(tmp_path, TWO.replace(SERVO, ""))


@pytest.mark.parametrize(
    ("joint", "other"),
    [("left_elbow_joint", "right_elbow_joint"), ("FL_hip_joint", "FR_hip_joint"), ("RH_KFE", "LH_KFE"),
     ("shoulder_pan", "shoulder_pan")],
)  # fmt: skip
def test_a_mirrored_joint_has_the_other_side_in_its_name(joint, other):
    assert (mirrored(joint), mirrored(other)) == (other, joint)


def test_a_joint_starts_from_the_identified_servo_of_its_type_or_mirror_image_and_keeps_its_mounting(tmp_path):
    robot = write_arm(tmp_path / "a", TWO)
    identified = robot.with_servos({"elbow": {"kp": 15.0, "frictionloss": 0.2, "offset": 0.03, "delay": 0.01}})
    stiff = write_arm(tmp_path / "b", TWO.replace("kp = 20.0", "kp = 40.0"))
    started, sources = servos_like(stiff, identified)
    assert sources == {"shoulder": "elbow", "elbow": "elbow"}  # the shoulder was not identified
    assert started.kp.tolist() == [30.0, 30.0]  # the ratio to the nominal gain
    assert (started.frictionloss.tolist(), started.delay.tolist()) == ([0.2, 0.2], [0.01, 0.01])
    assert started.offset.tolist() == [0.0, 0.0]
    with pytest.raises(UsageError, match="no identified joint"):
        servos_like(stiff, robot)
