"""Rollouts of many candidates for a robot's servos beside recordings, the whole robot in one batch."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import Link, RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import LINK_FIELDS, with_links
from gaponet.sim.replay import Corrector, idle_limbs, rollout
from gaponet.sim.temperature import recorded_temperatures, warm_values
from gaponet.sysid.joint_rollouts import ROW_PERIOD_S, SETTLE_S

WINDOW_S = 8.0  # what is fitted to a second or two does not hold over whole motions
MIN_WINDOW_S = 0.8
IMMOVABLE_ARMATURE = 1e6  # kg·m², of a joint that stands
MAX_ERROR_RAD = np.pi  # of a simulation that diverged


def cut(sequences: ListOf[Sequence], count: int) -> list[Sequence]:
    """Return `count` evenly picked windows of WINDOW_S, shorter where a recording is."""
    if count < 1:
        raise UsageError(f"--windows {count}: give at least 1")
    parts = []
    for s in sequences:
        rows = min(round(WINDOW_S / s.dt), len(s))
        parts += [s.rows(slice(a, a + rows)) for a in range(0, len(s) - rows + 1, rows)]
    parts = [p for p in parts if p.duration >= MIN_WINDOW_S]
    if not parts:
        raise UsageError(
            f"no recording is as long as {MIN_WINDOW_S:g} s; identification needs longer ones"
        )
    count = min(count, len(parts))
    return [parts[i * len(parts) // count] for i in range(count)]


class RobotRollouts:
    """Rollouts of windows of recordings, n operated joints; rows in which a tip may touch something do not count.

    Attributes:
        window: Window of each row that counts, (rows,).
        recorded: Whether a row holds a joint, (n, rows).
        rows: Number of rows that hold a joint, (n,).
    """

    def __init__(
        self, parts: list[Sequence], robot: RobotSpec, nthread: int = 0, corrector: Corrector | None = None,
        touch: Array | None = None,
    ) -> None:  # fmt: skip
        """Take windows of recordings, and a robot whose own values hold where candidates give none.

        Rollouts go on from the recording in the rows of `touch`, (windows, rows), in which a tip may touch something.
        """
        self.parts, self.robot, self.nthread, self.corrector = parts, robot, nthread, corrector
        self.locked, self.op, self.n = (
            idle_limbs(parts, robot),
            robot.operated_index,
            len(robot.operated),
        )
        free = [j for j in robot.joint_names if j not in self.locked]
        rows = max(map(len, parts))
        self.real = np.zeros((rows, len(parts), self.n))
        for i, s in enumerate(parts):
            self.real[: len(s), i] = s.qpos[:, self.op]
        thin = [max(1, round(ROW_PERIOD_S / s.dt)) for s in parts]
        self.touch = np.zeros((rows, len(parts)), bool) if touch is None else touch.T[:rows]
        after = max(1, round(SETTLE_S / max(s.dt for s in parts)))
        near = np.array([self.touch[max(0, t - after) : t + 1].any(axis=0) for t in range(rows)])
        self.counted = ~near[1:] & np.array([
            [t >= SETTLE_S / s.dt and t < len(s) and t % k == 0 for s, k in zip(parts, thin, strict=True)]
            for t in range(1, rows)
        ])  # fmt: skip
        self.window = np.broadcast_to(np.arange(len(parts)), self.counted.shape)[self.counted]
        # Joints that a window does not hold stand where it says.
        self.recorded = np.array(
            [[j not in p.meta.unrecorded for p in parts] for j in robot.operated]
        )[:, self.window]
        self.standing = [
            (w, i)
            for w, p in enumerate(parts)
            for i, j in enumerate(free)
            if j in p.meta.unrecorded
        ]
        self.rows = self.recorded.sum(axis=1)

    def flat_errors(self, values: dict[str, Array], links: ListOf[dict[str, Link]] = ()) -> Array:
        """Return q_sim − q_real in the rows that count, (k, n, rows) rad; values (k, n), `links` (k,)."""
        k, m = len(values["kp"]), len(self.parts)
        delay = np.array(self.robot.delay)
        delay[self.op] = max(float(values["delay"].max()), self.robot.dt / self.robot.decimation)
        terms = any(values[f].any() for f in SERVO_TERMS if f in values)
        plain: dict[str, Any] = {} if terms else dict.fromkeys(SERVO_TERMS, np.array(0.0))
        acting = replace(self.robot, delay=delay, **plain)
        conditions = [Condition.of(s, self.robot)._replace(temperature=None) for s in self.parts]
        sim = BatchSim(acting, conditions * k, self.nthread, self.locked, servo_model=terms)
        each = {f: np.repeat(x, m, axis=0) for f, x in values.items()}
        warm = warm_values(values, recorded_temperatures(self.parts, self.op).T)
        each |= {
            f: x.swapaxes(1, 2).reshape(-1, self.n)
            for f, x in zip(("damping", "frictionloss"), warm, strict=True)
        }
        sim.set_servos(self.robot.operated, each)
        for (
            w,
            i,
        ) in (
            self.standing
        ):  # n joints of a robot that is not locked have as many degrees of freedom
            sim.batch.expand("dof_armature")[w::m, i] = IMMOVABLE_ARMATURE
            if sim.servo_model is not None:
                sim.servo_model.armature[w::m, i], sim.servo_model.values["backlash"][w::m, i] = (
                    IMMOVABLE_ARMATURE,
                    0.0,
                )
        if links:
            robots = [replace(self.robot, links=one) for one in links]
            models = [
                {c: with_links(model, robot) for c, model in sim.models.items()} for robot in robots
            ]
            for name in LINK_FIELDS:
                rows = np.array([getattr(each[c], name) for each in models for c in conditions])
                if rows.size:
                    sim.batch.expand(name)[:] = rows
        return self.simulated_errors(sim)

    def simulated_errors(self, sim: BatchSim) -> Array:
        """Return q_sim − q_real in the rows that count, (k, n, rows) rad, of simulations of k times the windows."""
        k, m = sim.num_envs // len(self.parts), len(self.parts)
        qpos = rollout(sim, self.parts * k, self.corrector, touch=np.tile(self.touch, k))[0, 1:][
            ..., self.op
        ]
        error = (qpos.reshape(len(qpos), k, m, self.n) - self.real[1:, None]).astype(np.float32)
        errors = error.transpose(1, 3, 0, 2)[:, :, self.counted]
        return (
            np.clip(np.nan_to_num(errors, nan=MAX_ERROR_RAD), -MAX_ERROR_RAD, MAX_ERROR_RAD)
            * self.recorded
        )
