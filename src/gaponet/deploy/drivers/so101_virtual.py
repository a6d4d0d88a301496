"""A VIRTUAL SO-101 on a pseudo-terminal: servos that answer like STS3215, hidden physics in real time behind them."""

from __future__ import annotations

import os
import select
import time
import tty
from pathlib import Path

import numpy as np

from gaponet.deploy.clock import uncollected
from gaponet.deploy.drivers import feetech as reg
from gaponet.deploy.drivers.so101 import SPEAK, STALL_CURRENT, STEP, STEPS
from gaponet.deploy.drivers.virtual import LiveUnit
from gaponet.robot import RobotSpec
from gaponet.virtual.physics import Physics

Array = np.ndarray

PERIOD = 0.005  # s between two steps of the physics
BEHIND = 0.5  # s of arrears that are dropped: an interrupted process does not hurry afterwards
CATCH_UP = 4  # steps
FREE_DAMPING = 0.3  # N·m·s/rad that the gears brake with when the torque is off (assumed)


class VirtualSO101:
    """The servos' side of the bus; `port` is what a driver opens."""

    def __init__(
        self, robot: RobotSpec, physics: Physics, payload: tuple[float, str] = (0.0, "hand"), link: Path | None = None
    ) -> None:
        """
        Args:
            robot: so101.
            physics: Of the unit.
            payload: kg, and mount.
            link: Another name for the port, a symbolic link; replaced if it is one.
        """
        self.robot = robot
        self.live = LiveUnit(robot, physics, payload, period=PERIOD)
        self._order = robot.index(SPEAK)  # servo number − 1 → joint
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port, self._slave = os.ttyname(slave), slave
        self._link = link
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(self.port)
        self.memory = [bytearray(128) for _ in SPEAK]
        for memory in self.memory:
            memory[reg.MODEL.address : reg.MODEL.address + 2] = reg.MODEL.encode(reg.STS3215)
            memory[reg.PRESENT_VOLTAGE.address] = 120
        self.deaf: set[int] = set()  # servos that do not answer
        self.damaged = False  # replies have a wrong checksum
        self._buffer = b""
        self._apply()

    def run(self, seconds: float = np.inf) -> None:
        """Live and answer in real time."""
        with uncollected():
            self._serve(seconds)

    def _serve(self, seconds: float) -> None:
        began = time.monotonic()
        start = began - self.live.steps * PERIOD
        while time.monotonic() - began < seconds:
            due = start + self.live.steps * PERIOD
            readable, _, _ = select.select([self._master], [], [], min(max(0.0, due - time.monotonic()), PERIOD))
            if readable:
                self._hear(os.read(self._master, 4096))
            now = time.monotonic()
            if now - due > BEHIND:
                start += now - due
            for _ in range(CATCH_UP):  # then look at the bus again, however far behind
                if start + self.live.steps * PERIOD <= time.monotonic():
                    self.live.step()

    def close(self) -> None:
        """The cable is out."""
        for descriptor in (self._master, self._slave):
            os.close(descriptor)
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def _hear(self, data: bytes) -> None:
        self._buffer += data
        while (start := self._buffer.find(b"\xff\xff")) >= 0:
            packet = self._buffer[start:]
            if len(packet) < 4 or len(packet) < 4 + packet[3]:
                self._buffer = packet
                return
            end = 4 + packet[3]
            body, self._buffer = packet[2:end], packet[end:]
            if reg.checksum(body[:-1]) == body[-1]:
                self._do(body[0], body[2], body[3:-1])
        self._buffer = self._buffer[-1:] if self._buffer.endswith(b"\xff") else b""

    def _do(self, servo: int, instruction: int, parameters: bytes) -> None:
        if instruction == reg.PING:
            self._answer(servo, b"")
        elif instruction == reg.READ:
            self._refresh()
            self._answer(servo, self._bytes(servo, parameters[0], parameters[1]))
        elif instruction == reg.WRITE:
            self._store(servo, parameters[0], parameters[1:])
            self._answer(servo, b"")
        elif instruction == reg.SYNC_READ:
            self._refresh()
            for one in parameters[2:]:
                self._answer(one, self._bytes(one, parameters[0], parameters[1]))
        elif instruction == reg.SYNC_WRITE:
            size = parameters[1] + 1
            for i in range(2, len(parameters), size):
                self._store(parameters[i], parameters[0], parameters[i + 1 : i + size])
        self._apply()

    def _answer(self, servo: int, data: bytes) -> None:
        if not 1 <= servo <= len(SPEAK) or servo in self.deaf:
            return
        reply = reg.packet(servo, 0, data)
        os.write(self._master, reply[:-1] + bytes([reply[-1] ^ self.damaged]))

    def _bytes(self, servo: int, address: int, size: int) -> bytes:
        return bytes(self.memory[servo - 1][address : address + size]) if 1 <= servo <= len(SPEAK) else b""

    def _store(self, servo: int, address: int, data: bytes) -> None:
        if 1 <= servo <= len(SPEAK):
            self.memory[servo - 1][address : address + len(data)] = data

    def _refresh(self) -> None:
        """Readings into the registers."""
        qpos, qvel, tau, temperature = (values[self._order] for values in self.live.read())
        current = tau / self.robot.effort_limit[self._order] * STALL_CURRENT
        for i, memory in enumerate(self.memory):
            for register, value in (
                (reg.PRESENT_POSITION, np.clip(round(qpos[i] / STEP) + STEPS // 2, 0, STEPS - 1)),
                (reg.PRESENT_VELOCITY, round(qvel[i] / STEP)),
                (
                    reg.PRESENT_LOAD,
                    np.clip(round(1000 * tau[i] / self.robot.effort_limit[self._order[i]]), -1000, 1000),
                ),
                (reg.PRESENT_CURRENT, round(current[i])),
                (reg.PRESENT_TEMPERATURE, round(temperature[i])),
            ):
                memory[register.address : register.address + register.size] = register.encode(int(value))

    def _apply(self) -> None:
        """Registers into targets and gains."""
        kp, kd = self.robot.kp.copy(), self.robot.kd.copy()
        for joint, memory in zip(self._order, self.memory, strict=True):
            if not memory[reg.TORQUE_ENABLE.address]:
                kp[joint], kd[joint] = 0.0, FREE_DAMPING
                continue
            at = reg.GOAL_POSITION.address
            self.live.ctrl[joint] = (reg.GOAL_POSITION.decode(bytes(memory[at : at + 2])) - STEPS / 2) * STEP
        self.live.set_gains(kp, kd)
