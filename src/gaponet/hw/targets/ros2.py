# mypy: disable-error-code="misc, type-arg, valid-type, arg-type"
"""Targets from a ROS 2 topic and states to another, over DDS, without ROS: what ros2_control's joint trajectory
controller takes (trajectory_msgs/JointTrajectory) and its joint state broadcaster gives (sensor_msgs/JointState).

Streams, not plans: one point per message, as MoveIt Servo and teleoperation send it, in force at once. A message
without points ends the run. Types and names are those that ROS 2 puts on the bus (rt/…, …::msg::dds_::…_).
"""

import struct
import time
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl.types import float64, int32, sequence, uint32

from gaponet.hw.drivers import dds
from gaponet.hw.drivers.hg import HEADER
from gaponet.hw.targets.live import LARGEST, Heard

TOPIC = "rt/joint_trajectory_controller/joint_trajectory"
STATES = "rt/joint_states"
QUEUE = 8  # messages kept between two looks: 0.1 ms each
AHEAD = 0.2  # s after its stamp at which a point may be due; later ones belong to a plan


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    sec: int32
    nanosec: uint32


@dataclass
@annotate.final
@annotate.autoid("sequential")
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
@annotate.final
@annotate.autoid("sequential")
class JointTrajectoryPoint(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectoryPoint_"):
    positions: sequence[float64]
    velocities: sequence[float64]
    accelerations: sequence[float64]
    effort: sequence[float64]
    time_from_start: Duration


@dataclass
@annotate.final
@annotate.autoid("sequential")
class JointTrajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    header: Header
    joint_names: sequence[str]
    points: sequence[JointTrajectoryPoint]


@dataclass
@annotate.final
@annotate.autoid("sequential")
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


def encode(message: Any) -> bytes:
    """A message as plain CDR, little-endian, without its header."""
    return message.__idl__.serialize(message)[len(HEADER) :]


def decode(kind: Any, data: bytes) -> Any:
    """A message of that kind from plain CDR without its header.

    Raises:
        ValueError: It is none.
    """
    try:
        return kind.__idl__.deserialize(HEADER + data, has_header=True)
    except (struct.error, IndexError, TypeError, MemoryError, OverflowError) as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from None


class ROS2Wire:
    """A `Wire` on a DDS domain."""

    def __init__(self, domain: int = 0, interface: str = "lo", topic: str = TOPIC, states: str = STATES) -> None:
        """
        Args:
            domain: ROS_DOMAIN_ID.
            interface: Network interface.
            topic: The topic of JointTrajectory, with rt/ in front.
            states: The topic of JointState, likewise.
        """
        self.address = f"{topic}, domain {domain}, interface {interface}"
        self._bus = dds.Bus(domain, interface)
        self._reader = self._bus.reader(topic, JointTrajectory, QUEUE)
        self._writer = self._bus.writer(states, JointState)
        point = JointTrajectoryPoint([0.0], [], [], [], Duration(0, 0))  # the first of its kind takes long
        heard("", encode(JointTrajectory(Header(Time(0, 0), ""), ["joint"], [point])))

    def receive(self) -> list[Heard]:
        """Trajectories since the last look."""
        return [heard(s.sample_info.publication_handle, bytes(s.data)) for s in dds.samples(self._reader, QUEUE)]

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """A JointState of all joints, stamped with the wall clock, as ROS does, for whoever listens."""
        header = Header(Time(*divmod(time.time_ns(), 10**9)), "")
        message = JointState(header, list(state["joint_names"]), state["qpos"], state["qvel"], state["tau"])
        dds.send(self._writer, JointState, encode(message))

    def close(self, why: str) -> None:
        """Leave the bus."""
        self._bus = self._reader = self._writer = None  # type: ignore[assignment]


def heard(sender: Hashable, data: bytes) -> Heard:
    """What a JointTrajectory says."""
    if len(data) > LARGEST:
        return Heard(sender, wrong=f"has more than {LARGEST} bytes")
    try:
        said = decode(JointTrajectory, data)
    except ValueError as error:
        return Heard(sender, wrong=str(error))
    stamp, names = said.header.stamp, said.joint_names
    at = stamp.sec + 1e-9 * stamp.nanosec or None  # 0: at once
    if not said.points:
        return Heard(sender, at, end=True)
    point, due = said.points[0], said.points[-1].time_from_start
    if len(said.points) > 1 or due.sec + 1e-9 * due.nanosec > AHEAD:
        return Heard(sender, wrong=f"a plan; send one point per message, due within {AHEAD:g} s")
    if len(point.positions) != len(names) or len(set(names)) != len(names):
        return Heard(sender, wrong=f"{len(point.positions)} positions for {len(set(names))} joints")
    return Heard(sender, at, dict(zip(names, point.positions, strict=True)))
