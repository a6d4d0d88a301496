"""Servo types: the package's table, entries from identified robots, and values taken over from
another robot.
"""

import json

import pytest
from arm import TOML, write_arm

from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot, servo_table
from gaponet.robot.toml_file import Spread
from gaponet.sysid.servo_types import far_from_servo_type, measured_types, mirrored, servos_like
from gaponet.sysid.uncertainty import JointUncertainty, ParameterUncertainty, to_axes

SERVO = '[[servo]]\nname = "S1"\nsource = "a bench"\narmature = 0.02\ndamping = 0.5\n'
TWO = (
    TOML.replace("timestep = 0.005", "timestep = 0.02").replace(
        "effort_limit = 5.0", 'effort_limit = 5.0\nservo = "S1"'
    )
    + SERVO
)


def test_a_value_an_order_of_magnitude_off_is_named(tmp_path):
    robot = write_arm(tmp_path, TWO)
    assert far_from_servo_type(robot) == []
    odd = robot.with_identified({"elbow": {"armature": 0.25, "damping": 0.4}})
    assert far_from_servo_type(odd) == [
        "elbow: armature 0.25 is 12 times the 0.02 of the S1 (a bench)"
    ]


def test_every_type_of_the_table_has_a_name_of_its_own():
    names = [servo.name for servo in servo_table().servo]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("servo", servo_table().servo, ids=lambda servo: servo.name)
def test_every_type_of_the_table_has_source_licence_and_ordered_values(servo):
    assert servo.source
    assert servo.licence
    assert servo.measured or servo.effort_limit
    for spread in servo.measured.values():
        assert spread.low <= spread.value <= spread.high


def test_a_value_outside_its_spread_is_refused():
    with pytest.raises(RobotError, match="value"):
        Spread(3.0, 1.0, 2.0)


@pytest.fixture
def command(tmp_path):
    """gaponet robot servos of an identified folder, with source and licence."""
    values = {
        "shoulder": {"damping": 0.8, "frictionloss": 0.1, "armature": 0.03},
        "elbow": {"damping": 1.2, "frictionloss": 0.3, "armature": 0.05},
    }
    robot = write_arm(tmp_path / "nominal", TWO)
    save_robot(robot.with_identified(values), tmp_path / "id")
    words = ["robot", "servos", "--from", str(tmp_path / "id")]
    return [*words, "--source", "my logs", "--licence", "CC0-1.0"]


def test_an_entry_needs_a_licence(command):
    assert main(command[:4]) == 2


def test_an_entry_from_an_identified_folder_has_the_values_of_its_joints_and_loads(
    command, tmp_path, capsys
):
    assert main(command) == 0
    entry = capsys.readouterr().out
    (servo, _) = write_arm(tmp_path / "used", TWO.replace(SERVO, entry)).servo.types
    assert servo.name == "S1"
    assert (servo.source, servo.licence) == ("my logs", "CC0-1.0")
    assert (servo.joints, servo.robots) == (2, 1)
    found = {
        field: vars(servo.measured[field]) for field in ("damping", "frictionloss", "armature")
    }
    assert found["damping"] == pytest.approx({"value": 1.0, "low": 0.8, "high": 1.2})
    assert found["frictionloss"] == pytest.approx({"value": 0.2, "low": 0.1, "high": 0.3})
    assert found["armature"] == pytest.approx({"value": 0.04, "low": 0.03, "high": 0.05})


def test_an_entry_is_printed_as_json(command, capsys):
    assert main([*command, "--json"]) == 0
    (servo,) = json.loads(capsys.readouterr().out)["servos"]
    assert servo["damping"] == {"value": 1.0, "low": 0.8, "high": 1.2}


def test_the_interval_of_a_single_joint_is_that_of_its_standard_error(tmp_path):
    robot = write_arm(tmp_path / "nominal", TWO).with_identified({"elbow": {"frictionloss": 0.2}})
    save_robot(robot, tmp_path / "id")
    fields = ("kp", "frictionloss")
    std = 0.02 / 20.0  # on the axis: friction over kp
    rest = ((0.0,) * 3, ((0.0,) * 3,) * 3, (1.0,) * 3, 0.0, 0.0, 0.0)
    covariance = ((0.0, 0.0), (0.0, std**2))
    joints = {}
    for joint, x in to_axes(robot, fields).items():
        joints[joint] = JointUncertainty(tuple(x), covariance, *rest)
    ParameterUncertainty(fields, joints, (), 24, True).save(tmp_path / "id")
    (servo,) = measured_types([load_robot(tmp_path / "id")], "my logs", "CC0-1.0")
    assert servo.measured == {"frictionloss": Spread(0.2, 0.167, 0.233)}  # 1.645 of them


def test_a_robot_s_own_servo_type_comes_before_the_table_s(tmp_path):
    used = TWO.replace('"S1"', '"STS3215"')
    own = write_arm(tmp_path, used).servo.types[0]
    packaged = write_arm(tmp_path, used.split("[[servo]]")[0]).servo.types[0]
    assert (own.source, own.measured["armature"].value) == ("a bench", 0.02)
    assert packaged == load_robot("so101").servo.types[0]


def test_an_undefined_servo_type_is_refused(tmp_path):
    with pytest.raises(RobotError, match="S1"):
        write_arm(tmp_path, TWO.replace(SERVO, ""))
    with pytest.raises(RobotError, match="S1"):
        write_arm(tmp_path, TWO + SERVO)


@pytest.mark.parametrize(
    ("joint", "other"),
    [
        ("left_elbow_joint", "right_elbow_joint"),
        ("FL_hip_joint", "FR_hip_joint"),
        ("RH_KFE", "LH_KFE"),
        ("shoulder_pan", "shoulder_pan"),
    ],
)
def test_a_mirrored_joint_has_the_other_side_in_its_name(joint, other):
    assert (mirrored(joint), mirrored(other)) == (other, joint)


def test_a_joint_starts_from_the_identified_servo_of_its_type_and_keeps_its_mounting(tmp_path):
    robot = write_arm(tmp_path / "a", TWO)
    elbow = {"kp": 15.0, "frictionloss": 0.2, "offset": 0.03, "delay": 0.01}
    identified = robot.with_identified({"elbow": elbow})
    stiff = write_arm(tmp_path / "b", TWO.replace("kp = 20.0", "kp = 40.0"))
    started, sources = servos_like(stiff, identified)
    assert sources == {"shoulder": "elbow", "elbow": "elbow"}  # the shoulder was not identified
    assert started.servo.kp.tolist() == [30.0, 30.0]  # the ratio to the nominal gain
    assert started.servo.frictionloss.tolist() == [0.2, 0.2]
    assert started.servo.delay.tolist() == [0.01, 0.01]
    assert started.servo.offset.tolist() == [0.0, 0.0]


def test_a_robot_that_is_not_identified_gives_no_servos(tmp_path):
    robot = write_arm(tmp_path, TWO)
    with pytest.raises(UsageError, match="identified"):
        servos_like(robot, robot)
