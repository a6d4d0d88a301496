"""The SO-101 driver on a pseudo-terminal with servos that answer like STS3215."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from gaponet.deploy.driver import DriverError
from gaponet.deploy.drivers import feetech as reg
from gaponet.deploy.drivers.so101 import STEP, SO101Driver, read_calibration
from gaponet.deploy.drivers.so101_virtual import VirtualSO101
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.virtual.fleet import load_fleet

pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")


@pytest.fixture
def served(so101: RobotSpec) -> Iterator[VirtualSO101]:
    arm = VirtualSO101(so101, load_fleet("default", so101).unit("virtual-1"))
    over = threading.Event()

    def live() -> None:
        while not over.is_set():
            arm.run(0.02)

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    yield arm
    over.set()
    thread.join()
    arm.close()


@pytest.fixture
def driver(so101: RobotSpec, served: VirtualSO101) -> Iterator[SO101Driver]:
    driver = SO101Driver(so101, served.port, timeout=1.0)  # s: machines that run tests are busy
    driver.connect()
    yield driver
    driver.close()


def test_a_packet_is_what_the_protocol_manual_says():
    # from the manual: write 1000 to goal position (42) of servo 1
    assert reg.packet(1, reg.WRITE, bytes([42, 0xE8, 0x03])).hex(" ") == "ff ff 01 05 03 2a e8 03 e1"


@pytest.mark.parametrize("value", [0, 5, 1000, -1, -1000])
def test_numbers_with_a_sign_bit_survive(value):
    for register in (reg.PRESENT_VELOCITY, reg.PRESENT_LOAD):
        assert register.decode(register.encode(value)) == value


def test_connecting_moves_nothing_and_switches_nothing_on(driver, served):
    assert all(m[reg.TORQUE_ENABLE.address] == 0 for m in served.memory)
    assert np.isfinite(driver.read().qpos).all()


def test_a_target_is_followed_and_damp_lets_go(driver, served, so101):
    at = so101.index(["wrist_roll"])[0]
    target = driver.read().qpos.copy()
    target[at] += 0.3
    driver.write(target)
    deadline = time.monotonic() + 20
    while abs((state := driver.read()).qpos[at] - target[at]) > 0.05 and time.monotonic() < deadline:
        time.sleep(0.02)
    assert abs(state.qpos[at] - target[at]) < 0.05
    assert abs(state.qpos[at] / STEP - round(state.qpos[at] / STEP)) < 1e-6
    driver.damp()
    driver.read()
    assert all(m[reg.TORQUE_ENABLE.address] == 0 for m in served.memory)


def test_a_servo_that_falls_silent_makes_the_state_old(driver, served):
    before = driver.read().time
    driver._bus.timeout = 0.05
    served.deaf.add(3)
    time.sleep(0.1)
    assert driver.read().time - before < 0.1
    assert driver.read().time == driver.read().time


def test_damaged_replies_are_counted_and_not_believed(driver, served):
    old = driver.read()
    driver._bus.timeout = 0.05
    served.damaged = True
    new = driver.read()
    assert new.time == old.time
    assert new.refused > old.refused


def test_a_missing_servo_is_named(so101, served):
    served.deaf.add(4)
    with pytest.raises(DriverError, match=r"servo 4 \(wrist_flex\) does not answer"):
        SO101Driver(so101, served.port, timeout=1.0).connect()


def test_a_port_that_is_not_there_is_said(so101):
    with pytest.raises(DriverError, match="is the arm plugged in"):
        SO101Driver(so101, "/dev/nothing").connect()


def test_a_calibration_of_lerobot_gives_middle_and_sign(so101, tmp_path):
    rows = {
        name: {"id": i + 1, "drive_mode": int(i == 2), "homing_offset": 0, "range_min": 1000, "range_max": 3000 + i}
        for i, name in enumerate(so101.joint_names)
    }
    (tmp_path / "arm.json").write_text(json.dumps(rows))
    servos, middle, sign = read_calibration(tmp_path / "arm.json", so101)
    assert servos == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(middle, [2000, 2000.5, 2001, 2001.5, 2002, 2002.5])
    assert sign.tolist() == [1, 1, -1, 1, 1, 1]
    (tmp_path / "arm.json").write_text("{}")
    with pytest.raises(UsageError, match="not a calibration of LeRobot"):
        read_calibration(tmp_path / "arm.json", so101)
