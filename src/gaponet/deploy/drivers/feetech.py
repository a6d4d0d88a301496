"""Feetech's servo bus (STS series, protocol 0): packets over any byte stream, and the registers of an STS3215.

A packet is FF FF id length instruction parameters… checksum; a reply has a status byte in place of the instruction.
Numbers are little-endian; velocity and load are sign and magnitude. From Feetech's public memory table (STS3215) and
protocol manual. Tested against a bus that answers by the same document; not against servos.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from gaponet.deploy.driver import DriverError

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
BROADCAST = 0xFE
ERRORS = ("voltage", "angle sensor", "overheat", "overcurrent", "", "overload")  # status bits, from the lowest


@dataclass(frozen=True)
class Register:
    """Where a value is, how many bytes, and which bit is its sign (None: unsigned)."""

    address: int
    size: int
    sign: int | None = None

    def decode(self, data: bytes) -> int:
        """Bytes → number."""
        value = int.from_bytes(data, "little")
        if self.sign is not None and value >> self.sign & 1:
            return -(value & (1 << self.sign) - 1)
        return value

    def encode(self, value: int) -> bytes:
        """Number → bytes."""
        if value < 0:
            assert self.sign is not None
            value = -value | 1 << self.sign
        return value.to_bytes(self.size, "little")


MODEL = Register(3, 2)
MODE = Register(33, 1)  # 0: position
TORQUE_ENABLE = Register(40, 1)
GOAL_POSITION = Register(42, 2, 15)
PRESENT_POSITION = Register(56, 2, 15)
PRESENT_VELOCITY = Register(58, 2, 15)
PRESENT_LOAD = Register(60, 2, 10)  # 0.1 % of full drive
PRESENT_VOLTAGE = Register(62, 1)  # 0.1 V
PRESENT_TEMPERATURE = Register(63, 1)  # °C
PRESENT_CURRENT = Register(69, 2, 15)  # 6.5 mA
PRESENT = Register(56, 15)  # the block that holds all of them
STS3215 = 777  # model number


class Stream(Protocol):
    """What we need of a serial port; pyserial's Serial has it."""

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, waiting no longer than the port's time-out."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def reset_input_buffer(self) -> None:
        """Drop what was received and not read."""


def checksum(body: bytes) -> int:
    """Of everything between FF FF and itself."""
    return ~sum(body) & 0xFF


def packet(servo: int, code: int, parameters: bytes = b"") -> bytes:
    """An instruction, or a reply with `code` its status."""
    body = bytes([servo, len(parameters) + 2, code]) + parameters
    return b"\xff\xff" + body + bytes([checksum(body)])


class ServoBus:
    """Talks to servos; every reply is checked."""

    def __init__(self, stream: Stream, timeout: float = 0.01) -> None:
        """
        Args:
            stream: An open port.
            timeout: Longest wait for one servo's reply, s.
        """
        self.stream, self.timeout = stream, timeout
        self.refused = 0  # replies with a wrong checksum

    def ping(self, servo: int) -> bool:
        """Whether it answers."""
        self._send(packet(servo, PING))
        return self._reply(servo, 0) is not None

    def read(self, servo: int, register: Register) -> int:
        """One register.

        Raises:
            DriverError: No answer, or a damaged one.
        """
        self._send(packet(servo, READ, bytes([register.address, register.size])))
        data = self._reply(servo, register.size)
        if data is None:
            raise DriverError(f"servo {servo} does not answer; is it powered and is its number {servo}?")
        return register.decode(data)

    def write(self, servo: int, register: Register, value: int) -> None:
        """One register, acknowledged."""
        self._send(packet(servo, WRITE, bytes([register.address]) + register.encode(value)))
        if self._reply(servo, 0) is None:
            raise DriverError(f"servo {servo} does not acknowledge; is it powered?")

    def sync_read(self, servos: Iterable[int], block: Register) -> dict[int, bytes]:
        """The same block of several servos in one exchange; those that did not answer well are missing."""
        servos = list(servos)
        self._send(packet(BROADCAST, SYNC_READ, bytes([block.address, block.size, *servos])))
        replies = ((servo, self._reply(servo, block.size)) for servo in servos)
        return {servo: data for servo, data in replies if data is not None}

    def sync_write(self, register: Register, values: dict[int, int]) -> None:
        """One register of several servos; nobody acknowledges."""
        parameters = b"".join(bytes([servo]) + register.encode(value) for servo, value in values.items())
        self._send(packet(BROADCAST, SYNC_WRITE, bytes([register.address, register.size]) + parameters))

    def _send(self, data: bytes) -> None:
        self.stream.reset_input_buffer()
        self.stream.write(data)

    def _reply(self, servo: int, size: int) -> bytes | None:
        """Parameters of the next reply, or None after the time-out or where it is damaged."""
        deadline = time.monotonic() + self.timeout
        head = self._bytes(4, deadline)
        while head and head[:2] != b"\xff\xff":  # noise before a packet
            more = self._bytes(1, deadline)
            head = head[1:] + more if more else b""
        if len(head) < 4 or head[3] < 2:
            return None
        rest = self._bytes(head[3], deadline)
        if len(rest) != head[3] or checksum(head[2:] + rest[:-1]) != rest[-1] or head[2] != servo:
            self.refused += 1
            return None
        return rest[1:-1] if len(rest) - 2 == size else None

    def _bytes(self, count: int, deadline: float) -> bytes:
        data = b""
        while len(data) < count and time.monotonic() < deadline:
            data += self.stream.read(count - len(data))
        return data if len(data) == count else b""
