"""Delay and offset per joint: the cheapest honest correction. u_j(t) = a_j(t − d_j) + o_j."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.base.structure import Angle, read_json
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import Progress, replay

MAX_DELAY = 0.16  # s, in steps of the control period
PIECE = 20.0  # s, free run per fitting piece
FRAMES = 10_000  # frames fitted on at most


@dataclass(frozen=True)
class DelayOffset:
    """Fitted values by operated joint: delay s, offset rad."""

    delay: dict[str, Annotated[float, Interval(ge=0, le=1)]]
    offset: dict[str, Angle]

    @classmethod
    def read(cls, run: Path) -> DelayOffset:
        """Read the one kept in a run folder, in delay_offset.json.

        Raises:
            ModelError: Missing or damaged.
        """
        hint = "give a complete run folder of gaponet train"
        return read_json(cls, run / "delay_offset.json", ModelError, hint)

    def corrector(self, robot: RobotSpec) -> _DelayOffsetCorrector:
        return _DelayOffsetCorrector(self, robot)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def fit(
        cls, sequences: ListOf[Sequence], robot: RobotSpec, nthread: int = 0, progress: Progress | None = None
    ) -> DelayOffset:
        """Try every whole-step delay on all joints at once; keep each joint's with the least error after its offset.

        Joints are fitted as if alone; their coupling is small beside delay and sag.
        """
        part = DelayOffset.pieces(sequences)
        op, names = robot.operated_index, robot.operated
        dt = float(np.median([s.dt for s in part]))
        delays = dt * np.arange(int(MAX_DELAY / dt) + 1)
        error, offset = np.empty((len(delays), len(op))), np.empty((len(delays), len(op)))
        zero = dict.fromkeys(names, 0.0)
        for i, delay in enumerate(delays):
            candidate = DelayOffset(dict.fromkeys(names, float(delay)), zero)
            twins = replay(part, robot, candidate.corrector(robot), nthread, lock_idle=True)
            for k, (j, name) in enumerate(zip(op, names, strict=True)):
                both = zip(part, twins, strict=True)
                mine = [(s.qpos - t.qpos)[1:, j] for s, t in both if name not in s.meta.unrecorded]
                e = np.concatenate(mine or [np.zeros(1)])
                offset[i, k] = np.median(e)
                error[i, k] = np.abs(e - offset[i, k]).mean()
            if progress:
                progress(i + 1, len(delays))
        best = error.argmin(axis=0)
        return DelayOffset(
            {j: round(float(delays[best[k]]), 6) for k, j in enumerate(names)},
            {j: round(float(offset[best[k], k]), 6) for k, j in enumerate(names)},
        )

    @staticmethod
    def pieces(sequences: ListOf[Sequence], seconds: float = PIECE, frames: int = FRAMES) -> list[Sequence]:
        """Cut sequences into pieces that run side by side; evenly thinned to at most `frames` rows."""
        cut = []
        for s in sequences:
            rows = round(seconds / s.dt)
            for start in range(0, max(len(s) - rows // 2, 0) + 1, rows):
                cut.append(s.rows(slice(start, start + rows)))
        return cut[:: max(1, round(sum(map(len, cut)) / frames))]


class _DelayOffsetCorrector:
    """Delays targets and adds the offset; before the first command, the first command."""

    def __init__(self, values: DelayOffset, robot: RobotSpec) -> None:
        self.op = robot.operated_index
        self.range = robot.qpos_range[self.op]
        for joint in robot.operated:
            if joint not in values.delay or joint not in values.offset:
                raise ModelError(f"delay and offset of joint '{joint}' are not known (delay_offset.json); train again")
        self.delay = np.array([values.delay[j] for j in robot.operated])
        self.offset = np.array([values.offset[j] for j in robot.operated])

    def reset(self, start: ListOf[Sequence]) -> None:
        """Begin with one simulation per sequence."""
        self.steps = np.round(self.delay[None, :] / np.array([s.dt for s in start])[:, None]).astype(int)  # (k, n)
        self.past: list[Array] = []

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Targets of delay steps ago plus offset, (k, n_all) rad."""
        self.past.append(np.array(target[:, self.op]))
        if len(self.past) > self.steps.max() + 1:
            self.past.pop(0)
        past = np.stack(self.past)  # (depth, k, n), newest last
        index = np.maximum(len(past) - 1 - self.steps, 0)
        delayed = np.take_along_axis(past, index[None], axis=0)[0]
        out = np.array(target, float)
        out[:, self.op] = np.clip(delayed + self.offset, self.range[:, 0], self.range[:, 1])
        return out
