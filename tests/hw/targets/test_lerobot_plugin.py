"""The LeRobot plug-in's motions, with stand-ins for the classes of LeRobot that it derives from."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from contacts import Contacts
from lerobot_plugin import plugin as plugin

import gaponet as gp
from gaponet.base.errors import UsageError
from gaponet.robot.folder import save_robot

FOUND = {
    "shoulder_pan": 11.5,
    "shoulder_lift": -68.8,
    "elbow_flex": 0.0,
    "wrist_flex": 80.2,
    "wrist_roll": 22.9,
}


def seen(gripper: float) -> dict[str, float]:
    return {f"{joint}.pos": value for joint, value in FOUND.items()} | {
        "gripper.pos": gripper,
        "camera": None,
    }


def test_a_cameras_depth_is_observed_beside_its_colours(plugin, so101):
    wrist = SimpleNamespace(height=4, width=6, read_latest=lambda: "colours")
    front = SimpleNamespace(
        **vars(wrist), use_rgb=True, use_depth=True, read_latest_depth=lambda: "depth"
    )
    robot = plugin.GaponetSO101.__new__(plugin.GaponetSO101)
    robot.units = plugin.Units(so101)
    robot.cameras = {"wrist": wrist, "front": front}
    shapes = {"wrist": (4, 6, 3), "front": (4, 6, 3), "front_depth": (4, 6, 1)}
    assert robot.observation_features == robot.action_features | shapes
    assert [read() for *_, read in robot.pictures()] == ["colours", "colours", "depth"]


def test_an_arm_is_not_moved_without_consent(plugin, monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    monkeypatch.setattr(
        "subprocess.Popen", lambda *_, **__: pytest.fail("a controller was started")
    )
    robot = plugin.GaponetSO101.__new__(plugin.GaponetSO101)
    robot.config = plugin.GaponetSO101Config()
    with pytest.raises(UsageError, match=r"--robot\.yes"):
        robot.connect()


def test_a_controller_that_ends_at_its_start_is_an_error_with_its_messages(plugin):
    pytest.importorskip("zmq")
    command = [sys.executable, "-c", "raise SystemExit('no arm at the port')"]
    with pytest.raises(ConnectionError, match="port"):
        plugin.so101.Controller.start(lambda address: command)


def test_its_motions_are_one_plan_from_where_the_arm_is_and_the_gripper_keeps_what_it_holds(
    plugin, so101, tmp_path
):
    (tmp_path / "roll.csv").write_text(
        "time,wrist_roll\n" + "\n".join(f"{0.1 * k},{0.05 * k}" for k in range(5))
    )
    config = plugin.GaponetMotionConfig(
        motions=f"{tmp_path / 'roll.csv'},sweep-shoulder_pan", fps=20.0, lead=0.5
    )
    motion = plugin.GaponetMotion(config)
    motion.connect()
    with pytest.raises(ConnectionError, match="unknown"):
        motion.get_action()
    plugin.set_observation(seen(gripper=62.0))
    said = [motion.get_action()]
    said += [motion.get_action() for _ in range(1000)]
    assert said[-1] == said[-2], "the plan is over"
    units = motion.units
    rows = np.array([units.rad(action) for action in said])
    np.testing.assert_allclose(
        rows[:10], np.repeat(units.rad(seen(62.0))[None], 10, axis=0), atol=1e-9
    )
    assert {round(action["gripper.pos"], 6) for action in said} == {62.0}, (
        "no motion of these names the gripper"
    )
    first = np.abs(rows[:, 4] - 0.2).argmin()
    assert np.ptp(rows[: first + 1], axis=0).argmax() == 4
    assert (np.ptp(rows[: first + 1, [0, 1, 2, 3]], axis=0) == 0).all(), "the file names one joint"
    assert Contacts(so101).along(rows, 0.02)[0] == 0
    assert np.abs(np.diff(rows, axis=0)).max() * 20 < 5.0


def test_a_motion_that_goes_into_the_table_is_refused_before_a_row_is_said(plugin, tmp_path):
    (tmp_path / "roll.csv").write_text("time,wrist_roll\n0,0.4\n0.1,0.4\n")
    (tmp_path / "shove.csv").write_text("time,shoulder_lift,elbow_flex\n0,1.7,0.3\n0.1,1.7,0.3\n")
    motion = plugin.GaponetMotion(plugin.GaponetMotionConfig(motions=str(tmp_path)))
    motion.connect()
    plugin.set_observation(seen(gripper=10.0))
    with pytest.raises(UsageError, match="plane"):
        motion.get_action()


def test_an_arm_that_follows_shows_the_policy_the_nominal_simulator(plugin, so101):
    measured = so101.qpos_home
    nominal = measured + 0.1
    robot = plugin.GaponetSO101.__new__(plugin.GaponetSO101)
    robot.units = plugin.Units(so101)
    robot.cameras = {}
    robot.config = plugin.GaponetSO101Config(known=Path("known"), follow=True)
    remote = SimpleNamespace(nominal_qpos=nominal)
    states = iter([SimpleNamespace(qpos=measured)])
    robot.controller = SimpleNamespace(states=states, remote=remote)

    seen = robot.units.rad(robot.get_observation())

    np.testing.assert_allclose(seen, nominal)


def test_following_without_an_identified_robot_is_refused_before_anything_moves(plugin):
    robot = plugin.GaponetSO101.__new__(plugin.GaponetSO101)
    robot.config = plugin.GaponetSO101Config(yes=True, follow=True)
    with pytest.raises(ValueError, match="known"):
        robot.connect()


def test_the_processor_commands_an_arm_as_its_nominal_simulator_moves(plugin, so101, tmp_path):
    servo = {"kp": 14.0, "offset": 0.05}
    soft = so101.with_identified(dict.fromkeys(so101.operated, servo))
    save_robot(soft, tmp_path / "soft")
    target = so101.qpos_home + 0.1
    sent = {}
    for follow in (False, True):
        step = plugin.GaponetCorrect(known=str(tmp_path / "soft"), follow=follow)
        for _ in range(100):
            sent[follow] = step.corrector(target)

    nominal = gp.AlignedSim(so101)
    robot = gp.AlignedSim(soft)
    reached = gp.AlignedSim(soft)
    for _ in range(200):
        nominal.step(target)
        robot.step(sent[True])
        reached.step(sent[False])
    moved = so101.operated_index
    assert np.abs(robot.qpos - nominal.qpos)[moved].max() < 0.005
    assert np.abs(reached.qpos - target)[moved].max() < 0.02
