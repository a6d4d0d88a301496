"""Another program on the servo bus of an SO-101: what of it is seen, and what is not mistaken for
it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tty
from collections.abc import Iterator

import numpy as np
import pytest
from servos import Wire, on_port

from gaponet.hw.control.driver import DriverError
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.serial_port import other_programs
from gaponet.hw.drivers.so101 import SO101Driver

serial = pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

ELBOW = 3  # servo
HOLDER = (
    "import os, sys; os.open(sys.argv[1], os.O_RDWR); print('open', flush=True); sys.stdin.read()"
)


@pytest.fixture
def commanded(driver: SO101Driver) -> SO101Driver:
    """A driver that has sent goals, which the servos hold."""
    driver.write(driver.read().qpos)
    driver.read()
    return driver


@pytest.fixture
def holder() -> Iterator[tuple[str, subprocess.Popen]]:
    """A port, and a child of another process that has it open."""
    master, slave = os.openpty()
    tty.setraw(slave)
    port = os.ttyname(slave)
    shell = f'"{sys.executable}" -c "{HOLDER}" {port}; true'
    process = subprocess.Popen(
        ["sh", "-c", shell], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    assert process.stdout.readline() == "open\n"
    yield port, process
    process.communicate("")
    os.close(master)
    os.close(slave)


def test_a_program_that_has_the_port_open_is_named(holder):
    port, _ = holder

    (program,) = other_programs(port)

    assert program.startswith("python")


def test_a_port_that_another_program_has_open_is_refused_and_nothing_is_sent(so101, holder):
    port, _ = holder

    with pytest.raises(DriverError, match="open"):
        SO101Driver(so101, port).connect()


def test_the_virtual_arm_at_the_other_end_of_a_port_is_no_other_program(servos):
    with on_port(servos) as port:
        assert other_programs(port) == []


def test_the_port_is_closed_for_others_again_after_the_watchdog_has_opened_it(driver, monkeypatch):
    driver.watchdog()
    monkeypatch.setattr("gaponet.hw.drivers.so101_port.other_programs", lambda port: ["lerobot"])

    with pytest.raises(DriverError, match="lerobot"):
        driver.read()


def test_goals_that_another_program_writes_are_a_fault_within_two_states(commanded, servos):
    faults = []
    for goal in (1300, 1310):
        servos.set(ELBOW, "goal", goal)
        faults.append(commanded.read().fault)

    assert faults[0] is None
    assert faults[1].kind == "source"
    assert "goal 1310, which was never sent here" in faults[1].text


def test_requests_of_another_program_on_the_wire_are_a_fault(commanded, wire):
    request = reg.packet(reg.BROADCAST, reg.SYNC_READ, bytes([56, 2, 1, 2, 3]))
    for _ in range(2):
        wire.buffer += request
        fault = commanded.read().fault

    assert fault.kind == "source"


def test_replies_that_answer_another_program_are_a_fault(commanded, wire):
    for servo in (1, 2):
        wire.buffer += reg.packet(servo, 0, bytes(2))  # a position, as LeRobot reads it

    assert commanded.read().fault.kind == "source"


def test_one_strange_packet_is_no_fault(commanded, wire):
    wire.buffer += reg.packet(1, 0, bytes(2))

    assert commanded.read().fault is None


def test_an_adapter_that_echoes_what_is_sent_is_no_other_program(so101, servos, monkeypatch):
    wire = Wire(servos)
    answer = servos.answer
    monkeypatch.setattr(servos, "answer", lambda data: data + answer(data))
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: wire)
    driver = SO101Driver(so101, timeout=0.001)
    driver.connect()
    for step in range(10):
        driver.write(np.full(6, 0.01 * step))
        state = driver.read()

    assert state.fault is None


def test_a_servo_that_missed_the_last_goals_is_not_taken_for_commanded_by_others(commanded, servos):
    before = servos.get(ELBOW, "goal")
    for step in range(1, 20):
        commanded.write(np.full(6, 0.01 * step))
        servos.set(ELBOW, "goal", before)
        fault = commanded.read().fault

    assert fault.kind == "goal"


def test_the_recording_names_the_servos_and_their_port(driver):
    assert driver.facts["source"] == "servos 1, 2, 3, 4, 5, 6 on /dev/ttyACM0"
