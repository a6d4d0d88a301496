"""Two predictions that need no identified simulator: the command itself, and the nominal
simulation, later and shifted.

Each joint's path gets a delay and an offset. They are fitted to half of the motions and measured on
the other half, and the other way round, so no motion is measured with numbers that were fitted to
it. A single motion is fitted to itself.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Run, metrics

MAX_DELAY_S = 0.3
MIN_DELAY_STEP_S = 0.005
MAX_FITTED_ROWS = 20_000  # of all motions together


def command_run(sequence: Sequence, robot: RobotSpec) -> Run:
    """Return a run whose simulated positions are the commands, as the servos take them."""
    low, high = robot.qpos_range.T
    return Run.of(sequence, np.clip(sequence.ctrl, low, high), robot)


def baseline_errors(nominal: ListOf[Run], commands: ListOf[Run]) -> dict[str, float]:
    """Return the mean |error| of delay + offset and of the command itself, rad, for recordings in
    one order.
    """
    return {
        "delay_offset": _error(_later_and_shifted(nominal)),
        "command": _error(_later_and_shifted(commands)),
    }


def _error(runs: list[Run]) -> float:
    return float(metrics(runs)["mpjae"])


def _later_and_shifted(runs: ListOf[Run]) -> list[Run]:
    """Return runs with delays and offsets that were fitted to the other half of the motions."""
    motions = list(dict.fromkeys(run.meta.independent_motion for run in runs))
    first_half = set(motions[::2])
    first = []
    second = []
    for run in runs:
        if run.meta.independent_motion in first_half:
            first.append(run)
        else:
            second.append(run)
    of_first = fit_delay_offset(first)
    of_second = fit_delay_offset(second or first)  # a single motion is fitted to itself
    moved = []
    for run in runs:
        in_first_half = run.meta.independent_motion in first_half
        delay, offset = of_second if in_first_half else of_first
        moved.append(replace(run, qpos_sim=delayed(run.qpos_sim, delay, run.dt) + offset))
    return moved


def delayed(path: Array, delay: Array, dt: float) -> Array:
    """Return a path (T, n) rad, whose first row holds before it, later by delays (n,) s."""
    rows = np.arange(len(path))
    late = []
    for joint_delay, joint_path in zip(delay, path.T, strict=True):
        late.append(np.interp(rows - joint_delay / dt, rows, joint_path))
    return np.stack(late, axis=1)


def fit_delay_offset(runs: ListOf[Run]) -> tuple[Array, Array]:
    """Return each joint's delay, s, and offset, rad, (n,), with the least mean |error|."""
    joints = runs[0].qpos_real.shape[1]
    stride = max(1, sum(len(run.qpos_real) for run in runs) // MAX_FITTED_ROWS)
    step = max(MIN_DELAY_STEP_S, min(run.dt for run in runs))
    delays = np.arange(0.0, MAX_DELAY_S + step / 2, step)
    error = np.full((len(delays), joints), np.inf)  # rad; infinite for a joint without recordings
    offset = np.zeros((len(delays), joints))  # rad
    for i, delay in enumerate(delays):
        differences = _differences(runs, np.full(joints, delay), stride)
        held = ~np.isnan(differences).all(axis=0)  # (n,)
        offset[i, held] = np.nanmedian(differences[:, held], axis=0)
        error[i, held] = np.nanmean(np.abs(differences[:, held] - offset[i, held]), axis=0)
    best = error.argmin(axis=0)
    return delays[best], offset[best, np.arange(joints)]


def _differences(runs: ListOf[Run], delay: Array, stride: int) -> Array:
    """Return q_real − q_sim of every `stride`th row with delays (n,) s, all runs together, (rows,
    n) rad; NaN for a joint that a run does not hold.
    """
    parts = []
    for run in runs:
        part = (run.qpos_real - delayed(run.qpos_sim, delay, run.dt))[1::stride]
        missing = [j for j in range(len(delay)) if j not in run.recorded]
        part[:, missing] = np.nan
        parts.append(part)
    return np.concatenate(parts)
