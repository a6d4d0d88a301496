"""Inverse of a simulator: position targets, held for a control period, that move it along a given
motion.

The mean torque of a period is inverse dynamics at its mean
acceleration and at the mean state before its physics steps. A position actuator gives the mean of
kp·(u + offset − q) − kd·v over the physics steps, each within the motor's limits. The remaining
error is the variation of torques within a period.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.batch import Batch, BatchSim
from gaponet.sim.servo import overcome_friction, present, torque_range

# Agreement of two simulators: largest difference of targets, and number of random motions that are
# compared.
MAX_TARGET_DIFFERENCE_RAD = 1e-4
COMPARED_MOTIONS = 32


@dataclass(frozen=True)
class Period:
    """One control period of a motion of num robots, arrays (num, n).

    Attributes:
        qpos, qvel: At its start, rad, rad/s.
        next_qpos, next_qvel: At its end.
        friction: Friction against each joint's motion at the end over its limit, in [−1, 1]; of a
            joint at rest, its place in the friction band.
    """

    qpos: Array
    qvel: Array
    next_qpos: Array
    next_qvel: Array
    friction: Array


class Inertia:
    """Inertia matrix of some degrees of freedom of a batch's simulations, as of its last call."""

    def __init__(self, batch: Batch, model: mujoco.MjModel, dof: Array) -> None:
        place = np.full(model.nv, -1)
        place[dof] = np.arange(len(dof))
        # MuJoCo keeps the lower triangle, row by row
        row = place[np.repeat(np.arange(model.nv), model.M_rownnz)]
        column = place[model.M_colind]
        self._entries = np.flatnonzero((row >= 0) & (column >= 0))
        self.row = row[self._entries]
        self.column = column[self._entries]
        self.n = len(dof)
        self.sparse: Array = batch.bind("M")

    def matrix(self, num: int) -> Array:
        """Mass matrices of the first num simulations, (num, n, n) kg·m²."""
        full = np.zeros((num, self.n, self.n))
        values = self.sparse[:num, self._entries]
        full[:, self.row, self.column] = values
        full[:, self.column, self.row] = values
        return full


class AnalyticInverse:
    """Targets of position actuators along a motion, without contacts and joint limits.

    Attributes:
        ahead: Number of control periods after the coming one that a call needs, because servos have
            a delay.
        saturated: Joints whose motors cannot give the torque of the last period of a call, (num,
            n).
    """

    def __init__(
        self,
        batch: Batch,
        model: mujoco.MjModel,
        joints: tuple[str, ...],
        nstep: Array,
        timestep: Array,
    ) -> None:
        """
        Args:
            batch: Simulations to compute in, one per robot, with `model`; payloads may differ.
                Nothing else may use them.
            nstep, timestep: Physics steps per control period, their length in s; (num,) each.

        Raises:
            UsageError: A joint without exactly one position actuator.
        """
        self.batch = batch
        self.num = batch.nsim
        self.at = np.array([model.joint(name).qposadr[0] for name in joints])
        self.dof = np.array([model.joint(name).dofadr[0] for name in joints])
        act = np.array([_position_actuator(model, name) for name in joints])
        bias = _own(batch, model, "actuator_biasprm")[:, act]
        self.kp = _own(batch, model, "actuator_gainprm")[:, act, 0]
        self.kd = -bias[..., 2]
        self.offset = bias[..., 0] / self.kp
        self.delay = _own(batch, model, "actuator_delay")[:, act]
        self.low, self.high = _most_torque(model, joints, act)
        self.frictionloss = _own(batch, model, "dof_frictionloss")[:, self.dof]
        self.damping = _own(batch, model, "dof_damping")[:, self.dof]
        terms = {}
        if model.nuser_actuator == len(SERVO_TERMS):
            terms = dict(zip(SERVO_TERMS, model.actuator_user[act].T, strict=True))
        self.terms = present(terms)
        # kd takes the speed before the step
        self.explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        self.h = timestep[:, None]
        self.dt = (nstep * timestep)[:, None]
        self.ahead = int(np.ceil((self.delay / self.dt).max() - 1e-9))
        within = [self.within_period(int(n), int(nstep.max())) for n in nstep]
        before, speeds = zip(*within, strict=True)
        self.before = np.array(before).transpose(1, 2, 0)[..., None]
        self.speeds = np.array(speeds).transpose(1, 2, 0)[..., None]
        # of each physics step, (steps, num)
        self.share = (np.arange(nstep.max())[:, None] < nstep) / nstep
        self.qpos = batch.bind("qpos")
        self.qvel = batch.bind("qvel")
        self.bias = batch.bind("qfrc_bias")
        self.passive = batch.bind("qfrc_passive")
        self.inertia = Inertia(batch, model, self.dof)
        self.saturated = np.zeros((self.num, len(joints)), bool)

    @classmethod
    def of(cls, sim: BatchSim) -> AnalyticInverse:
        """Return the inverse of a simulation that nothing else uses."""
        return cls(
            sim.batch,
            next(iter(sim.models.values())),
            sim.joint_names,
            sim.periods.nstep,
            sim.periods.timestep,
        )

    def set_state(self, data: mujoco.MjData) -> None:
        """Copy positions and velocities of a scene, (nq,) rad and (nv,) rad/s."""
        self.qpos[:] = data.qpos
        self.qvel[:] = data.qvel

    def __call__(self, periods: ListOf[Period]) -> Array:
        """Return the targets to send, (num, n) rad, not limited to any range.

        periods: The coming one and `ahead` more.
        """
        held = np.stack([self.targets_in_force(period) for period in periods])
        if not self.ahead:
            undelayed: Array = held[0]
            return undelayed
        late = np.broadcast_to(self.delay / self.dt, held[0].shape)
        whole = np.minimum(late.astype(int), self.ahead - 1)
        first = np.take_along_axis(held, whole[None], axis=0)[0]
        second = np.take_along_axis(held, whole[None] + 1, axis=0)[0]
        delayed: Array = first + (late - whole) * (second - first)
        return delayed

    def targets_in_force(self, period: Period) -> Array:
        """Return the targets that must be in force in a period, (num, n) rad, not limited to any
        range.
        """
        displacement = period.next_qpos - period.qpos
        gain = period.next_qvel - period.qvel
        ends = np.stack([self.h * period.qvel, self.h * period.next_qvel, displacement])
        # at which physics steps begin
        qpos = period.qpos + np.einsum("ibkx,bkj->ikj", self.before, ends)
        before = np.einsum("ibkx,bkj->ikj", self.speeds, ends) / self.h
        after = before[1:]
        mean = self._mean
        torque = self._torque(mean(qpos), mean(before[:-1]), gain / self.dt, period.friction)
        torque += self.damping * (mean(after) - mean(before[:-1]))
        back = self.kp * (qpos - self.offset) + self.kd * (before[:-1] if self.explicit else after)
        low = self.low
        high = self.high
        mean_low = low
        mean_high = high
        no_load = self.terms.get("no_load_speed")
        if no_load is not None:
            low, high = torque_range(self.high, before[:-1] / no_load)
            mean_low = mean(low)
            mean_high = mean(high)
        self.saturated = (torque < mean_low) | (torque > mean_high)
        return self._targets(np.clip(torque, mean_low, mean_high), back, low, high)

    def _mean(self, values: Array) -> Array:
        """Return the mean over the physics steps of a period, (steps, num, n) → (num, n)."""
        mean: Array = np.einsum("ik,ikj->kj", self.share, values)
        return mean

    def _targets(self, torque: Array, back: Array, low: Array, high: Array) -> Array:
        """Return targets u (num, n) for which the mean over steps of kp·u − back, (steps, num, n),
        within the motors' limits, (n,) or (steps, num, n), is torque (num, n).
        """
        mean = self._mean
        out = (torque + mean(back)) / self.kp
        for _ in range(len(back)):
            requested = self.kp * out - back
            applied = np.clip(requested, low, high)
            if (applied == requested).all():
                break
            free = np.maximum(mean((applied == requested).astype(float)), 1 / len(back))
            out = out + (torque - mean(applied)) / (self.kp * free)
        result: Array = out
        return result

    def _torque(self, qpos: Array, qvel: Array, qacc: Array, friction: Array) -> Array:
        self.qpos[:, self.at] = qpos
        self.qvel[:, self.dof] = qvel
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        load = self.bias[:, self.dof]
        torque = (
            load
            - self.passive[:, self.dof]
            + np.einsum("kij,kj->ki", self.inertia.matrix(self.num), qacc)
        )
        against = overcome_friction(self.terms, self.frictionloss, qvel, friction, torque, load)
        return np.asarray(torque + against)

    def agrees_with(self, other: AnalyticInverse, limits: Array) -> bool:
        """Return True if the inverses of two simulators of the same joints, limits (n, 2) rad,
        agree for any motion.
        """
        if self.ahead != other.ahead or not np.allclose(self.dt, other.dt):
            return False
        rng = np.random.default_rng(0)
        n = len(limits)
        for _ in range(COMPARED_MOTIONS):
            low, high = np.clip(limits, -np.pi, np.pi).T
            q = low + (high - low) * rng.random((1, n))
            v = rng.uniform(-1.0, 1.0, (1, n))
            a = rng.uniform(-5.0, 5.0, (1, n))
            friction = rng.uniform(-1.0, 1.0, (1, n))
            q_end = q + self.dt * (v + 0.5 * self.dt * a)
            v_end = v + self.dt * a
            period = Period(q, v, q_end, v_end, friction)
            mine = self([period] * (1 + self.ahead))
            theirs = other([period] * (1 + other.ahead))
            if np.abs(mine - theirs).max() > MAX_TARGET_DIFFERENCE_RAD:
                return False
        return True

    @staticmethod
    def within_period(count: int, rows: int) -> tuple[Array, Array]:
        """Return positions before each of `count` physics steps of h, and speeds, from the states
        at a period's ends.

        Speeds follow a parabola; MuJoCo's positions follow from the speeds after each step.

        Returns:
            Weights of h·q̇ at the start, of h·q̇ at the end, and the way: of positions beyond the
            first, (rows, 3), and of h·speeds from the first to that after the last step, (rows + 1,
            3). Rows beyond the period are zero.
        """
        i = np.arange(count + 1.0)
        # α, β of v = v_0 + α i + β i²
        shape = np.linalg.pinv([[count, count**2], [i.sum(), (i**2).sum()]])
        weights = shape @ [[-1.0, 1.0, 0.0], [-count, 0.0, 1.0]]
        speeds = np.zeros((rows + 1, 3))
        before = np.zeros((rows, 3))
        speeds[: count + 1] = np.stack([i, i**2], axis=1) @ weights + [1.0, 0.0, 0.0]
        before[1:count] = speeds[1:count].cumsum(axis=0)
        return before, speeds


def _own(batch: Batch, model: mujoco.MjModel, name: str) -> Array:
    """Return a field of the model by simulation, (num or 1, …)."""
    values = batch.expanded(name)
    result: Array = getattr(model, name)[None] if values is None else values
    return result


def _most_torque(model: mujoco.MjModel, joints: tuple[str, ...], actuators: Array) -> Array:
    """Return the least and the largest torque of motors, (2, n) N·m; ±inf without a limit."""
    at = np.array([model.joint(name).id for name in joints])
    limits = [
        (model.actuator_forcelimited[actuators], model.actuator_forcerange[actuators]),
        (model.jnt_actfrclimited[at], model.jnt_actfrcrange[at]),
    ]
    low, high = zip(
        *(np.where(limited[:, None], both, [-np.inf, np.inf]).T for limited, both in limits),
        strict=True,
    )
    return np.array([np.max(low, axis=0), np.min(high, axis=0)])


def _position_actuator(model: mujoco.MjModel, joint: str) -> int:
    """Return the index of a joint's only actuator; refuses all but position actuators without gear
    and dynamics.
    """
    of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    mine = np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == model.joint(joint).id))
    if len(mine) != 1:
        raise UsageError(
            f"joint '{joint}' has {len(mine)} actuators in the simulator; there must be one, "
            "position"
        )
    i = int(mine[0])
    kinds = (model.actuator_gaintype[i], model.actuator_biastype[i], model.actuator_dyntype[i])
    plain = kinds == (
        mujoco.mjtGain.mjGAIN_FIXED,
        mujoco.mjtBias.mjBIAS_AFFINE,
        mujoco.mjtDyn.mjDYN_NONE,
    )
    kp = model.actuator_gainprm[i, 0]
    if (
        not plain
        or kp <= 0
        or abs(model.actuator_biasprm[i, 1] + kp) > 1e-6 * kp
        or model.actuator_gear[i, 0] != 1
    ):
        raise UsageError(
            f"joint '{joint}': its actuator is no position actuator (<position>, gear 1) in the "
            "simulator"
        )
    return i
