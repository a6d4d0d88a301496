"""One law for servos of one type."""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, recordings, write_arm

from gaponet.base.errors import RobotError, UsageError
from gaponet.sysid.identify import identify
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.shared_servo import far_from_published, mirrored, same_servos, servos_like, share

SERVO = '[[servo]]\nname = "S1"\nsource = "a bench"\narmature = 0.02\ndamping = 0.5\n'
TWO = (
    TOML.replace("timestep = 0.005", "timestep = 0.02").replace(
        "effort_limit = 5.0", 'effort_limit = 5.0\nservo = "S1"'
    )
    + SERVO
)


def test_two_equal_servos_get_one_servo_model(tmp_path):
    robot = write_arm(tmp_path, TWO)
    assert same_servos(robot) == {"S1": [0, 1]}
    true = {"kp": 15.0, "damping": 0.6, "frictionloss": 0.1, "armature": 0.02, "offset": 0.0, "delay": 0.0}
    acting = robot.with_servos({"shoulder": true | {"offset": 0.02}, "elbow": true | {"offset": -0.01}})
    runs = JointRollouts(recordings(acting, 2, rows=80), robot)
    start = {f: np.array([0.7, 1.3]) * v for f, v in true.items()}  # what each joint's own fit may end at
    before = np.abs(runs.errors({f: v[None] for f, v in start.items()})).mean()
    found = share(runs, start, [0, 1], 0.02)
    assert np.abs(runs.errors({f: v[None] for f, v in found.items()})).mean() < 0.1 * before
    for f in ("kp", "damping", "frictionloss", "armature"):
        assert found[f][0] == pytest.approx(found[f][1])
        assert found[f][0] == pytest.approx(true[f], rel=0.15)
    np.testing.assert_allclose(found["offset"], [0.02, -0.01], atol=2e-3)


def test_a_value_an_order_of_magnitude_off_is_named(tmp_path):
    robot = write_arm(tmp_path, TWO)
    assert far_from_published(robot) == []
    odd = robot.with_servos({"elbow": {"armature": 0.25, "damping": 0.4}})
    assert far_from_published(odd) == ["elbow: armature 0.25 is 12 times the 0.02 published for the S1 (a bench)"]


def test_an_undefined_servo_type_is_refused(tmp_path):
    with pytest.raises(RobotError, match="joint 'shoulder': servo 'S1' is no"):
        write_arm(tmp_path, TWO.replace(SERVO, ""))
    robot = write_arm(tmp_path / "own", TOML)
    assert same_servos(robot) == {} == same_servos(replace(robot, servos=()))


def test_identify_can_share_a_servo_model(tmp_path):
    robot = write_arm(tmp_path, TWO)
    motions = recordings(robot, 3, rows=80, kp=0.8)
    fit = identify(motions[:2], robot, motions[2:], windows=2, terms=(), shared=True)
    assert fit.robot.kp[0] == pytest.approx(fit.robot.kp[1])
    np.testing.assert_allclose(fit.robot.kp, 0.8 * robot.kp, rtol=0.1)
    (law,) = fit.shared
    assert (law.name, law.before.shape, law.after.shape) == ("S1", (1,), (1,))
    assert law.after.mean() < 5e-3


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
