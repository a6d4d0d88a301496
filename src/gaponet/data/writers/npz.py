"""Dataset → NumPy: one .npz per recording, in SI units, with all metadata.

ctrl, qpos, qvel and the optional channels (T, n) float32; time (T) s; joint_names; gaponet: JSON of dt and metadata.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gaponet.data.sequence import ARRAYS, Sequence
from gaponet.data.store import Entry
from gaponet.data.writers import stated
from gaponet.robot.spec import RobotSpec


def write_recording(entry: Entry, sequence: Sequence, robot: RobotSpec, folder: Path) -> Path:
    """Write one file."""
    arrays = {name: x for name in ARRAYS if (x := getattr(sequence, name)) is not None}
    text = json.dumps({"dt": sequence.dt, "stated": stated(entry)}, ensure_ascii=False)
    file = Path(f"{entry.id}.npz")
    np.savez(
        folder / file, allow_pickle=False, time=sequence.dt * np.arange(len(sequence)),
        joint_names=np.array(sequence.joint_names), gaponet=np.array(text), **arrays,
    )  # fmt: skip
    return file
