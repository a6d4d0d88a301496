"""Feetech's servo bus (STS series, protocol 0): packets over any byte stream, and the registers of
an STS3215.

A packet is FF FF id length instruction parameters… checksum; a reply has a status byte in place of
the instruction. Numbers are little-endian; velocity and load are sign and magnitude. From Feetech's
public memory table (STS3215) and protocol manual. Tested against buses that answer by the same
documents, well and badly; not against servos.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from serial import Serial

PING = 1
READ = 2
WRITE = 3
SYNC_READ = 0x82
SYNC_WRITE = 0x83
BROADCAST = 0xFE
# Meaning of the status bits; bit 4 says that the torque is on.
ERRORS = (
    "voltage",
    "angle sensor",
    "overheat",
    "overcurrent",
    "",
    "overload",
)
FAULTY = sum(1 << bit for bit, word in enumerate(ERRORS) if word)
RETRIES = 2  # of a read, as LeRobot's num_read_retries
REQUEST_TAGS = 8  # lengths of replies, by which the requests that they answer are told apart
MAX_REPLY_BYTES = 64  # behind the length byte of a reply
REMEMBERED_REQUESTS = 16  # by which echoes of what was sent here are known
MAX_BYTES_RATIO = 4  # of received to requested bytes, after which a request is given up


@dataclass(frozen=True)
class Register:
    """Register of a servo: address, size in bytes, and number of its sign bit (None: unsigned)."""

    address: int
    size: int
    sign: int | None = None

    def value_in(self, block: Register, data: bytes) -> int:
        """Return the value of this register in the bytes of a block that contains it."""
        start = self.address - block.address
        return self.decode(data[start : start + self.size])

    def decode(self, data: bytes) -> int:
        """Return the value of little-endian bytes."""
        value = int.from_bytes(data, "little")
        if self.sign is not None and value >> self.sign & 1:
            return -(value & (1 << self.sign) - 1)
        return value

    def encode(self, value: int) -> bytes:
        """Return the little-endian bytes of a value."""
        if value < 0:
            assert self.sign is not None
            value = -value | 1 << self.sign
        return value.to_bytes(self.size, "little")


MODEL = Register(3, 2)
MIN_POSITION = Register(9, 2)  # goals are cut to these two
MAX_POSITION = Register(11, 2)
MAX_TORQUE = Register(16, 2)  # 0.1 %; of TORQUE_LIMIT at power-up
P = Register(21, 1)
D = Register(22, 1)
I = Register(23, 1)  # noqa: E741
PROTECTION_CURRENT = Register(28, 2)  # 6.5 mA
HOMING_OFFSET = Register(31, 2, 11)  # position = encoder − this
MODE = Register(33, 1)  # 0: position
TORQUE_ENABLE = Register(40, 1)
ACCELERATION = Register(41, 1)  # of the servo's own path to a goal, 100 steps/s²; 0: none
GOAL_POSITION = Register(42, 2, 15)
GOAL_VELOCITY = Register(46, 2, 15)  # of that path, steps/s; 0: none
TORQUE_LIMIT = Register(48, 2)  # 0.1 %
PRESENT_POSITION = Register(56, 2, 15)
PRESENT_VELOCITY = Register(58, 2, 15)
PRESENT_LOAD = Register(60, 2, 10)  # 0.1 % of full drive
PRESENT_VOLTAGE = Register(62, 1)  # 0.1 V
PRESENT_TEMPERATURE = Register(63, 1)  # °C
PRESENT_CURRENT = Register(69, 2, 15)  # 6.5 mA
SETTINGS = Register(3, 31)  # block from MODEL to MODE
RUNNING = Register(40, 31)  # block from TORQUE_ENABLE to PRESENT_CURRENT
STS3215 = 777  # model number


def checksum(body: bytes) -> int:
    """Return the inverted sum of all bytes between FF FF and the checksum."""
    return ~sum(body) & 0xFF


def packet(servo: int, code: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction, or of a reply, whose code is its status."""
    body = bytes([servo, len(parameters) + 2, code]) + parameters
    return b"\xff\xff" + body + bytes([checksum(body)])


class ServoBus:
    """Sends requests to servos and checks every reply.

    Attributes:
        refused: Number of replies with a wrong checksum.
        errors: Servo → error bits of all its replies so far.
        foreign: Number of intact packets that another program must have caused: requests that were
            not sent here, and replies of a length that nobody here has asked for.
    """

    def __init__(self, stream: Serial, timeout: float = 0.01) -> None:
        """Send over a port; missing replies are given up after `timeout` s of silence."""
        self.stream = stream
        self.timeout = timeout
        self.refused = 0
        self.errors: dict[int, int] = {}
        self.foreign = 0
        self._tag = 0
        self._sizes: set[int] = set()  # bytes of all replies that were asked for
        self._sent: deque[bytes] = deque(maxlen=REMEMBERED_REQUESTS)  # requests

    def sync_read(
        self, servos: Iterable[int], block: Register, retries: int = RETRIES
    ) -> dict[int, bytes]:
        """Return a block of each of several servos; servos without an intact reply are missing.

        What is missing after a silence is requested again. A reply does not name its request. So
        successive requests are for 0 to 7 bytes more than needed: the length of a reply shows which
        request it answers, and a late reply to an earlier call is not taken for it.
        """
        missing = list(servos)
        replies = dict[int, bytes]()
        sizes = set[int]()
        for _ in range(1 + retries):
            self._tag = (self._tag + 1) % REQUEST_TAGS
            size = block.size + self._tag
            sizes.add(size)
            self._sizes.add(size)
            request = packet(BROADCAST, SYNC_READ, bytes([block.address, size, *missing]))
            self._discard_input()
            self._send(request)
            replies |= self._replies(missing, size, sizes, request)
            missing = [servo for servo in missing if servo not in replies]
            if not missing:
                break
        return {servo: data[: block.size] for servo, data in replies.items()}

    def sync_write(self, register: Register, values: dict[int, int]) -> None:
        """Write one register of several servos; they do not acknowledge it."""
        parameters = bytes([register.address, register.size])
        for servo, value in values.items():
            parameters += bytes([servo]) + register.encode(value)
        self._send(packet(BROADCAST, SYNC_WRITE, parameters))

    def broadcast(self, register: Register, value: int) -> None:
        """Write one register of all servos on the bus; they do not acknowledge it."""
        self._send(packet(BROADCAST, WRITE, bytes([register.address]) + register.encode(value)))

    def _send(self, request: bytes) -> None:
        self._sent.append(request)
        self.stream.write(request)

    def _discard_input(self) -> None:
        """Empty the input buffer; count what another program has caused in it."""
        waiting = self.stream.in_waiting
        data = self.stream.read(waiting) if waiting else b""
        while (start := data.find(b"\xff\xff")) >= 0 and len(data) >= start + 6:
            end = start + 4 + data[start + 3]
            body = data[start + 2 : end]
            intact = len(data) >= end and len(body) > 3 and checksum(body[:-1]) == body[-1]
            if intact:
                self._count_foreign(body)
            data = data[end if intact else start + 1 :]
        self.stream.reset_input_buffer()

    def _count_foreign(self, body: bytes) -> None:
        """Count an intact packet, without FF FF, that no request of ours explains."""
        if b"\xff\xff" + body in self._sent:
            return
        if body[0] == BROADCAST or body[1] - 2 not in self._sizes:
            self.foreign += 1

    def _replies(
        self, servos: list[int], expected: int, sizes: set[int], request: bytes
    ) -> dict[int, bytes]:
        """Return intact replies of these servos, in any order, until all have come or nothing more
        comes.

        An adapter with one wire for both directions echoes the request, which is then skipped.
        """
        replies: dict[int, bytes] = {}
        data = b""
        reply_bytes = expected + 6
        patience = MAX_BYTES_RATIO * reply_bytes * len(servos)  # bytes
        silent = time.monotonic() + self.timeout
        while len(replies) < len(servos) and patience > 0:
            wanted = (len(servos) - len(replies)) * reply_bytes - len(data)
            more = self.stream.read(max(1, wanted))
            if more:
                silent = time.monotonic() + self.timeout
            elif time.monotonic() >= silent:
                break
            patience -= len(more)
            bodies, data = self._intact_bodies(data + more, servos)
            for body in bodies:
                if body == request[2:]:
                    continue
                self._count_foreign(body)
                servo = body[0]
                self.errors[servo] = self.errors.get(servo, 0) | body[2]
                if servo in servos and body[1] - 2 in sizes:
                    replies[servo] = body[3:-1]
        return replies

    def _intact_bodies(self, data: bytes, servos: list[int]) -> tuple[list[bytes], bytes]:
        """Return the intact packets in some bytes, without FF FF, and the bytes that are left.

        What is left may be the beginning of a packet.
        """
        bodies = []
        while (start := data.find(b"\xff\xff")) >= 0 and len(data) >= start + 6:
            length = data[start + 3]
            body = data[start + 2 : start + 4 + length]
            if not 2 <= length <= MAX_REPLY_BYTES:
                data = data[start + 1 :]
            elif len(body) < 2 + length:
                break
            elif checksum(body[:-1]) != body[-1]:
                self.refused += body[0] in servos
                data = data[start + 1 :]  # the next packet may begin within the damaged one
            else:
                bodies.append(body)
                data = data[start + 2 + len(body) :]
        return bodies, data
