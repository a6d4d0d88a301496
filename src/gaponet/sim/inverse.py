"""The inverse of a simulator: the position targets, held for a control period, that lead it along a given motion.

In closed form where the simulator's numbers are known: the mean torque that the period asks for is inverse dynamics at
its mean acceleration and the mean of the states at which physics steps begin; the position actuator's is the mean of
kp·(u + offset − q) − kd·v over the physics steps, each as much as the motor can give. What is left is how torques vary
within a period.

By answers where it is a black box: it is asked where seven targets would lead it, all joints at once; what lies between
two of them is interpolated, asked again and mended.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.batch import Batch, BatchSim
from gaponet.sim.servo import friction_limit, present

PROBES = np.array([-0.4, -0.1, -0.02, 0.0, 0.02, 0.1, 0.4])  # rad, around the target of the period before
ALIKE, TRIED = 1e-4, 32  # rad: two simulators are one where targets of so many motions differ by less
NARROW, WIDE = 0.1, 3.0  # as a share of these at least, and so many times what is missing
MENDED, FINE = 2, 0.1  # times what was interpolated is mended, by so many rad at most
ALONE, SLIDING = 1e-3, 0.5  # rad by which a joint is asked alone, and rad/s at which all of them slide then
FLAT, LEAST, STANDS = 0.05, 1e-4, 0.1  # of an answer over a target: none, least, least of what it was
SAME = 1e-6  # rad: answers that differ by less are the same, as within a friction band

Answer = Callable[[Array, Array], tuple[Array, Array]]  # targets (k, num, n) rad, qvel (num, n) → next qpos, qvel


@dataclass(frozen=True)
class Period:
    """One control period of a motion of num robots, arrays (num, n).

    Attributes:
        qpos, qvel: At its start, rad, rad/s.
        next_qpos, next_qvel: At its end.
        friction: Share of its dry friction that each joint had against it at the end, in [−1, 1]: of a joint at rest,
            where in the band it stood.
    """

    qpos: Array
    qvel: Array
    next_qpos: Array
    next_qvel: Array
    friction: Array


class Inertia:
    """The inertia matrix among some degrees of freedom of the simulations of a batch, as of its last call."""

    def __init__(self, batch: Batch, model: mujoco.MjModel, dof: Array) -> None:
        place = np.full(model.nv, -1)
        place[dof] = np.arange(len(dof))
        row = place[np.repeat(np.arange(model.nv), model.M_rownnz)]  # MuJoCo keeps the lower triangle, row by row
        column = place[model.M_colind]
        self.kept = np.flatnonzero((row >= 0) & (column >= 0))
        self.row, self.column, self.n = row[self.kept], column[self.kept], len(dof)
        self.sparse: Array = batch.bind("M")

    def matrix(self, num: int) -> Array:
        """Mass matrices of the first num simulations, (num, n, n) kg·m²."""
        full = np.zeros((num, self.n, self.n))
        values = self.sparse[:num, self.kept]
        full[:, self.row, self.column] = values
        full[:, self.column, self.row] = values
        return full


class ClosedForm:
    """Targets of position actuators along a motion; no contacts, no joint limits. Its batch is nobody else's.

    Attributes:
        ahead: Control periods of a motion that must be known after the coming one, because servos are late.
    """

    def __init__(
        self, batch: Batch, model: mujoco.MjModel, joints: tuple[str, ...], nstep: Array, timestep: Array
    ) -> None:
        """
        Args:
            batch: Simulations to compute in, one per robot.
            model: The model of all of them, whatever they carry.
            joints: n names.
            nstep, timestep: Physics steps per control period, their length in s; (num,) each.

        Raises:
            UsageError: A joint without exactly one position actuator: ask for answers instead.
        """
        self.batch, self.num = batch, batch.nsim
        self.at = np.array([model.joint(name).qposadr[0] for name in joints])
        self.dof = np.array([model.joint(name).dofadr[0] for name in joints])
        act = np.array([_position_actuator(model, name) for name in joints])
        bias = _own(batch, model, "actuator_biasprm")[:, act]
        self.kp, self.kd = _own(batch, model, "actuator_gainprm")[:, act, 0], -bias[..., 2]
        self.offset, self.delay = bias[..., 0] / self.kp, model.actuator_delay[act]
        self.low, self.high = _most_torque(model, joints, act)
        self.frictionloss, self.damping = model.dof_frictionloss[self.dof], model.dof_damping[self.dof]
        user = (
            model.actuator_user[act].T
            if model.nuser_actuator == len(SERVO_TERMS)
            else np.zeros((len(SERVO_TERMS), len(act)))
        )
        self.law = present(dict(zip(SERVO_TERMS, user, strict=True)))
        self.explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER  # kd takes the speed before the step
        self.h, self.dt = timestep[:, None], (nstep * timestep)[:, None]
        self.ahead = int(np.ceil((self.delay / self.dt).max() - 1e-9))
        before, speeds = zip(*(self.within(int(n), int(nstep.max())) for n in nstep), strict=True)
        self.before, self.speeds = (np.array(x).transpose(1, 2, 0)[..., None] for x in (before, speeds))
        self.share = (np.arange(nstep.max())[:, None] < nstep) / nstep  # of each physics step, (steps, num)
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.bias, self.passive = batch.bind("qfrc_bias"), batch.bind("qfrc_passive")
        self.inertia = Inertia(batch, model, self.dof)

    @classmethod
    def of(cls, sim: BatchSim) -> ClosedForm:
        """Inverse dynamics in a batch of robots, which must be a batch of its own."""
        return cls(sim.batch, next(iter(sim.models.values())), sim.joint_names, sim.nstep, sim.timestep)

    def stand(self, data: mujoco.MjData) -> None:
        """Copy positions and velocities of a scene, (nq,) and (nv,)."""
        self.qpos[:], self.qvel[:] = data.qpos, data.qvel

    def __call__(self, periods: ListOf[Period], near: Array) -> Array:
        """The targets to send, (num, n) rad, not limited to any range.

        Args:
            periods: The coming one and `ahead` more.
            near: Not looked at.
        """
        held = np.stack([self._held(period) for period in periods])  # in force
        if not self.ahead:
            return held[0]
        late = np.broadcast_to(self.delay / self.dt, held[0].shape)
        whole = np.minimum(late.astype(int), self.ahead - 1)
        first, second = (np.take_along_axis(held, i[None], axis=0)[0] for i in (whole, whole + 1))
        return first + (late - whole) * (second - first)

    def _held(self, period: Period) -> Array:
        way, gain = period.next_qpos - period.qpos, period.next_qvel - period.qvel
        known = np.stack([self.h * period.qvel, self.h * period.next_qvel, way])
        qpos = period.qpos + np.einsum("ibkx,bkj->ikj", self.before, known)  # at which physics steps begin
        before = np.einsum("ibkx,bkj->ikj", self.speeds, known) / self.h
        after, mean = before[1:], lambda x: np.einsum("ik,ikj->kj", self.share, x)
        torque = self._torque(mean(qpos), mean(before[:-1]), gain / self.dt, period.friction)
        torque += self.damping * (mean(after) - mean(before[:-1]))
        back = self.kp * (qpos - self.offset) + self.kd * (before[:-1] if self.explicit else after)
        return self._told(np.clip(torque, self.low, self.high), back, mean)

    def _told(self, torque: Array, back: Array, mean: Callable[[Array], Array]) -> Array:
        """Targets (num, n) whose kp·u − back, (steps, num, n), is torque (num, n) in the mean, limited step by step."""
        out = (torque + mean(back)) / self.kp
        for _ in range(len(back)):
            asked = self.kp * out - back
            given = np.clip(asked, self.low, self.high)
            if (given == asked).all():
                break
            free = np.maximum(mean((given == asked).astype(float)), 1 / len(back))
            out = out + (torque - mean(given)) / (self.kp * free)
        return out

    def _torque(self, qpos: Array, qvel: Array, qacc: Array, friction: Array) -> Array:
        self.qpos[:, self.at], self.qvel[:, self.dof] = qpos, qvel
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        load = self.bias[:, self.dof]
        torque = load - self.passive[:, self.dof] + np.einsum("kij,kj->ki", self.inertia.matrix(self.num), qacc)
        return torque + friction * friction_limit(self.law, self.frictionloss, qvel, torque, load)

    def alike(self, other: ClosedForm, limits: Array) -> bool:
        """Return True if the inverses of two simulators of the same joints, limits (n, 2) rad, agree for any motion."""
        if self.ahead != other.ahead or not np.allclose(self.dt, other.dt):
            return False
        rng, n = np.random.default_rng(0), len(limits)
        for _ in range(TRIED):
            low, high = np.clip(limits, -np.pi, np.pi).T
            q = low + (high - low) * rng.random((1, n))
            v, a, friction = (rng.uniform(-top, top, (1, n)) for top in (1.0, 5.0, 1.0))
            ends = q + self.dt * (v + 0.5 * self.dt * a), v + self.dt * a
            period = Period(q, v, *ends, friction)
            told = [inverse([period] * (1 + inverse.ahead), q) for inverse in (self, other)]
            if np.abs(told[0] - told[1]).max() > ALIKE:
                return False
        return True

    @staticmethod
    def within(count: int, rows: int) -> tuple[Array, Array]:
        """Positions before each of `count` physics steps of h, and speeds, from what is known at a period's ends.

        Speeds follow a parabola; MuJoCo's positions follow from the speeds after each step.

        Returns:
            Weights of h·q̇ at the start, of h·q̇ at the end, and the way: of positions beyond the first, (rows, 3), and
            of h·speeds from the first to that after the last step, (rows + 1, 3). Rows beyond the period are zero.
        """
        i = np.arange(count + 1.0)
        shape = np.linalg.pinv([[count, count**2], [i.sum(), (i**2).sum()]])  # α, β of v = v_0 + α i + β i²
        known = shape @ [[-1.0, 1.0, 0.0], [-count, 0.0, 1.0]]
        speeds, before = np.zeros((rows + 1, 3)), np.zeros((rows, 3))
        speeds[: count + 1] = np.stack([i, i**2], axis=1) @ known + [1.0, 0.0, 0.0]
        before[1:count] = speeds[1:count].cumsum(axis=0)
        return before, speeds


class Probed:
    """Targets by the simulator's own answers.

    Joints pull at each other, and each has a friction band and a most torque of its own. So it is asked in each period
    how all joints answer to each one, while all slide and no motor is near its limit; and what an answer misses is told
    in rad of each joint's own target: there, a joint at its limit is nobody else's concern.
    """

    def __init__(self, answer: Answer, dt: Array | float, ahead: int = 0) -> None:
        """
        Args:
            answer: Where targets, held, would lead each robot, from where it is, with speeds that are given; in free
                space: a target is not pushed through what it touches.
            dt: Control period, s, one or (num, 1).
            ahead: Control periods after the coming one at whose end is answered, because servos are late.
        """
        self.answer, self.dt, self.ahead = answer, dt, ahead
        self._slope: Array | None = None  # of each joint's answer over each joint's target, (num, n, n)

    def __call__(self, periods: ListOf[Period], near: Array) -> Array:
        """Targets (num, n) rad that lead to where the period ends, the nearest to `near` among those that do so.

        Position and speed at the end count together, q + q̇·dt: the speed alone would drift, the position alone ring.
        """
        period, own = periods[-1], np.linalg.inv(self._slopes(periods[0]))

        def missed(targets: Array) -> Array:
            qpos, qvel = self.answer(targets, periods[0].qvel)
            return np.einsum("kij,pkj->pki", own, qpos - period.next_qpos + self.dt * (qvel - period.next_qvel))

        left = missed(near[None])[0]
        wide = np.clip(WIDE * np.abs(left) / PROBES[-1], NARROW, 1.0)
        asked = PROBES[PROBES != 0, None, None] * wide
        probed = np.insert(missed(near + asked), len(PROBES) // 2, left, axis=0)
        more, slope = _crossing(_rising(probed / wide))
        away = near - periods[0].qpos
        wound = (slope <= FLAT) & (left * np.sign(away) > FLAT * np.abs(away))  # limited far beyond what is asked for
        more, moves = np.where(wound, -away, more * wide), wound | (slope > FLAT)
        told, lefts = [near], [left]
        for _ in range(1 + MENDED):
            told.append(told[-1] + more)
            lefts.append(missed(told[-1][None])[0])
            steps = np.abs(more) > SAME
            slope = np.maximum(slope, np.divide(lefts[-1] - lefts[-2], more, out=slope.copy(), where=steps))
            more = np.where(moves, np.clip(-lefts[-1] / np.maximum(slope, FLAT), -FINE, FINE), 0.0)
        best = np.abs(lefts).sum(axis=2).argmin(axis=0)
        return np.array(told)[best, np.arange(len(near))]

    def _slopes(self, period: Period) -> Array:
        """How all joints answer to each, (num, n, n); of one that does not move, what was known stays."""
        n = period.qpos.shape[1]
        if self._slope is None:
            self._slope = np.tile(np.eye(n), (len(period.qpos), 1, 1)) * LEAST
        told = period.qpos + ALONE * np.concatenate([np.zeros((1, n)), np.eye(n)])[:, None]
        qpos, qvel = self.answer(told, np.where(period.next_qpos < period.qpos, -SLIDING, SLIDING))
        reached = qpos + self.dt * qvel
        slope = ((reached[1:] - reached[0]) / ALONE).transpose(1, 2, 0)
        moves = np.einsum("kjj->kj", slope) > STANDS * np.einsum("kjj->kj", self._slope)
        self._slope = np.where(moves[:, None], slope, self._slope)
        return self._slope


def _own(batch: Batch, model: mujoco.MjModel, name: str) -> Array:
    """A field of the model by simulation, (num or 1, …)."""
    values = batch.expanded(name)
    return getattr(model, name)[None] if values is None else values


def _rising(missed: Array) -> Array:
    """Values over PROBES, (7, num, n), with what falls again left out, from the middle outwards.

    A target that asks for more than a motor can give is no answer of its joint, but of those that pull at it.
    """
    middle = len(PROBES) // 2
    below = np.minimum.accumulate(missed[middle::-1], axis=0)[:0:-1]
    return np.concatenate([below, np.maximum.accumulate(missed[middle:], axis=0)])


def _crossing(missed: Array) -> tuple[Array, Array]:
    """Where values that rise over PROBES, (7, num, n), pass zero, and how steeply.

    Where one of them is as good as zero, or none passes it, the least target of the best: what nothing answers to, by
    friction or because a motor gives all it can, is not asked for in vain.
    """
    above = np.clip((missed < 0).sum(axis=0), 1, len(PROBES) - 1)
    low, high = (np.take_along_axis(missed, i[None], axis=0)[0] for i in (above - 1, above))
    rise, wide = np.maximum(high - low, 1e-15), PROBES[above] - PROBES[above - 1]
    passed = (low < -SAME) & (high > SAME)
    least = (np.abs(missed) + FLAT * np.abs(PROBES)[:, None, None]).argmin(axis=0)
    return np.where(passed, PROBES[above - 1] - low / rise * wide, PROBES[least]), rise / wide


def _most_torque(model: mujoco.MjModel, joints: tuple[str, ...], actuators: Array) -> Array:
    """The least and the most that motors give, (2, n) N·m; ±inf where there is no limit."""
    at = np.array([model.joint(name).id for name in joints])
    limits = [(model.actuator_forcelimited[actuators], model.actuator_forcerange[actuators]),
              (model.jnt_actfrclimited[at], model.jnt_actfrcrange[at])]  # fmt: skip
    low, high = zip(*(np.where(limited[:, None], both, [-np.inf, np.inf]).T for limited, both in limits), strict=True)
    return np.array([np.max(low, axis=0), np.min(high, axis=0)])


def _position_actuator(model: mujoco.MjModel, joint: str) -> int:
    """The index of the one actuator of a joint, which must be a position actuator without gear or dynamics."""
    of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    mine = np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == model.joint(joint).id))
    if len(mine) != 1:
        raise UsageError(f"joint '{joint}' has {len(mine)} actuators in the simulator; there must be one, position")
    i = int(mine[0])
    kinds = (model.actuator_gaintype[i], model.actuator_biastype[i], model.actuator_dyntype[i])
    plain = kinds == (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE, mujoco.mjtDyn.mjDYN_NONE)
    kp = model.actuator_gainprm[i, 0]
    if not plain or kp <= 0 or abs(model.actuator_biasprm[i, 1] + kp) > 1e-6 * kp or model.actuator_gear[i, 0] != 1:
        raise UsageError(f"joint '{joint}': its actuator is no position actuator (<position>, gear 1) in the simulator")
    return i
