"""A dry run computes all commands and sends none."""

import numpy as np
import pytest
from arm import TOML, XML, commands
from motion_files import write_motion

from gaponet.base.errors import UsageError
from gaponet.cli.main import main
from gaponet.hw.control import publisher
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.drivers.dry import DryRun, summarize_commands
from gaponet.hw.drivers.link import measure_link
from gaponet.hw.drivers.open import open_driver
from gaponet.hw.targets.policy import motion_policy
from gaponet.robot.spec import load_robot
from gaponet.sysid.motion.motion import Motion
from gaponet.testing.fleet import load_fleet
from gaponet.testing.virtual_driver import VirtualDriver

MOTION = Motion("sway", "whole_body", 0.02, commands(100, seed=1))


class Deaf(VirtualDriver):
    def write(self, ctrl, weight=1.0):
        raise AssertionError("a command was sent")

    damp = write


def test_a_dry_run_goes_through_the_motion_and_sends_nothing(arm):
    clock = SimulatedClock()
    driver = DryRun(Deaf(arm, load_fleet("easy", arm).unit("virtual-1"), clock))
    config = ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1, damp=0.1)
    controller = Controller(driver, arm, config=config, clock=clock)
    recording = controller.run(motion_policy(MOTION, 0.02))
    assert recording.fault is None
    sent = summarize_commands(recording, controller.limits)
    assert sent["shoulder"]["lowest_rad"] <= MOTION.ctrl[:, 0].min() + 1e-9
    assert sent["elbow"]["highest_rad"] >= MOTION.ctrl[:, 1].max() - 1e-9
    assert 0 < sent["elbow"]["torque_nm"] <= controller.limits.effort[1]


def test_a_dry_run_that_is_stopped_damps_nothing_and_needs_no_watchdog(arm):
    inner = Deaf(arm, load_fleet("easy", arm).unit("virtual-1"), SimulatedClock())
    inner.watchdog = dict
    driver, play = DryRun(inner), motion_policy(MOTION, 0.02)
    controller = Controller(driver, arm, config=ControlConfig(blend=0.3, damp=0.1), clock=inner.clock)
    recording = controller.run(lambda k, state: controller.stop("no more") if k == 9 else play(k, state))
    assert recording.events[-1].text == "nothing was sent"
    assert driver.watchdog() is None


def test_a_dry_run_beside_a_run_of_the_same_robot_is_refused(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(publisher, "LOCK_FOLDER", tmp_path)
    inner = Deaf(arm, load_fleet("easy", arm).unit("virtual-1"), SimulatedClock())
    inner.address = "a port"
    with publisher.sole_publisher("a port"), pytest.raises(UsageError, match="another process commands"):
        Controller(DryRun(inner), arm, clock=SimulatedClock()).run(motion_policy(MOTION, 0.02))


def test_a_dry_run_on_the_command_line_says_what_would_be_sent(arm, tmp_path, capsys):
    write_motion(tmp_path / "sway.npz", MOTION, arm)
    command = ["run", "--motion", str(tmp_path / "sway.npz"), "--robot", str(arm.folder), "--payload-side", "hand"]
    assert main([*command, "--fast", "--dry-run"]) == 0
    assert "nothing was sent" in " ".join(capsys.readouterr().out.split())
    assert main([*command, "--fast", "--dry-run", "--out", str(tmp_path / "out")]) == 2


def test_a_link_that_loses_every_fifth_state_says_so():
    class Lossy:
        k = 0

        def read(self):
            from gaponet.hw.control.driver import State

            self.k += 1 + (self.k % 5 == 3)
            none = np.zeros(1)
            return State(1e-3 * self.k, none, none, none, none)

    found = measure_link(Lossy(), 0.2)
    assert found["lost"] == pytest.approx(found["states"] / 4, rel=0.1)


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
