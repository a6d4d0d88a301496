"""Dataset → SAGE folder: real/{robot}/gaponet/{recording}/{control,state_motor}.csv and joint_list.txt.

Time in µs; joints in the unit that the robot's log_unit says. What the format has no place for (qacc, temperatures,
notes) stays behind; unit, payload and gains stand in the sheet beside it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.files import write_text
from gaponet.data.sequence import Sequence
from gaponet.data.store import Entry
from gaponet.robot.spec import RobotSpec

SHEET = True


def write_recording(entry: Entry, sequence: Sequence, robot: RobotSpec, folder: Path) -> Path:
    """Write one motion folder."""
    place = Path("real") / robot.name / "gaponet" / entry.id
    (folder / place).mkdir(parents=True)
    state = {"positions": sequence.qpos, "velocities": sequence.qvel}
    state |= {"torques": sequence.tau} if sequence.tau is not None else {}
    for name, columns in (("control", {"positions": sequence.ctrl}), ("state_motor", state)):
        values = [_in_log_units(kind, x, robot) for kind, x in columns.items()]
        write_text(
            folder / place / f"{name}.csv", _text(name.upper(), sequence, list(columns), values)
        )
    write_text(folder / place / "joint_list.txt", "\n".join(sequence.joint_names) + "\n")
    return place


def _in_log_units(kind: str, values: Array, robot: RobotSpec) -> Array:
    """rad → what this robot's logs hold: the way back from data.describe.plausibility.to_radians."""
    out = np.array(values, float)
    for j, unit in enumerate(robot.log_units):
        if unit == "deg" and kind != "torques":
            out[:, j] *= 180 / np.pi
        if unit == "fraction" and kind != "torques":
            low, high = robot.qpos_range[j]
            out[:, j] = (out[:, j] - (low if kind == "positions" else 0.0)) / (high - low)
    return out


def _text(kind: str, sequence: Sequence, columns: list[str], values: list[Array]) -> str:
    lines = [",".join(["type", "timestamp", *columns])]
    for t, row in enumerate(zip(*values, strict=True)):
        lists = ",".join('"[' + ", ".join(map(repr, x.tolist())) + ']"' for x in row)
        lines.append(f"{kind},{1e6 * sequence.dt * t!r},{lists}")
    return "\n".join(lines) + "\n"
