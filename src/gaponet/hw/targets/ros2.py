# mypy: disable-error-code="misc, type-arg, valid-type"
"""Targets from a ROS 2 topic and states to another, over DDS, without ROS.

Messages are those of ros2_control: its joint trajectory controller receives
trajectory_msgs/JointTrajectory, its joint state broadcaster sends sensor_msgs/JointState. Each
message has one point, as MoveIt Servo and teleoperation send it, and takes effect at once. A
message without points ends the run. Types and topics have the names that ROS 2 uses on DDS (rt/…,
…::msg::dds_::…_).
"""

import struct
import time
from collections.abc import Hashable
from typing import Any

from cyclonedds.idl.types import float64, int32, sequence, uint32

from gaponet.hw.drivers import dds
from gaponet.hw.drivers.hg import HEADER
from gaponet.hw.targets.message import MAX_MESSAGE_BYTES, Message

TOPIC = "rt/joint_trajectory_controller/joint_trajectory"
STATES_TOPIC = "rt/joint_states"
QUEUE_LENGTH = 8  # messages buffered between two calls; decoding one takes 0.1 ms
MAX_TIME_FROM_START_S = 0.2  # later points belong to a planned trajectory

Time = dds.make_struct("builtin_interfaces::msg::dds_::Time_", sec=int32, nanosec=uint32)
Duration = dds.make_struct("builtin_interfaces::msg::dds_::Duration_", sec=int32, nanosec=uint32)
Header = dds.make_struct("std_msgs::msg::dds_::Header_", stamp=Time, frame_id=str)
JointTrajectoryPoint = dds.make_struct(
    "trajectory_msgs::msg::dds_::JointTrajectoryPoint_",
    positions=sequence[float64],
    velocities=sequence[float64],
    accelerations=sequence[float64],
    effort=sequence[float64],
    time_from_start=Duration,
)
JointTrajectory = dds.make_struct(
    "trajectory_msgs::msg::dds_::JointTrajectory_",
    header=Header,
    joint_names=sequence[str],
    points=sequence[JointTrajectoryPoint],
)
JointState = dds.make_struct(
    "sensor_msgs::msg::dds_::JointState_",
    header=Header,
    name=sequence[str],
    position=sequence[float64],
    velocity=sequence[float64],
    effort=sequence[float64],
)


def encode(message: Any) -> bytes:
    """Return a message as plain CDR, little-endian, without its header."""
    result: bytes = message.__idl__.serialize(message)[len(HEADER) :]
    return result


def decode(kind: Any, data: bytes) -> Any:
    """Return a message of that type from plain CDR without its header.

    Raises:
        ValueError: The bytes are not such a message.
    """
    try:
        return kind.__idl__.deserialize(HEADER + data, has_header=True)
    except (struct.error, IndexError, TypeError, MemoryError, OverflowError) as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from None


class ROS2Transport:
    """A `Transport` on a DDS domain."""

    def __init__(
        self, domain: int = 0, interface: str = "lo", topic: str = TOPIC, states: str = STATES_TOPIC
    ) -> None:
        """Join the domain ROS_DOMAIN_ID.

        Topics, of JointTrajectory and of JointState, have the prefix rt/.
        """
        self.address = f"{topic}, domain {domain}, interface {interface}"
        self._bus = dds.Bus(domain, interface)
        self._reader = self._bus.reader(topic, JointTrajectory, QUEUE_LENGTH)
        self._writer = self._bus.writer(states, JointState)
        # Decoding the first one takes long.
        point = JointTrajectoryPoint([0.0], [], [], [], Duration(0, 0))
        to_message("", encode(JointTrajectory(Header(Time(0, 0), ""), ["joint"], [point])))

    def receive(self) -> list[Message]:
        """Return the messages since the last call."""
        messages = self._reader.receive_with_publisher()
        return [to_message(publisher, bytes(data)) for publisher, data in messages]

    def senders(self) -> set[Hashable]:
        """Return the publishers of the topic, also those that have not sent a message."""
        return set(self._reader.publishers())

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Publish a JointState of all joints, stamped with the wall clock, as ROS does."""
        header = Header(Time(*divmod(time.time_ns(), 10**9)), "")
        message = JointState(
            header, list(state["joint_names"]), state["qpos"], state["qvel"], state["tau"]
        )
        self._writer.send(encode(message))

    def close(self, reason: str) -> None:
        """Leave the bus."""
        self._bus = None  # type: ignore[assignment]
        self._reader = None  # type: ignore[assignment]
        self._writer = None  # type: ignore[assignment]


def to_message(sender: Hashable, data: bytes) -> Message:
    """Return the content of a JointTrajectory (plain CDR without its header)."""
    if len(data) > MAX_MESSAGE_BYTES:
        return Message(sender, error=f"has more than {MAX_MESSAGE_BYTES} bytes")
    try:
        trajectory = decode(JointTrajectory, data)
    except ValueError as error:
        return Message(sender, error=str(error))
    stamp = trajectory.header.stamp
    names = trajectory.joint_names
    points = trajectory.points
    time_s = stamp.sec + 1e-9 * stamp.nanosec or None  # 0: no clock
    if not points:
        return Message(sender, time_s, end=True)
    due = points[-1].time_from_start
    if len(points) > 1 or due.sec + 1e-9 * due.nanosec > MAX_TIME_FROM_START_S:
        return Message(
            sender,
            error=f"a plan; send one point per message, due within {MAX_TIME_FROM_START_S:g} s",
        )
    positions = points[0].positions
    if len(positions) != len(names) or len(set(names)) != len(names):
        return Message(sender, error=f"{len(positions)} positions for {len(set(names))} joints")
    return Message(sender, time_s, dict(zip(names, positions, strict=True)))
