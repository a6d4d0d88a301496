# mypy: disable-error-code="type-arg, valid-type, method-assign, unused-ignore, attr-defined, assignment"
"""hg topics over cyclonedds: types for the bus, raw bytes for us. Imported when a bus is opened.

The classes below are what other participants see of our types. They carry a message as bytes: `serialize` and
`deserialize`, which cyclonedds calls on every sample, hand them through instead of walking 500 fields.

What is uint8 in Unitree's IDL is byte here: the wire is the same, and uint8 as cyclonedds 11 describes it ends every
program on libddsc 0.10, Unitree's SDK among them, with a null pointer in its discovery (eclipse-cyclonedds/cyclonedds
issue 1554; tests/deploy/test_peers.py).
"""

import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.arrays import Array
from gaponet.deploy.driver import DriverError
from gaponet.deploy.drivers.hg import HEADER

try:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl import annotations as annotate
    from cyclonedds.idl.types import array, byte, float32, int16, uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError:
    raise DriverError("cyclonedds is not installed; run: pip install 'gaponet[dds]'") from None

QUEUE = 64  # messages kept for us between two reads: 128 ms at 500 Hz


@dataclass
@annotate.final
@annotate.autoid("sequential")
class IMUState(IdlStruct, typename="unitree_hg.msg.dds_.IMUState_"):
    """Attitude of the pelvis."""

    quaternion: array[float32, 4]
    gyroscope: array[float32, 3]
    accelerometer: array[float32, 3]
    rpy: array[float32, 3]
    temperature: int16


@dataclass
@annotate.final
@annotate.autoid("sequential")
class MotorState(IdlStruct, typename="unitree_hg.msg.dds_.MotorState_"):
    """What a motor says."""

    mode: byte
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
    """What a motor is told."""

    mode: byte
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
    """rt/lowstate."""

    version: array[uint32, 2]
    mode_pr: byte
    mode_machine: byte
    tick: uint32
    imu_state: IMUState
    motor_state: array[MotorState, 35]
    wireless_remote: array[byte, 40]
    reserve: array[uint32, 4]
    crc: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class LowCmd(IdlStruct, typename="unitree_hg.msg.dds_.LowCmd_"):
    """rt/lowcmd and rt/arm_sdk."""

    mode_pr: byte
    mode_machine: byte
    motor_cmd: array[MotorCmd, 35]
    reserve: array[uint32, 4]
    crc: uint32


def raw(kind: type[IdlStruct]) -> type[IdlStruct]:
    """The same type on the bus, its samples bytes (`.data`, after the CDR header)."""

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        return HEADER + self.data

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        sample = cls.__new__(cls)
        sample.data = data[len(HEADER) :] if data[:2] == HEADER[:2] else b""
        return sample

    kind.serialize = serialize
    kind.deserialize = classmethod(deserialize)
    return kind


class Bus:
    """One participant in a DDS domain, on one network interface."""

    def __init__(self, domain: int, interface: str) -> None:
        """
        Args:
            domain: 0 on a Unitree robot.
            interface: Network interface that reaches the robot: eth0, enp3s0…, lo for a robot on this machine.
        """
        if interface not in _interfaces():
            raise DriverError(f"no network interface '{interface}' here; there are {', '.join(_interfaces())}")
        # lo has no multicast on Linux: programs on it, Unitree's SDK among them, are found by asking port after port.
        lonely = interface == "lo"
        discovery = '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="localhost"/></Peers>'
        config = (
            f'<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="{interface}"/></Interfaces>'
            f"<AllowMulticast>{str(not lonely).lower()}</AllowMulticast></General>"
            f"<Discovery>{discovery if lonely else ''}</Discovery></Domain></CycloneDDS>"
        )
        try:
            self._domain = (
                _DOMAINS[domain] if domain in _DOMAINS else _DOMAINS.setdefault(domain, Domain(domain, config))
            )
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise DriverError(f"DDS on {interface} does not start: {error}; is the interface up?") from None
        self._topics: dict[str, Topic] = {}

    def writer(self, topic: str, kind: type[IdlStruct]) -> DataWriter:
        """A writer as Unitree's SDK makes it: reliable, the newest sample only."""
        return DataWriter(self._participant, self._topic(topic, kind))

    def reader(self, topic: str, kind: type[IdlStruct]) -> DataReader:
        """A reader that keeps what came since the last look."""
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(QUEUE))
        return DataReader(self._participant, self._topic(topic, kind), qos)

    def _topic(self, name: str, kind: type[IdlStruct]) -> Topic:
        if name not in self._topics:
            self._topics[name] = Topic(self._participant, name, raw(kind))
        return self._topics[name]

    def publishers(self, wait: float = 0.5) -> defaultdict[str, list[str]]:
        """Who else publishes what, after listening for `wait` s: topic → programs, as they call themselves."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication

        programs = BuiltinDataReader(self._participant, BuiltinTopicDcpsParticipant)
        publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        time.sleep(wait)
        names = {e.key: _program(e.qos) for e in programs.read(N=500) if hasattr(e, "key")}
        found: defaultdict[str, list[str]] = defaultdict(list)
        for entry in publications.read(N=500):
            if hasattr(entry, "topic_name") and entry.participant_key != self._participant.guid:
                found[entry.topic_name].append(
                    names.get(entry.participant_key, "a program that does not tell its name")
                )
        return found


def _program(qos: Qos) -> str:
    """Name, process and machine of a participant, where it tells them."""
    told = {policy.key: policy.value for policy in qos if isinstance(policy, Policy.Property)}
    name, pid, host = (told.get(f"__{key}", "?") for key in ("ProcessName", "Pid", "Hostname"))
    return f"{name} (process {pid} on {host})"


_DOMAINS: dict[int, Domain] = {}  # a domain is configured once per process


def send(writer: DataWriter, kind: type[IdlStruct], data: Array) -> None:
    """Publish one message."""
    sample = kind.__new__(kind)
    sample.data = data.tobytes()
    try:
        writer.write(sample)
    except DDSException as error:
        raise DriverError(f"DDS refused a message: {error}") from None


def receive(reader: DataReader) -> list[Array]:
    """All messages since the last call, oldest first, as bytes."""
    try:
        samples = reader.take(N=QUEUE)
    except DDSException as error:
        raise DriverError(f"DDS does not give messages: {error}") from None
    return [np.frombuffer(s.data, np.uint8) for s in samples if hasattr(s, "data")]


def _interfaces() -> list[str]:
    import socket

    return [name for _, name in socket.if_nameindex()]
