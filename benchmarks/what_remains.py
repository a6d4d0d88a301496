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

REST_SPEED = 0.02  # rad/s
REST_SPAN_S = 0.2
KINDS = ("at the table", "at rest, free", "moving, free")


def main(dataset: str, folder: str) -> None:
    """Print the mean |error| of each kind of row, mrad, and what one removes from the mean over
    motions.
    """
    data = Dataset(dataset)
    robot = load_robot(folder)
    heights = tips_of(robot)
    table = robot.scene.table
    shape = (len(KINDS), len(robot.operated))
    sums = np.zeros(shape)
    counts = np.zeros(shape)
    means = []
    test = data.sequences(split_entries(data, ())["test"])
    for log, simulated in zip(test, replay(test, robot), strict=True):
        error = 1e3 * np.abs(simulated.qpos - log.qpos)[:, robot.operated_index]
        low = np.zeros(len(log), bool)
        if heights is not None and table is not None:
            low = heights(log.ctrl) < table.height
        rests = _rests(log.qpos[:, robot.operated_index], log.dt)
        at_table = np.broadcast_to(low[:, None], rests.shape)
        for k, rows in enumerate((at_table, ~at_table & rests, ~at_table & ~rests)):
            sums[k] += (error * rows).sum(axis=0)
            counts[k] += rows.sum(axis=0)
        means.append((error.mean(), error[~low].mean()))
    print(f"{'rows':<16}{'share':>7}{'all':>7}  " + "  ".join(robot.operated))
    for k, kind in enumerate(KINDS):
        joints = []
        for j, joint in enumerate(robot.operated):
            joints.append(f"{sums[k, j] / max(counts[k, j], 1):{len(joint)}.2f}")
        share = counts[k].sum() / counts.sum()
        mean = sums[k].sum() / max(counts[k].sum(), 1)
        print(f"{kind:<16}{share:7.2f}{mean:7.2f}  {'  '.join(joints)}")
    whole, free = np.mean(means, axis=0)
    print(f"mean over {len(test)} motions: {whole:.2f} mrad, without rows at the table {free:.2f}")


def _rests(qpos: np.ndarray, dt: float) -> np.ndarray:
    """Return in which rows the joints rest, (T, n), by recorded positions, rad."""
    speed = np.abs(np.gradient(qpos.astype(float), dt, axis=0))
    smooth: np.ndarray = uniform_filter1d(speed, max(1, round(REST_SPAN_S / dt)), axis=0)
    return smooth < REST_SPEED


if __name__ == "__main__":
    main(*sys.argv[1:])
