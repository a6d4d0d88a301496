# mypy: disable-error-code="misc, type-arg, valid-type, method-assign, unused-ignore, attr-defined, assignment"
"""hg topics over cyclonedds: types for the bus, raw bytes for us. Imported when a bus is opened.

The classes below are what other participants see of our types. They carry a message as bytes: `serialize` and
`deserialize`, which cyclonedds calls on every sample, hand them through instead of walking 500 fields.

What is uint8 in Unitree's IDL is byte here: the wire is the same, and uint8 as cyclonedds 11 describes it ends every
program on libddsc 0.10, Unitree's SDK among them, with a null pointer in its discovery (eclipse-cyclonedds/cyclonedds
issue 1554; tests/hw/control/test_peers.py).
"""

import atexit
import threading
import time
from collections import defaultdict
from dataclasses import dataclass
from types import new_class
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import DriverError
from gaponet.hw.drivers import hg

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
LARGEST = 64  # KiB of a message that is put together from its parts

KINDS = {"<f4": float32, "<i2": int16, "<u4": uint32, "u1": byte}


def _struct(name: str, fields: hg.Fields, **parts: type[IdlStruct]) -> type[IdlStruct]:
    """The type of a message of drivers.hg under the name that it has in Unitree's IDL; parts: its structs, by field."""
    members = {field: (parts.get(field) or KINDS[kind], count) for field, kind, count in fields}
    hints = {field: kind if count == 1 else array[kind, count] for field, (kind, count) in members.items()}
    space = {"__annotations__": hints, "__module__": __name__}
    made = new_class(name, (IdlStruct,), {"typename": f"unitree_hg.msg.dds_.{name}_"}, lambda ns: ns.update(space))
    return annotate.autoid("sequential")(annotate.final(dataclass(made)))


IMUState, MotorState = _struct("IMUState", hg.IMU), _struct("MotorState", hg.MOTOR_STATE)
MotorCmd = _struct("MotorCmd", hg.MOTOR_CMD)
LowState = _struct("LowState", hg.LOW_STATE, imu_state=IMUState, motor_state=MotorState)
LowCmd = _struct("LowCmd", hg.LOW_CMD, motor_cmd=MotorCmd)


def raw(kind: type[IdlStruct]) -> type[IdlStruct]:
    """The same type on the bus, its samples bytes (`.data`, after the CDR header)."""

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        return hg.HEADER + self.data

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        sample = cls.__new__(cls)
        sample.data = data[len(hg.HEADER) :] if data[:2] == hg.HEADER[:2] else b""
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
        # lo does not say that it has multicast on Linux: programs on it, Unitree's SDK among them, are found by asking
        # port after port, and those that were told to use it there nevertheless by their multicast.
        lonely = interface == "lo"
        multicast = ' multicast="true"' if lonely else ""
        discovery = '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="localhost"/></Peers>'
        config = (
            f'<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="{interface}"{multicast}/>'
            f"</Interfaces><AllowMulticast>{'spdp' if lonely else 'true'}</AllowMulticast></General>"
            f"<Discovery>{discovery if lonely else ''}</Discovery>"
            # of Fast DDS, ROS 2's: its descriptions of types do not come through, and nothing would be matched
            "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
            f"<Internal><MaxSampleSize>{LARGEST} KiB</MaxSampleSize></Internal></Domain></CycloneDDS>"
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

    def reader(self, topic: str, kind: type[IdlStruct], keep: int = QUEUE) -> DataReader:
        """A reader that keeps the newest that came since the last look."""
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(keep))
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
SHUTDOWN_S = 3.0  # longest wait for the deletion of the domains at the end of a process


@atexit.register
def _delete_domains() -> None:
    """Delete the domains before the interpreter ends, or leave them to the operating system.

    In some runs cyclonedds 11.0.1 waits for ever while it deletes a domain (ddsi_stop); a command would never return.
    """

    def delete() -> None:
        for domain in _DOMAINS.values():
            domain.__del__()

    deleting = threading.Thread(target=delete, daemon=True)
    deleting.start()
    deleting.join(SHUTDOWN_S)


def send(writer: DataWriter, kind: type[IdlStruct], data: Array | bytes) -> None:
    """Publish one message."""
    sample = kind.__new__(kind)
    sample.data = bytes(data)
    try:
        writer.write(sample)
    except DDSException as error:
        raise DriverError(f"DDS refused a message: {error}") from None


def samples(reader: DataReader, most: int = QUEUE) -> list[Any]:
    """All messages since the last call, oldest first, each with bytes (`.data`) and source (`.sample_info`)."""
    try:
        return [sample for sample in reader.take(N=most) if hasattr(sample, "data")]
    except DDSException as error:
        raise DriverError(f"DDS does not give messages: {error}") from None


def receive(reader: DataReader) -> list[Array]:
    """All messages since the last call, oldest first, as bytes."""
    return [np.frombuffer(s.data, np.uint8) for s in samples(reader)]


def _interfaces() -> list[str]:
    import socket

    return [name for _, name in socket.if_nameindex()]
