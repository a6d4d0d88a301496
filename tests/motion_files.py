"""Motion files as others write them, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaponet.motion.files import SAGE_PERIOD_S
from gaponet.motion.motion import Motion
from gaponet.robot.spec import RobotSpec


def write_motion(path: str | Path, motion: Motion, robot: RobotSpec) -> None:
    """Write a motion: .txt at 50 Hz as SAGE reads it, .csv and .npz at the motion's own period."""
    path = Path(path)
    if path.suffix == ".npz":
        np.savez(path, joint_names=np.array(robot.joint_names), ctrl=motion.ctrl, dt=motion.dt)
        return
    if path.suffix == ".txt":
        names = list(robot.joint_names)
        table = motion.sample(SAGE_PERIOD_S)
    else:
        names = ["time", *robot.joint_names]
        table = np.column_stack([np.arange(len(motion.ctrl)) * motion.dt, motion.ctrl])
    lines = [",".join(names)]
    for row in table:
        lines.append(",".join(f"{value:.9g}" for value in row))
    path.write_text("\n".join(lines) + "\n")
