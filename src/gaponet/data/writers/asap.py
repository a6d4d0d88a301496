"""Dataset → ASAP's motion with `action`: {recording: {dof, action, fps, root_trans_offset, root_rot, pose_aa, …}}.

dof (T, n) rad is what the robot did; action (T, n) is what it was told, as ASAP's policies say it: the target is
default_dof_pos + action_scale · action. The root stands still at the origin, as the robot was held. pose_aa
(T, 1 + n, 3) holds the root and each joint's axis times its angle. Beside ASAP's fields stand joint_names,
action_scale, default_dof_pos, ctrl and stated (JSON), which ASAP leaves alone. joblib.load and pickle.load open it.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from gaponet.data.sequence import OPTIONAL
from gaponet.data.store import Dataset
from gaponet.data.writers import Tell, Written, stated
from gaponet.robot.mjcf import compile_spec, read_mjcf
from gaponet.robot.spec import RobotSpec

SCALE = 0.25  # in ASAP's configuration


def write(dataset: Dataset, robot: RobotSpec, folder: Path, tell: Tell) -> list[Written]:
    """One file per recording, with one motion in it."""
    model = compile_spec(read_mjcf(robot.mjcf), robot.mjcf)
    axes = np.array([model.joint(name).axis for name in dataset.joint_names])  # (n, 3)
    written = []
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        rows = len(sequence)
        root = np.zeros((rows, 1, 3), np.float32)
        pose = np.concatenate([root, sequence.qpos[:, :, None] * axes[None].astype(np.float32)], axis=1)
        motion = {
            "dof": sequence.qpos, "dof_vel": sequence.qvel, "fps": sequence.rate,
            "action": ((sequence.ctrl - robot.qpos_home) / SCALE).astype(np.float32), "action_scale": SCALE,
            "default_dof_pos": np.array(robot.qpos_home), "ctrl": sequence.ctrl, "pose_aa": pose,
            "root_trans_offset": np.zeros((rows, 3), np.float32),
            "root_rot": np.tile(np.array([0, 0, 0, 1], np.float32), (rows, 1)),
            "joint_names": list(sequence.joint_names), "stated": stated(entry),
        } | {name: x for name in OPTIONAL if (x := getattr(sequence, name)) is not None}  # fmt: skip
        file = Path(f"{entry.id}.pkl")
        (folder / file).write_bytes(pickle.dumps({entry.id: motion}, protocol=4))
        written.append(Written(file, 1, rows, sequence.rate))
        tell(entry.meta.motion)
    return written
