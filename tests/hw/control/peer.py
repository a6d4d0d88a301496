"""The other end of the wire: a program on Unitree's public IDL and the cyclonedds 0.10.2 that its
SDK pins. No gaponet.

    python peer.py robot|client DOMAIN SECONDS

robot: rt/lowstate at 100 Hz, joints follow rt/arm_sdk. client: hears rt/lowstate, swings an elbow
over rt/arm_sdk. Both use the SDK's own configuration of the bus for interface lo, and print one
JSON line at the end. Runs in an environment of its own (test_peers.py).
"""

import json
import math
import random
import struct
import sys
import time
from dataclasses import dataclass, fields, is_dataclass

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl.types import array, float32, int16, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

CONFIG = """<?xml version="1.0" encoding="UTF-8" ?>
<CycloneDDS><Domain Id="any"><General><Interfaces>
<NetworkInterface name="lo" priority="default" multicast="default" />
</Interfaces></General></Domain></CycloneDDS>"""
ELBOW = 16
WEIGHT = 27
MOTORS = 27


@dataclass
@annotate.final
@annotate.autoid("sequential")
class IMUState(IdlStruct, typename="unitree_hg.msg.dds_.IMUState_"):
    quaternion: array[float32, 4]
    gyroscope: array[float32, 3]
    accelerometer: array[float32, 3]
    rpy: array[float32, 3]
    temperature: int16


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MotorState(IdlStruct, typename="unitree_hg.msg.dds_.MotorState_"):
    mode: uint8
    q: float32
    dq: float32
    ddq: float32
    tau_est: float32
    temperature: array[int16, 2]
    vol: float32
    sensor: array[uint32, 2]
    motorstate: uint32
    reserve: array[uint32, 4]


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MotorCmd(IdlStruct, typename="unitree_hg.msg.dds_.MotorCmd_"):
    mode: uint8
    q: float32
    dq: float32
    tau: float32
    kp: float32
    kd: float32
    reserve: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class LowState(IdlStruct, typename="unitree_hg.msg.dds_.LowState_"):
    version: array[uint32, 2]
    mode_pr: uint8
    mode_machine: uint8
    tick: uint32
    imu_state: IMUState
    motor_state: array[MotorState, 35]
    wireless_remote: array[uint8, 40]
    reserve: array[uint32, 4]
    crc: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class LowCmd(IdlStruct, typename="unitree_hg.msg.dds_.LowCmd_"):
    mode_pr: uint8
    mode_machine: uint8
    motor_cmd: array[MotorCmd, 35]
    reserve: array[uint32, 4]
    crc: uint32


def crc(packed: bytes) -> int:
    """CRC-32/MPEG-2 over 32-bit words, highest byte first."""
    value = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", packed):
        for shift in (24, 16, 8, 0):
            value = (value << 8 & 0xFFFFFFFF) ^ TABLE[value >> 24 ^ word >> shift & 0xFF]
    return value


def entry(byte: int) -> int:
    value = byte << 24
    for _ in range(8):
        value = (value << 1 & 0xFFFFFFFF) ^ (0x04C11DB7 if value >> 31 else 0)
    return value


TABLE = [entry(byte) for byte in range(256)]


def numbers(value: object) -> list:
    """All numbers of a message in turn."""
    if isinstance(value, (list, tuple, bytes)):  # an array of uint8 may come as bytes
        return [n for part in value for n in numbers(part)]
    return (
        numbers([getattr(value, f.name) for f in fields(value)]) if is_dataclass(value) else [value]
    )


def packed(message: LowState | LowCmd) -> bytes:
    """The C struct of a message without its checksum."""
    state = "<2IBB2xI13fh2x" + 35 * "B3x4f2hf7I" + "40B4I"
    layout = state if isinstance(message, LowState) else "<BB2x" + 35 * "B3x5fI" + "4I"
    return struct.pack(layout, *numbers(message)[:-1])


def robot(part: DomainParticipant, seconds: float) -> dict:
    """Be an H1-2 that nobody pushes: commanded joints follow by their weight, all readings are a
    little noisy.
    """
    writer = DataWriter(part, Topic(part, "rt/lowstate", LowState))
    reader = DataReader(part, Topic(part, "rt/arm_sdk", LowCmd))
    q = [0.0] * MOTORS
    heard = 0
    wrong = 0
    last = None
    stiff = 0.0
    start = time.monotonic()
    q[13] = 0.2
    q[20] = 0.2
    state = LowState(
        [1, 0],
        0,
        6,
        0,
        IMUState([1.0, 0, 0, 0], [0.0] * 3, [0.0] * 3, [0.0] * 3, 30),
        [MotorState(0, 0, 0, 0, 0, [0, 0], 0, [0, 0], 0, [0] * 4) for _ in range(35)],
        [0] * 40,
        [0] * 4,
        0,
    )
    while (now := time.monotonic() - start) < seconds:
        for command in reader.take(N=10):
            if not isinstance(command, LowCmd):
                continue
            heard = heard + 1
            last = command.motor_cmd[WEIGHT].q
            wrong += command.crc != crc(packed(command))
            stiff = max(stiff, max(m.kp for m in command.motor_cmd))
            for k in range(13, MOTORS):
                if command.motor_cmd[k].kp > 0:
                    q[k] += last * (command.motor_cmd[k].q - q[k])
        state.tick = int(now * 1000)
        for k in range(MOTORS):
            m = state.motor_state[k]
            noise = random.gauss(0, 1)
            m.mode = 1
            m.q = q[k] + 1e-5 * noise
            m.dq = 1e-3 * noise
            m.tau_est = 0.1 * noise
            m.temperature = [35, 36]
        state.crc = crc(packed(state))
        writer.write(state)
        time.sleep(max(0.0, 0.01 - (time.monotonic() - start - now)))
    return {"commands": heard, "wrong_crc": wrong, "last_weight": last, "largest_kp": stiff}


def client(part: DomainParticipant, seconds: float) -> dict:
    """Hear states, and swing the left elbow once they come."""
    writer = DataWriter(part, Topic(part, "rt/arm_sdk", LowCmd))
    reader = DataReader(part, Topic(part, "rt/lowstate", LowState))
    heard = 0
    wrong = 0
    home = None
    moved = 0.0
    start = time.monotonic()
    while (now := time.monotonic() - start) < seconds:
        newest = None
        for state in reader.take(N=100):
            if isinstance(state, LowState):
                heard = heard + 1
                newest = state
        if newest is not None:
            wrong += newest.crc != crc(packed(newest))
            home = home or ([m.q for m in newest.motor_state], now)
            moved = max(moved, abs(newest.motor_state[ELBOW].q - home[0][ELBOW]))
            command = LowCmd(
                0,
                newest.mode_machine,
                [MotorCmd(0, 0, 0, 0, 0, 0, 0) for _ in range(35)],
                [0] * 4,
                0,
            )
            for k in range(13, MOTORS):
                command.motor_cmd[k] = MotorCmd(1, home[0][k], 0.0, 0.0, 60.0, 2.0, 0)
            command.motor_cmd[ELBOW].q += 0.3 * math.sin(now - home[1])
            command.motor_cmd[WEIGHT].q = min(1.0, (now - home[1]) / 2)
            command.crc = crc(packed(command))
            writer.write(command)
        time.sleep(0.02)
    return {"states": heard, "wrong_crc": wrong, "moved": moved}


if __name__ == "__main__":
    kind, number, lasting = sys.argv[1:]
    domain = Domain(int(number), CONFIG)
    end = {"robot": robot, "client": client}[kind](DomainParticipant(int(number)), float(lasting))
    print(json.dumps(end), flush=True)
