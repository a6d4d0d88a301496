"""The SO-101 driver on a wire without time: servos written apart from it (tests/servos.py), and
the virtual arm.
"""

from __future__ import annotations

import json
import random
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from servos import Servos, Wire, on_port

from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.so101 import FULL_TORQUE, SO101Driver
from gaponet.hw.drivers.so101_calibration import JOINTS, STEP_RAD, read_calibration
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.so101_virtual import PERIOD, VirtualSO101

serial = pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

OFF = bytes.fromhex("ff ff fe 04 03 28 00 d2")  # write 0 to torque enable (40) of all servos
SILENCE = 0.001  # s; on a wire without time whatever comes is there


def instructions(servos: Servos) -> list[int]:
    return [request[4] for request in servos.heard]


def calibration(path: Path, **changes: dict[str, int]) -> Path:
    """The file of the arm that Servos is."""
    row = {"drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    path.write_text(
        json.dumps({j: {"id": i + 1} | row | changes.get(j, {}) for i, j in enumerate(JOINTS)})
    )
    return path


# ---- packets


def test_a_packet_is_what_the_protocol_manual_says():
    # from the manual: write 1000 to goal position (42) of servo 1
    assert (
        reg.packet(1, reg.WRITE, bytes([42, 0xE8, 0x03])).hex(" ") == "ff ff 01 05 03 2a e8 03 e1"
    )


@pytest.mark.parametrize("value", [0, 5, 1000, -1, -1000])
def test_numbers_with_a_sign_bit_survive(value):
    for register in (reg.PRESENT_VELOCITY, reg.PRESENT_LOAD, reg.HOMING_OFFSET):
        assert register.decode(register.encode(value)) == value


# ---- connecting


def test_connecting_writes_nothing(driver, servos):
    assert set(instructions(servos)) == {reg.SYNC_READ}
    np.testing.assert_allclose(driver.read().qpos[:5], 0.0)


def test_the_gains_are_those_of_the_servos_and_what_differs_is_said(driver, so101):
    # LeRobot's P of 16; robot.toml's 17.8 N·m/rad is 32
    np.testing.assert_allclose(driver.kp, 17.8 / 2)
    assert driver.facts["servos"]["p"] == [16] * 6
    assert driver.facts["servos"]["torque_limit"] == [1000] * 6
    (note,) = driver.facts["remarks"]
    assert note.startswith("P of all joints is 16, about 8.9 N·m/rad, robot.toml says 17.8")


def test_a_servo_that_is_set_otherwise_is_named(so101, wire, servos):
    for servo in range(1, 7):
        servos.set(servo, "p", 32)
    servos.set(6, "torque_limit", 500)
    servos.set(2, "i", 4)
    servos.set(3, "speed", 200)
    driver = SO101Driver(so101, timeout=SILENCE)
    driver.connect()
    np.testing.assert_allclose(driver.kp, so101.servo.kp)
    i, limit, speed = driver.facts["remarks"]
    assert i.startswith("shoulder_lift: I is not 0")
    assert limit.startswith("gripper: the torque limit")
    assert speed.startswith("elbow_flex: the servo limits its speed")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda servos: servos.set(4, "model", 1284), "model 1284"),
        (lambda servos: servos.set(1, "mode", 1), "mode 1"),
        (lambda servos: servos.silence(4), "wrist_flex"),
        (lambda servos: servos.status.__setitem__(0, 1 << 2), "overheat"),
        (
            lambda servos: [
                servos.set(n, end, v) for n in (1, 2) for end, v in (("low", 0), ("high", 4095))
            ],
            "--calibration",
        ),
    ],
    ids=["model", "mode", "missing", "error", "no calibration"],
)
def test_servos_that_it_cannot_command_are_refused_and_nothing_is_written(
    so101, wire, servos, change, complaint
):
    change(servos)
    with pytest.raises(DriverError, match=complaint):
        SO101Driver(so101, timeout=SILENCE).connect()
    assert set(instructions(servos)) == {reg.SYNC_READ}


def test_a_robot_with_other_joints_is_refused():
    with pytest.raises(UsageError, match="gripper"):
        SO101Driver(load_robot("h1_2"))


def test_a_port_that_is_not_there_is_said(so101):
    with pytest.raises(DriverError, match="plugged"):
        SO101Driver(so101, "/dev/nothing").connect()


# ---- reading


def test_a_lost_reply_confuses_no_torque_limits(so101, wire, servos):
    servos.set(6, "torque_limit", 500)  # LeRobot's for the gripper
    driver = SO101Driver(so101, timeout=SILENCE)
    driver.connect()
    driver.write(driver.read().qpos)
    lost = iter([True, False])
    servos.adversary = lambda servo, reply: b"" if servo == 3 and next(lost, False) else reply
    assert driver.read().fault is None


def test_a_reply_that_was_lost_is_asked_for_again(driver, servos):
    lost = iter([True, False])
    servos.adversary = lambda servo, reply: b"" if servo == 3 and next(lost, False) else reply
    servos.set(3, "position", 2345)
    assert driver.read().qpos[2] == pytest.approx(345 * STEP_RAD)
    whole, again = servos.heard[-2:]
    assert (whole[7:-1], again[7:-1]) == (bytes([1, 2, 3, 4, 5, 6]), bytes([3]))


@pytest.mark.parametrize(
    ("adversary", "refused"),
    [
        (lambda servo, reply: b"" if servo == 3 else reply, 0),
        (lambda servo, reply: reply[:-1] + bytes([reply[-1] ^ 1]), 6 * (1 + reg.RETRIES)),
        (lambda servo, reply: bytes(4096), 0),
    ],
    ids=["a silent servo", "damaged replies", "a bus that never stops talking"],
)
def test_a_state_is_old_unless_every_servo_has_answered_well(driver, servos, adversary, refused):
    before = driver.read()
    servos.adversary = adversary
    after = driver.read()
    assert driver.read().time == after.time == before.time
    assert after.refused == before.refused + refused


def shuffled(servo: int, reply: bytes) -> bytes:
    """Noise, half a packet and an unasked servo before every reply."""
    return b"\x00\xff" + reply[:5] + bytes.fromhex("ff ff 09 02 00 f4") + b"\xff" + reply


def test_noise_half_packets_and_strangers_between_replies_do_no_harm(driver, servos):
    servos.set(5, "position", 2500)
    servos.adversary = shuffled
    assert driver.read().qpos[4] == pytest.approx(500 * STEP_RAD)


def test_whatever_single_byte_is_changed_a_state_is_true_or_old(driver, servos):
    rng = random.Random(0)

    def change(servo: int, reply: bytes) -> bytes:
        at = rng.randrange(3 * len(reply))
        return (
            reply
            if at >= len(reply)
            else reply[:at] + bytes([reply[at] ^ rng.randrange(1, 256)]) + reply[at + 1 :]
        )

    before = driver.read()
    servos.adversary = change
    true = {}
    for _ in range(150):
        for servo in range(1, 7):
            servos.set(servo, "position", rng.randrange(1000, 3000))
        where = np.array([servos.get(servo, "position") for servo in range(1, 7)])
        state = driver.read()
        if state.time != before.time:
            true[state.time] = np.array_equal(driver.arm.steps(state.qpos), where)
        assert np.array_equal(state.qpos, before.qpos) or true.get(state.time)
        before = state
    assert all(true.values())
    assert len(true) > 10


def test_answers_that_come_late_are_never_taken_for_those_to_a_later_question(driver, servos, wire):
    """Every reply of a period arrives in the next one, before or after that one's own."""
    kept: list[bytes] = []
    arriving = b""

    def late(servo: int, reply: bytes) -> bytes:
        kept.append(reply)
        out = arriving if len(kept) == 1 else b""  # with the first reply to a request
        return out + reply if own else out

    before = driver.read()
    servos.adversary = late
    for period in range(40):
        own = period % 3 == 0  # its own replies come in time as well
        arriving = b"".join(kept)
        kept[:] = []
        for servo in range(1, 7):
            servos.set(servo, "position", 1100 + 10 * period + servo)
        state = driver.read()
        assert (state.time != before.time) == own
        if own:
            np.testing.assert_array_equal(
                driver.arm.steps(state.qpos), 1100 + 10 * period + np.arange(1, 7)
            )
        before = state


def test_a_late_reply_is_not_taken_for_the_next_registers(wire, servos):
    """Every reply comes with the next question's, before that one's own."""
    bus = reg.ServoBus(wire, SILENCE)
    kept = [b""]

    def late(servo: int, reply: bytes) -> bytes:
        kept.append(reply)
        return kept[-2] + reply

    servos.adversary = late
    for _ in range(5):
        found = [r.decode(bus.sync_read([1], r)[1]) for r in (reg.P, reg.D, reg.I, reg.MODE)]
        assert found == [16, 32, 0, 0]


# ---- the servos' own word


@pytest.mark.parametrize(("bit", "word"), [(b, w) for b, w in enumerate(reg.ERRORS) if w])
def test_an_error_bit_in_any_reply_is_a_fault_for_good(driver, servos, bit, word):
    servos.status[3] = 1 << bit
    assert driver.read().fault.kind == "robot"
    servos.status[3] = 0
    assert driver.read().fault.text.startswith(f"servo 4 (wrist_flex): {word};")


def test_an_error_is_heard_even_where_another_reply_is_missing(driver, servos):
    servos.status[5] = 1 << 5
    servos.silence(1)
    assert "gripper): overload" in driver.read().fault.text


def test_a_torque_that_is_on_is_no_error(driver, servos):
    servos.status = [1 << 4] * 6
    assert driver.read().fault is None


# ---- commanding


def test_torque_comes_on_with_the_first_goal_and_a_hold_leaves_it_on(driver, servos):
    target = driver.read().qpos + 0.1
    driver.write(target)
    assert [servos.get(s, "torque") for s in range(1, 7)] == [1] * 6
    np.testing.assert_allclose(driver.read().qpos, target, atol=STEP_RAD)
    del servos.heard[:]
    driver.write(target)
    assert [request[5] for request in servos.heard] == [reg.GOAL_POSITION.address], (
        "a servo that reset stays off"
    )
    count = len(servos.heard)
    driver.close(hold=True)
    assert len(servos.heard) == count


def ignore_goals(servos: Servos, number: int, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the first `count` goals for a servo be lost."""
    store = servos._store
    lost = iter(range(count))

    def take(servo: int, at: int, data: bytes) -> None:
        is_goal = at == reg.GOAL_POSITION.address
        if servo == number and is_goal and next(lost, None) is not None:
            return
        store(servo, at, data)

    monkeypatch.setattr(servos, "_store", take)


def test_no_torque_comes_on_if_a_servo_holds_the_goal_of_an_earlier_run(
    driver, servos, monkeypatch
):
    servos.set(3, "goal", 2900)
    ignore_goals(servos, 3, 1000, monkeypatch)

    with pytest.raises(DriverError, match=r"servo 3 \(elbow_flex\).* 2900"):
        driver.write(driver.read().qpos)

    assert [servos.get(s, "torque") for s in range(1, 7)] == [0] * 6


def test_no_torque_comes_on_if_a_servo_does_not_say_its_goal(driver, servos):
    found = driver.read().qpos
    servos.silence(3)

    with pytest.raises(DriverError, match=r"servo 3 \(elbow_flex\)"):
        driver.write(found)

    assert [servos.get(s, "torque") for s in range(1, 7)] == [0] * 6


def test_a_first_goal_that_was_lost_twice_is_sent_again(driver, servos, monkeypatch):
    ignore_goals(servos, 3, 2, monkeypatch)

    driver.write(np.full(6, 0.1))

    assert servos.get(3, "goal") == servos.get(2, "goal") != 0
    assert [servos.get(s, "torque") for s in range(1, 7)] == [1] * 6


def test_a_servo_whose_torque_did_not_come_on_gets_it_only_with_its_goal(
    driver, servos, monkeypatch
):
    found = driver.read().qpos
    driver.write(found)
    servos.set(3, "torque", 0)
    driver.read()
    ignore_goals(servos, 3, 1000, monkeypatch)
    servos.set(3, "goal", 2900)  # it has reset itself

    with pytest.raises(DriverError, match="elbow_flex"):
        driver.write(found)

    assert servos.get(3, "torque") == 0


def test_an_arm_that_is_closed_without_a_hold_is_let_go(driver, servos):
    driver.write(driver.read().qpos)

    driver.close()

    assert [servos.get(s, "torque") for s in range(1, 7)] == [0] * 6


def test_from_the_first_goal_until_the_end_no_other_program_can_open_the_port(
    driver, wire, monkeypatch
):
    calls: list[int] = []
    wire.fileno = lambda: 0
    monkeypatch.setattr("fcntl.ioctl", lambda descriptor, request: calls.append(request))
    assert calls == []
    driver.write(driver.read().qpos)
    assert calls == [termios.TIOCEXCL]
    driver.close()
    assert calls == [termios.TIOCEXCL, termios.TIOCNXCL]


def test_goals_stay_within_the_calibrated_range(driver, servos):
    driver.write(np.full(6, 9.0))
    assert [servos.get(s, "goal") for s in range(1, 7)] == [3000] * 6
    driver.write(np.full(6, -9.0))
    assert [servos.get(s, "goal") for s in range(1, 7)] == [1000] * 6
    np.testing.assert_allclose(driver.qpos_range[:5], [[-1000 * STEP_RAD, 1000 * STEP_RAD]] * 5)


def test_damping_tells_all_servos_at_once_without_asking_any(driver, servos):
    driver.write(driver.read().qpos)
    servos.silence(*range(1, 7))
    del servos.heard[:]
    driver.damp()
    assert servos.heard[0] == OFF
    assert set(instructions(servos)) == {reg.WRITE, reg.SYNC_WRITE}
    assert [servos.get(s, "torque") for s in range(1, 7)] == [0] * 6


def test_reading_after_the_port_was_lost_is_an_error_of_the_driver(so101, servos):
    with on_port(servos) as port:
        driver = SO101Driver(so101, port=port)
        driver.connect()
        driver._port.close()
        with pytest.raises(DriverError, match="cable"):
            driver.read()


def test_a_port_that_is_lost_while_damping_is_opened_again(driver, servos, wire):
    driver.write(driver.read().qpos)
    wire.lost = True
    for call in (driver.read, driver.damp, driver.damp):
        with pytest.raises(DriverError, match="Input/output"):
            call()
    wire.lost = False
    del servos.heard[:]
    driver.damp()
    assert servos.heard[0] == OFF


def test_the_watchdog_says_nothing_until_it_damps_and_then_asks_nothing(
    so101, wire, servos, driver
):
    from gaponet.hw.drivers.open import open_driver

    other = open_driver(**driver.watchdog())
    del servos.heard[:]
    other.connect()
    assert not servos.heard
    other.damp()
    assert servos.heard[0] == OFF
    other.close(hold=True)
    assert set(instructions(servos)) == {reg.WRITE, reg.SYNC_WRITE}


def test_a_watchdog_that_takes_over_while_the_arm_sinks_raises_no_torque_limit(
    so101, wire, servos, driver
):
    """Else the arm springs back to its last goal with full torque."""
    from gaponet.hw.drivers.open import open_driver

    other = open_driver(**driver.watchdog())
    other.connect()
    driver.write(driver.read().qpos)
    driver.damp(share=0.4)
    assert servos.get(1, "torque_limit") == 400

    limits = []
    for share in (1.0, 0.5, 0.1):
        other.damp(share=share)
        limits.append(servos.get(1, "torque_limit"))

    assert limits == [400, 200, 40]


def test_a_watchdog_lowers_also_a_servo_that_does_not_answer(so101, wire, servos, driver):
    from gaponet.hw.drivers.open import open_driver

    other = open_driver(**driver.watchdog())
    other.connect()
    driver.write(driver.read().qpos)
    servos.silence(3)

    other.damp(share=0.5)

    assert [servos.get(number, "torque_limit") for number in (1, 3)] == [500, 500]


# ---- calibration


def test_a_calibration_of_lerobot_gives_zero_sign_and_range(so101, tmp_path):
    file = calibration(
        tmp_path / "arm.json", elbow_flex={"drive_mode": 1}, wrist_flex={"range_max": 3003}
    )
    found = read_calibration(file, so101)
    assert found.servos == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(found.zero[:5], [2000, 2000, 2000, 2001.5, 2000])
    assert found.sign.tolist() == [1, 1, -1, 1, 1, 1]


@pytest.mark.parametrize("drive_mode", [0, 1])
def test_the_gripper_closes_where_its_calibration_says(so101, tmp_path, drive_mode):
    found = read_calibration(
        calibration(tmp_path / "arm.json", gripper={"drive_mode": drive_mode}), so101
    )
    closed, opened = so101.qpos_range[so101.index(["gripper"])[0]]
    want = np.zeros(6)
    want[5] = closed
    assert found.steps(want)[5] == (3000 if drive_mode else 1000)
    want[5] = opened  # 1.92 rad from there: 1251 of the 2000 calibrated steps
    assert found.steps(want)[5] == pytest.approx(1749 if drive_mode else 2251, abs=1)


@pytest.mark.parametrize(
    "content",
    ["{}", "[1]", "{", '{"gripper": 1}', None],
    ids=["no joints", "a list", "cut short", "a number", "no range"],
)
def test_a_file_that_is_no_calibration_is_refused(so101, tmp_path, content):
    file = calibration(tmp_path / "arm.json", gripper={"range_min": 3000})
    if content is not None:
        file.write_text(content)
    with pytest.raises(UsageError, match=r"arm\.json"):
        SO101Driver(so101, calibration=file)


@pytest.mark.parametrize(
    ("field", "register"),
    [("homing_offset", "homing"), ("range_min", "low"), ("range_max", "high")],
)
def test_a_calibration_that_is_not_in_the_servos_is_refused(
    so101, wire, servos, tmp_path, field, register
):
    file = calibration(tmp_path / "arm.json")
    SO101Driver(so101, calibration=file, timeout=SILENCE).connect()
    servos.set(3, register, 1234)
    with pytest.raises(
        DriverError,
        match=field,
    ):
        SO101Driver(so101, calibration=file, timeout=SILENCE).connect()


# ---- the virtual arm


class Alive(Wire):
    """A virtual arm on the wire; every read lets it live for a period."""

    def __init__(self, arm: VirtualSO101) -> None:
        self.arm = arm
        super().__init__(self)  # type: ignore[arg-type]

    def answer(self, data: bytes) -> bytes:
        self.arm.live.step()
        return self.arm.receive(data)


@pytest.fixture
def arm(so101: RobotSpec) -> Iterator[VirtualSO101]:
    arm = VirtualSO101(so101, load_fleet("easy", so101).unit("virtual-1"))
    yield arm
    arm.close()


@pytest.fixture
def connect(
    so101: RobotSpec, arm: VirtualSO101, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], SO101Driver]:
    def connect() -> SO101Driver:
        monkeypatch.setattr(serial, "Serial", lambda *_, **__: Alive(arm))
        driver = SO101Driver(so101, timeout=SILENCE)
        driver.connect()
        return driver

    return connect


def follow(driver: SO101Driver, joint: int, by: float, seconds: float = 2.0) -> float:
    """Where a joint is some time after its target moved, rad from the target."""
    target = driver.read().qpos.copy()
    target[joint] += by
    driver.write(target)
    for _ in range(round(seconds / PERIOD)):
        state = driver.read()
    return float(state.qpos[joint] - target[joint])


def test_the_virtual_arm_follows_and_its_readings_are_whole_steps(connect, so101, arm):
    driver = connect()
    assert driver.facts["remarks"] == []
    roll = so101.index(["wrist_roll"])[0]
    assert abs(follow(driver, roll, 0.3)) < 0.05
    steps = driver.read().qpos[roll] / STEP_RAD + driver.arm.zero[roll]
    assert abs(steps - round(steps)) < 1e-6
    driver.damp()
    assert all(memory[reg.TORQUE_ENABLE.address] == 0 for memory in arm.memory)


@pytest.mark.parametrize(
    ("register", "value", "by", "ratio"),
    [(reg.P, 16, 0.0, 1.5), (reg.TORQUE_LIMIT, FULL_TORQUE // 50, 0.5, 3.0)],
)
def test_a_virtual_servo_has_the_stiffness_and_the_torque_of_its_registers(
    connect, so101, arm, register, value, by, ratio
):
    lift = so101.index(["shoulder_lift"])[0]
    before = follow(connect(), lift, by)
    for memory in arm.memory:
        memory[register.address : register.address + register.size] = register.encode(value)
    driver = connect()
    np.testing.assert_allclose(driver.kp, so101.servo.kp / (2 if register is reg.P else 1))
    assert abs(follow(driver, lift, by)) > ratio * abs(before)  # it sags, or does not lift


def test_it_speaks_over_a_pseudo_terminal_in_another_thread(so101, arm):
    over = threading.Event()

    def live() -> None:
        while not over.is_set():
            arm.run(0.02)

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    try:
        driver = SO101Driver(
            so101, arm.terminal.port, timeout=20.0
        )  # s: machines that run tests are busy
        driver.connect()
        assert np.isfinite(driver.read().qpos).all()
        driver.close()
    finally:
        over.set()
        thread.join()


def test_a_bus_on_which_frames_pass_stands_still_until_a_goal_is_written(so101):
    arm = VirtualSO101(so101, load_fleet("easy", so101).unit("virtual-1"), frame=0.04)
    bus = reg.ServoBus(Wire(SimpleNamespace(answer=arm.receive)), SILENCE)  # type: ignore[arg-type]
    try:
        before = bus.sync_read([1, 2], reg.RUNNING)
        assert arm.live.steps == 0
        bus.sync_write(reg.GOAL_POSITION, {1: 2048, 2: 2048})
        assert arm.live.steps == round(0.04 / PERIOD)
        bus.sync_write(reg.TORQUE_ENABLE, {1: 1, 2: 1})
        assert arm.live.steps == round(0.04 / PERIOD)
        assert bus.sync_read([1, 2], reg.RUNNING) != before
    finally:
        arm.close()
