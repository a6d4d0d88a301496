"""Labels: corrections under which the simulator follows the recordings in free run, by iterative learning control.

A whole motion is run free under a + Δa, and what is left of its error, looked at a little later (a servo answers late)
and smoothed, is added to Δa (Arimoto, Kawamura & Miyazaki 1984; Bristow, Tharayil & Alleyne 2006). So the labels of a
motion hold together: what an inverse model says of each row alone leads along a recording only from its own states,
and a network fitted to it leaves more (docs/results/unnamed.md).
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

ITERATIONS, GAIN = 3, 0.8
LEAD, SMOOTH, NEAR = 0.12, 0.06, 0.01  # s: how much later a correction shows, σ of the filter; m: a tip is at the table


def trajectory_labels(
    sequences: ListOf[Sequence], robot: RobotSpec, limit: float, nthread: int = 0, tick: Callable[[], object] = bool
) -> Array:
    """Δa* of the operated joints within ±limit rad, (rows of all recordings, n).

    Of every recording the iteration that followed it best; tick is called in each. NaN where a joint was not recorded,
    and where a tip is at the robot's table: what a contact takes no correction explains.
    """
    op = robot.operated_index
    deltas = [np.zeros((len(s), len(op))) for s in sequences]
    best = [(np.inf, d) for d in deltas]
    for iteration in range(ITERATIONS + 1):
        tick()
        told = [_told(s, d, op) for s, d in zip(sequences, deltas, strict=True)]
        runs = replay(told, robot, nthread=nthread, lock_idle=True)
        errors = [(s.qpos - run.qpos)[:, op].astype(float) for s, run in zip(sequences, runs, strict=True)]
        found = [(float(np.nan_to_num(np.abs(e), nan=np.pi).mean()), d) for e, d in zip(errors, deltas, strict=True)]
        best = [min(pair, key=lambda x: x[0]) for pair in zip(best, found, strict=True)]
        if iteration < ITERATIONS:
            deltas = [_bettered(*x, limit) for x in zip(deltas, errors, (s.dt for s in sequences), strict=True)]
    labels = np.concatenate([d for _, d in best]).astype(np.float32)
    silent = np.concatenate([np.tile([j in s.meta.unrecorded for j in robot.operated], (len(s), 1)) for s in sequences])
    if robot.table is not None:
        silent[np.concatenate(tip_heights(sequences, robot)) < robot.table.height + NEAR] = True
    return np.where(silent, np.nan, labels).astype(np.float32)


def _bettered(delta: Array, error: Array, dt: float, limit: float) -> Array:
    """The next Δa of a recording, (T, n) rad."""
    later = np.minimum(np.arange(len(error)) + round(LEAD / dt), len(error) - 1)
    more = delta + GAIN * np.nan_to_num(error)[later]
    return np.clip(gaussian_filter1d(more, SMOOTH / dt, axis=0, mode="nearest"), -limit, limit)


def _told(sequence: Sequence, delta: Array, op: Array) -> Sequence:
    """A recording's start under other targets."""
    ctrl = sequence.ctrl.copy()
    ctrl[:, op] += delta.astype(ctrl.dtype)
    return replace(sequence, ctrl=ctrl)
