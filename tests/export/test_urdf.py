"""A user's URDF takes along what its tags hold, and is told what they do not."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import pytest
from arm import TOML, write_arm

from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.export.export_folder import Source, export_robot
from gaponet.robot.spec import Link

FOUND = {
    "shoulder": {"kp": 16.0, "damping": 0.8, "frictionloss": 0.1, "delay": 0.013, "armature": 0.05},
    "elbow": {"kp": 24.0, "damping": 0.6, "frictionloss": 0.07},
}
LINK = (
    '<link name="{0}"><inertial><mass value="0.3"/>'
    '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
URDF = f"""<robot name="arm"><!-- by hand -->
  {LINK.format("base")}{LINK.format("upper")}{LINK.format("fore")}
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/>
    <limit effort="9" velocity="3" lower="-1.5" upper="1.5"/>
    <dynamics friction="0.5"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><axis xyz="0 1 0"/>
    <limit effort="9" velocity="3" lower="-1.5" upper="1.5"/></joint>
  <transmission name="t"><type>t</type>
    <joint name="elbow"><hardwareInterface>e</hardwareInterface></joint>
  </transmission>
</robot>
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm") / "arm").with_identified(FOUND)


@pytest.fixture(scope="module")
def made(robot, tmp_path_factory):
    """What was exported into the user's URDF."""
    folder = tmp_path_factory.mktemp("urdf")
    file = folder / "mine.urdf"
    file.write_text(URDF)
    return export_robot(robot, "urdf", folder / "out", source=Source(file))


def test_a_urdf_gets_the_damping_friction_and_effort_that_were_found(made):
    damping = {}
    friction = {}
    efforts = []
    for joint in ET.parse(made.file).getroot().findall("joint"):
        name = joint.attrib["name"]
        dynamics = joint.find("dynamics").attrib
        damping[name] = float(dynamics["damping"])
        friction[name] = float(dynamics["friction"])
        efforts.append(joint.find("limit").attrib["effort"])
    assert damping == {"shoulder": 0.8, "elbow": 0.6}
    assert friction == {"shoulder": 0.1, "elbow": 0.07}
    assert efforts == ["5", "5"]


def test_mujoco_reads_the_damping_of_a_urdf(made):
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert model.dof_damping.ravel().tolist() == [0.8, 0.6]


def test_a_urdf_keeps_all_but_its_dynamics_and_efforts(made):
    assert "<!-- by hand -->" in made.file.read_text()
    changes = (made.file.parent / "changes.diff").read_text().splitlines()
    changed = [line for line in changes if line.startswith(("+", "-"))]
    headers = [line for line in changes if line.startswith(("+++", "---"))]
    assert len(changed) - len(headers) == 9


def test_what_a_urdf_cannot_hold_is_named_and_has_its_price(made):
    lost = next(note for note in made.notes if "no place" in note)
    assert "kp, armature, delay" in lost
    alone = made.errors["mine.urdf alone, all else as before"]
    assert alone > 100 * made.errors["in gaponet"] + 0.002


@pytest.fixture
def lacking(tmp_path):
    """An export into a URDF that has no place for a hand's mass, a table, a stop, and a limit."""
    table = "[[tip]]\nbody = 'fore'\npos = [0.2, 0.0, 0.0]\n[identified_table]\nheight = -0.5\n"
    mount = "[identified_mount.hand]\npos = [0.2, 0.0, 0.0]\nmass = 0.6\n"
    robot = write_arm(tmp_path / "arm", TOML + table + mount)
    robot = robot.with_identified({"shoulder": {"effort_limit": 3.0}, "elbow": {"stop_low": -0.7}})
    limit = '<limit effort="9" velocity="3" lower="-1.5" upper="1.5"/>'
    file = tmp_path / "mine.urdf"
    file.write_text(URDF.replace(limit, "", 1).replace("revolute", "continuous", 1))
    return export_robot(robot, "urdf", tmp_path / "out", source=Source(file), payload_mass=0.5)


@pytest.mark.parametrize(
    "words",
    [
        "1.1 kg at fore (hand)",
        "table (height -0.500 m)",
        "stops of elbow",
        "torque limits of shoulder",
    ],
)
def test_masses_tables_stops_and_limits_that_a_urdf_does_not_get_are_named(lacking, words):
    assert any(words in note for note in lacking.notes)


def test_a_hand_and_a_table_that_a_urdf_does_not_get_have_their_price(lacking):
    alone = lacking.errors["mine.urdf alone, all else as before"]
    assert alone > lacking.errors["in gaponet"] + 0.005


def test_links_are_written_where_the_file_has_the_mass_that_was_corrected(robot, tmp_path):
    file = tmp_path / "mine.urdf"
    link = Link(0.4, (0.12, 0.0, 0.01), (1e-4, 2e-3, 2e-3, 0.0, 0.0, 0.0))
    file.write_text(URDF)
    made = export_robot(
        replace(robot, links={"upper": link, "fore": link}),
        "urdf",
        tmp_path / "out",
        source=Source(file),
    )
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert model.body("upper").mass == pytest.approx(0.4)
    assert model.body("upper").ipos == pytest.approx(link.pos)
    assert model.body("fore").mass == pytest.approx(0.3)  # 0.2 in robot.xml
    assert "inertias of fore were not written: their masses in the file are others" in made.notes


def test_links_are_written_into_the_users_mjcf(robot, tmp_path):
    link = Link(0.4, (0.12, 0.0, 0.01), (1e-4, 2e-3, 2e-3, 0.0, 0.0, 0.0))
    made = export_robot(replace(robot, links={"upper": link}), "mjcf", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(made.file))
    assert model.body("upper").mass == pytest.approx(0.4)
    assert model.body("upper").ipos == pytest.approx(link.pos)
    assert model.body("fore").mass == pytest.approx(0.2)


def test_a_file_that_is_none_or_has_other_joints_is_refused(robot, tmp_path, capsys):
    with pytest.raises(UsageError, match="--into"):
        export_robot(robot, "urdf", tmp_path / "a")
    with pytest.raises(RobotError, match="<mujoco>"):
        export_robot(robot, "urdf", tmp_path / "b", source=Source(robot.mjcf))
    file = tmp_path / "other.urdf"
    file.write_text(URDF.replace('"shoulder"', '"left_shoulder"'))
    with pytest.raises(RobotError, match="--prefix"):
        export_robot(robot, "urdf", tmp_path / "c", source=Source(file))
    assert main(["export", str(robot.folder), "--to", "urdf", "--into", str(file)]) == 2
    assert "no joint 'shoulder'" in capsys.readouterr().err
