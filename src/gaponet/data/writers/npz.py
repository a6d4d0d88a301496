"""Dataset → NumPy: one .npz per recording, in SI, with everything that is known of it.

ctrl, qpos, qvel and what else there is (T, n) float32; time (T) s; joint_names; gaponet: JSON of dt and metadata.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gaponet.data.sequence import ARRAYS
from gaponet.data.store import Dataset
from gaponet.data.writers import Tell, Written, stated
from gaponet.robot.spec import RobotSpec


def write(dataset: Dataset, robot: RobotSpec, folder: Path, tell: Tell) -> list[Written]:
    """One file per recording."""
    written = []
    for entry in dataset.entries:
        sequence = dataset.read(entry)
        arrays = {name: x for name in ARRAYS if (x := getattr(sequence, name)) is not None}
        told = json.dumps({"dt": sequence.dt, "stated": json.loads(stated(entry))}, ensure_ascii=False)
        file = Path(f"{entry.id}.npz")
        np.savez(
            folder / file, allow_pickle=False, time=sequence.dt * np.arange(len(sequence)),
            joint_names=np.array(sequence.joint_names), gaponet=np.array(told), **arrays,
        )  # fmt: skip
        written.append(Written(file, 1, len(sequence), sequence.rate))
        tell(entry.meta.motion)
    return written
