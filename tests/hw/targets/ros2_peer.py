"""A ROS 2 node, as far as the bus can tell, without gaponet: python ros2_peer.py DOMAIN

Streams one-point trajectories of joints a and b until it has heard a JointState, prints that as JSON and ends.
"""

import json
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

CONFIG = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>
<Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class Stamp(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Span(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    sec: int32
    nanosec: uint32


@dataclass
class Head(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Stamp
    frame_id: str


@dataclass
class Point(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectoryPoint_"):
    positions: sequence[float64]
    velocities: sequence[float64]
    accelerations: sequence[float64]
    effort: sequence[float64]
    time_from_start: Span


@dataclass
class Trajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    header: Head
    joint_names: sequence[str]
    points: sequence[Point]


@dataclass
class State(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Head
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


def main(domain: int) -> None:
    bus = Domain(domain, CONFIG)
    part = DomainParticipant(domain)
    reliable = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))  # as rclcpp has it
    topic = Topic(part, "rt/joint_trajectory_controller/joint_trajectory", Trajectory)
    writer = DataWriter(part, topic, reliable)
    reader = DataReader(part, Topic(part, "rt/joint_states", State), reliable)
    state = None
    for k in range(3000):
        stamp = Stamp(*divmod(time.time_ns(), 10**9))
        point = Point([0.25, -0.5], [], [], [], Span(0, 20_000_000))
        writer.write(Trajectory(Head(stamp, ""), ["a", "b"], [point]))
        state = next((s for s in reader.take(N=10) if isinstance(s, State)), state)
        if state is not None and k > 50:
            break
        time.sleep(0.01)
    assert state
    print(json.dumps({name: getattr(state, name) for name in ("name", "position", "velocity", "effort")}))
    del bus


if __name__ == "__main__":
    sys.path.pop(0)
    main(int(sys.argv[1]))
