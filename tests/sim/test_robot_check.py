"""gaponet robot check steps the simulator: what it calls wrong is wrong, and what it says to write
mends it.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.robot.finding import Finding
from gaponet.robot.spec import Scene
from gaponet.sim.robot_check import check_robot

LIGHT = XML.replace('damping="0.5" armature="0.02" frictionloss="0.05"', "")
STIFF = TOML.replace("kp = 20.0", "kp = 4000.0\nkd = 1.0").replace(
    "effort_limit = 5.0", "effort_limit = 300.0"
)
# The upper arm starts inside a pedestal that is fixed to the world, as links beside a base without
# its joint do.
WELDED = XML.replace(' contype="0" conaffinity="0"', "").replace(
    '<body name="upper">',
    '<body name="base"><geom type="box" size="0.03 0.03 0.03" pos="0.02 0 0"/></body>'
    '<body name="upper">',
)


def said(findings: list[Finding], check: str, level: str) -> list[str]:
    return [f.message for f in findings if (f.check, f.level) == (check, level)]


def bad(findings: list[Finding]) -> list[str]:
    return [f.message for f in findings if f.level in ("warning", "error")]


def test_a_sound_arm_has_no_warning_at_any_payload(arm):
    assert bad(check_robot(arm, (0.0, 0.5))) == []


def test_an_unstable_kp_is_an_error_and_each_suggested_cure_works(tmp_path):
    stiff = write_arm(tmp_path / "stiff", STIFF, LIGHT)
    findings = check_robot(stiff)
    (text,) = said(findings, "step", "error")
    step = re.search(r"timestep = (\S+) in robot.toml", text)[1]
    armature = re.search(r"armature = (\S+) in robot.xml", text)[1]
    shorter = write_arm(
        tmp_path / "shorter", STIFF.replace("timestep = 0.005", f"timestep = {step}"), LIGHT
    )
    assert bad(check_robot(shorter)) == []
    heavier = LIGHT.replace("<joint name", f'<joint armature="{armature}" name')
    assert bad(check_robot(write_arm(tmp_path / "heavier", STIFF, heavier))) == []


def test_a_kp_too_small_for_a_payload_alone_is_a_warning_of_that_payload(tmp_path):
    robot = write_arm(tmp_path / "arm", TOML.replace("kp = 20.0", "kp = 1.5"), XML)
    assert not said(check_robot(robot), "step", "warning")
    (text,) = said(check_robot(robot, (0.0, 3.0)), "step", "warning")
    assert "is too little to hold it up with 3 kg: it falls away" in text


def test_an_unknown_torque_limit_is_a_warning(tmp_path):
    robot = write_arm(tmp_path / "arm", TOML.replace("effort_limit = 5.0", "effort_limit = 1e6"))
    texts = said(check_robot(robot), "limits", "warning")
    assert [text.split(":")[0] for text in texts] == ["shoulder", "elbow"]


def test_a_joint_too_weak_for_its_payload_is_a_warning_of_that_payload(arm):
    assert not said(check_robot(arm), "load", "warning")
    (text,) = said(check_robot(arm, (0.0, 1.5)), "load", "warning")
    assert text.startswith("shoulder: needs 6.77 N·m to hold its home with 1.5 kg, its limit is 5")


def test_links_inside_each_other_touch_by_choice_alone(tmp_path):
    off = write_arm(tmp_path / "off", TOML, WELDED)
    assert said(check_robot(off), "contacts", "ok")[0].startswith(
        "at home base and upper lie inside each other"
    )
    on = replace(off, scene=Scene(contacts=True))
    (text,) = said(check_robot(on), "contacts", "warning")
    assert "contacts = false in robot.toml" in text
    excluded = WELDED.replace(
        "</mujoco>", '<contact><exclude body1="base" body2="upper"/></contact></mujoco>'
    )
    assert not said(
        check_robot(replace(write_arm(tmp_path / "x", TOML, excluded), scene=Scene(contacts=True))),
        "contacts",
        "warning",
    )


def test_postures_of_the_logs_in_which_links_meet_are_counted(tmp_path):
    xml = WELDED.replace('pos="0.02 0 0"', 'pos="0 0 -0.2"')  # reached with the arm hanging down
    robot = replace(write_arm(tmp_path / "arm", TOML, xml), scene=Scene(contacts=True))
    postures = np.array([[0.0, 0.0], [1.5, 0.0], [0.2, 0.0], [1.45, 0.1]])
    (text,) = said(check_robot(robot, postures=postures), "contacts", "warning")
    assert text.startswith("in 50% of the logs' postures base and ")


@pytest.mark.parametrize(
    ("xml", "check", "words"),
    [
        (
            XML.replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="-2 2"', 1),
            "limits",
            "stops the motor at 2 N·m",
        ),
        (
            XML.replace('range="-1.5 1.5"', 'range="-86 86"', 1),
            "range",
            "shoulder: its range is -86 to 86 rad: are",
        ),
        (
            XML.replace('angle="radian"', 'angle="degree"'),
            "range",
            "elbow: its range is -0.0262 to 0.0262 rad",
        ),
        (LIGHT, "damping", "no damping, kd or friction at shoulder, elbow"),
        (LIGHT, "inertia", "no armature at shoulder, elbow"),
        (
            XML.replace('axis="0 1 0"', 'axis="0 1 0" stiffness="3"', 1),
            "couplings",
            "springs at shoulder",
        ),
        (
            XML.replace('body name="fore"', 'body name="fore" gravcomp="1"'),
            "couplings",
            "gravcomp in robot.xml",
        ),
        (
            XML.replace('integrator="implicitfast"', 'gravity="0 0 0"'),
            "couplings",
            "gravity in robot.xml is [0.0,",
        ),
        (
            XML.replace(
                "</mujoco>",
                '<equality><joint joint1="shoulder" joint2="elbow"/></equality></mujoco>',
            ),
            "couplings",
            "robot.xml has 1 <equality>",
        ),
    ],
)
def test_springs_constraints_and_missing_inertia_are_reported(tmp_path, xml, check, words):
    findings = check_robot(write_arm(tmp_path / "arm", TOML, xml))
    assert any(words in f.message for f in findings if f.check == check and f.level != "ok")


def test_joints_that_an_equality_locks_are_an_error(tmp_path):
    welded = XML.replace("</mujoco>", '<equality><weld body1="fore"/></equality></mujoco>')
    (text,) = said(check_robot(write_arm(tmp_path / "arm", TOML, welded)), "couplings", "error")
    assert text.startswith("shoulder, elbow: cannot move")


def test_joints_that_an_equality_only_couples_are_no_error(tmp_path):
    coupled = XML.replace(
        "</mujoco>", '<equality><joint joint1="shoulder" joint2="elbow"/></equality></mujoco>'
    )
    findings = check_robot(write_arm(tmp_path / "arm", TOML, coupled))
    assert not said(findings, "couplings", "error")


def test_an_equality_that_is_not_active_is_not_counted(tmp_path):
    equality = '<equality><weld body1="fore" active="false"/></equality>'
    robot = write_arm(tmp_path / "arm", TOML, XML.replace("</mujoco>", f"{equality}</mujoco>"))
    assert not said(check_robot(robot), "couplings", "note")


def test_a_hold_that_swings_or_sags_is_reported(tmp_path):
    swinging = check_robot(write_arm(tmp_path / "free", TOML, LIGHT))
    assert "does not come to rest" in said(swinging, "hold", "error")[0]
    soft = check_robot(write_arm(tmp_path / "soft", TOML.replace("kp = 20.0", "kp = 5.0"), XML))
    assert "hangs" in said(soft, "hold", "note")[0]
