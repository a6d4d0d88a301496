"""Baseline: a delay and an offset per joint, u_j(t) = a_j(t − d_j) + o_j."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Interval

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.structure import Angle, read_json
from gaponet.data.pair import SimulatedReplay
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay

MAX_DELAY_S = 0.16
PIECE_S = 20.0  # duration of a rollout in the fit
MAX_FIT_ROWS = 10_000


@dataclass(frozen=True)
class DelayOffset:
    """Fitted values per operated joint: delay s, offset rad."""

    delay: dict[str, Annotated[float, Interval(ge=0, le=1)]]
    offset: dict[str, Angle]

    @classmethod
    def read(cls, run: Path) -> DelayOffset:
        """Read delay_offset.json of a run folder.

        Raises:
            ModelError: The file is missing or damaged.
        """
        hint = "give a complete run folder of gaponet train"
        return read_json(cls, run / "delay_offset.json", ModelError, hint)

    def corrector(self, robot: RobotSpec) -> DelayOffsetCorrector:
        """Return the corrections for rollouts of sim.replay."""
        return DelayOffsetCorrector(self, robot)

    @classmethod
    def fit(cls, sequences: ListOf[Sequence], robot: RobotSpec, nthread: int = 0) -> DelayOffset:
        """Fit delay and offset of each joint by rollouts with all delays in whole control periods.

        All joints have the same delay in a rollout. Each joint takes the delay with the least error
        after its offset: the coupling between joints is small compared with delay and sag.
        """
        pieces = DelayOffset.pieces(sequences)
        op = robot.operated_index
        names = robot.operated
        dt = float(np.median([s.dt for s in pieces]))
        delays = dt * np.arange(int(MAX_DELAY_S / dt) + 1)
        error = np.empty((len(delays), len(op)))  # rad
        offset = np.empty((len(delays), len(op)))  # rad
        zero = dict.fromkeys(names, 0.0)
        for i, delay in enumerate(delays):
            candidate = DelayOffset(dict.fromkeys(names, float(delay)), zero)
            rollouts = replay(pieces, robot, candidate.corrector(robot), nthread, lock_idle=True)
            for k, name in enumerate(names):
                errors = _joint_errors(pieces, rollouts, name, op[k])
                offset[i, k] = np.median(errors)
                error[i, k] = np.abs(errors - offset[i, k]).mean()
        best = error.argmin(axis=0)  # index of the delay of each joint, (n,)
        best_delays = {}
        best_offsets = {}
        for k, name in enumerate(names):
            best_delays[name] = round(float(delays[best[k]]), 6)
            best_offsets[name] = round(float(offset[best[k], k]), 6)
        return DelayOffset(best_delays, best_offsets)

    @staticmethod
    def pieces(sequences: ListOf[Sequence]) -> list[Sequence]:
        """Cut sequences into pieces, and take an even subset with about MAX_FIT_ROWS rows."""
        pieces = []
        for s in sequences:
            rows = round(PIECE_S / s.dt)
            for start in range(0, max(len(s) - rows // 2, 0) + 1, rows):
                pieces.append(s.rows(slice(start, start + rows)))
        return pieces[:: max(1, round(sum(map(len, pieces)) / MAX_FIT_ROWS))]


def _joint_errors(
    pieces: list[Sequence], rollouts: list[SimulatedReplay], name: str, joint: int
) -> Array:
    """Return recorded − simulated position of a joint, (rows,) rad; a single 0 if none has it."""
    errors = []
    for piece, rollout in zip(pieces, rollouts, strict=True):
        if name not in piece.meta.unrecorded:
            errors.append((piece.qpos - rollout.qpos)[1:, joint])
    if not errors:
        return np.zeros(1)
    return np.concatenate(errors)


class DelayOffsetCorrector:
    """Delays targets and adds the offset. Before the first target, the first target holds."""

    def __init__(self, values: DelayOffset, robot: RobotSpec) -> None:
        self.operated = robot.operated_index
        self.range = robot.qpos_range[self.operated]
        for joint in robot.operated:
            if joint not in values.delay or joint not in values.offset:
                raise ModelError(
                    f"delay and offset of joint '{joint}' are not known (delay_offset.json); "
                    "train again"
                )
        self.delay = np.array([values.delay[j] for j in robot.operated])
        self.offset = np.array([values.offset[j] for j in robot.operated])
        self.periods = np.zeros((0, len(self.delay)), int)  # delay in control periods, (k, n)
        self.past: list[Array] = []  # targets, (k, n) rad, newest last

    def reset(self, start: ListOf[Sequence]) -> None:
        """Start one simulation per sequence."""
        dt = np.array([s.dt for s in start])
        self.periods = np.round(self.delay[None, :] / dt[:, None]).astype(int)
        self.past = []

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Return delayed targets plus offset, (k, n_all) rad."""
        self.past.append(np.array(target[:, self.operated]))
        if len(self.past) > self.periods.max() + 1:
            self.past.pop(0)
        past = np.stack(self.past)  # (depth, k, n)
        index = np.maximum(len(past) - 1 - self.periods, 0)
        delayed = np.take_along_axis(past, index[None], axis=0)[0]
        corrected = np.array(target, float)
        corrected[:, self.operated] = np.clip(
            delayed + self.offset, self.range[:, 0], self.range[:, 1]
        )
        return corrected
