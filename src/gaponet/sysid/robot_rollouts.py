"""Free runs of many candidates for a robot's servos beside recordings, the whole robot in one batch: their errors."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.replay import Corrector, idle_limbs, rollout

WINDOW = 8.0  # s; what is fitted on a second or two does not hold over whole motions
SHORTEST = 0.8  # s
THIN = 0.01  # s between rows that count
SETTLE = 0.1  # s: velocities at a window's start are measured ones
IMMOVABLE = 1e6  # kg·m²: the armature of a joint that stands
FAR = np.pi  # rad: an error beyond, of a simulation that flew away, counts as this

NO_LAW = {name: np.array(0.0) for name in SERVO_TERMS}


def cut(sequences: ListOf[Sequence], count: int) -> list[Sequence]:
    """Windows of WINDOW seconds (shorter where a recording is), evenly picked."""
    parts = []
    for s in sequences:
        rows = min(round(WINDOW / s.dt), len(s))
        parts += [s.rows(slice(a, a + rows)) for a in range(0, len(s) - rows + 1, rows)]
    parts = [p for p in parts if p.duration >= SHORTEST]
    if not parts:
        raise UsageError(f"no recording is as long as {SHORTEST:g} s; identification needs longer ones")
    return [parts[i * len(parts) // min(count, len(parts))] for i in range(min(count, len(parts)))]


class RobotRollouts:
    """Windows of recordings, n operated joints of a robot; rows in which something may be touched are passed over.

    Attributes:
        window: Which window each row that counts is of, (rows,).
        recorded: Whether a row says something of a joint, (n, rows).
        rows: How many do, of each joint, (n,).
    """

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        nthread: int = 0,
        corrector: Corrector | None = None,
        touch: Array | None = None,
    ) -> None:
        """
        Args:
            parts: Windows of recordings.
            robot: What is not given a candidate's values is its own.
            nthread: Threads, 0 for all cores.
            corrector: Corrects the targets on the way, as in replay.
            touch: Rows in which something may be touched, (windows, rows): runs go on from the recording there.
        """
        self.parts, self.robot, self.nthread, self.corrector = parts, robot, nthread, corrector
        self.locked, self.op, self.n = idle_limbs(parts, robot), robot.operated_index, len(robot.operated)
        free = [j for j in robot.joint_names if j not in self.locked]
        rows = max(map(len, parts))
        self.real = np.zeros((rows, len(parts), self.n))
        for i, s in enumerate(parts):
            self.real[: len(s), i] = s.qpos[:, self.op]
        thin = [max(1, round(THIN / s.dt)) for s in parts]
        self.touch = np.zeros((rows, len(parts)), bool) if touch is None else touch.T[:rows]
        after = max(1, round(SETTLE / max(s.dt for s in parts)))
        near = np.array([self.touch[max(0, t - after) : t + 1].any(axis=0) for t in range(rows)])
        self.counted = ~near[1:] & np.array([
            [t >= SETTLE / s.dt and t < len(s) and t % k == 0 for s, k in zip(parts, thin, strict=True)]
            for t in range(1, rows)
        ])  # fmt: skip
        self.window = np.broadcast_to(np.arange(len(parts)), self.counted.shape)[self.counted]
        # Joints of which a window holds nothing stand where it says.
        self.recorded = np.array([[j not in p.meta.unrecorded for p in parts] for j in robot.operated])[:, self.window]
        self.standing = [(w, i) for w, p in enumerate(parts) for i, j in enumerate(free) if j in p.meta.unrecorded]
        self.rows = self.recorded.sum(axis=1)

    def run(self, values: dict[str, Array], parts: list[Sequence] | None = None) -> Array:
        """Errors q_sim − q_real of rows that count, (k, n, rows) rad, of k candidates.

        Args:
            values: (k, n) each, as BatchSim.set_servos takes them.
            parts: The windows of each candidate in turn, where they do not all have the same; then k times as many.
        """
        k, m = len(values["kp"]), len(self.parts)
        late = np.array(self.robot.delay)
        late[self.op] = max(float(values["delay"].max()), self.robot.dt / self.robot.decimation)
        parts = self.parts * k if parts is None else parts
        law = any(values[f].any() for f in SERVO_TERMS if f in values)
        known: dict[str, Any] = {} if law else NO_LAW
        acting = replace(self.robot, delay=late, **known)
        sim = BatchSim(acting, [Condition.of(s, self.robot) for s in parts], self.nthread, self.locked, servo_model=law)
        sim.set_servos(self.robot.operated, {f: np.repeat(x, m, axis=0) for f, x in values.items()})
        for w, i in self.standing:  # n joints of a robot that is not locked have as many degrees of freedom
            sim.batch.expand("dof_armature")[w::m, i] = IMMOVABLE
        qpos = rollout(sim, parts, self.corrector, touch=np.tile(self.touch, k))[0, 1:][..., self.op]
        error = (qpos.reshape(len(qpos), k, m, self.n) - self.real[1:, None]).astype(np.float32)
        errors = error.transpose(1, 3, 0, 2)[:, :, self.counted]
        return np.clip(np.nan_to_num(errors, nan=FAR), -FAR, FAR) * self.recorded
