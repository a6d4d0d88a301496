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
    names, ctrl = list(robot.joint_names), motion.ctrl
    if path.suffix == ".txt":
        ctrl = motion.sample(SAGE_PERIOD_S)
    else:
        names, ctrl = ["time", *names], np.column_stack([np.arange(len(ctrl)) * motion.dt, ctrl])
    lines = [",".join(names), *(",".join(f"{v:.9g}" for v in row) for row in ctrl)]
    path.write_text("\n".join(lines) + "\n")
