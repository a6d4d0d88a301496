"""A ROS 2 node without gaponet, as MoveIt Servo streams: ROS_DOMAIN_ID=DOMAIN python rclpy_peer.py
[JOINT [SECONDS]]

Begins when it hears a JointState, moves one joint (the first) by 0.2 rad and back about where it
was heard, one point a message, and ends the run by a message without points; prints the last state
and what the joint did as JSON.
"""

import json
import math
import sys
import time

import rclpy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

rclpy.init()
node = rclpy.create_node("servo")
states = []
seconds = float((sys.argv[2:] or ["1"])[0])
told = node.create_publisher(JointTrajectory, "/joint_trajectory_controller/joint_trajectory", 10)
node.create_subscription(JointState, "/joint_states", states.append, 10)


def tell(joints, *points):
    message = JointTrajectory(joint_names=joints, points=points)
    message.header.stamp = node.get_clock().now().to_msg()
    told.publish(message)


deadline = time.monotonic() + 60
while not states and time.monotonic() < deadline:
    rclpy.spin_once(node, timeout_sec=0.1)
joint = (sys.argv[1:] or states[0].name)[0]
at = states[0].name.index(joint)
begun = time.monotonic()
heard = []
while (t := time.monotonic() - begun) < seconds:
    target = states[0].position[at] + 0.1 - 0.1 * math.cos(2 * math.pi * t / seconds)
    tell([joint], JointTrajectoryPoint(positions=[target]))
    until = time.monotonic() + 0.02
    while time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.005)
    heard.append(states[-1].position[at] - states[0].position[at])
tell([joint])
rclpy.spin_once(node, timeout_sec=0.5)
fields = ("name", "position", "velocity", "effort")
print(
    json.dumps(
        {f: list(getattr(states[-1], f)) for f in fields}
        | {"moved": max(heard), "targets": len(heard)}
    )
)
