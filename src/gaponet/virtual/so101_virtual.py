"""A VIRTUAL SO-101: servos that answer like STS3215 with hidden physics, on a pseudo-terminal in
real time.

Registers with an effect: torque enable, goal, P (stiffness), position limits, torque limit. The
others are only stored. The calibration is that of LeRobot for an arm with the limits of the MJCF.
"""

from __future__ import annotations

import os
import select
import time
import tty
from pathlib import Path

import numpy as np

from gaponet.hw.control.clock import no_garbage_collection
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.so101_calibration import (
    CONTINUOUS_JOINT,
    GRIPPER,
    JOINTS,
    STEP_RAD,
    STEPS_PER_TURN,
    ArmCalibration,
    ServoRow,
)
from gaponet.hw.drivers.so101_servos import FULL_TORQUE, STALL_CURRENT_STEPS, STIFFNESS_PER_P
from gaponet.robot.spec import RobotSpec
from gaponet.robot.toml_file import Table
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_driver import LiveUnit

PERIOD = 0.005  # s between two steps of the physics
MAX_LAG_S = 0.5  # behind real time; a longer lag, as of an interrupted process, is dropped
MAX_CATCH_UP_STEPS = 4  # between two looks at the bus
GRIPPER_SHIFT_STEPS = 300  # of the middle of the gripper's range against that of the encoder
FREE_DAMPING = 0.3  # N·m·s/rad of the gears while the torque is off (assumed)


class Terminal:
    """A pseudo-terminal, which a driver opens like a serial port.

    Attributes:
        port: Path that a driver opens.
        descriptor: Our end.
    """

    def __init__(self, link: Path | None) -> None:
        """link: Symbolic link to the port; an existing link is replaced."""
        self.descriptor, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self._link = link
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.port)

    def close(self) -> None:
        """Close both ends and remove the link."""
        for descriptor in (self.descriptor, self._slave):
            os.close(descriptor)
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()


class VirtualSO101:
    """The servos on the bus; a driver opens `terminal.port`."""

    def __init__(
        self,
        robot: RobotSpec,
        physics: Physics,
        payload: tuple[float, str] = (0.0, "hand"),
        link: Path | None = None,
        frame: float | None = None,
    ) -> None:
        """
        Args:
            payload: kg, and mount.
            link: Symbolic link to the port; an existing link is replaced.
            frame: Simulated time per goal position, s; default: real time.
        """
        # The arm rests on a table while its torque is off.
        robot = robot.with_table(robot.scene.table or Table(height=0.0))
        self.robot = robot
        # None: real time
        self._steps_per_goal = None if frame is None else round(frame / PERIOD)
        self.live = LiveUnit(robot, physics, payload, period=PERIOD)
        self._order = robot.index(JOINTS)  # servo number − 1 → joint
        self.calibration = ArmCalibration(_as_calibrated(robot), robot)
        self.terminal = Terminal(link)
        self.memory = [_new_memory(self.calibration.rows[joint]) for joint in JOINTS]
        self.silent: set[int] = set()  # servos that do not answer
        self.damaged = False  # replies have a wrong checksum
        self.status = [0] * len(JOINTS)  # error bits in replies
        self._buffer = b""  # bytes of the bus that are no whole packet yet
        self._replies = b""
        self._apply()

    @no_garbage_collection()
    def run(self, seconds: float = np.inf) -> None:
        """Simulate and answer in real time."""
        bus = self.terminal.descriptor
        began = time.monotonic()
        start = began - self.live.steps * PERIOD
        while time.monotonic() - began < seconds:
            due = start + self.live.steps * PERIOD
            wait = MAX_LAG_S
            if self._steps_per_goal is None:
                wait = min(max(0.0, due - time.monotonic()), PERIOD)
            readable, _, _ = select.select([bus], [], [], wait)
            if readable:
                os.write(bus, self.receive(os.read(bus, 4096)))
            if self._steps_per_goal is not None:
                continue
            now = time.monotonic()
            if now - due > MAX_LAG_S:
                start += now - due
            for _ in range(MAX_CATCH_UP_STEPS):
                if start + self.live.steps * PERIOD <= time.monotonic():
                    self.live.step()

    def close(self) -> None:
        self.terminal.close()

    def receive(self, data: bytes) -> bytes:
        """Handle bytes from the bus and return the replies."""
        self._buffer = self._buffer + data
        self._replies = b""
        while (start := self._buffer.find(b"\xff\xff")) >= 0:
            packet = self._buffer[start:]
            if len(packet) < 4 or len(packet) < 4 + packet[3]:
                self._buffer = packet
                return self._replies
            end = 4 + packet[3]
            body = packet[2:end]
            self._buffer = packet[end:]
            if reg.checksum(body[:-1]) == body[-1]:
                self._execute(body[0], body[2], body[3:-1])
        self._buffer = self._buffer[-1:] if self._buffer.endswith(b"\xff") else b""
        return self._replies

    def _execute(self, servo: int, instruction: int, parameters: bytes) -> None:
        """Do what a packet asks for, and append the replies.

        Args:
            servo: Who is asked; BROADCAST in SYNC_READ and SYNC_WRITE.
            instruction: One of drivers.feetech.
            parameters: Of READ: address, size. Of WRITE: address, data. Of SYNC_READ: address,
                size, servos. Of SYNC_WRITE: address, size, then number and data of each servo.
        """
        if instruction == reg.PING:
            self._answer(servo, b"")
        elif instruction == reg.READ:
            self._refresh()
            self._answer(servo, self._bytes(servo, parameters[0], parameters[1]))
        elif instruction == reg.WRITE:
            receivers = range(1, len(JOINTS) + 1) if servo == reg.BROADCAST else (servo,)
            for receiver in receivers:
                self._store(receiver, parameters[0], parameters[1:])
            self._answer(servo, b"")  # nobody answers a broadcast
        elif instruction == reg.SYNC_READ:
            self._refresh()
            for receiver in parameters[2:]:
                self._answer(receiver, self._bytes(receiver, parameters[0], parameters[1]))
        elif instruction == reg.SYNC_WRITE:
            size = parameters[1]
            for i in range(2, len(parameters), size + 1):  # number of a servo, then its data
                data = parameters[i + 1 : i + 1 + size]
                self._store(parameters[i], parameters[0], data)
        self._apply()
        if instruction == reg.SYNC_WRITE and parameters[0] == reg.GOAL_POSITION.address:
            self._play_frame()

    def _play_frame(self) -> None:
        """Simulate the time that one goal position stands for, if time is not real."""
        for _ in range(self._steps_per_goal or 0):
            self.live.step()

    def _answer(self, servo: int, data: bytes) -> None:
        if not 1 <= servo <= len(JOINTS) or servo in self.silent:
            return
        reply = reg.packet(servo, self.status[servo - 1], data)
        if self.damaged:
            wrong_checksum = reply[-1] ^ 1
            reply = reply[:-1] + bytes([wrong_checksum])
        self._replies += reply

    def _bytes(self, servo: int, address: int, size: int) -> bytes:
        if not 1 <= servo <= len(JOINTS):
            return b""
        return bytes(self.memory[servo - 1][address : address + size])

    def _store(self, servo: int, address: int, data: bytes) -> None:
        if 1 <= servo <= len(JOINTS):
            self.memory[servo - 1][address : address + len(data)] = data

    def _refresh(self) -> None:
        """Write readings into the registers."""
        order = self._order
        qpos, qvel, tau, temperature = self.live.read()
        calibration = self.calibration
        steps = np.rint(qpos / (STEP_RAD * calibration.sign) + calibration.zero)[order]
        share = (tau / self.robot.servo.effort_limit)[order]
        values = {
            reg.PRESENT_POSITION: np.clip(steps, 0, STEPS_PER_TURN - 1),  # beyond its limits too
            reg.PRESENT_VELOCITY: np.rint(qvel[order] / STEP_RAD),
            reg.PRESENT_LOAD: np.clip(np.rint(1000 * share), -1000, 1000),
            reg.PRESENT_CURRENT: np.rint(share * STALL_CURRENT_STEPS),
            reg.PRESENT_TEMPERATURE: np.rint(temperature[order]),
        }
        for register, numbers in values.items():
            for memory, value in zip(self.memory, numbers, strict=True):
                _put(memory, register, int(value))

    def _apply(self) -> None:
        """Set targets, gains and torque limits from the registers."""
        kp = self.robot.servo.kp.copy()
        kd = self.robot.servo.kd.copy()
        effort = self.robot.servo.effort_limit.copy()
        goals = self.calibration.steps(self.live.ctrl)
        for joint, memory in zip(self._order, self.memory, strict=True):
            kp[joint] = STIFFNESS_PER_P * _get(memory, reg.P)
            effort[joint] *= min(_get(memory, reg.TORQUE_LIMIT), FULL_TORQUE) / FULL_TORQUE
            if not _get(memory, reg.TORQUE_ENABLE):
                kp[joint] = 0.0
                kd[joint] = FREE_DAMPING
                continue
            lowest = _get(memory, reg.MIN_POSITION)
            highest = _get(memory, reg.MAX_POSITION)
            goals[joint] = np.clip(_get(memory, reg.GOAL_POSITION), lowest, highest)
            self.live.ctrl[joint] = self.calibration.qpos(goals)[joint]
        self.live.set_gains(kp, kd, effort)


def _as_calibrated(robot: RobotSpec) -> dict[str, ServoRow]:
    """Return LeRobot's calibration of an arm with the joint limits of the MJCF."""
    rows = {}
    for number, joint in enumerate(JOINTS, 1):
        low, high = robot.qpos_range[robot.index([joint])[0]]
        half = (high - low) / 2 / STEP_RAD  # steps
        middle = STEPS_PER_TURN / 2
        if joint == CONTINUOUS_JOINT:
            half = (STEPS_PER_TURN - 1) / 2
            middle -= 0.5
        elif joint == GRIPPER:
            middle -= GRIPPER_SHIFT_STEPS
        rows[joint] = ServoRow(
            id=number,
            drive_mode=0,
            homing_offset=17 * number,  # any that differ
            range_min=int(np.ceil(middle - half)),
            range_max=int(np.floor(middle + half)),
        )
    return rows


def _new_memory(row: ServoRow) -> bytearray:
    """Return the registers of a calibrated servo with the values of its manufacturer."""
    values = {
        reg.MODEL: reg.STS3215,
        reg.MIN_POSITION: row.range_min,
        reg.MAX_POSITION: row.range_max,
        reg.HOMING_OFFSET: row.homing_offset,
        reg.MAX_TORQUE: FULL_TORQUE,
        reg.TORQUE_LIMIT: FULL_TORQUE,
        reg.P: 32,
        reg.D: 32,
        reg.PROTECTION_CURRENT: 500,
        reg.PRESENT_VOLTAGE: 120,
    }
    memory = bytearray(128)
    for register, value in values.items():
        _put(memory, register, value)
    return memory


def _put(memory: bytearray, register: reg.Register, value: int) -> None:
    memory[register.address : register.address + register.size] = register.encode(value)


def _get(memory: bytearray, register: reg.Register) -> int:
    return register.decode(bytes(memory[register.address : register.address + register.size]))
