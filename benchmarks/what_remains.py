"""Where the error of an identified robot remains: rows at the table, at rest and moving, by joint.

    python benchmarks/what_remains.py DATASET ROBOT

Rows of the test motions. "At the table": the command would bring a tip below the table of
robot.toml. "At rest": the joint's recorded speed is below 0.02 rad/s over 0.2 s. docs/results.md
has the real SO-101's.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.ndimage import uniform_filter1d

from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.spec import load_robot
from gaponet.sim.dynamics import tips_of
from gaponet.sim.replay import replay

REST_SPEED, REST_SPAN_S = 0.02, 0.2


def main(dataset: str, folder: str) -> None:
    """Print the mean |error| of each kind of row, mrad, and what one removes from the mean over
    motions.
    """
    data, robot = Dataset(dataset), load_robot(folder)
    heights, op = tips_of(robot), robot.operated_index
    kinds = ["at the table", "at rest, free", "moving, free"]
    sums, counts = np.zeros((2, len(kinds), len(op)))
    means = []
    test = data.sequences(split_entries(data, ())["test"])
    for s, simulated in zip(test, replay(test, robot), strict=True):
        error = 1e3 * np.abs(simulated.qpos - s.qpos)[:, op]
        low = np.zeros(len(s), bool)
        if heights is not None and robot.scene.table is not None:
            low = heights(s.ctrl) < robot.scene.table.height
        speed = np.abs(np.gradient(s.qpos[:, op].astype(float), s.dt, axis=0))
        rest = uniform_filter1d(speed, max(1, round(REST_SPAN_S / s.dt)), axis=0) < REST_SPEED
        at_table = np.broadcast_to(low[:, None], rest.shape)
        for k, rows in enumerate((at_table, ~at_table & rest, ~at_table & ~rest)):
            sums[k] += (error * rows).sum(axis=0)
            counts[k] += rows.sum(axis=0)
        means.append((error.mean(), error[~low].mean()))
    print(f"{'rows':<16}{'share':>7}{'all':>7}  " + "  ".join(robot.operated))
    for kind, total, count in zip(kinds, sums, counts, strict=True):
        joints = "  ".join(
            f"{x:{len(j)}.2f}"
            for x, j in zip(total / np.maximum(count, 1), robot.operated, strict=True)
        )
        print(
            f"{kind:<16}{count.sum() / counts.sum():7.2f}{total.sum() / max(count.sum(), 1):7.2f}  {joints}"
        )
    whole, free = np.mean(means, axis=0)
    print(f"mean over {len(test)} motions: {whole:.2f} mrad, without rows at the table {free:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
