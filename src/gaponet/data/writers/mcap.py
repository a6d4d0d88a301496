"""Dataset → ROS 2 bags: a folder with an MCAP file per recording, for any tool that reads JointState.

/joint_states has position, velocity and effort (N·m, where it was recorded), /joint_commands the commanded position;
row t of both has the same stamp. The sheet holds unit, payload and gains. Other channels are not written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.store import Entry
from gaponet.robot.spec import RobotSpec

SHEET = True

START = 10**9  # ns: a stamp of 0 would mean that there is none
KIND = "sensor_msgs/msg/JointState"


def write_recording(entry: Entry, sequence: Sequence, robot: RobotSpec, folder: Path) -> Path:
    """Write one bag."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = store.types
    none, names = np.zeros(0), list(sequence.joint_names)
    ctrl, qpos, qvel = (np.asarray(x, float) for x in (sequence.ctrl, sequence.qpos, sequence.qvel))
    tau = np.zeros((len(sequence), 0)) if sequence.tau is None else np.asarray(sequence.tau, float)
    with Writer(folder / entry.id, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        state, command = (
            bag.add_connection(t, KIND, typestore=store)
            for t in ("/joint_states", "/joint_commands")
        )
        for t in range(len(sequence)):
            now = START + round(1e9 * sequence.dt * t)
            stamp = types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            for topic, values in (
                (state, (qpos[t], qvel[t], tau[t])),
                (command, (ctrl[t], none, none)),
            ):
                bag.write(
                    topic, now, store.serialize_cdr(types[KIND](header, names, *values), KIND)
                )
    return Path(entry.id)
