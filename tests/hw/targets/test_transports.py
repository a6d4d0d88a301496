"""Transports of live targets: JSON over ZeroMQ and through a pipe, ROS 2's messages on a real DDS
bus.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from environments import environment

from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError
from gaponet.hw.targets.message import MAX_MESSAGE_BYTES, Message
from gaponet.hw.targets.pipe import PipeTransport

STATE = {
    "time": 7.0,
    "joint_names": ("a", "b"),
    "commanded": ("b",),
    "qpos": [0.1, 0.2],
    "qvel": [0, 0],
    "tau": [1, 2],
}


def received(transport, count, seconds=20.0):
    """At least that many messages."""
    found = []
    deadline = time.monotonic() + seconds
    while len(found) < count and time.monotonic() < deadline:
        found += transport.receive()
        time.sleep(0.002)
    return found


def free_port():
    """A port of this machine that nobody listens at."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


@pytest.fixture
def listening():
    zeromq = pytest.importorskip("gaponet.hw.targets.zeromq")
    transport = zeromq.ZeroMQTransport(f"tcp://127.0.0.1:{free_port()}")
    yield transport
    transport.close("over")


def test_a_policy_takes_states_sends_targets_and_hears_why_it_is_over(listening):
    from gaponet.hw.targets.client import RemoteRobot

    with RemoteRobot(listening.address, patience=20.0) as robot:
        with pytest.raises(DriverError, match="state"):
            robot.send(np.zeros(2))
        (hello,) = received(listening, 1)
        assert not hello.target
        listening.publish(hello.sender, STATE)
        states = iter(robot)
        state = next(states)
        assert (robot.joint_names, robot.commanded) == (("a", "b"), ("b",))
        np.testing.assert_array_equal(state.qpos, STATE["qpos"])
        robot.send(state.qpos + 1)
        robot.send({"b": 3})
        one, other = received(listening, 2)
        assert (one.target, other.target) == ({"b": 1.2}, {"b": 3.0})
        assert one.sender == other.sender == hello.sender
        assert hello.time < one.time < other.time
        listening.close("damped")
        assert list(states) == []
        assert robot.ended == "damped"


def test_a_policy_that_stalled_finds_the_newest_state_and_why_the_run_is_over(listening):
    from gaponet.hw.targets.client import RemoteRobot

    with RemoteRobot(listening.address, patience=20.0) as robot:
        (hello,) = received(listening, 1)
        for k in range(500):
            listening.publish(hello.sender, STATE | {"time": float(k)})
            time.sleep(0.001)
        time.sleep(1.0)
        states = iter(robot)
        assert next(states).time == 499.0
        for _ in range(500):
            listening.publish(hello.sender, STATE)
            time.sleep(0.001)
        listening.close("no target was accepted")
        time.sleep(1.0)  # the transport is gone before the policy looks again
        assert list(states) == []
        assert robot.ended == "no target was accepted"


def test_a_policy_that_leaves_ends_the_run_and_one_that_crashes_does_not(listening):
    from gaponet.hw.targets.client import RemoteRobot

    with pytest.raises(ZeroDivisionError), RemoteRobot(listening.address):
        raise ZeroDivisionError
    with RemoteRobot(listening.address):
        pass
    said = received(listening, 3)
    assert [m.end for m in said] == [False, False, True]
    assert len({m.sender for m in said}) == 2


@pytest.fixture
def dealer(listening):
    """A function that returns a socket which is connected to the transport."""
    import zmq

    context = zmq.Context()

    def connect():
        socket = context.socket(zmq.DEALER)
        socket.connect(listening.address)
        return socket

    yield connect
    context.destroy(linger=0)


def test_a_stranger_who_says_too_much_is_cut_off_and_nobody_else(listening, dealer):
    stranger = dealer()
    sender = dealer()
    stranger.send(b"x" * (MAX_MESSAGE_BYTES + 1))
    stranger.send_multipart([b"", b"\x80\x04pickle"])
    sender.send(json.dumps({"time": 1.0, "target": {"a": 0.5}}).encode())
    found = received(listening, 1) + received(listening, 1, 0.5)
    assert [m.target for m in found if not m.error] == [{"a": 0.5}]
    assert len(listening.receive()) == 0
    listening.publish(b"nobody", STATE)


def test_no_more_messages_are_taken_at_a_look_than_a_period_can_bear(listening, dealer):
    sender = dealer()
    counts = [0]
    for k in range(300):
        sender.send(json.dumps({"time": k}).encode())
    deadline = time.monotonic() + 20
    while sum(counts) < 300 and time.monotonic() < deadline:
        counts.append(len(listening.receive()))
    assert sum(counts) == 300
    assert max(counts) <= 64


def test_of_a_flood_through_a_pipe_the_newest_lines_are_read():
    read, write = os.pipe()
    os.write(write, b"".join(b'{"time": %d}\n' % k for k in range(300)))
    flood, *messages = PipeTransport(read).receive()
    assert "236 older lines were not read" in flood.error
    assert [message.time for message in messages] == list(range(236, 300))


def test_two_cannot_listen_at_one_address(listening):
    from gaponet.hw.targets.zeromq import ZeroMQTransport

    with pytest.raises(UsageError, match="listen"):
        ZeroMQTransport(listening.address)


def test_lines_through_a_pipe_may_come_in_parts_be_too_long_and_cease():
    read, write = os.pipe()
    transport = PipeTransport(read)
    assert transport.receive() == []
    line = b'{"time": 1, "target": {"a": 0.5}}\n'
    os.write(write, line[:7])
    assert transport.receive() == []
    os.write(write, line[7:] + line[:-1])
    assert transport.receive() == [Message("stdin", 1.0, {"a": 0.5})]
    os.write(write, b"\n")
    assert len(transport.receive()) == 1
    os.write(write, b"x" * (MAX_MESSAGE_BYTES + 1))
    assert "has more than" in transport.receive()[0].error
    os.write(write, b"x" * 100 + b'"time": 9}\n' + line)
    assert [m.target for m in transport.receive()] == [{"a": 0.5}]
    os.write(write, b'{"time": 2, "end": true}')
    assert transport.receive() == []
    os.close(write)
    last, closed = transport.receive()
    assert last.end, "a program need not end its last line"
    assert "closed the pipe" in closed.error
    assert transport.receive() == []
    os.close(read)


def trajectory(names, positions, stamp=(5, 7), due=20_000_000, points=1):
    """CDR of a JointTrajectory by rosbags, whose reader and writer of ROS messages are its own."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types
    header = kind["std_msgs/msg/Header"](kind["builtin_interfaces/msg/Time"](*stamp), "base")
    none = np.array([])
    due = kind["builtin_interfaces/msg/Duration"](0, due)
    point = kind["trajectory_msgs/msg/JointTrajectoryPoint"](
        np.array(positions, float), none, none, none, due
    )
    message = kind["trajectory_msgs/msg/JointTrajectory"](header, list(names), [point] * points)
    return bytes(store.serialize_cdr(message, "trajectory_msgs/msg/JointTrajectory"))


@pytest.fixture(scope="module")
def ros2():
    pytest.importorskip("rosbags", reason="pip install 'gaponet[ros]'")
    return pytest.importorskip("gaponet.hw.targets.ros2", reason="pip install 'gaponet[dds]'")


def test_ros_messages_are_on_the_wire_as_another_library_has_them(ros2):
    from rosbags.typesys import Stores, get_typestore

    data = trajectory(["left", "right_elbow"], [0.1, -0.2])
    said = ros2.decode(ros2.JointTrajectory, data[4:])
    assert ros2.encode(said) == data[4:]
    assert ros2.to_message("a", data[4:]) == Message(
        "a", 5 + 7e-9, {"left": 0.1, "right_elbow": -0.2}
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    state = ros2.JointState(
        ros2.Header(ros2.Time(3, 4), ""), ["left", "b"], [0.1, 0.2], [1.0, 2.0], []
    )
    read = store.deserialize_cdr(data[:4] + ros2.encode(state), "sensor_msgs/msg/JointState")
    assert (read.header.stamp.sec, read.name, read.velocity.tolist()) == (
        3,
        ["left", "b"],
        [1.0, 2.0],
    )
    assert bytes(store.serialize_cdr(read, "sensor_msgs/msg/JointState"))[4:] == ros2.encode(state)


def test_plans_and_what_is_no_trajectory_are_refused(ros2):
    def said(*given, **options):
        return ros2.to_message("a", trajectory(*given, **options)[4:])

    assert "a plan" in said("ab", [1, 2], points=2).error
    assert "a plan" in said("ab", [1, 2], due=900_000_000).error
    assert "1 positions for 2 joints" in said("ab", [1]).error
    assert "2 positions for 1 joints" in said("aa", [1, 2]).error
    assert said("ab", [1, 2], stamp=(0, 0)).time is None
    assert said("ab", [], points=0).end
    whole = trajectory("ab", [1, 2])[4:]
    assert "has more than" in ros2.to_message("a", whole + bytes(MAX_MESSAGE_BYTES)).error
    rng = np.random.default_rng(0)
    for cut in range(len(whole)):
        broken = bytearray(whole[: cut + 1])
        broken[rng.integers(len(broken))] = rng.integers(256)
        message = ros2.to_message("a", bytes(broken))
        assert message.error or message.end or message.target is not None


def test_a_trajectory_on_the_bus_arrives_and_states_are_published(ros2):
    from gaponet.hw.drivers import dds

    domain = 30 + os.getpid() % 150
    transport = ros2.ROS2Transport(domain)
    bus = dds.Bus(domain, "lo")
    writer = bus.writer(ros2.TOPIC, ros2.JointTrajectory)
    reader = bus.reader(ros2.STATES_TOPIC, ros2.JointState)
    found = []
    states = []
    deadline = time.monotonic() + 60
    while not (found and states) and time.monotonic() < deadline:
        writer.send(trajectory("ab", [0.25, -0.5])[4:])
        transport.publish(None, STATE)
        found += transport.receive()
        states += reader.receive()
        time.sleep(0.01)
    transport.close("over")
    assert (found[-1].error, found[-1].target) == ("", {"a": 0.25, "b": -0.5})
    state = ros2.decode(ros2.JointState, bytes(states[-1]))
    assert (state.name, state.position, state.effort) == (["a", "b"], [0.1, 0.2], [1.0, 2.0])


def test_a_second_publisher_of_targets_on_the_bus_is_seen_before_it_says_anything(ros2):
    from gaponet.hw.drivers import dds

    domain = 30 + os.getpid() % 150
    transport = ros2.ROS2Transport(domain)
    buses = [dds.Bus(domain, "lo") for _ in range(2)]
    writers = [bus.writer(ros2.TOPIC, ros2.JointTrajectory) for bus in buses]
    deadline = time.monotonic() + 60
    while len(transport.senders()) < len(writers) and time.monotonic() < deadline:
        time.sleep(0.01)

    assert len(transport.senders()) == 2
    transport.close("over")


ROS_PACKAGES = ("rclpy", "rmw-fastrtps-cpp", "sensor-msgs", "trajectory-msgs")


@pytest.fixture(scope="module", params=["jazzy", "kilted"])
def talk(ros2, request):
    """What a node of rclpy has heard of us, and our messages of it: on Fast DDS, whose descriptions
    of types Cyclone DDS does not take.
    """
    version = request.param
    packages = [f"ros-{version}-{name}" for name in ROS_PACKAGES]
    python = environment(f"ros-{version}", "3.12", tuple(packages))
    domain = 30 + os.getpid() % 150
    there = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    transport = ros2.ROS2Transport(domain)
    command = [python, Path(__file__).with_name("rclpy_peer.py"), "b"]
    peer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **there})
    try:
        found = []
        deadline = time.monotonic() + 60
        while peer.poll() is None and time.monotonic() < deadline:
            transport.publish(None, STATE)
            found += transport.receive()
            time.sleep(0.01)
        assert peer.stdout
        return json.loads(peer.stdout.read()), found
    finally:
        peer.kill()
        peer.wait()
        transport.close("over")


@pytest.mark.peers
def test_ros_2_itself_hears_us(talk):
    said, _ = talk
    expected = {
        "name": ["a", "b"],
        "position": [0.1, 0.2],
        "velocity": [0.0, 0.0],
        "effort": [1.0, 2.0],
    }
    assert said.items() >= expected.items()
    assert said["targets"] > 5


@pytest.mark.peers
def test_ros_2_itself_is_heard(talk):
    _, found = talk
    assert [m.error for m in found if m.error] == []
    assert len({m.sender for m in found}) == 1
    assert [m.time for m in found] == sorted(m.time for m in found)
    assert found[-1].end


@pytest.mark.peers
def test_targets_from_ros_2_itself_are_those_of_its_node(talk):
    _, found = talk
    targets = [m.target["b"] for m in found if m.target]
    assert len(targets) > 5
    assert 0.2 <= min(targets) < 0.25
    assert 0.35 < max(targets) <= 0.4
