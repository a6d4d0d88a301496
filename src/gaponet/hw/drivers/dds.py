# mypy: disable-error-code="misc, type-arg, valid-type, method-assign, unused-ignore"
# mypy: disable-error-code="attr-defined, assignment"
"""Unitree's hg topics over cyclonedds: IDL types for the bus, bytes for this package.

Imported when a bus is opened.

Other participants see the classes below as the types of our topics. Messages are bytes: `serialize`
and `deserialize`, which cyclonedds calls on every sample, pass them through instead of walking 500
fields.

uint8 of Unitree's IDL is byte here. On the wire both are the same. uint8 as cyclonedds 11 describes
it ends every program on libddsc 0.10, Unitree's SDK among them, with a null pointer in its
discovery (eclipse-cyclonedds/cyclonedds issue 1554; tests/hw/control/test_peers.py).
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
from gaponet.base.installation import install_command
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
    raise DriverError(f"cyclonedds is not installed; run: {install_command('dds')}") from None

QUEUE_LENGTH = 64  # messages buffered between two reads: 128 ms at 500 Hz
MAX_SAMPLE_KIB = 64  # of a message that is put together from fragments
DISCOVERY_S = 0.5  # in which other participants are heard
MAX_ENTRIES = 500  # of discovery that are read
NAMELESS = "a program that does not tell its name"
SHUTDOWN_S = 3.0  # longest wait for the deletion of the domains at the end of a process
HANDLE_MASK = (1 << 64) - 1  # cyclonedds gives a handle now with a sign, now without
SCALARS = {"<f4": float32, "<i2": int16, "<u4": uint32, "u1": byte}


def make_struct(typename: str, **fields: Any) -> Any:
    """Return a final IDL struct; fields: name → IDL type."""
    space = {"__annotations__": fields, "__module__": __name__}
    name = typename.replace(".", ":").rpartition(":")[2].rstrip("_")
    made = new_class(name, (IdlStruct,), {"typename": typename}, lambda ns: ns.update(space))
    return annotate.autoid("sequential")(annotate.final(dataclass(made)))


def _struct(name: str, fields: hg.Fields, **parts: type[IdlStruct]) -> type[IdlStruct]:
    """Return the IDL type of a message of drivers.hg under its name in Unitree's IDL.

    parts: its structs, by field.
    """
    hints = {}
    for field, scalar, count in fields:
        kind = parts.get(field) or SCALARS[scalar]
        hints[field] = kind if count == 1 else array[kind, count]
    result: type[IdlStruct] = make_struct(f"unitree_hg.msg.dds_.{name}_", **hints)
    return result


IMUState = _struct("IMUState", hg.IMU)
MotorState = _struct("MotorState", hg.MOTOR_STATE)
MotorCmd = _struct("MotorCmd", hg.MOTOR_CMD)
LowState = _struct("LowState", hg.LOW_STATE, imu_state=IMUState, motor_state=MotorState)
LowCmd = _struct("LowCmd", hg.LOW_CMD, motor_cmd=MotorCmd)


def as_bytes(kind: type[IdlStruct]) -> type[IdlStruct]:
    """Change a type so that its samples are bytes (`.data`, after the CDR header).

    On the bus it stays the same.
    """

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        result: bytes = hg.HEADER + self.data
        return result

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        sample = cls.__new__(cls)
        sample.data = data[len(hg.HEADER) :] if data[:2] == hg.HEADER[:2] else b""
        return sample

    kind.serialize = serialize
    kind.deserialize = classmethod(deserialize)
    return kind


class Writer:
    """Publishes messages of one topic."""

    def __init__(self, writer: DataWriter, kind: type[IdlStruct]) -> None:
        self._writer = writer
        self._kind = kind

    def send(self, data: Array | bytes) -> None:
        """Publish one message.

        Raises:
            DriverError: DDS refuses it.
        """
        sample = self._kind.__new__(self._kind)
        sample.data = bytes(data)
        try:
            self._writer.write(sample)
        except DDSException as error:
            raise DriverError(f"DDS refused a message: {error}") from None


class Reader:
    """Receives messages of one topic and buffers the newest ones."""

    def __init__(self, reader: DataReader, queue_length: int) -> None:
        self._reader = reader
        self._queue_length = queue_length

    def samples(self) -> list[Any]:
        """Return the samples since the last call, oldest first: bytes (`.data`) and source
        (`.sample_info`).

        Raises:
            DriverError: DDS fails.
        """
        try:
            taken = self._reader.take(N=self._queue_length)
        except DDSException as error:
            raise DriverError(f"DDS does not give messages: {error}") from None
        return [sample for sample in taken if hasattr(sample, "data")]

    def receive(self) -> list[Array]:
        """Return the messages since the last call, oldest first, as arrays of bytes."""
        return [np.frombuffer(sample.data, np.uint8) for sample in self.samples()]

    def receive_with_publisher(self) -> list[tuple[int, Array]]:
        """Return the messages since the last call, oldest first: publisher's handle and array of
        bytes.
        """
        messages = []
        for sample in self.samples():
            handle = sample.sample_info.publication_handle & HANDLE_MASK
            messages.append((handle, np.frombuffer(sample.data, np.uint8)))
        return messages

    def publishers(self) -> set[int]:
        """Return the handles of the publishers of the topic that are connected now.

        Takes some µs.
        """
        try:
            handles = self._reader.get_matched_publications()
        except DDSException as error:
            raise DriverError(f"DDS does not say who publishes: {error}") from None
        return {handle & HANDLE_MASK for handle in handles}

    def describe(self, handle: int) -> str:
        """Return a publisher in words: its program, and the GUID of its DDS writer."""
        signed = handle - (1 << 64) if handle >> 63 else handle
        try:
            publication = self._reader.get_matched_publication_data(signed)
        except DDSException:
            publication = None
        if publication is None:
            return "a publisher that has left"
        participant = self._reader.participant
        assert participant is not None
        names = _programs(participant)
        program = names.get(publication.participant_key, NAMELESS)
        return f"{program}, DDS writer {publication.key}"


class Bus:
    """One participant in a DDS domain, on one network interface."""

    def __init__(self, domain: int, interface: str) -> None:
        """
        Args:
            domain: 0 on a Unitree robot.
            interface: Network interface that reaches the robot: eth0, enp3s0…, lo for a robot on
                this machine.

        Raises:
            DriverError: There is no such interface, DDS does not start on it, or this process uses
                the domain on another one.
        """
        if interface not in _interfaces():
            raise DriverError(
                f"no network interface '{interface}' here; there are {', '.join(_interfaces())}"
            )
        used = _INTERFACES.get(domain, interface)
        if used != interface:
            raise DriverError(
                f"this process uses DDS domain {domain} on {used} already, and cannot use it on "
                f"{interface} too: it would reach the robot on {used}. Start another process for "
                f"{interface}"
            )
        try:
            if domain not in _DOMAINS:
                _DOMAINS[domain] = Domain(domain, _configuration(interface))
                _INTERFACES[domain] = interface
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise DriverError(
                f"DDS on {interface} does not start: {error}; is the interface up?"
            ) from None
        self._topics: dict[str, Topic] = {}

    def writer(self, topic: str, kind: type[IdlStruct]) -> Writer:
        """Return a writer as Unitree's SDK makes it: reliable, the newest sample only."""
        return Writer(DataWriter(self._participant, self._topic(topic, kind)), kind)

    def reader(
        self,
        topic: str,
        kind: type[IdlStruct],
        queue_length: int = QUEUE_LENGTH,
        of_others: bool = False,
    ) -> Reader:
        """Return a reader that buffers the newest messages since the last call.

        Args:
            of_others: Leave out what this participant itself publishes.
        """
        policies = [Policy.Reliability.BestEffort, Policy.History.KeepLast(queue_length)]
        if of_others:
            policies.append(Policy.IgnoreLocal.Participant)
        qos = Qos(*policies)
        return Reader(DataReader(self._participant, self._topic(topic, kind), qos), queue_length)

    def _topic(self, name: str, kind: type[IdlStruct]) -> Topic:
        if name not in self._topics:
            self._topics[name] = Topic(self._participant, name, as_bytes(kind))
        return self._topics[name]

    def publishers(self) -> defaultdict[str, list[str]]:
        """Return the other publishers, which takes DISCOVERY_S: topic → programs, as they call
        themselves.
        """
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        time.sleep(DISCOVERY_S)
        names = _programs(self._participant)
        publishers: defaultdict[str, list[str]] = defaultdict(list)
        for entry in publications.read(N=MAX_ENTRIES):
            if hasattr(entry, "topic_name") and entry.participant_key != self._participant.guid:
                name = names.get(entry.participant_key, NAMELESS)
                publishers[entry.topic_name].append(name)
        return publishers


def _configuration(interface: str) -> str:
    """Return cyclonedds' configuration for one network interface.

    lo has no multicast on Linux by its own account. Programs on it, Unitree's SDK among them, are
    found by asking port after port; programs that were configured to use multicast there
    nevertheless are found by that.
    """
    loopback = interface == "lo"
    multicast = ' multicast="true"' if loopback else ""
    discovery = (
        '<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="localhost"/></Peers>'
    )
    return (
        '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface '
        f'name="{interface}"{multicast}/>'
        f"</Interfaces><AllowMulticast>{'spdp' if loopback else 'true'}</AllowMulticast></General>"
        f"<Discovery>{discovery if loopback else ''}</Discovery>"
        # Type descriptions of Fast DDS, which ROS 2 uses, do not come through; without this nothing
        # would be matched.
        "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
        f"<Internal><MaxSampleSize>{MAX_SAMPLE_KIB} "
        "KiB</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


def _programs(participant: DomainParticipant) -> dict[Any, str]:
    """Return the names of all participants, as they call themselves, by their keys."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant

    entries = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant).read(N=MAX_ENTRIES)
    return {entry.key: _program(entry.qos) for entry in entries if hasattr(entry, "key")}


def _program(qos: Qos) -> str:
    """Return name, process and machine of a participant, as far as it tells them."""
    properties = {policy.key: policy.value for policy in qos if isinstance(policy, Policy.Property)}
    name = properties.get("__ProcessName", "?")
    pid = properties.get("__Pid", "?")
    host = properties.get("__Hostname", "?")
    return f"{name} (process {pid} on {host})"


def _interfaces() -> list[str]:
    import socket

    return [name for _, name in socket.if_nameindex()]


_DOMAINS: dict[int, Domain] = {}  # a domain is configured once per process
_INTERFACES: dict[int, str] = {}  # on which each of them is


@atexit.register
def _delete_domains() -> None:
    """Delete the domains before the interpreter ends, or leave them to the operating system.

    In some runs cyclonedds 11.0.1 waits for ever while it deletes a domain (ddsi_stop); a command
    would never return.
    """

    def delete() -> None:
        for domain in _DOMAINS.values():
            domain.__del__()

    deleting = threading.Thread(target=delete, daemon=True)
    deleting.start()
    deleting.join(SHUTDOWN_S)
