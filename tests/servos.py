"""Six servos as Feetech's public documents describe them, written apart from the package: the
outside of the bus.

`Servos` answers bytes with bytes; `Wire` is a serial port with them at its other end, without any
time: a reply is there as soon as a request was written. `adversary` may change what a servo says.
"""

from __future__ import annotations

import os
import select
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# address, bytes: from Feetech's memory table
REGISTERS = {
    "model": (3, 2), "id": (5, 1), "low": (9, 2), "high": (11, 2), "max_torque": (16, 2),
    "p": (21, 1), "d": (22, 1), "i": (23, 1), "homing": (31, 2), "mode": (33, 1),
    "torque": (40, 1), "acceleration": (41, 1), "goal": (42, 2), "speed": (46, 2),
    "torque_limit": (48, 2), "position": (56, 2), "voltage": (62, 1), "celsius": (63, 1),
}  # fmt: skip
FACTS = {  # of each servo
    "model": 777, "low": 1000, "high": 3000, "max_torque": 1000, "p": 16, "d": 32,
    "torque_limit": 1000, "position": 2000, "voltage": 120, "celsius": 30,
}  # fmt: skip
Adversary = Callable[[int, bytes], bytes]  # servo, its reply → what reaches the driver


class Servos:
    """Numbers 1 to 6, ideal: where a goal is sent with torque on, the position is at once."""

    def __init__(self) -> None:
        self.table = [bytearray(128) for _ in range(6)]
        self.status = [0] * 6
        self.heard: list[bytes] = []  # whole requests
        self.adversary: Adversary = lambda servo, reply: reply
        self._pending = b""
        for number in range(1, 7):
            self.set(number, "id", number)
            for name, value in FACTS.items():
                self.set(number, name, value)

    def get(self, servo: int, name: str) -> int:
        at, size = REGISTERS[name]
        return int.from_bytes(self.table[servo - 1][at : at + size], "little")

    def set(self, servo: int, name: str, value: int) -> None:
        at, size = REGISTERS[name]
        self.table[servo - 1][at : at + size] = value.to_bytes(size, "little")

    def silence(self, *numbers: int) -> None:
        """Let these servos answer no more."""
        self.adversary = lambda servo, reply: b"" if servo in numbers else reply

    def answer(self, data: bytes) -> bytes:
        """What the servos say to these bytes."""
        self._pending += data
        said = b""
        while True:
            at = self._pending.find(b"\xff\xff")
            if (
                at < 0
                or len(self._pending) < at + 4
                or len(self._pending) < at + 4 + self._pending[at + 3]
            ):
                return said
            end = at + 4 + self._pending[at + 3]
            request = self._pending[at:end]
            self._pending = self._pending[end:]
            assert sum(request[2:]) % 256 == 255, "the request's checksum is wrong"
            self.heard.append(request)
            said += self.obey(request[2], request[4], request[5:-1])

    def obey(self, who: int, instruction: int, words: bytes) -> bytes:
        everyone = range(1, 7)
        if instruction == 0x82:  # sync read
            return b"".join(
                self._reply(s, self.table[s - 1][words[0] : words[0] + words[1]]) for s in words[2:]
            )
        if instruction == 0x83:  # sync write
            step = words[1] + 1
            for at in range(2, len(words), step):
                self._store(words[at], words[0], words[at + 1 : at + step])
            return b""
        if instruction == 3:
            for servo in everyone if who == 0xFE else (who,):
                self._store(servo, words[0], words[1:])
        if who not in everyone:
            return b""
        return self._reply(
            who, self.table[who - 1][words[0] : words[0] + words[1]] if instruction == 2 else b""
        )

    def _store(self, servo: int, at: int, data: bytes) -> None:
        self.table[servo - 1][at : at + len(data)] = data
        if self.get(servo, "torque"):
            self.set(
                servo,
                "position",
                min(max(self.get(servo, "goal"), self.get(servo, "low")), self.get(servo, "high")),
            )

    def _reply(self, servo: int, data: bytes) -> bytes:
        body = bytes([servo, len(data) + 2, self.status[servo - 1]]) + bytes(data)
        return self.adversary(servo, b"\xff\xff" + body + bytes([255 - sum(body) % 256]))


class Wire:
    """A serial port at whose other end servos answer at once."""

    def __init__(self, servos: Servos) -> None:
        self.servos = servos
        self.buffer = b""
        self.lost = False

    def _there(self) -> None:
        if self.lost:
            raise OSError(5, "Input/output error")

    @property
    def in_waiting(self) -> int:
        self._there()
        return len(self.buffer)

    def read(self, size: int = 1) -> bytes:
        self._there()
        out = self.buffer[:size]
        self.buffer = self.buffer[size:]
        return out

    def write(self, data: bytes) -> int:
        self._there()
        self.buffer += self.servos.answer(data)
        return len(data)

    def reset_input_buffer(self) -> None:
        self._there()
        self.buffer = b""

    def close(self) -> None:
        pass


@contextmanager
def on_port(servos: Servos) -> Iterator[str]:
    """A pseudo-terminal at which the servos answer, from a thread; yields its name."""
    master, slave = os.openpty()
    tty.setraw(slave)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            if select.select([master], [], [], 0.1)[0]:
                os.write(master, servos.answer(os.read(master, 4096)))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        over.set()
        thread.join()
        os.close(master)
        os.close(slave)
