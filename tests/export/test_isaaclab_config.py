"""Identified servos in Isaac Lab's own configuration classes; make engines runs them there."""

import json
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from arm import write_arm

from gaponet.export.export_folder import export_robot
from gaponet.export.isaaclab_config import native_form
from gaponet.export.plain_servos import own_motions

STEP = 0.005  # s, of the arm's physics


@dataclass
class IdealPDActuatorCfg:
    """Fields that Isaac Lab 3.0 publishes for it."""

    joint_names_expr: list
    stiffness: float
    damping: float
    actuator_effort_limit: float
    armature: float
    friction: float
    viscous_friction: float


@dataclass
class DelayedPDActuatorCfg(IdealPDActuatorCfg):
    min_delay: int = 0
    max_delay: int = 0


@dataclass
class DCMotorCfg(IdealPDActuatorCfg):
    saturation_effort: float = field(default=0.0)
    actuator_velocity_limit: float = field(default=0.0)


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def exported_config(robot, folder, monkeypatch):
    """Return the names that robot_cfg.py of an export defines."""
    classes = SimpleNamespace(
        IdealPDActuatorCfg=IdealPDActuatorCfg,
        DelayedPDActuatorCfg=DelayedPDActuatorCfg,
        DCMotorCfg=DCMotorCfg,
    )
    monkeypatch.setitem(sys.modules, "isaaclab", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", classes)
    export_robot(robot, "isaaclab", folder)
    names = {}
    exec((folder / "robot_cfg.py").read_text(), names)
    return names


def test_a_late_servo_is_isaac_labs_delayed_actuator_in_whole_steps(arm, tmp_path, monkeypatch):
    found = {"shoulder": {"delay": 0.012, "kp": 21.0, "offset": 0.02}, "elbow": {"delay": 0.001}}

    config = exported_config(arm.with_identified(found), tmp_path / "out", monkeypatch)

    shoulder, elbow = config["ACTUATORS"].values()
    assert isinstance(shoulder, DelayedPDActuatorCfg)
    assert (shoulder.min_delay, shoulder.max_delay, shoulder.stiffness) == (2, 2, 21.0)
    assert type(elbow) is IdealPDActuatorCfg
    assert config["OFFSETS"] == {"shoulder": 0.02, "elbow": 0.0}
    assert config["PHYSICS_STEP"] == STEP


def test_a_servo_with_a_no_load_speed_is_a_dc_motor_unless_it_is_late(arm, tmp_path, monkeypatch):
    found = {"shoulder": {"no_load_speed": 4.0, "delay": 0.01}, "elbow": {"no_load_speed": 5.0}}

    config = exported_config(arm.with_identified(found), tmp_path / "out", monkeypatch)

    shoulder, elbow = config["ACTUATORS"].values()
    assert isinstance(shoulder, DelayedPDActuatorCfg)
    assert isinstance(elbow, DCMotorCfg)
    assert (elbow.saturation_effort, elbow.actuator_velocity_limit) == (5.0, 5.0)


def test_the_losses_name_each_effect_that_isaac_labs_classes_lack(arm):
    stribeck = {"stribeck": 0.3, "stribeck_speed": 0.1}
    found = {"delay": 0.012, "target_speed": 1.0} | stribeck
    robot = arm.with_identified(dict.fromkeys(arm.joint_names, found))
    plain = robot.with_identified(
        {joint: dict.fromkeys(stribeck, 0.0) for joint in arm.joint_names}
    )
    motions = own_motions(robot, count=2)

    form = native_form(robot, plain, STEP, motions)

    identified, model, delays, speed = form.losses.values()
    assert identified == pytest.approx(0.0, abs=1e-9)
    assert model > 0.0
    assert model != delays
    assert speed > delays
    assert form.robot.servo.delay == pytest.approx([0.01, 0.01])


def test_a_robot_that_isaac_labs_classes_hold_loses_nothing(arm):
    robot = arm.with_identified({"elbow": {"delay": 2 * STEP, "offset": 0.01, "damping": 0.8}})

    form = native_form(robot, robot, STEP, own_motions(robot, count=1))

    assert list(form.losses) == ["as identified"]


def test_the_readme_states_both_forms_and_facts_have_the_native_servos(arm, tmp_path):
    robot = arm.with_identified({"elbow": {"delay": 0.012}})

    folder = tmp_path / "out"

    exported = export_robot(robot, "isaaclab", folder)

    facts = json.loads((folder / "facts.json").read_text())
    assert facts["native"]["elbow"]["delay_steps"] == 2
    readme = (folder / "README.md").read_text()
    assert "VIRTUAL" in readme
    for form in ("native", "plain"):
        assert f"{facts['error_mrad'][form]:.2f}" in readme
    assert exported.errors["in Isaac Lab's own classes"] > 0
    assert np.isfinite(facts["error_mrad"]["native"])
