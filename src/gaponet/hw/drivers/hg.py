"""Unitree's hg messages (H1-2, G1) as arrays of bytes: layout on the wire and under the checksum,
and the checksum.

LowState and LowCmd have a fixed size, so that all motors' values of a field are read or written at
once: 5 µs per message instead of 2 ms field by field, of the 2 ms between two states at 500 Hz.

Fields and types are those of Unitree's public IDL (unitree_sdk2, unitree_hg). On the wire they are
little-endian CDR without padding at the end of a struct. The checksum is CRC-32/MPEG-2 over the
32-bit words of the C struct, which has padding. Tested against the serialiser of cyclonedds and a
CRC written bit by bit; not against a robot.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from gaponet.base.arrays import Array

Fields = list[tuple[str, Any, int]]  # name, scalar type or Fields, count

MOTORS = 35  # slots in a message; H1-2 uses 27
HEADER = b"\x00\x01\x00\x00"  # plain CDR, little endian

IMU: Fields = [
    ("quaternion", "<f4", 4),
    ("gyroscope", "<f4", 3),
    ("accelerometer", "<f4", 3),
    ("rpy", "<f4", 3),
    ("temperature", "<i2", 1),
]
MOTOR_STATE: Fields = [
    ("mode", "u1", 1),
    ("q", "<f4", 1),
    ("dq", "<f4", 1),
    ("ddq", "<f4", 1),
    ("tau_est", "<f4", 1),
    ("temperature", "<i2", 2),
    ("vol", "<f4", 1),
    ("sensor", "<u4", 2),
    ("motorstate", "<u4", 1),
    ("reserve", "<u4", 4),
]
MOTOR_CMD: Fields = [
    ("mode", "u1", 1),
    ("q", "<f4", 1),
    ("dq", "<f4", 1),
    ("tau", "<f4", 1),
    ("kp", "<f4", 1),
    ("kd", "<f4", 1),
    ("reserve", "<u4", 1),
]
LOW_STATE: Fields = [
    ("version", "<u4", 2),
    ("mode_pr", "u1", 1),
    ("mode_machine", "u1", 1),
    ("tick", "<u4", 1),
    ("imu_state", IMU, 1),
    ("motor_state", MOTOR_STATE, MOTORS),
    ("wireless_remote", "u1", 40),
    ("reserve", "<u4", 4),
    ("crc", "<u4", 1),
]
LOW_CMD: Fields = [
    ("mode_pr", "u1", 1),
    ("mode_machine", "u1", 1),
    ("motor_cmd", MOTOR_CMD, MOTORS),
    ("reserve", "<u4", 4),
    ("crc", "<u4", 1),
]


def flatten(
    fields: Fields, start: int, padded: bool, prefix: str = ""
) -> tuple[list[tuple[str, str, int, int]], int]:
    """Return every scalar field as (path, type, count, offset), and the offset after the last.

    Args:
        fields: Fields of a struct.
        start: Offset at which it begins.
        padded: Pad as C does (structs begin and end at multiples of 4), else as CDR does (only
            scalars are aligned).
    """
    out: list[tuple[str, str, int, int]] = []
    at = start
    for name, kind, count in fields:
        if isinstance(kind, str):
            size = np.dtype(kind).itemsize
            at += -at % size
            out.append((prefix + name, kind, count, at))
            at += size * count
            continue
        for i in range(count):
            at += -at % 4 if padded else 0
            part, at = flatten(
                kind, at, padded, f"{prefix}{name}[{i}]." if count > 1 else f"{prefix}{name}."
            )
            out += part
    return out, at + (-at % 4 if padded else 0)


class Message:
    """Layout of a fixed-size message: fields of all motors at once, other fields, and the
    checksum.

    Attributes:
        layout: Path of a field, as `flatten` names it → kind, count, and offset on the wire.
        wire_size: Bytes on the wire.
        packed_size: Bytes of the C struct, with padding.
        columns: Name of a motor's field → its offset on the wire for each motor.
    """

    def __init__(self, fields: Fields, motors: str) -> None:
        wire, self.wire_size = flatten(fields, 0, padded=False)
        packed, self.packed_size = flatten(fields, 0, padded=True)
        self.layout = {path: (kind, count, offset) for path, kind, count, offset in wire}
        names = [path.split(".")[-1] for path, *_ in wire if path.startswith(f"{motors}[1].")]
        # From the second motor on, slots repeat every `stride` bytes; the first may begin closer to
        # what precedes it.
        self.columns = {}
        for name in names:
            offsets = [self.layout[f"{motors}[{i}].{name}"][2] for i in range(MOTORS)]
            self.columns[name] = np.array(offsets)
        self._gather = self._bytes(wire, packed)

    def _bytes(
        self, wire: list[tuple[str, str, int, int]], packed: list[tuple[str, str, int, int]]
    ) -> Array:
        """Return the wire offset of every byte of the padded struct.

        Padding points behind the message, at a 0.
        """
        source = np.full(self.packed_size, self.wire_size)
        for (_, kind, count, at), (_, _, _, to) in zip(wire, packed, strict=True):
            size = np.dtype(kind).itemsize * count
            source[to : to + size] = np.arange(at, at + size)
        words = source.reshape(-1, 4)[:-1]  # the last word is the checksum itself
        return np.ascontiguousarray(words[:, ::-1]).ravel()  # each word from its highest byte on

    def new(self) -> Array:
        """Return an empty message, (wire_size,) bytes."""
        return np.zeros(self.wire_size, np.uint8)

    def view(self, data: Array, path: str) -> Array:
        """Return a field outside the motors as a writable view, (count,)."""
        kind, count, at = self.layout[path]
        return data[at : at + np.dtype(kind).itemsize * count].view(kind)

    def motors(self, data: Array, name: str) -> Array:
        """Return a field of all motors, (35,) or (35, count), as a copy."""
        kind, count, _ = self.layout[self._path(name)]
        size = np.dtype(kind).itemsize * count
        values = np.ascontiguousarray(data[self.columns[name][:, None] + np.arange(size)]).view(
            kind
        )
        return values[:, 0] if count == 1 else values

    def set_motors(self, data: Array, name: str, values: Array) -> None:
        """Write a field of all motors, (35,) or (35, count)."""
        kind, count, _ = self.layout[self._path(name)]
        table = np.ascontiguousarray(np.asarray(values, kind).reshape(MOTORS, count)).view(np.uint8)
        data[self.columns[name][:, None] + np.arange(table.shape[1])] = table

    def _path(self, name: str) -> str:
        return next(path for path in self.layout if path.endswith(f"[0].{name}"))

    def checksum(self, data: Array) -> int:
        """Return CRC-32/MPEG-2 of the C struct's words: polynomial 0x04c11db7, start 0xffffffff,
        highest bit first.
        """
        ordered = np.append(data, np.uint8(0))[self._gather]
        # Zlib's is the same with all bits mirrored.
        mirrored = zlib.crc32(MIRRORED_BYTES[ordered].tobytes()) ^ 0xFFFFFFFF
        return int(f"{mirrored:032b}"[::-1], 2)

    def seal(self, data: Array) -> None:
        """Write the checksum."""
        self.view(data, "crc")[0] = self.checksum(data)

    def intact(self, data: Array) -> bool:
        """Return True if the checksum is right."""
        return int(self.view(data, "crc")[0]) == self.checksum(data)


MIRRORED_BYTES = np.array([int(f"{b:08b}"[::-1], 2) for b in range(256)], np.uint8)
LowState = Message(LOW_STATE, "motor_state")
LowCmd = Message(LOW_CMD, "motor_cmd")
