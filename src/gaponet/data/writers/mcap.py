"""Dataset → ROS 2 bags: a folder with an MCAP file per recording, for any tool that reads JointState.

/joint_states has position, velocity and effort (N·m, where it was recorded), /joint_commands the commanded position;
row t of both has the same stamp. What the messages have no place for stays behind; unit, payload and gains stand in the
sheet.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.store import Dataset
from gaponet.data.writers import Tell, Written
from gaponet.robot.spec import RobotSpec

SHEET = True

START = 10**9  # ns: a stamp of 0 would mean that there is none
KIND = "sensor_msgs/msg/JointState"


def write(dataset: Dataset, robot: RobotSpec, folder: Path, tell: Tell) -> list[Written]:
    """One bag per recording."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = store.types
    none, names = np.zeros(0), list(dataset.joint_names)
    written = []
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        ctrl, qpos, qvel = (np.asarray(x, float) for x in (sequence.ctrl, sequence.qpos, sequence.qvel))
        tau = None if sequence.tau is None else np.asarray(sequence.tau, float)
        with Writer(folder / entry.id, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            state, command = (
                bag.add_connection(t, KIND, typestore=store) for t in ("/joint_states", "/joint_commands")
            )
            for t in range(len(sequence)):
                now = START + round(1e9 * sequence.dt * t)
                stamp = types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
                header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
                for topic, values in (
                    (state, (qpos[t], qvel[t], none if tau is None else tau[t])), (command, (ctrl[t], none, none)),
                ):  # fmt: skip
                    position, velocity, effort = values
                    message = types[KIND](
                        header=header, name=names, position=position, velocity=velocity, effort=effort
                    )
                    bag.write(topic, now, store.serialize_cdr(message, KIND))
        written.append(Written(Path(entry.id), 1, len(sequence), sequence.rate))
        tell(entry.meta.motion)
    return written
