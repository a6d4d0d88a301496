"""A dry run computes all commands and sends none."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from arm import TOML, XML
from hw.noted_arm import DT, MOTION, QUICK, NotedArm, acting
from motion_files import write_motion

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.hw.control import publisher
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import State
from gaponet.hw.drivers.dry import DryRun, summarize_commands
from gaponet.hw.drivers.link import measure_link
from gaponet.hw.drivers.open import open_driver
from gaponet.hw.targets.policy import motion_policy
from gaponet.motion.motion import Motion
from gaponet.robot.spec import load_robot


class Deaf(NotedArm):
    def write(self, ctrl, weight=1.0):
        raise AssertionError("a command was sent")

    damp = write


def test_a_dry_run_goes_through_the_motion_and_sends_nothing(arm):
    inner = Deaf(arm)
    driver = DryRun(inner)
    controller = Controller(driver, arm, config=QUICK, clock=inner.clock)
    recording = controller.run(motion_policy(MOTION, DT))
    assert recording.fault is None
    sent = summarize_commands(recording, controller.limits)
    assert sent["shoulder"]["lowest_rad"] <= MOTION.ctrl[:, 0].min() + 1e-9
    assert sent["elbow"]["highest_rad"] >= MOTION.ctrl[:, 1].max() - 1e-9
    assert 0 < sent["elbow"]["torque_nm"] <= controller.limits.effort[1]


def test_a_dry_run_that_is_stopped_damps_nothing_and_needs_no_watchdog(arm):
    inner = Deaf(arm)
    inner.watchdog = dict
    driver = DryRun(inner)
    controller = Controller(driver, arm, config=QUICK, clock=inner.clock)
    recording = controller.run(acting(lambda: controller.stop("no more"), 9))
    assert recording.events[-1].text == "nothing was sent"
    assert driver.watchdog() is None


def test_a_dry_run_beside_a_run_of_the_same_robot_is_refused(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(publisher, "LOCK_FOLDER", tmp_path)
    inner = Deaf(arm)
    inner.address = "a port"
    with (
        publisher.sole_publisher("a port"),
        pytest.raises(UsageError, match="commands"),
    ):
        Controller(DryRun(inner), arm, clock=inner.clock).run(motion_policy(MOTION, DT))


def dry_run(arm, folder, motion):
    """The command of a dry run of a motion."""
    file = folder / f"{motion.name}.npz"
    write_motion(file, motion, arm)
    command = ["run", "--motion", str(file), "--robot", str(arm.folder)]
    command += ["--payload-side", "hand", "--fast", "--dry-run"]
    command += ["--blend", "0.2", "--blend-speed", "4", "--settle", "0.1", "--damp", "0.1"]
    return command


def test_a_dry_run_on_the_command_line_says_what_would_be_sent(arm, tmp_path, capsys):
    command = dry_run(arm, tmp_path, MOTION)
    assert main(command) == 0
    assert "nothing was sent" in " ".join(capsys.readouterr().out.split())
    assert main([*command, "--out", str(tmp_path / "out")]) == 2


def test_a_dry_run_does_not_compare_a_stated_payload_with_torques(arm, tmp_path, capsys):
    hold = Motion("hold", "whole_body", DT, np.full((150, 2), 0.1))  # 3 s, rad
    command = dry_run(arm, tmp_path, hold)
    command += ["--compensate", "--payload-mass", "0.2", "--compensation.payload-max", "0.2"]
    assert main(command) == 0
    assert "in the hand?" not in " ".join(capsys.readouterr().out.split())


def test_a_link_that_loses_every_fifth_state_says_so():
    numbers = (k for k in itertools.count(1) if k % 5 != 4)
    state = lambda: State(1e-3 * next(numbers), *np.zeros((4, 1)))  # noqa: E731
    link = measure_link(SimpleNamespace(read=state), 0.2)
    assert link["lost"] == pytest.approx(link["states"] / 4, rel=0.1)


def test_a_robot_whose_mjcf_lies_in_a_subfolder_can_be_opened_by_a_watchdog(tmp_path):
    from gaponet.hw.drivers.unitree import UnitreeDriver

    folder = tmp_path / "arm"
    (folder / "model").mkdir(parents=True)
    (folder / "robot.toml").write_text('mjcf = "model/arm.xml"\n' + TOML)
    (folder / "model" / "arm.xml").write_text(XML)
    assert load_robot(folder).folder == folder
    h1_2 = load_robot("h1_2")
    own = tmp_path / "h1"
    (own / "model").mkdir(parents=True)
    text = (h1_2.folder / "robot.toml").read_text()
    (own / "robot.toml").write_text('mjcf = "model/robot.xml"\n' + text)
    (own / "model" / "robot.xml").write_text(h1_2.mjcf.read_text())
    assert open_driver(**UnitreeDriver(load_robot(own)).watchdog()).joint_names == h1_2.joint_names
