"""The same two-joint motion in the files of other tools, for tests of readers and for fuzzing."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from logs import late, wave

ROWS = 40
JOINTS = ("shoulder", "elbow")
TOML = 'joints = ["shoulder", "elbow"]\n'


def motion(rows: int = ROWS) -> tuple[np.ndarray, np.ndarray]:
    """Commands and positions (rows, 2)."""
    ctrl = wave(rows, 2, 0.02)
    return ctrl, late(ctrl, 2)


def write_npz(folder: Path, rows: int = ROWS) -> None:
    """A plain one."""
    ctrl, qpos = motion(rows)
    np.savez(
        folder / "a.npz",
        target=ctrl,
        q=qpos,
        time=0.02 * np.arange(rows),
        joint_names=np.array(JOINTS),
    )
    (folder / "logs.toml").write_text(
        'ctrl = "target"\nqpos = "q"\ntime_unit = "s"\nposition_unit = "rad"\n'
    )


def write_gaponet(folder: Path, rows: int = ROWS, objects: bool = True) -> None:
    """GAPONet's own motion file of two motions: arrays of objects, or one padded array."""
    ctrl, qpos = motion(rows)
    parts = {
        "real_dof_positions_cmd": ctrl,
        "real_dof_positions": qpos,
        "real_dof_velocities": 0 * qpos,
    }
    pad = lambda x: np.concatenate([x, np.zeros((5, 2))])  # noqa: E731
    stack = {k: np.stack([pad(v), pad(v[::-1])]) for k, v in parts.items()}
    if objects:
        for name, x in parts.items():
            stack[name] = np.empty(2, object)
            stack[name][:] = [x, x[::-1][:-3]]
    np.savez(
        folder / "a.npz",
        **stack,
        joint_sequence=np.array(JOINTS, object),
        payloads=np.array([0.0, 0.2]),
    )
    (folder / "logs.toml").write_text("rate = 50.0\n")


def write_aloha(folder: Path, rows: int = ROWS) -> None:
    """An ALOHA episode."""
    import h5py

    ctrl, qpos = motion(rows)
    with h5py.File(folder / "episode_0.hdf5", "w") as file:
        file["action"] = ctrl
        file["observations/qpos"] = qpos
        file["observations/qvel"] = 0 * qpos
        file["observations/images/top"] = np.zeros((rows, 2, 2, 3), np.uint8)
    (folder / "logs.toml").write_text("rate = 50.0\n" + TOML)


def write_mat(folder: Path, rows: int = ROWS) -> None:
    """A struct and a clock."""
    from scipy.io import savemat

    ctrl, qpos = motion(rows)
    savemat(folder / "a.mat", {"log": {"cmd": ctrl, "q": qpos}, "t": 20.0 * np.arange(rows)})
    (folder / "logs.toml").write_text(
        TOML
        + 'time = "t"\ntime_unit = "ms"\nposition_unit = "rad"\nctrl = "log.cmd"\nqpos = "log.q"\n'
    )


def write_pace(folder: Path, rows: int = ROWS) -> None:
    """A dictionary of tensors, and of gains as NumPy arrays, as newer ones of PACE's collectors
    are.
    """
    import torch

    ctrl, qpos = map(torch.tensor, motion(rows))
    gains = {"kp": np.array([20.0, 30.0]), "kd": np.array([1.0, 1.5])}
    torch.save(
        {"time": 0.02 * torch.arange(rows), "dof_pos": qpos, "des_dof_pos": ctrl} | gains,
        folder / "a.pt",
    )
    (folder / "logs.toml").write_text(TOML)


def write_asap(folder: Path, rows: int = ROWS) -> None:
    """Actions as ASAP's policy gives them: a quarter of them is added to home."""
    ctrl, qpos = motion(rows)
    (folder / "a.pkl").write_bytes(
        pickle.dumps({"walk": {"dof": qpos, "action": ctrl / 0.25, "fps": 50}})
    )
    (folder / "logs.toml").write_text(TOML + "action_scale = 0.25\n")


CUSTOM = "std_msgs/Header header\nstring[] joints\nfloat64[] position\nfloat32[3] gains\nuint8 mode"


class Messages:
    """Messages of ROS 2.

    Attributes:
        store: The types.
        tau: Torque that Unitree's command feeds forward, N·m.
        reached_in: Time in which a point of a trajectory is to be reached, s.
    """

    def __init__(self, tau: float, reached_in: float) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        from gaponet.data.formats.rosbag import CONTROLLER, HG

        texts = {f"unitree_hg/msg/{name}": text for name, text in HG.items()}
        texts["my_robot_msgs/msg/JointCommand"] = CUSTOM
        texts["control_msgs/msg/JointTrajectoryControllerState"] = CONTROLLER
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        for kind, text in texts.items():
            self.store.register(get_types_from_msg(text, kind))
        self.tau = tau
        self.reached_in = reached_in

    def make(self, kind: str, **fields: object) -> Any:
        return self.store.types[kind](**fields)

    def command(self, kind: str, t: float, x: np.ndarray) -> Any:
        """A message of one of the kinds of write_bag."""
        if kind == "trajectory":
            return self.trajectory(t, x)
        if kind == "custom":
            return self.custom(t, x)
        if kind == "array":
            return self.array(x)
        if kind == "controller":
            return self.controller(t, x)
        if kind == "unitree":
            return self.low_command(x)
        return self.state(t, x)

    def header(self, t: float) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(t), nanosec=round(t % 1 * 1e9))
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def state(self, t: float, x: np.ndarray) -> Any:
        none = np.array([])
        return self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(t),
            name=list(JOINTS),
            position=x,
            velocity=none,
            effort=none,
        )

    def point(self, x: np.ndarray) -> Any:
        soon = self.make(
            "builtin_interfaces/msg/Duration",
            sec=int(self.reached_in),
            nanosec=round(1e9 * (self.reached_in % 1)),
        )
        none = np.array([])
        return self.make(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=x,
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=soon,
        )

    def trajectory(self, t: float, x: np.ndarray) -> Any:
        return self.make(
            "trajectory_msgs/msg/JointTrajectory",
            header=self.header(t),
            joint_names=list(JOINTS),
            points=[self.point(x)],
        )

    def custom(self, t: float, x: np.ndarray) -> Any:
        return self.make(
            "my_robot_msgs/msg/JointCommand",
            header=self.header(t),
            joints=list(JOINTS),
            position=x,
            gains=np.ones(3, np.float32),
            mode=2,
        )

    def array(self, x: np.ndarray) -> Any:
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self.make("std_msgs/msg/Float64MultiArray", layout=layout, data=x)

    def controller(self, t: float, x: np.ndarray) -> Any:
        return self.make(
            "control_msgs/msg/JointTrajectoryControllerState",
            header=self.header(t),
            joint_names=list(JOINTS),
            reference=self.point(x),
            feedback=self.point(x),
            error=self.point(0 * x),
            output=self.point(np.array([])),
        )

    def motors(self, kind: str, x: np.ndarray, **rest: object) -> list[Any]:
        """All 35 motors; the first two are the joints."""
        return [
            self.make(kind, q=float(x[i]) if i < 2 else 0.0, dq=0.0, mode=1, **rest)
            for i in range(35)
        ]

    def low_command(self, x: np.ndarray) -> Any:
        kind = "unitree_hg/msg/MotorCmd"
        return self.make(
            "unitree_hg/msg/LowCmd",
            mode_pr=0,
            mode_machine=0,
            motor_cmd=self.motors(kind, x, reserve=0, tau=self.tau, kp=20.0, kd=1.0),
            reserve=np.zeros(4, np.uint32),
            crc=0,
        )

    def low_state(self, x: np.ndarray) -> Any:
        three = np.zeros(3, np.float32)
        imu = self.make(
            "unitree_hg/msg/IMUState",
            quaternion=np.zeros(4, np.float32),
            gyroscope=three,
            accelerometer=three,
            rpy=three,
            temperature=0,
        )
        motors = self.motors(
            "unitree_hg/msg/MotorState",
            x,
            ddq=0.0,
            tau_est=0.0,
            temperature=np.zeros(2, np.int16),
            vol=0.0,
            motorstate=0,
            sensor=np.zeros(2, np.uint32),
            reserve=np.zeros(4, np.uint32),
        )
        return self.make(
            "unitree_hg/msg/LowState",
            version=np.zeros(2, np.uint32),
            mode_pr=0,
            mode_machine=0,
            tick=0,
            imu_state=imu,
            motor_state=motors,
            wireless_remote=np.zeros(40, np.uint8),
            reserve=np.zeros(4, np.uint32),
            crc=0,
        )


def write_bag(
    bag: Path,
    storage: str = "mcap",
    command: str = "state",
    drift: float = 0.0,
    away: float = 0.0,
    twice: bool = False,
    rows: int = ROWS,
    with_command: bool = True,
    tau: float = 0.0,
    reached_in: float = 0.0,
) -> Path:
    """States at 50 Hz and commands at 25 Hz, on two topics.

    Args:
        command: What kind of message: state, trajectory, array, controller, custom, unitree.
        drift, away: Of the command's clock against the recorder's, s/s and s.
        twice: Every state is recorded two times.
        tau: Torque that Unitree's command feeds forward, N·m.
        reached_in: Time in which a point of a trajectory is to be reached, s.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    messages = Messages(tau, reached_in)
    ctrl, qpos = motion(rows)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        topics: dict[str, Any] = {}

        def send(topic: str, received: float, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            data = messages.store.serialize_cdr(message, kind)
            writer.write(topics[topic], round(received * 1e9), data)

        for i in range(rows):
            t = 100.0 + 0.02 * i
            for _ in range(2 if twice else 1):
                if command == "unitree":
                    state = messages.low_state(qpos[i])
                else:
                    state = messages.state(t, qpos[i])
                send("/joint_states", t + 0.001, state)
            if i % 2 == 0 and with_command:
                sent = t + 0.004 + away + drift * (t - 100.0)
                send("/arm/commands", t + 0.005, messages.command(command, sent, ctrl[i]))
    return bag


def sheet(**said: object) -> str:
    """A logs.toml."""
    return "".join(f"{k} = {json.dumps(v)}\n" for k, v in said.items())
