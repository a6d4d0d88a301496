"""Rollouts of many candidates for a robot's servos beside recordings, the whole robot in one
batch.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array, evenly_spread_order
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
        for start in range(0, len(s) - rows + 1, rows):
            parts.append(s.rows(slice(start, start + rows)))
    parts = [p for p in parts if p.duration >= MIN_WINDOW_S]
    if not parts:
        raise UsageError(
            f"no recording is as long as {MIN_WINDOW_S:g} s; identification needs longer ones"
        )
    count = min(count, len(parts))
    picked = [parts[i * len(parts) // count] for i in range(count)]
    if len(_conditions(picked)) < min(count, len(_conditions(parts))):
        # Recordings are often stored in a regular order, such as four payloads of one motion after
        # the other. Every fourth window has the same payload.
        places = sorted(evenly_spread_order(len(parts))[:count])
        picked = [parts[place] for place in places]
    return picked


def _conditions(parts: list[Sequence]) -> set[tuple[object, ...]]:
    """Return the units, payloads and rates of windows."""
    found: set[tuple[object, ...]] = set()
    for part in parts:
        meta = part.meta
        found.add((meta.unit_id, meta.payload_mass, meta.payload_side, round(part.rate)))
    return found


class RobotRollouts:
    """Rollouts of windows of recordings, n operated joints; rows in which a tip may touch
    something do not count.

    Attributes:
        window: Window of each row that counts, (rows,).
        recorded: Whether a row holds a joint, (n, rows).
    """

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        nthread: int = 0,
        corrector: Corrector | None = None,
        touch: Array | None = None,
    ) -> None:
        """Take windows of recordings, and a robot whose own values hold where candidates give none.

        Rollouts go on from the recording in the rows of `touch`, (windows, rows), in which a tip
        may touch something.
        """
        self.parts = parts
        self.robot = robot
        self.nthread = nthread
        self.corrector = corrector
        self.locked = idle_limbs(parts, robot)
        self.op = robot.operated_index
        self.n = len(robot.operated)
        rows = max(map(len, parts))
        self.real = np.zeros((rows, len(parts), self.n))
        for i, part in enumerate(parts):
            self.real[: len(part), i] = part.qpos[:, self.op]
        self.touch = np.zeros((rows, len(parts)), bool)
        if touch is not None:
            self.touch = touch.T[:rows]
        self.counted = self._counted()  # (rows − 1, windows): of the state after each step
        self.window = np.broadcast_to(np.arange(len(parts)), self.counted.shape)[self.counted]
        recorded = np.stack([p.meta.records(robot.operated) for p in parts], axis=1)
        self.recorded = recorded[:, self.window]

    @property
    def rows(self) -> Array:
        """Number of rows that hold a joint, (n,)."""
        return np.asarray(self.recorded.sum(axis=1))

    def _counted(self) -> Array:
        """Return the rows that count: after the start has settled, every ROW_PERIOD_S, away from
        contacts.
        """
        rows = len(self.touch)
        after = max(1, round(SETTLE_S / max(p.dt for p in self.parts)))
        near = np.array([self.touch[max(0, t - after) : t + 1].any(axis=0) for t in range(rows)])
        time = np.arange(rows)
        counted = []
        for part in self.parts:
            thin = max(1, round(ROW_PERIOD_S / part.dt))
            settled = time >= SETTLE_S / part.dt
            counted.append(settled & (time < len(part)) & (time % thin == 0))
        return np.asarray(np.array(counted).T[1:] & ~near[1:])

    def flat_errors(self, values: dict[str, Array], links: ListOf[dict[str, Link]] = ()) -> Array:
        """Return q_sim − q_real in the rows that count, (k, n, rows) rad; values (k, n), `links`
        (k,).
        """
        sim, conditions = self._simulations(values)
        sim.set_servos(self.robot.operated, self._beside_windows(values))
        self._hold_standing_joints(sim)
        if links:
            self._set_links(sim, conditions, links)
        return self.simulated_errors(sim)

    def _simulations(self, values: dict[str, Array]) -> tuple[BatchSim, list[Condition]]:
        """Return simulations of all windows for each candidate, and the windows' conditions."""
        delay = np.array(self.robot.servo.delay)
        delay[self.op] = max(float(values["delay"].max()), self.robot.dt / self.robot.decimation)
        acting = self.robot.with_servo(delay=delay)
        has_terms = any(values[f].any() for f in SERVO_TERMS if f in values)
        if not has_terms:
            acting = acting.with_servo(**dict.fromkeys(SERVO_TERMS, 0.0))
        conditions = [Condition.of(s, self.robot)._replace(temperature=None) for s in self.parts]
        every = conditions * len(values["kp"])
        sim = BatchSim(acting, every, self.nthread, self.locked, servo_model=has_terms)
        return sim, conditions

    def _beside_windows(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return values (k, n) for each window, at its temperature, (k · windows, n)."""
        each = {f: np.repeat(x, len(self.parts), axis=0) for f, x in values.items()}
        temperature = recorded_temperatures(self.parts, self.op).T
        damping, frictionloss = warm_values(values, temperature)  # (k, n, windows)
        each["damping"] = damping.swapaxes(1, 2).reshape(-1, self.n)
        each["frictionloss"] = frictionloss.swapaxes(1, 2).reshape(-1, self.n)
        return each

    def _hold_standing_joints(self, sim: BatchSim) -> None:
        """Let joints that a window does not hold stand where the window says."""
        windows = len(self.parts)
        for window, part in enumerate(self.parts):
            own = slice(window, None, windows)  # simulations of all candidates
            # The joints of a simulation are its degrees of freedom.
            for joint in np.flatnonzero(~part.meta.records(sim.joint_names)):
                sim.batch.expand("dof_armature")[own, joint] = IMMOVABLE_ARMATURE
                if sim.servo_model is not None:
                    sim.servo_model.servos.armature[own, joint] = IMMOVABLE_ARMATURE
                    sim.servo_model.servos.terms["backlash"][own, joint] = 0.0

    def _set_links(
        self, sim: BatchSim, conditions: list[Condition], links: ListOf[dict[str, Link]]
    ) -> None:
        """Give each candidate's simulations its links."""
        models = []
        for one in links:
            robot = replace(self.robot, links=one)
            own = {c: with_links(model, robot) for c, model in sim.models.items()}
            models += [own[c] for c in conditions]
        for name in LINK_FIELDS:
            rows = np.array([getattr(model, name) for model in models])
            if rows.size:
                sim.batch.expand(name)[:] = rows

    def simulated_errors(self, sim: BatchSim) -> Array:
        """Return q_sim − q_real in the rows that count, (k, n, rows) rad, of simulations of k
        times the windows.
        """
        windows = len(self.parts)
        k = sim.num_envs // windows
        channels = rollout(sim, self.parts * k, self.corrector, touch=np.tile(self.touch, k))
        qpos = channels[0, 1:][..., self.op]
        each = qpos.reshape(len(qpos), k, windows, self.n)
        error = (each - self.real[1:, None]).astype(np.float32)
        errors = error.transpose(1, 3, 0, 2)[:, :, self.counted]
        errors = np.nan_to_num(errors, nan=MAX_ERROR_RAD).clip(-MAX_ERROR_RAD, MAX_ERROR_RAD)
        return np.asarray(errors * self.recorded)
