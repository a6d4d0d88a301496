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
    names = list(dict.fromkeys(run.meta.independent_motion for run in runs))
    half = {name: i % 2 for i, name in enumerate(names)}
    folds: list[list[Run]] = [[], []]
    for run in runs:
        folds[half[run.meta.independent_motion]].append(run)
    fitted = [fit_delay_offset(fold or folds[0]) for fold in folds]
    moved = []
    for run in runs:
        delay, offset = fitted[1 - half[run.meta.independent_motion]]
        moved.append(replace(run, qpos_sim=delayed(run.qpos_sim, delay, run.dt) + offset))
    return moved


def delayed(path: Array, delay: Array, dt: float) -> Array:
    """Return a path (T, n) rad, whose first row holds before it, later by delays (n,) s."""
    rows = np.arange(len(path))
    late = [np.interp(rows - d / dt, rows, x) for d, x in zip(delay, path.T, strict=True)]
    return np.stack(late, axis=1)


def fit_delay_offset(runs: ListOf[Run]) -> tuple[Array, Array]:
    """Return each joint's delay, s, and offset, rad, (n,), with the least mean |error|."""
    joints = runs[0].qpos_real.shape[1]
    every = max(1, sum(len(run.qpos_real) for run in runs) // MAX_FITTED_ROWS)
    step = max(MIN_DELAY_STEP_S, min(run.dt for run in runs))
    delays = np.arange(0.0, MAX_DELAY_S + step / 2, step)
    error = np.full((len(delays), joints), np.inf)
    offset = np.zeros((len(delays), joints))
    for i, delay in enumerate(delays):
        apart = []
        for run in runs:
            late = delayed(run.qpos_sim, np.full(joints, delay), run.dt)
            away = (run.qpos_real - late)[1::every]
            away[:, [j for j in range(joints) if j not in run.recorded]] = np.nan
            apart.append(away)
        away = np.concatenate(apart)
        held = ~np.isnan(away).all(axis=0)
        offset[i, held] = np.nanmedian(away[:, held], axis=0)
        error[i, held] = np.nanmean(np.abs(away[:, held] - offset[i, held]), axis=0)
    best = error.argmin(axis=0)
    return delays[best], offset[best, np.arange(joints)]
