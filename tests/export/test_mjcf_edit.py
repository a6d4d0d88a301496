"""A copy of a user's MJCF has the robot's numbers where MuJoCo or the file has its own ways."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.base.errors import RobotError
from gaponet.export.mjcf_edit import edit_mjcf
from gaponet.export.simulator_facts import mjcf_text, simulator_facts
from gaponet.robot.spec import Link
from gaponet.sim.model import build_model

SERVO = {"kp": 16.0, "damping": 0.8, "armature": 0.03, "zero": 0.05}
SERVOS = """<position name="s" joint="shoulder" kp="20"/>
  <position name="e" joint="elbow" kp="20"/>"""
TIPS = """
[[tip]]
body = "fore"
pos = [0.2, 0.0, 0.0]
[[tip]]
body = "upper"
pos = [0.1, 0.0, 0.0]
[table]
height = -0.1
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    arm = write_arm(tmp_path_factory.mktemp("arm") / "arm")
    return arm.with_identified(dict.fromkeys(arm.joint_names, SERVO))


def with_servos(servos=SERVOS, defaults=""):
    """Return the arm's MJCF with actuators, and with more in its defaults."""
    text = XML.strip().replace("<default>", f"<default>{defaults}")
    return text.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>")


def edit(robot, text, folder, payload_mass=0.0):
    """Write a file and its edited copy; return the copy and the joints in another unit."""
    folder.mkdir(exist_ok=True)
    file = folder / "mine.xml"
    if isinstance(text, str):
        text = text.encode()
    file.write_bytes(text)
    return edit_file(robot, file, folder / "out", payload_mass)


def edit_file(robot, file, out, payload_mass=0.0):
    facts = simulator_facts(robot, robot.dt, payload_mass, robot) | {"prefix": ""}
    return edit_mjcf(file, out, robot, facts, payload_mass)


def load(file):
    return mujoco.MjModel.from_xml_path(str(file))


def solref_of_tips(model):
    """Return the solref of each tip's contact with the table, (2, 2), the first tip first."""
    solref = np.zeros((2, 2))
    for k in range(model.npair):
        names = {model.geom(model.pair_geom1[k]).name, model.geom(model.pair_geom2[k]).name}
        (tip,) = names - {"gaponet_table"}
        solref[int(tip[-1])] = model.pair_solref[k]
    return solref


def test_each_tip_has_the_stiffness_of_its_own_body(tmp_path):
    robot = write_arm(tmp_path / "arm", TOML + TIPS)
    expected = solref_of_tips(build_model(robot))

    file, _ = edit_file(robot, robot.mjcf, tmp_path / "out")
    text = mjcf_text(robot, robot.dt)

    assert abs(expected[0] - expected[1]).min() > 10.0
    assert solref_of_tips(load(file)) == pytest.approx(expected)
    assert solref_of_tips(mujoco.MjModel.from_xml_string(text)) == pytest.approx(expected)


def test_a_servo_inherits_no_armature_damping_or_delay(robot, tmp_path):
    own = 'armature="0.5" damping="0.3 0.1 0.05" delay="0.02" nsample="12"'
    text = with_servos(defaults=f'<position kp="20" {own}/>')
    one_added = text.replace('<position name="e" joint="elbow" kp="20"/>', "")

    for number, file_text in enumerate((text, one_added)):
        model = load(edit(robot, file_text, tmp_path / str(number))[0])
        assert not model.actuator_armature.any()
        assert not model.actuator_damping.any()
        assert not model.actuator_dampingpoly.any()
        assert not model.actuator_delay.any()
        assert model.nhistory == 0


def test_a_joint_inherits_no_damping_of_higher_order(robot, tmp_path):
    text = with_servos().replace('<joint damping="0.5"', '<joint damping="0.5 0.1"')
    model = load(edit(robot, text, tmp_path)[0])
    assert model.dof_damping == pytest.approx([0.8, 0.8])
    assert not model.dof_dampingpoly.any()


def test_a_body_without_an_end_tag_carries_a_payload_a_tip_and_an_inertia(tmp_path):
    end = '"/>\n      </body>'
    assert XML.count(end) == 1
    tool = '"/>\n<body name="tool" pos="0.2 0 0.1"/></body>'
    xml = XML.replace(end, tool)
    toml = TOML.replace('body = "fore"\npos = [0.2, 0.0, 0.0]', 'body = "tool"\npos = [0, 0, 0.05]')
    toml += TIPS.replace('"fore"', '"tool"')
    robot = write_arm(tmp_path / "arm", toml, xml)
    link = Link(0.1, (0.0, 0.0, 0.02), (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
    robot = replace(robot, links={"tool": link})

    model = load(edit_file(robot, robot.mjcf, tmp_path / "out", payload_mass=0.5)[0])

    tool = model.body("tool")
    assert tool.mass[0] == pytest.approx(link.mass)
    payload = model.body("payload_hand")
    assert payload.parentid[0] == tool.id
    assert payload.pos == pytest.approx([0.0, 0.0, 0.05])
    assert model.geom("gaponet_table_tip_0").bodyid[0] == tool.id


def test_a_copy_is_not_edited_again(robot, tmp_path):
    file, _ = edit(robot, with_servos(), tmp_path)
    assert load(file).qpos0 == pytest.approx([-0.05, -0.05])
    with pytest.raises(RobotError, match="zero"):
        edit_file(robot, file, tmp_path / "again")


def test_a_copy_with_a_payload_gets_no_second_one(robot, tmp_path):
    without_zero = robot.with_servo(zero=0.0)
    file, _ = edit(without_zero, with_servos(), tmp_path, payload_mass=0.5)
    with pytest.raises(RobotError, match="original"):
        edit_file(without_zero, file, tmp_path / "again", payload_mass=0.5)


def test_a_copy_does_not_replace_its_own_source(robot, tmp_path):
    file, _ = edit(robot, with_servos(), tmp_path)
    before = file.read_bytes()
    with pytest.raises(RobotError, match="--out"):
        edit_file(robot, file, tmp_path / "out")
    assert file.read_bytes() == before


def test_a_copy_that_does_not_compile_leaves_the_last_one(robot, tmp_path):
    file, _ = edit(robot, with_servos(), tmp_path)
    before = file.read_bytes()
    text = with_servos().replace("<compiler ", '<compiler boundmass="2" ')
    with pytest.raises(RobotError, match="boundmass"):
        edit(robot, text, tmp_path, payload_mass=0.5)
    assert file.read_bytes() == before


def test_a_servo_with_a_negative_gear_gets_its_range_mirrored_and_is_named(robot, tmp_path):
    servos = SERVOS.replace('kp="20"', 'kp="20" gear="-1" ctrlrange="-0.5 1.4"', 1)
    file, other_unit = edit(robot, with_servos(servos), tmp_path)
    servo = load(file).actuator("s")
    assert servo.ctrlrange == pytest.approx([-1.4, 0.5])
    assert servo.gear[0] == 1.0
    assert other_unit == ["shoulder"]


@pytest.mark.skipif(not hasattr(mujoco.MjsActuator, "set_to_pid"), reason="needs MuJoCo 4")
def test_a_pid_servo_keeps_the_range_of_its_targets(robot, tmp_path):
    servos = '<pid name="s" joint="shoulder" input="pos" kp="20" ctrlrange="-0.5 1.4"/>'
    file, other_unit = edit(robot, with_servos(servos), tmp_path)
    assert load(file).actuator("s").ctrlrange == pytest.approx([-0.5, 1.4])
    assert other_unit == []


def test_a_file_keeps_its_encoding(robot, tmp_path):
    text = '<?xml version="1.0" encoding="ISO-8859-1"?><!-- Größe in ° -->' + with_servos()
    file, _ = edit(robot, text.encode("latin-1"), tmp_path)
    assert load(file).nu == 2
    assert "Größe in °" in file.read_text(encoding="latin-1")
    assert 'kp="20"' in (file.parent / "changes.diff").read_text(encoding="utf-8")


def test_servos_of_an_included_file_are_found(robot, tmp_path):
    included = f"<mujocoinclude>{SERVOS}</mujocoinclude>"
    (tmp_path / "servos.xml").write_text(included)
    file, _ = edit(robot, with_servos('<include file="servos.xml"/>'), tmp_path)
    model = load(file)
    assert [model.actuator(i).name for i in range(model.nu)] == ["s", "e"]
    assert model.actuator_gainprm[:, 0].tolist() == [16.0, 16.0]


def test_a_coupling_of_joints_keeps_all_its_digits(tmp_path):
    ratio = 0.333333333333
    coupling = f'<joint joint1="elbow" joint2="shoulder" polycoef="0 {ratio} 0 0 0"/>'
    xml = XML.replace("</mujoco>", f"<equality>{coupling}</equality></mujoco>")
    robot = write_arm(tmp_path / "arm", xml=xml)
    model = mujoco.MjModel.from_xml_string(mjcf_text(robot, robot.dt))
    assert model.eq_data[0, 1] == pytest.approx(ratio, rel=1e-12)


def test_facts_have_what_the_robot_carries_its_links_and_its_table(tmp_path):
    toml = TOML.replace("pos = [0.2, 0.0, 0.0]", "pos = [0.2, 0.0, 0.0]\nmass = 0.6") + TIPS
    link = Link(0.4, (0.12, 0.0, 0.01), (1e-4, 2e-3, 2e-3, 0.0, 0.0, 0.0))
    robot = replace(write_arm(tmp_path / "arm", toml), links={"upper": link})

    facts = simulator_facts(robot, robot.dt, payload_mass=0.5)

    hand = facts["payload_mounts"]["hand"]
    assert hand["mass"] == pytest.approx(1.1)
    assert hand["body"] == "fore"
    assert facts["links"]["upper"]["mass"] == 0.4
    assert facts["table"]["height"] == -0.1
    assert [tip["body"] for tip in facts["table"]["tips"]] == ["fore", "upper"]
    assert np.allclose(hand["pos"], [0.2, 0.0, 0.0])
