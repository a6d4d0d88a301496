"""What the Unitree driver makes of messages, and the virtual H1-2 of commands."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")

from hw.control.loopback import Loopback, RobotClock, living

from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, State
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.hw.drivers.unitree_commands import CommandMessages
from gaponet.hw.drivers.unitree_states import (
    MOTOR_NAMES,
    FirstMessages,
    StateReceiver,
    motor_numbers,
    require_h1_2,
)
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.unitree_virtual import VirtualH12

TORSO = MOTOR_NAMES.index("torso_joint")
ELBOW = MOTOR_NAMES.index("left_elbow_joint")


@pytest.fixture(scope="module")
def robot() -> RobotSpec:
    return load_robot("h1_2")


@pytest.fixture(scope="module")
def served(robot: RobotSpec) -> VirtualH12:
    return VirtualH12(
        robot,
        load_fleet("easy", robot).unit("virtual-4"),
        domain=180 + os.getpid() % 40,
        rate=100.0,
    )


def message(motors: int = 27, machine: int = 6) -> np.ndarray:
    data = hg.LowState.new()
    q = np.zeros(hg.MOTORS)
    q[:motors] = np.linspace(0.1, 0.2, motors)
    hg.LowState.set_motors(data, "q", q)
    hg.LowState.view(data, "mode_machine")[0] = machine
    hg.LowState.view(data, "imu_state.quaternion")[0] = 1.0
    return data


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (message(29), "G1"),
        (message(12), "torso_joint"),
        (message(27, 5), "mode_machine"),
    ],
)
def test_another_robot_is_refused(data, why):
    with pytest.raises(DriverError, match=why):
        require_h1_2([data], "lo")


def receiver(robot: RobotSpec, found: np.ndarray, *later: list[np.ndarray]) -> StateReceiver:
    """A receiver that found a robot by one message, and what comes before each reading."""
    queue = list(later)
    source = SimpleNamespace(receive=lambda: queue.pop(0), second="")
    states = StateReceiver(motor_numbers(robot))
    states.begin(source, FirstMessages([0.0], [found], 0))
    return states


@pytest.mark.parametrize(
    ("quaternion", "tilt"),
    [
        ((1.0, 0.0, 0.0, 0.0), 0.0),
        ((np.cos(0.4), 0.0, np.sin(0.4), 0.0), 0.8),
        ((np.cos(0.4), 0.0, 0.0, np.sin(0.4)), 0.0),
        ((0.0, 0.0, 0.0, 0.0), np.nan),
    ],
    ids=["upright", "leaning", "turned", "none"],
)
def test_the_trunk_leans_by_what_the_quaternion_says_and_none_is_not_upright(
    robot, quaternion, tilt
):
    data = message()
    hg.LowState.view(data, "imu_state.quaternion")[:] = quaternion
    assert receiver(robot, data).newest.tilt == pytest.approx(tilt, abs=1e-3, nan_ok=True)


def test_only_the_stop_keys_of_the_remote_stop(robot):
    reported = receiver(robot, message()).reported_fault
    pressed = message()
    for keys, stops in (
        (0x0008, True),
        (0x0220, True),
        (0x0020, False),
        (0x0200, False),
        (0x0104, False),
    ):
        hg.LowState.view(pressed, "wireless_remote")[2:4] = keys & 0xFF, keys >> 8
        assert (reported(pressed) is not None and reported(pressed).kind == "stop") == stops, hex(
            keys
        )


def test_what_one_of_several_messages_says_stops_for_good(robot):
    pressed = message()
    well = message()
    hg.LowState.view(pressed, "wireless_remote")[2] = 0x08  # select
    for data in (pressed, well):
        hg.LowState.seal(data)
    states = receiver(robot, message(), [pressed, well], [well])
    assert [states.read().fault.kind, states.read().fault.kind] == ["stop", "stop"]


@pytest.fixture
def clock(robot: RobotSpec, monkeypatch: pytest.MonkeyPatch) -> RobotClock:
    return living(monkeypatch, robot)


def connected(robot: RobotSpec, **how: Any) -> UnitreeDriver:
    """A driver of the robot that lives by `clock`."""
    driver = UnitreeDriver(robot, **how)
    driver.connect()
    return driver


def heard(clock: RobotClock) -> list[dict]:
    """The commands that the robot has received by now."""
    clock.wait_until(clock.now() + 0.02)
    return clock.robot.heard


def test_a_robot_is_virtual_once_it_has_said_so(robot, clock):
    driver = UnitreeDriver(robot)
    before = driver.virtual

    driver.connect()

    assert [before, driver.virtual] == [False, True]


def test_on_arm_sdk_the_torso_is_held_where_it_was_found_with_its_gains(robot, clock):
    torso = robot.index(["torso_joint"])[0]
    driver = connected(robot)
    found = driver.read().qpos[torso]

    for angle in (0.3, 0.7):
        driver.write(np.where(np.arange(27) == torso, angle, 0.0), 1.0)
    driver.damp()

    rows = heard(clock)
    assert [row["ctrl"][TORSO] for row in rows] == pytest.approx([found] * 3)
    assert [row["kp"][TORSO] for row in rows] == [robot.servo.kp[torso]] * 3
    assert [row["kd"][TORSO] for row in rows] == [robot.servo.kd[torso]] * 3
    assert [row["mode"][TORSO] for row in rows] == [1] * 3


@pytest.mark.parametrize("how", [{"joints": "upper_body"}, {"topic": "lowcmd"}])
def test_a_torso_that_is_commanded_is_damped_and_one_that_is_not_is_off_on_lowcmd(
    robot, clock, how
):
    driver = connected(robot, **how)

    driver.write(np.zeros(27))
    driver.damp()

    assert heard(clock)[-1]["kp"][TORSO] == 0


def test_an_identified_robot_is_commanded_with_the_gains_of_its_real_servos(robot, clock):
    driver = connected(robot.with_identified({"left_elbow_joint": {"kp": 60.0}}))

    driver.write(robot.qpos_home)

    real = robot.servo.kp[robot.index(["left_elbow_joint"])[0]]
    assert heard(clock)[0]["kp"][ELBOW] == real != 60.0


@pytest.mark.parametrize("speed", [0.0, 1.0, 100.0])
def test_damping_gains_are_four_times_the_robots_but_no_more_than_the_effort_limits_allow(
    robot, speed
):
    messages = CommandMessages(robot, robot.joint_names, shares_control=False)
    still = np.zeros(27)

    sent = messages.damping(1.0, State(0.0, still, np.full(27, speed), still, still))

    kp, kd = (hg.LowCmd.motors(sent, name)[:27] for name in ("kp", "kd"))
    order = robot.index(MOTOR_NAMES)
    np.testing.assert_array_equal(kp, 0.0)
    believed = min(max(speed, 1e-6), 12.0)  # a wrong speed must not take the brake away
    most = np.minimum(4 * robot.servo.kd, robot.servo.effort_limit / believed)[order]
    np.testing.assert_allclose(kd, most, rtol=1e-6)


@pytest.mark.parametrize("servo", [{"kd": np.zeros(27)}, {"effort_limit": np.full(27, 0.1)}])
def test_a_folder_with_weak_servos_takes_no_brake_away(robot, servo):
    messages = CommandMessages(robot.with_servo(**servo), robot.joint_names[13:], True)
    usual = CommandMessages(robot, robot.joint_names[13:], shares_control=True)
    still = np.zeros(27)
    moving = State(0.0, still, np.full(27, 2.0), still, still)

    sent = hg.LowCmd.motors(messages.damping(1.0, moving), "kd")

    np.testing.assert_array_equal(sent, hg.LowCmd.motors(usual.damping(1.0, moving), "kd"))
    assert sent[TORSO] > 0, "the torso is held while the arms brake"
    assert (sent[TORSO + 1 : 27] > 0).all()


def test_after_damping_the_last_message_gives_the_arms_back(robot, clock):
    driver = connected(robot)

    driver.write(robot.qpos_home, 1.0)
    driver.damp(0.5)
    driver.close()

    rows = heard(clock)
    assert [row["weight"] for row in rows] == [1.0, 0.5, 0.0]
    assert rows[-1]["kp"][ELBOW] == 0


def test_a_hold_sends_nothing(robot, clock):
    driver = connected(robot)

    driver.write(robot.qpos_home, 1.0)
    driver.close(hold=True)

    assert len(heard(clock)) == 1


def test_a_silent_driver_publishes_nothing(robot, clock):
    driver = connected(robot, silent=True)

    driver.write(robot.qpos_home)
    driver.damp()
    driver.close()

    assert heard(clock) == []


def test_what_the_robot_reported_stops_also_after_a_new_connection(robot, clock):
    driver = connected(robot)
    clock.robot.inject("remote", 0.0)
    driver.write(robot.qpos_home)
    clock.wait_until(clock.now() + 0.1)
    assert driver.read().fault.kind == "stop"
    driver.close()

    clock.robot.inject("none", 0.0)
    driver.connect()

    assert driver.read().fault.kind == "stop"


def test_another_publisher_of_the_topic_is_refused(robot, monkeypatch):
    bus = Loopback()
    monkeypatch.setattr(
        bus,
        "publishers",
        lambda: defaultdict(list, {"rt/arm_sdk": ["a demo (process 7 on robot)"]}),
    )
    monkeypatch.setattr("gaponet.hw.drivers.dds", bus, raising=False)
    with pytest.raises(DriverError, match="demo"):
        UnitreeDriver(robot).connect()


def test_legs_are_commanded_only_on_lowcmd_and_another_robot_never(robot, so101):
    assert not any(
        "hip" in j or "knee" in j or "ankle" in j for j in UnitreeDriver(robot, "lowcmd").commanded
    )
    with pytest.raises(UsageError, match="legs"):
        UnitreeDriver(robot, "arm_sdk", "all")
    with pytest.raises(UsageError, match="27"):
        UnitreeDriver(so101)


def command(robot: RobotSpec, **columns: np.ndarray) -> np.ndarray:
    data = hg.LowCmd.new()
    for name, values in {"mode": np.ones(hg.MOTORS), **columns}.items():
        hg.LowCmd.set_motors(data, name, values)
    return data


@pytest.mark.parametrize("field", ["q", "dq", "tau", "kp", "kd"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_command_that_is_not_a_number_is_refused(served, robot, field, wrong):
    before = served.live.ctrl.copy()
    refused = served.refused
    values = np.full(hg.MOTORS, 0.5)
    values[16] = wrong
    served.apply_command("lowcmd", command(robot, **{field: values}), 0.0)
    assert served.refused == refused + 1
    np.testing.assert_array_equal(served.live.ctrl, before)


def test_torque_and_velocity_targets_are_followed(served, robot):
    elbow = robot.index(["left_elbow_joint"])[0]
    at = MOTOR_NAMES.index("left_elbow_joint")
    one = np.eye(hg.MOTORS)[at]
    speed = []
    for columns in ({"tau": 12.0 * one}, {"dq": -1.0 * one, "kd": 8.0 * np.ones(hg.MOTORS)}):
        served.apply_command("lowcmd", command(robot, **columns), 0.0)
        for _ in range(15):
            served.live.step()
        speed.append(served.live.read()[1][elbow])
    assert speed[0] > 0.5
    assert -2.0 < speed[1] < -0.3


FORCED = (
    '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo" '
    'multicast="true"/></Interfaces>'
    "<AllowMulticast>true</AllowMulticast></General></Domain></CycloneDDS>"
)
FORCING = """
import sys
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from gaponet.hw.drivers import dds
domain = Domain(int(sys.argv[1]), sys.argv[2])
participant = DomainParticipant(int(sys.argv[1]))
topic = Topic(participant, "rt/lowcmd", dds.as_bytes(dds.LowCmd))
writer = DataWriter(participant, topic)
sys.stdin.read()
"""


def test_a_program_that_is_made_to_use_multicast_on_loopback_is_found():
    from gaponet.hw.drivers import dds

    domain = 225 + os.getpid() % 5
    other = subprocess.Popen(
        [sys.executable, "-c", FORCING, str(domain), FORCED], stdin=subprocess.PIPE
    )
    try:
        bus = dds.Bus(domain, "lo")
        deadline = time.monotonic() + 30
        found = []
        while not found and time.monotonic() < deadline:
            found = bus.publishers()["rt/lowcmd"]
        assert len(found) == 1
        assert f"process {other.pid}" in found[0]
    finally:
        other.kill()
        other.wait()


@pytest.fixture
def two_networks(monkeypatch) -> Any:
    """drivers.dds of a process that has used no domain yet, on a machine with lo and eth0."""
    from gaponet.hw.drivers import dds

    monkeypatch.setattr(dds, "_DOMAINS", {})
    monkeypatch.setattr(dds, "_INTERFACES", {})
    monkeypatch.setattr(dds, "_interfaces", lambda: ["lo", "eth0"])
    monkeypatch.setattr(dds, "Domain", lambda domain, configuration: None)
    monkeypatch.setattr(dds, "DomainParticipant", lambda domain: None)
    return dds


def test_a_second_connection_by_another_interface_is_refused(two_networks):
    two_networks.Bus(0, "lo")

    with pytest.raises(DriverError, match="domain 0 on lo already"):
        two_networks.Bus(0, "eth0")


def test_a_second_connection_by_the_same_interface_is_accepted(two_networks):
    two_networks.Bus(0, "eth0")
    two_networks.Bus(0, "eth0")


def test_a_process_ends_although_the_deletion_of_its_dds_domain_never_does():
    program = (
        "import threading\n"
        "from gaponet.hw.drivers import dds\n"
        "class Stuck:\n"
        "    def __del__(self):\n"
        "        if threading.current_thread() is not threading.main_thread():\n"
        "            threading.Event().wait()\n"
        "dds._DOMAINS[0] = Stuck()\n"
        "print('done')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout) == (0, "done\n"), ended.stderr
