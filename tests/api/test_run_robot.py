"""gp.run_robot does what gaponet run does: known limits, a plan, consent; the result says what
happened.
"""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import commands
from hw.noted_arm import NotedArm, fake_watchdog
from servos import Servos, on_port
from wild_model import wild_model

import gaponet as gp
from gaponet.api.record import record_motions
from gaponet.api.run_consent import Permission
from gaponet.api.run_report import PlanText, describe_plan
from gaponet.api.run_robot import Compensation, RunRequest
from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.hardware import hardware_robot, reference_robot
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.plan import Planner
from gaponet.hw.control.recording import Event, Recording
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers.open import open_driver
from gaponet.hw.targets.message import Message
from gaponet.motion.files import write_motion
from gaponet.motion.motion import Motion
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_driver import VirtualDriver

QUICK = ControlConfig(blend=0.2, blend_speed=4.0, settle=0.1, damp=0.1)
FAST = gp.RunOptions(connection=gp.Connection(fast=True), control=QUICK)
SWAY = Motion("sway", "whole_body", 0.02, commands(30, seed=1))
WRITES = (0x03, 0x83)  # of the servo bus: write, sync write
DRIVER_OF = {"h1_2": "unitree", "so101": "so101"}


def changed(name: str, old: str, new: str, folder: Path) -> Path:
    """Write a copy of a packaged robot's folder in which a line of robot.toml is another one,
    everywhere.
    """
    save_robot(load_robot(name), folder)
    file = folder / "robot.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    return folder


def turned_wrist(folder: Path) -> Path:
    """Write a short motion of an SO-101."""
    path = folder / "turn.csv"
    path.write_text("time,wrist_roll\n0.0,0.0\n0.5,0.1\n1.0,0.0\n")
    return path


class SilentReporter:
    """Shows nothing. The result of the run holds plan and events."""

    def plan(self, text: PlanText) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def event(self, event: Event) -> None:
        pass


@pytest.fixture
def nobody(monkeypatch):
    """Nobody sits at a terminal."""
    monkeypatch.setattr("sys.stdin", io.StringIO("yes\n"))


@pytest.fixture
def bus():
    pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")
    servos = Servos()
    with on_port(servos) as port:
        yield port, servos


# ---- what it does


def test_a_virtual_robot_plays_a_motion_and_the_result_has_its_errors(arm):
    result = gp.run_robot(arm, motion=SWAY, options=FAST, report=SilentReporter())
    assert result.fault == ""
    assert result.recording.virtual
    assert result.motion is not None
    assert result.motion.name == "sway"
    assert set(result.tracking_error) == set(arm.joint_names)
    assert 0 < result.mean_tracking_error < 0.3


def test_compensation_by_an_identified_folder_reduces_the_error(arm, tmp_path):
    soft = arm.with_identified({joint: {"kp": 10.0} for joint in arm.joint_names})
    save_robot(soft, tmp_path / "soft")
    errors = {}
    for compensate in (False, True):
        result = gp.run_robot(
            tmp_path / "soft",
            motion=SWAY,
            compensate=compensate,
            options=FAST,
            report=SilentReporter(),
        )
        errors[compensate] = result.mean_tracking_error
    assert errors[True] < 0.7 * errors[False]


def simulate(robot, qpos, targets):
    """Return the positions of a simulated robot that rests at qpos, under targets, (T, n) rad."""
    sim = gp.AlignedSim(robot)
    sim.reset(qpos, ctrl=targets[0])
    positions = []
    for target in targets:
        sim.step(target)
        positions.append(sim.qpos.copy())
    return np.array(positions)


def test_with_follow_the_commands_move_the_identified_robot_as_the_nominal_simulator(arm, tmp_path):
    soft = arm.with_identified({joint: {"kp": 14.0, "delay": 0.01} for joint in arm.joint_names})
    save_robot(soft, tmp_path / "soft")
    open_loop = CompensatorConfig(feedback=0.0)
    options = replace(FAST, follow="nominal", compensation=open_loop)

    result = gp.run_robot(tmp_path / "soft", motion=SWAY, options=options, report=SilentReporter())

    assert result.recording.meta["follow"] == "nominal"
    rows = result.recording.run_rows()
    start = rows["qpos"][0]
    nominal = simulate(arm, start, rows["target"])
    followed = simulate(soft, start, rows["ctrl"])
    uncorrected = simulate(soft, start, rows["target"])
    moving = slice(15, None)  # the nominal simulator did not start at rest here
    apart = np.abs(followed - nominal)[moving].mean()
    assert apart < 0.2 * np.abs(uncorrected - nominal)[moving].mean()


def test_the_plan_is_shown_on_standard_error_unless_a_reporter_is_given(arm, capsys):
    gp.run_robot(arm, motion=SWAY, options=FAST)
    shown = capsys.readouterr()
    assert "Plan: sway" in shown.err
    assert "at the end it goes back" in shown.err
    assert shown.out == ""


def test_nothing_is_recorded_before_the_payload_is_stated(arm, tmp_path):
    request = RunRequest(arm, options=FAST)
    with pytest.raises(UsageError, match="--payload-mass"):
        record_motions(("sway",), request, out=tmp_path / "set", report=SilentReporter())
    assert not (tmp_path / "set").exists()


def test_a_motion_that_did_not_fit_is_repeated_as_it_was_played(arm, tmp_path, monkeypatch):
    write_motion(tmp_path / "fast.npz", SWAY, arm, 50.0)
    planned = []

    class Noted(Planner):
        def plan(self, motion, start):
            plan = super().plan(motion, start)
            planned.append((motion.ctrl, plan.motion.ctrl))
            return plan

    monkeypatch.setattr("gaponet.api.run_robot.Planner", Noted)
    options = gp.RunOptions(
        connection=gp.Connection(fast=True),
        control=QUICK,
        safety=SafetyConfig(speed=0.5),
        payload_mass=0.0,
        unchecked=True,
    )
    request = RunRequest(arm, options=options)
    names = (str(tmp_path / "fast.npz"),)
    record_motions(names, request, out=tmp_path / "set", repetitions=2, report=SilentReporter())
    (wanted, played), (again, _) = planned
    assert not np.array_equal(played, wanted)
    np.testing.assert_array_equal(again, played)


def test_a_recording_is_written_where_out_says(arm, tmp_path):
    options = gp.RunOptions(
        connection=gp.Connection(fast=True), control=QUICK, out=tmp_path / "out"
    )
    result = gp.run_robot(arm, motion=SWAY, options=options, report=SilentReporter())
    assert result.file == tmp_path / "out" / "sway.parquet"
    assert result.file.is_file()


def test_a_run_that_ends_with_an_error_leaves_a_recording_that_says_why(arm, tmp_path):
    class Broken(SilentReporter):
        """Fails as soon as the motion has begun."""

        def event(self, event: Event) -> None:
            if event.phase == "run":
                raise ValueError("the window is closed")

    options = replace(FAST, out=tmp_path / "out")
    with pytest.raises(ValueError, match="the window is closed"):
        gp.run_robot(arm, motion=SWAY, options=options, report=Broken())
    facts = json.loads((tmp_path / "out" / "sway.json").read_text())
    assert "the window is closed" in str(facts["events"])
    assert not list((tmp_path / "out").glob("unfinished*"))


def test_a_run_that_is_refused_after_its_plan_leaves_no_recording(arm, tmp_path):
    class Refusing(SilentReporter):
        def plan(self, text: PlanText) -> None:
            raise UsageError("not this plan")

    options = replace(FAST, out=tmp_path / "out")
    with pytest.raises(UsageError, match="not this plan"):
        gp.run_robot(arm, motion=SWAY, options=options, report=Refusing())
    assert not list(tmp_path.glob("out/*"))


def test_the_plan_names_the_source_of_the_states_where_the_driver_knows_it(so101):
    driver = VirtualDriver(so101, load_fleet("easy", so101).unit("virtual-1"), SimulatedClock())
    driver.facts["source"] = "participant 01.02 on 192.168.123.161"
    motion = Motion("still", "joint", 0.02, np.repeat(so101.qpos_home[None], 20, axis=0))
    plan = Planner(so101, driver.commanded).plan(motion, so101.qpos_home)
    text = str(describe_plan(plan, so101, driver, heaviest=0.0))
    assert "states come from participant 01.02 on 192.168.123.161" in text


@pytest.mark.parametrize(
    ("options", "motion", "word"),
    [
        ({}, None, "either"),
        ({"targets": "zmq"}, "sway", "either"),
        ({"dry_run": True, "out": Path("out")}, "sway", "dry"),
        ({"connection": gp.Connection(fast=True), "targets": "zmq"}, None, "real"),
        ({"follow": "nominal", "model": Path("run")}, "sway", "leave"),
    ],
)
def test_options_that_contradict_each_other_are_refused(arm, options, motion, word):
    with pytest.raises(UsageError, match=word):
        gp.run_robot(arm, motion=motion, options=gp.RunOptions(**options))


def test_an_unknown_driver_is_refused_with_those_that_exist(arm):
    with pytest.raises(UsageError, match="toaster"):
        gp.run_robot(arm, motion=SWAY, driver="toaster")


def test_a_network_that_fails_on_the_planned_motion_moves_nothing(arm, tmp_path):
    wild_model(tmp_path / "run", arm, np.nan)
    far = np.zeros((30, 2))
    far[:, 0] = 1.2
    options = gp.RunOptions(
        connection=gp.Connection(fast=True), control=QUICK, model=tmp_path / "run", unchecked=True
    )
    with (
        pytest.warns(RuntimeWarning, match="finite"),
        pytest.raises(UsageError, match="network"),
    ):
        gp.run_robot(
            motion=Motion("far", "joint", 0.02, far), options=options, report=SilentReporter()
        )


class Notes(SilentReporter):
    """Keeps the sentences of a run."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


@pytest.mark.filterwarnings("ignore:the network's answer:RuntimeWarning")
def test_a_network_that_fails_while_the_robot_moves_is_noted_and_recorded(arm, tmp_path):
    compensator = gp.Compensator(arm, wild_model(tmp_path / "run", arm, np.nan))
    compensator.reset(np.array([1.2, 0.0]), 0.0)
    compensator.step(np.array([1.2, 0.0]), None)
    recording = Recording(arm.name, True, arm.joint_names, arm.joint_names, 0.02)
    reporter = Notes()
    Compensation(compensator).note_failures(recording, reporter)
    assert recording.summary()["refused_answers"] > 0
    assert "not finite" in reporter.notes[0]


# ---- what guards it


def test_a_run_starts_one_watchdog_as_its_driver_says(arm, monkeypatch):
    wanted = {"kind": "of this driver"}
    started = []

    def start(spec: dict[str, object], *_: object) -> object:
        started.append(spec)
        return fake_watchdog()

    monkeypatch.setattr(VirtualDriver, "watchdog", lambda driver: wanted)
    monkeypatch.setattr("gaponet.hw.control.controller.Watchdog", start)
    gp.run_robot(arm, motion=SWAY, options=FAST, report=SilentReporter())
    assert started == [wanted]


INTO_THE_TABLE = np.array([0.5, 1.7, 0.3, 0.5, 0.3, 0.0])  # of an SO-101, rad
SENDING_S = 2.0


class Script:
    """A transport whose one sender leads the SO-101 from home into the table, and ends."""

    address = "nowhere"

    def __init__(self, robot: gp.RobotSpec, clock: SimulatedClock) -> None:
        self.robot = robot
        self.clock = clock

    def receive(self) -> list[Message]:
        passed = self.clock.now() - self.clock.start
        home = self.robot.qpos_home
        qpos = home + min(passed, 1.0) * (INTO_THE_TABLE - home)
        target = dict(zip(self.robot.joint_names, qpos.tolist(), strict=True))
        return [Message("a", passed, target, end=passed > SENDING_S)]

    def senders(self) -> set[str]:
        return {"a"}

    def publish(self, to: str, state: dict[str, object]) -> None:
        pass

    def close(self, reason: str) -> None:
        pass


@pytest.mark.parametrize("unchecked", [False, True])
def test_live_targets_are_cut_before_the_table_unless_unchecked(so101, monkeypatch, unchecked):
    clock = SimulatedClock()
    monkeypatch.setattr("gaponet.api.run_robot.MonotonicClock", lambda: clock)
    script = Script(so101, clock)
    monkeypatch.setattr("gaponet.api.run_robot.open_transport", lambda options: script)
    options = gp.RunOptions(control=QUICK, targets="zmq", unchecked=unchecked)
    result = gp.run_robot(so101, options=options, report=SilentReporter())
    remarks = " ".join(event.text for event in result.recording.events)
    assert ("targets are cut" in remarks) == (not unchecked)


# ---- consent


@pytest.mark.parametrize("driver", ["unitree", "so101"])
def test_without_a_terminal_and_without_consent_no_driver_is_opened(driver, nobody):
    options = gp.RunOptions(connection=gp.Connection(port="/dev/nothing"))
    with pytest.raises(UsageError, match="terminal"):
        gp.run_robot(motion="sweep-elbow", driver=driver, options=options)


@pytest.mark.parametrize("answer", [False, None, "yes", 1], ids=repr)
def test_a_consent_other_than_true_writes_to_no_servo(answer, bus, nobody, tmp_path):
    port, servos = bus
    statements = []

    def consent(statement: str) -> object:
        statements.append(statement)
        return answer

    options = gp.RunOptions(connection=gp.Connection(port=port), control=ControlConfig(rate=4.0))
    with pytest.raises(UsageError, match="commanded"):
        gp.run_robot(
            motion=turned_wrist(tmp_path),
            driver="so101",
            options=options,
            consent=consent,
            report=SilentReporter(),
        )
    assert "will move as planned" in statements[0]
    assert not any(request[4] in WRITES for request in servos.heard)


def test_a_consent_of_true_writes_to_the_servos(bus, nobody, tmp_path):
    port, servos = bus
    options = gp.RunOptions(
        connection=gp.Connection(port=port),
        control=ControlConfig(rate=4.0, blend=0.5, settle=0.3, damp=0.3),
        safety=SafetyConfig(acceleration=2.0),
    )
    result = gp.run_robot(
        motion=turned_wrist(tmp_path), driver="so101", options=options, consent=lambda text: True
    )
    assert any(request[4] in WRITES for request in servos.heard)
    assert not result.recording.virtual


def test_the_person_confirms_the_network_interface_of_the_robot(so101):
    driver = VirtualDriver(so101, load_fleet("easy", so101).unit("virtual-1"), SimulatedClock())
    driver.address = "unitree dds domain 0"
    driver.facts["interface"] = "eth0"
    statements = []

    def consent(statement: str) -> bool:
        statements.append(statement)
        return True

    permission = Permission("unitree", gp.RunOptions(), consent)
    permission.require_motion(driver, "as planned")

    assert "unitree dds domain 0 on eth0 will move as planned" in statements[0]


def test_lowcmd_needs_a_statement_that_the_robot_hangs_beside_yes(nobody):
    options = gp.RunOptions(connection=gp.Connection(topic="lowcmd"), yes=True)
    with pytest.raises(UsageError, match="falls"):
        gp.run_robot(motion="sweep-left_elbow", driver="unitree", options=options)


def test_with_lowcmd_it_is_first_asked_whether_the_robot_hangs(nobody):
    asked = []

    def refuse(statement: str) -> bool:
        asked.append(statement)
        return False

    options = gp.RunOptions(connection=gp.Connection(topic="lowcmd"))
    with pytest.raises(UsageError, match="commanded"):
        gp.run_robot(motion="sweep-left_elbow", driver="unitree", options=options, consent=refuse)
    assert len(asked) == 1
    assert "Does it hang?" in asked[0]


@pytest.fixture
def opened(so101, monkeypatch) -> list[NotedArm]:
    """The drivers that were opened: of SO-101 arms in simulated time, taken for real ones."""
    clock = SimulatedClock()
    drivers: list[NotedArm] = []

    def open_noted(kind: str, robot: gp.RobotSpec, **_: object) -> NotedArm:
        driver = NotedArm(robot, clock)
        drivers.append(driver)
        return driver

    monkeypatch.setattr("gaponet.api.run_robot.MonotonicClock", lambda: clock)
    monkeypatch.setattr("gaponet.api.run_robot.open_driver", open_noted)
    return drivers


def test_each_repetition_of_a_recording_is_consented_to_on_its_own(so101, opened, nobody, tmp_path):
    answers = [True, False]
    options = gp.RunOptions(control=QUICK, payload_mass=0.0, unit_id="a")
    with pytest.raises(UsageError, match="commanded"):
        record_motions(
            (str(turned_wrist(tmp_path)),),
            RunRequest(so101, driver="so101", options=options),
            out=tmp_path / "set",
            repetitions=3,
            consent=lambda statement: answers.pop(0),
            report=SilentReporter(),
        )
    first, second = opened
    assert first.sent
    assert not second.sent


@pytest.mark.parametrize("unit", ["lab/1", "..", "lab\n1", "lab\\1", "é" * 100], ids=ascii)
def test_a_unit_that_no_file_can_be_named_after_is_refused_before_anything_moves(
    so101, opened, tmp_path, unit
):
    options = gp.RunOptions(control=QUICK, payload_mass=0.0, unit_id=unit, yes=True)

    with pytest.raises(UsageError, match="--unit-id"):
        record_motions(
            (str(turned_wrist(tmp_path)),),
            RunRequest(so101, driver="so101", options=options),
            out=tmp_path / "set",
            report=SilentReporter(),
        )
    assert not opened


def test_a_motion_that_no_file_can_be_named_after_is_not_recorded(arm, tmp_path):
    options = replace(FAST, out=tmp_path / "out")
    with pytest.raises(UsageError, match="file's name"):
        gp.run_robot(arm, motion=replace(SWAY, name="a/b"), options=options)
    assert not list(tmp_path.glob("out/*"))


@pytest.fixture
def person_agrees(monkeypatch):
    """Somebody sits at the terminal and types what is asked for."""
    monkeypatch.setattr("gaponet.api.run_consent.require_terminal", lambda option: 0)
    monkeypatch.setattr("gaponet.api.run_consent.require_consent", lambda *question: None)


@pytest.mark.usefixtures("opened", "person_agrees")
@pytest.mark.parametrize(
    ("driver", "options", "consent", "source"),
    [
        ("so101", gp.RunOptions(), lambda text: True, "the caller's function"),
        ("so101", gp.RunOptions(), None, "typed on the terminal"),
        ("so101", gp.RunOptions(yes=True), None, "option yes"),
        ("so101", gp.RunOptions(dry_run=True), None, "none needed: dry run"),
        ("virtual", FAST, None, "none needed: virtual robot in this process"),
    ],
    ids=["function", "typed", "yes", "dry run", "virtual"],
)
def test_a_recording_says_how_consent_was_given(so101, tmp_path, driver, options, consent, source):
    result = gp.run_robot(
        so101,
        motion=turned_wrist(tmp_path),
        driver=driver,
        options=replace(options, control=QUICK),
        consent=consent,
        report=SilentReporter(),
    )
    assert result.recording.summary()["consent"] == source


# ---- limits


@pytest.mark.parametrize(
    ("name", "gain", "strong"),
    [
        ("h1_2", "kp = 100.0", "kp = 150.0"),
        ("h1_2", "kd = 2.0", "kd = 3.0"),
        ("so101", "kp = 17.8", "kp = 26.7"),
    ],
)
@pytest.mark.parametrize("way", ["class", "open_driver", "run_robot", "command"])
def test_a_folder_with_gains_beyond_the_known_robots_is_refused_in_every_way(
    way, name, gain, strong, tmp_path, capsys
):
    folder = changed(name, gain, strong, tmp_path / "strong")
    kind = DRIVER_OF[name]
    message = r"k[pd] of \w+ is .*the known robot has"
    if way == "command":
        words = ["run", "--driver", kind, "--robot", str(folder), "--motion", "x", "--yes"]
        assert main(words) == 2
        assert re.search(message, " ".join(capsys.readouterr().err.split()))
        return
    with pytest.raises(RobotError, match=message):
        open_in(way, kind, folder)


def open_in(way: str, kind: str, folder: Path) -> None:
    """Give a robot folder to a driver in one of the public ways."""
    if way == "class":
        from gaponet.hw.drivers.so101 import SO101Driver
        from gaponet.hw.drivers.unitree import UnitreeDriver

        {"unitree": UnitreeDriver, "so101": SO101Driver}[kind](load_robot(folder))
    elif way == "open_driver":
        open_driver(kind, folder)
    else:
        gp.run_robot(folder, motion="x", driver=kind, options=gp.RunOptions(yes=True))


def test_a_robot_changed_in_memory_is_refused_though_its_folder_is_the_packages(so101):
    strong = so101.with_servo(kp=1.5 * so101.servo.kp)
    with pytest.raises(RobotError, match="kp"):
        hardware_robot(strong, reference_robot("so101", None))


def test_a_driver_refuses_a_wider_joint_range(tmp_path):
    save_robot(load_robot("so101"), tmp_path / "wide")
    file = tmp_path / "wide" / "robot.xml"
    file.write_text(re.sub(r'range="[^"]*"', 'range="-3 3"', file.read_text()))
    with pytest.raises(RobotError, match="range"):
        open_driver("so101", tmp_path / "wide")


def test_a_folder_that_the_user_names_may_have_other_gains_also_in_the_watchdog(tmp_path):
    folder = changed("so101", "kp = 17.8", "kp = 26.7", tmp_path / "strong")
    driver = open_driver("so101", folder, limits_from=str(folder))
    watchdog = open_driver(**driver.watchdog())
    np.testing.assert_allclose(watchdog.kp, 1.5 * load_robot("so101").servo.kp)


def test_no_folder_lifts_the_limits_of_the_motors(tmp_path):
    folder = changed("h1_2", "kp = 100.0", "kp = 301.0", tmp_path / "strong")
    with pytest.raises(RobotError, match="300"):
        open_driver("unitree", folder, limits_from=str(folder))
