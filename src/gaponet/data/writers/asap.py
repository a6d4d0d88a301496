"""Dataset → ASAP's motion with `action`: {recording: {dof, action, fps, root_trans_offset, root_rot, pose_aa, …}}.

dof (T, n) rad is what the robot did; action (T, n) is what it was told, as ASAP's policies say it: the target is
default_dof_pos + action_scale · action. The root stands still at the origin, as the robot was held. pose_aa
(T, 1 + n, 3) holds the root and each joint's axis times its angle. Beside ASAP's fields stand joint_names,
action_scale, default_dof_pos, ctrl and stated (JSON), which ASAP leaves alone. joblib.load and pickle.load open it.
"""

from __future__ import annotations

import json
import pickle
from functools import cache
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import OPTIONAL, Sequence
from gaponet.data.store import Entry
from gaponet.data.writers import stated
from gaponet.robot.mjcf import compile_spec, read_mjcf
from gaponet.robot.spec import RobotSpec

SCALE = 0.25  # in ASAP's configuration


def write_recording(entry: Entry, sequence: Sequence, robot: RobotSpec, folder: Path) -> Path:
    """Write one file with one motion in it."""
    rows = len(sequence)
    root = np.zeros((rows, 1, 3), np.float32)
    axes = _joint_axes(robot.mjcf, sequence.joint_names).astype(np.float32)
    motion = {
        "dof": sequence.qpos, "dof_vel": sequence.qvel, "fps": sequence.rate,
        "action": ((sequence.ctrl - robot.qpos_home) / SCALE).astype(np.float32), "action_scale": SCALE,
        "default_dof_pos": np.array(robot.qpos_home), "ctrl": sequence.ctrl,
        "pose_aa": np.concatenate([root, sequence.qpos[:, :, None] * axes], axis=1),
        "root_trans_offset": np.zeros((rows, 3), np.float32),
        "root_rot": np.tile(np.array([0, 0, 0, 1], np.float32), (rows, 1)),
        "joint_names": list(sequence.joint_names), "stated": json.dumps(stated(entry), ensure_ascii=False),
    } | {name: x for name in OPTIONAL if (x := getattr(sequence, name)) is not None}  # fmt: skip
    file = Path(f"{entry.id}.pkl")
    (folder / file).write_bytes(pickle.dumps({entry.id: motion}, protocol=4))
    return file


@cache
def _joint_axes(mjcf: Path, joint_names: tuple[str, ...]) -> Array:
    """Return the axis of each joint in its body's frame, (n, 3)."""
    model = compile_spec(read_mjcf(mjcf), mjcf)
    return np.array([model.joint(name).axis for name in joint_names])
