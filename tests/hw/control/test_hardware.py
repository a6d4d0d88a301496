"""What a folder that somebody sent can change on a real robot: identified values within bounds,
and nothing else.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from runs import untrained

from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.hardware import hardware_robot, reference_robot, robot_hash
from gaponet.hw.control.plan import Planner
from gaponet.hw.control.safety import Limits, SafetyConfig
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.motion.motion import Motion
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot

JOINT = "left_shoulder_pitch_joint"
RUN = ["run", "--driver", "unitree", "--motion", "sweep-left_elbow", "--yes"]


@pytest.fixture(scope="module")
def h1_2() -> RobotSpec:
    return load_robot("h1_2")


def tampered(robot: RobotSpec, folder: Path, file: str, pattern: str, new: str) -> Path:
    """A copy of a robot folder in which one text was replaced, everywhere."""
    save_robot(robot, folder)
    text, count = re.subn(pattern, new, (folder / file).read_text())
    assert count
    (folder / file).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("file", "pattern", "new", "said"),
    [
        ("robot.toml", r"kp = (\d+)\.0", r"kp = \g<1>0.0", "kp of left_hip_yaw_joint"),
        ("robot.toml", r"effort_limit = (\d+)\.0", r"effort_limit = \g<1>0.0", "effort_limit"),
        ("robot.xml", r'range="[^"]*"', 'range="-9 9"', "qpos_range"),
        ("robot.xml", r'mass="(\d)', r'mass="9\1', "inertias"),
        ("collision.toml", r"radius = [\d.]+", "radius = 0.001", r"collision\.toml"),
    ],
)
def test_a_folder_that_differs_from_the_known_robot_is_refused_with_the_value(
    h1_2, tmp_path, capsys, file, pattern, new, said
):
    folder = tampered(h1_2, tmp_path / "sent", file, pattern, new)
    assert main([*RUN, "--robot", str(folder)]) == 2
    assert re.search(said, " ".join(capsys.readouterr().err.split()))
    sent = load_robot(folder)
    assert robot_hash(sent) != robot_hash(h1_2)
    with pytest.raises(RobotError, match=said):
        hardware_robot(sent, reference_robot("unitree", None))


def test_a_run_that_differs_from_the_known_robot_is_refused(h1_2, tmp_path, capsys):
    stiff = load_robot(
        tampered(h1_2, tmp_path / "sent", "robot.toml", r"kp = (\d+)\.0", r"kp = \g<1>0.0")
    )
    run = untrained(tmp_path / "run", stiff, Dataset.create(tmp_path / "set", stiff))
    assert main([*RUN, "--model", str(run)]) == 2
    assert "the known robot has 200 " in " ".join(capsys.readouterr().err.split())


def test_a_folder_supplies_identified_values_and_the_known_robot_all_else(h1_2, tmp_path):
    save_robot(
        h1_2.with_identified({JOINT: {"kp": 90.0, "stop_low": -0.5, "stop_high": 0.5}}),
        tmp_path / "identified",
    )
    file = tmp_path / "identified" / "robot.toml"
    file.write_text(re.sub(r"home = [-\d.]+", "home = 0.3", file.read_text()))
    sent = load_robot(tmp_path / "identified")
    known = reference_robot("unitree", None)
    robot = hardware_robot(sent, known)
    assert robot.folder == h1_2.folder
    assert robot.nominal is known
    assert robot.servo.kp[robot.index([JOINT])] == 90.0
    assert not np.array_equal(sent.qpos_home, h1_2.qpos_home)
    np.testing.assert_array_equal(robot.qpos_home, h1_2.qpos_home)
    limits = Limits.from_robot(robot, (JOINT,), SafetyConfig(margin=0.0))
    assert (limits.kp, limits.low, limits.high) == (100.0, -0.5, 0.5)


def test_an_identified_stop_does_not_widen_a_range(h1_2):
    wide = h1_2.with_identified({JOINT: {"stop_low": -50.0, "stop_high": 50.0}})
    np.testing.assert_array_equal(wide.qpos_range, h1_2.qpos_range)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"offset": 0.11}, "offset of"),
        ({"offset": np.nan}, "offset"),
        ({"kp": 0.0}, "kp of"),
        ({"kp": 24.0}, "400"),
        ({"kp": 401.0}, "kp"),
        ({"zero": -0.2}, "zero of .* is -0.2 rad"),
        ({"frictionloss": 21.0}, "21 N·m"),
        ({"damping": 101.0}, "damping"),
        ({"armature": 9.1}, "armature"),
        ({"stribeck": 11.0}, "stribeck"),
        ({"delay": 0.2}, "delay"),
        ({"backlash": 0.2}, "backlash"),
    ],
)
def test_identified_values_beyond_what_servos_have_are_refused_on_hardware(h1_2, values, said):
    with pytest.raises(RobotError, match=said):
        hardware_robot(h1_2.with_identified({JOINT: values}), h1_2)


def test_identified_masses_beyond_what_motors_carry_are_refused_on_hardware(h1_2):
    mounts = h1_2.payload_mounts
    heavy, light = (
        replace(h1_2, payload_mounts=(replace(mounts[0], mass=m), *mounts[1:]), nominal=h1_2)
        for m in (40, 1)
    )
    with pytest.raises(RobotError, match="masses"):
        hardware_robot(heavy, h1_2)
    assert hardware_robot(light, h1_2).nominal is h1_2


def test_an_identified_effort_limit_does_not_widen_that_of_the_plan(h1_2):
    at = h1_2.index([JOINT])
    strong = hardware_robot(h1_2.with_identified({JOINT: {"effort_limit": 1e5}}), h1_2)
    assert strong.servo.effort_limit[at] == h1_2.servo.effort_limit[at]


def test_limits_may_come_from_a_folder_that_the_user_names_but_not_beyond_the_motors(
    h1_2, tmp_path
):
    folder = tampered(h1_2, tmp_path / "soft", "robot.toml", r"kp = (\d+)\.0", r"kp = 40.0")
    soft = hardware_robot(load_robot(folder), reference_robot("unitree", str(folder)))
    assert UnitreeDriver(soft).kp.tolist() == [40.0] * 27
    with pytest.raises(RobotError, match="kp"):
        UnitreeDriver(h1_2.with_servo(kp=np.full(27, 1000.0)))
    with pytest.raises(RobotError, match="kd"):
        UnitreeDriver(h1_2.with_servo(kd=np.full(27, 11.0)))
    with pytest.raises(RobotError, match="effort_limit"):
        UnitreeDriver(h1_2.with_servo(effort_limit=1.01 * h1_2.servo.effort_limit))


def test_the_robot_of_an_extensions_driver_must_be_named(h1_2):
    with pytest.raises(UsageError, match="--limits-from"):
        reference_robot("toy", None)
    assert reference_robot("toy", str(h1_2.folder)).name == "h1_2"


def test_a_driver_writes_no_command_outside_its_robots_range(h1_2):
    driver = UnitreeDriver(h1_2)
    for value in (np.nan, h1_2.qpos_range[13, 1] + 0.06):
        ctrl = h1_2.qpos_home.copy()
        ctrl[driver.joint_names.index(JOINT)] = value
        with pytest.raises(DriverError, match=JOINT):
            driver.write(ctrl)


def test_a_robot_with_other_joints_than_the_known_one_is_refused(h1_2):
    with pytest.raises(RobotError, match="joints"):
        hardware_robot(load_robot("so101"), h1_2)


@pytest.mark.parametrize("name", ["kp", "kd"])
def test_a_driver_refuses_gains_above_those_of_the_known_robot(h1_2, name):
    stiffer = h1_2.with_servo(**{name: h1_2.servo[name] * 1.5})
    with pytest.raises(RobotError, match=name):
        UnitreeDriver(stiffer)


def test_a_driver_refuses_a_wider_range_than_that_of_the_known_robot(h1_2, tmp_path):
    folder = tampered(h1_2, tmp_path / "sent", "robot.xml", r'range="[^"]*"', 'range="-9 9"')
    with pytest.raises(RobotError, match="range"):
        UnitreeDriver(load_robot(folder))


def shifted(robot: RobotSpec, joint: str, by: float) -> SimpleNamespace:
    """A compensator that commands a joint away from its target."""
    shift = np.where(np.array(robot.joint_names) == joint, by, 0.0)
    return SimpleNamespace(
        reset=lambda target, mass: None, step=lambda target, qpos: target + shift
    )


def test_the_plan_judges_the_commands_that_a_compensator_makes(so101):
    planner = Planner(so101, so101.joint_names)
    low = np.array([0.0, 0.35, 0.2, 0.0, 0.0, 0.0])
    ctrl = np.repeat(low[None], 60, axis=0)
    ctrl[:, 0] += 0.1 * np.sin(np.linspace(0, 2 * np.pi, 60))
    plan = planner.plan(Motion("pan", "joint", 0.02, ctrl), low)
    judged = planner.judge_commands(plan, shifted(so101, "wrist_flex", 0.01), (0.0,))
    assert judged.correction == pytest.approx(0.01)
    assert judged.corrected_joint == "wrist_flex"
    with pytest.raises(UsageError, match="plane"):
        planner.judge_commands(plan, shifted(so101, "shoulder_lift", 0.5), (0.0,))
    with pytest.raises(UsageError, match="elbow_flex"):
        planner.judge_commands(plan, shifted(so101, "elbow_flex", np.nan), (0.0,))


def test_a_run_with_compensation_says_how_far_commands_lead_and_whose_limits_hold(
    so101, tmp_path, capsys
):
    save_robot(so101.with_identified({"elbow_flex": {"kp": 12.0}}), tmp_path / "identified")
    words = [
        "run",
        "--robot",
        str(tmp_path / "identified"),
        "--motion",
        "sweep-elbow_flex",
        "--fast",
        "--compensate",
    ]
    assert main([*words, "--payload-mass", "0", "--blend-speed", "4", "--blend", "0.2"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    lead = re.search(r"commands lead their targets by at most (\d\.\d\d) rad \((\w+)\)", said)
    assert lead
    assert 0.01 < float(lead[1]) < 0.5
    assert re.search(r"limits and collision shapes: .*identified", said)
