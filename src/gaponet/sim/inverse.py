"""The inverse of a simulator: the position targets, held for a control period, that lead it along a given motion.

In closed form where the simulator's numbers are known: the mean torque that the period asks for is inverse dynamics at
its mean acceleration and the mean of the states at which physics steps begin, q̄ among them; the position actuator's is
kp·(u + offset − q̄) − kd·v̄, v̄ the mean speed. What is left is how torques vary within a period.

By answers where it is a black box: it is asked where seven targets would lead it, what lies between two of them is
interpolated, asked again and mended. All joints are asked at once, in proportions in which they do not pull at each
other: where a forearm swings, moving the shoulder alone moves the elbow the other way, and the interpolation diverges
(docs/log.md). How they pull is asked too, of one joint in each period.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch

from gaponet.arrays import Array
from gaponet.errors import UsageError
from gaponet.robot import LAW
from gaponet.sim.batch import BatchSim
from gaponet.sim.servo import friction_limit

PROBES = np.array([-0.4, -0.1, -0.02, 0.0, 0.02, 0.1, 0.4])  # rad, around the target of the period before
ALIKE, TRIED = 1e-4, 32  # rad: two simulators are one where targets of so many motions differ by less
MENDED, FINE = 2, 0.02  # times what was interpolated is mended, by so many rad at most
ALONE = 0.1  # rad: by which one joint is asked alone
FLAT, STANDS = 1e-3, 0.3  # of an answer over a target; the same as a share of what it was: below it a joint stands
SAME = 1e-6  # rad: answers that differ by less are the same, as within a friction band

Answer = Callable[[Array], tuple[Array, Array]]  # targets (7, num, n) rad → next qpos, qvel, each (7, num, n)


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
        """Of the first num simulations, (num, n, n) kg·m²."""
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
            model: Of all of them, whatever they carry.
            joints: n names.
            nstep, timestep: Physics steps per control period, their length in s; (num,) each.

        Raises:
            UsageError: A joint without exactly one position actuator: ask for answers instead.
        """
        self.batch, self.num = batch, batch.nsim
        self.at = np.array([model.joint(name).qposadr[0] for name in joints])
        self.dof = np.array([model.joint(name).dofadr[0] for name in joints])
        act = np.array([position_actuator(model, name) for name in joints])
        bias = _own(batch, model, "actuator_biasprm")[:, act]
        self.kp, self.kd = _own(batch, model, "actuator_gainprm")[:, act, 0], -bias[..., 2]
        self.offset, self.delay = bias[..., 0] / self.kp, model.actuator_delay[act]
        limited = model.actuator_forcelimited[act].astype(bool)[:, None]
        self.low, self.high = np.where(limited, model.actuator_forcerange[act], [-np.inf, np.inf]).T
        self.frictionloss, self.damping = model.dof_frictionloss[self.dof], model.dof_damping[self.dof]
        self.law = dict(zip(LAW, model.actuator_user[act].T, strict=True)) if model.nuser_actuator == len(LAW) else None
        self.explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER  # kd takes the speed before the step
        self.h, self.dt = timestep[:, None], (nstep * timestep)[:, None]
        self.ahead = int(np.ceil((self.delay / self.dt).max() - 1e-9))
        self.weights = np.array([mean_before(int(n)) for n in nstep]).T[:, :, None]
        self.qpos, self.qvel = batch.bind("qpos"), batch.bind("qvel")
        self.bias, self.passive = batch.bind("qfrc_bias"), batch.bind("qfrc_passive")
        self.inertia = Inertia(batch, model, self.dof)

    @classmethod
    def of(cls, sim: BatchSim) -> ClosedForm:
        """Of the simulator of a batch of robots, which must be a batch of its own."""
        return cls(sim.batch, next(iter(sim.models.values())), sim.joint_names, sim.nstep, sim.timestep)

    def stand(self, data: mujoco.MjData) -> None:
        """What else there is in a scene stands as here."""
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
        first, last, whole = self.weights
        qpos = period.qpos + self.h * (first * period.qvel + last * period.next_qvel) + whole * way
        after = way / self.dt  # the mean of the speeds after each physics step, and before
        before = after - gain * self.h / self.dt
        torque = self._torque(qpos, before, gain / self.dt, period.friction) + self.damping * (after - before)
        force = np.clip(torque + self.kd * (before if self.explicit else after), self.low, self.high)
        return qpos + force / self.kp - self.offset

    def _torque(self, qpos: Array, qvel: Array, qacc: Array, friction: Array) -> Array:
        self.qpos[:, self.at], self.qvel[:, self.dof] = qpos, qvel
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        load = self.bias[:, self.dof]
        torque = load - self.passive[:, self.dof] + np.einsum("kij,kj->ki", self.inertia.matrix(self.num), qacc)
        limit = self.frictionloss
        if self.law is not None:
            limit = friction_limit(self.law, limit, qvel, torque, load)
        return torque + friction * limit


def alike(one: ClosedForm, other: ClosedForm, limits: Array) -> bool:
    """Whether two simulators of the same joints, with limits (n, 2) rad, are one: by their inverses of any motion."""
    if one.ahead != other.ahead or not np.allclose(one.dt, other.dt):
        return False
    rng, n = np.random.default_rng(0), len(limits)
    for _ in range(TRIED):
        low, high = np.clip(limits, -np.pi, np.pi).T
        q = low + (high - low) * rng.random((1, n))
        v, a, friction = (rng.uniform(-top, top, (1, n)) for top in (1.0, 5.0, 1.0))
        ends = q + one.dt * (v + 0.5 * one.dt * a), v + one.dt * a
        period = Period(q, v, *ends, friction)
        told = [inverse([period] * (1 + inverse.ahead), q) for inverse in (one, other)]
        if np.abs(told[0] - told[1]).max() > ALIKE:
            return False
    return True


class Probed:
    """Targets by the simulator's own answers."""

    def __init__(self, answer: Answer, dt: Array | float, ahead: int = 0) -> None:
        """
        Args:
            answer: Where targets, held, would lead each robot, in free space: a target is not pushed through what it
                touches.
            dt: Control period, s, one or (num, 1).
            ahead: Control periods after the coming one at whose end is answered, because servos are late.
        """
        self.answer, self.dt, self.ahead = answer, dt, ahead
        self._slope: Array | None = None  # of each joint's answer over each joint's target, (num, n, n)
        self._turn = 0  # the joint that is asked alone next

    def __call__(self, periods: ListOf[Period], near: Array) -> Array:
        """Targets (num, n) rad that lead to where the period ends, the nearest to `near` among those that do so.

        Position and speed at the end count together, q + q̇·dt: the speed alone would drift, the position alone ring.
        """
        period, n = periods[-1], near.shape[1]
        if self._slope is None:
            self._slope = np.tile(np.eye(n), (len(near), 1, 1)) * FLAT
            self._ask_alone(near, self._missed(near[None], period)[0], period, range(n))
        pull = np.linalg.inv(self._slope)
        pull /= np.abs(pull).max(axis=1, keepdims=True)  # on a joint for another
        missed = self._missed(near + PROBES[:, None, None] * pull.sum(axis=2), period)
        found, slope = _crossing(_rising(missed))
        out = near + np.einsum("kij,kj->ki", pull, found)
        left, more, moves = missed[0], np.zeros_like(found), slope > FLAT
        told, lefts = [near], [missed[len(PROBES) // 2]]
        for _ in range(1 + MENDED):
            before, left = left, self._missed(out[None], period)[0]
            told.append(out)
            lefts.append(left)
            steps = np.abs(more) > SAME
            slope = np.maximum(slope, np.divide(left - before, more, out=slope.copy(), where=steps))
            more = np.where(moves, np.clip(-left / np.maximum(slope, FLAT), -FINE, FINE), 0.0)
            out = out + np.einsum("kij,kj->ki", pull, more)
        self._ask_alone(near, lefts[0], period, [self._turn])
        self._turn = (self._turn + 1) % n
        best = np.abs(lefts).max(axis=2).argmin(axis=0)  # where motors give all they can, mending may make it worse
        return np.array(told)[best, np.arange(len(near))]

    def _ask_alone(self, near: Array, missed: Array, period: Period, joints: Iterable[int]) -> None:
        """How all joints answer to one; where it stands, by friction or at a limit, what was known stays.

        It is asked towards where it is, away from what its motor can give at most.
        """
        assert self._slope is not None
        for j in joints:
            told, step = near.copy(), np.where(near[:, j] > period.qpos[:, j], -ALONE, ALONE)
            told[:, j] += step
            slope = (self._missed(told[None], period)[0] - missed) / step[:, None]
            moves = slope[:, j] > np.maximum(FLAT, STANDS * self._slope[:, j, j])
            self._slope[moves, :, j] = slope[moves]

    def _missed(self, targets: Array, period: Period) -> Array:
        qpos, qvel = self.answer(targets)
        return qpos - period.next_qpos + self.dt * (qvel - period.next_qvel)


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
    best = np.abs(missed) <= np.abs(missed).min(axis=0) + SAME
    least = np.where(best, np.abs(PROBES)[:, None, None], np.inf).argmin(axis=0)
    return np.where(passed, PROBES[above - 1] - low / rise * wide, PROBES[least]), rise / wide


def mean_before(count: int) -> tuple[float, float, float]:
    """The mean of the positions before each of `count` physics steps of h, from what is known at a period's ends.

    Speeds follow a parabola; MuJoCo's positions follow from the speeds after each step.

    Returns:
        Weights of h·q̇ at the start, of h·q̇ at the end, and of the way; they add up to what is between that mean and the
        position at the start.
    """
    i = np.arange(1.0, count + 1)
    shape = np.linalg.pinv([[count, count**2], [i.sum(), (i**2).sum()]])  # α, β of v = v_0 + α i + β i²
    reached = np.cumsum([i**0, i, i**2], axis=1)[:, :-1].sum(axis=1) / count
    last, whole = reached[1:] @ shape
    return float(reached[0] - last - count * whole), float(last), float(whole)


def position_actuator(model: mujoco.MjModel, joint: str) -> int:
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
