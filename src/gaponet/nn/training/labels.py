"""Labels: corrections with which rollouts of the simulator follow the recordings, by iterative learning control.

Each iteration simulates a whole recording under a + Δa. The error a little later, because a servo responds late, is
smoothed and added to Δa (Arimoto, Kawamura & Miyazaki 1984; Bristow, Tharayil & Alleyne 2006). The labels of a
recording are therefore consistent with each other. An inverse model of single rows is only valid at the recorded
states, and a network that is fitted to it has a larger error (docs/results/unnamed.md).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay
from gaponet.sysid.table_contact import tip_heights

ITERATIONS, LEARNING_GAIN = 3, 0.8
LEAD_S = 0.12  # after this time a correction shows in the position
SMOOTHING_S = 0.06  # σ of the filter
TABLE_CLEARANCE_M = 0.01  # below it, a tip is taken to touch the table


def trajectory_labels(
    sequences: ListOf[Sequence], robot: RobotSpec, limit: float, nthread: int = 0, tick: Callable[[], object] = bool
) -> Array:
    """Return Δa* of the operated joints within ±limit rad, (rows of all recordings, n).

    Each recording has the labels of its best iteration. Rows are NaN where a joint was not recorded, and where a tip
    touches the robot's table: no correction explains a contact force.

    Args:
        tick: Called in each iteration.
    """
    op = robot.operated_index
    deltas = [np.zeros((len(s), len(op))) for s in sequences]
    best = [(np.inf, d) for d in deltas]
    for iteration in range(ITERATIONS + 1):
        tick()
        commanded = [_commanded(s, d, op) for s, d in zip(sequences, deltas, strict=True)]
        rollouts = replay(commanded, robot, nthread=nthread, lock_idle=True)
        errors = [(s.qpos - r.qpos)[:, op].astype(float) for s, r in zip(sequences, rollouts, strict=True)]
        costs = [float(np.nan_to_num(np.abs(e), nan=np.pi).mean()) for e in errors]
        candidates = zip(costs, deltas, strict=True)
        best = [min(pair, key=lambda x: x[0]) for pair in zip(best, candidates, strict=True)]
        if iteration < ITERATIONS:
            deltas = [_improved(*x, limit) for x in zip(deltas, errors, (s.dt for s in sequences), strict=True)]
    labels = np.concatenate([d for _, d in best]).astype(np.float32)
    unlabelled = np.concatenate(
        [np.tile([j in s.meta.unrecorded for j in robot.operated], (len(s), 1)) for s in sequences]
    )
    if robot.table is not None:
        unlabelled[np.concatenate(tip_heights(sequences, robot)) < robot.table.height + TABLE_CLEARANCE_M] = True
    return np.where(unlabelled, np.nan, labels).astype(np.float32)


def _improved(delta: Array, error: Array, dt: float, limit: float) -> Array:
    """Return Δa of the next iteration, (T, n) rad."""
    later = np.minimum(np.arange(len(error)) + round(LEAD_S / dt), len(error) - 1)
    raised = delta + LEARNING_GAIN * np.nan_to_num(error)[later]
    return np.clip(gaussian_filter1d(raised, SMOOTHING_S / dt, axis=0, mode="nearest"), -limit, limit)


def _commanded(sequence: Sequence, delta: Array, op: Array) -> Sequence:
    """Return a recording whose targets of the joints op are raised by delta, (T, n) rad."""
    ctrl = sequence.ctrl.copy()
    ctrl[:, op] += delta.astype(ctrl.dtype)
    return replace(sequence, ctrl=ctrl)
