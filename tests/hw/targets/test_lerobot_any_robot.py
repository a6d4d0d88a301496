"""A VIRTUAL robot of LeRobot that is not the SO-101, behind the plug-in's gaponet_robot."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
from arm import write_arm
from lerobot_plugin import lerobot_plugin as plugin

import gaponet as gp
from gaponet.robot.folder import save_robot

plugin = plugin
SOFT = {"kp": 12.0, "offset": 0.05, "frictionloss": 0.02}
LAMP = {"lamp.pos": 40.0, "lamp.colour": 3.0}


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


@pytest.fixture
def soft(arm, tmp_path):
    """The arm as identified, stored in `tmp_path / "soft"`."""
    robot = arm.with_identified(dict.fromkeys(arm.joint_names, SOFT))
    save_robot(robot, tmp_path / "soft")
    return robot


@pytest.fixture
def own(plugin):
    """The module of LeRobot's robot."""
    yield importlib.import_module("two_joints")
    del sys.modules["two_joints"]


@pytest.fixture
def wrap(plugin, own, soft, tmp_path):
    """Wrap LeRobot's robot, whose servos are the soft ones."""

    def wrap(**options):
        inner = own.TwoJointsConfig(simulated=gp.AlignedSim(soft), calibration_dir=tmp_path)
        given = {"known": str(tmp_path / "soft"), "joints": own.JOINTS, "fps": 50.0} | options
        config = plugin.GaponetRobotConfig(robot=inner, calibration_dir=tmp_path, **given)
        robot = plugin.GaponetRobot(config)
        robot.connect()
        return robot

    return wrap


def hold(robot, degrees, periods=150):
    """Command all joints for a while as LeRobot's loop does, and return what it observes at the
    end.
    """
    action = dict.fromkeys(robot.units.keys, degrees) | LAMP
    for _ in range(periods):
        robot.get_observation()
        robot.send_action(action)
    return robot.get_observation()


def test_joints_of_any_robot_reach_their_targets_with_the_correction(wrap, soft):
    uncorrected = gp.AlignedSim(soft)
    for _ in range(150):
        uncorrected.step(np.radians([10.0, 10.0]))

    seen = hold(wrap(), 10.0)

    missed = np.abs(np.degrees(uncorrected.qpos) - 10.0).max()
    assert missed > 2.0
    assert max(abs(seen[key] - 10.0) for key in ("lift.pos", "bend.pos")) < missed / 4


def test_what_is_no_joint_of_the_robot_passes_unchanged(wrap):
    robot = wrap()
    hold(robot, 10.0, periods=1)
    assert robot.robot.lamp == list(LAMP.values())
    assert robot.action_features == robot.robot.action_features


def test_calibration_is_that_of_lerobots_own_robot(wrap):
    robot = wrap()
    assert not robot.is_calibrated
    robot.calibrate()
    assert robot.robot.is_calibrated
    assert robot.is_calibrated


def test_a_joint_without_a_position_target_is_named(wrap):
    with pytest.raises(ValueError, match="'shoulder'"):
        wrap(joints={"bend": "elbow"})


def test_a_robot_that_follows_shows_the_policy_the_nominal_simulator(wrap, arm):
    nominal = gp.AlignedSim(arm)
    for _ in range(150):
        nominal.step(np.radians([10.0, 10.0]))

    seen = hold(wrap(follow=True), 10.0)

    expected = np.degrees(nominal.qpos)
    np.testing.assert_allclose([seen["lift.pos"], seen["bend.pos"]], expected, atol=0.5)


@pytest.mark.parametrize(
    ("unit", "value", "rad"),
    [("deg", 90.0, np.pi / 2), ("rad", 0.5, 0.5), ("signed_percent", 50.0, 0.75)],
)
def test_values_of_a_robot_are_in_the_unit_that_its_configuration_states(
    plugin, arm, unit, value, rad
):
    units = plugin.Units(arm, unit)
    action = dict.fromkeys(units.keys, value)
    np.testing.assert_allclose(units.rad(action), [rad, rad])
    assert units.named(units.rad(action)) == pytest.approx(action)


def test_lerobots_command_line_reads_the_robot_that_is_wrapped(plugin, own):
    draccus = pytest.importorskip("draccus")
    words = ["--type=gaponet_robot", "--robot={type: two_joints, id: mine}", "--unit=rad"]

    config = draccus.parse(plugin.GaponetRobotConfig.__mro__[1], args=words)

    assert config.unit == "rad"
    module = importlib.import_module("lerobot_robot_gaponet.any_robot")
    inner = module.inner_config(config.robot)
    assert isinstance(inner, own.TwoJointsConfig)
    assert inner.id == "mine"
