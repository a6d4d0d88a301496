"""Inverse of a simulator: position targets, held for a control period, that move it along a given
motion.

The mean torque of a period is inverse dynamics at its mean acceleration and at the mean state
before its physics steps. A position actuator gives the mean of kp·(u + offset − q) − kd·v over the
physics steps, each within the motor's limits. The remaining error is the variation of torques
within a period.
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
from gaponet.sim.commands import ControlPeriods
from gaponet.sim.model import driven_joints, joint_addresses
from gaponet.sim.servo import ServoTerms, overcome_friction, present, torque_range

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


class InverseDynamics:
    """Torque of motion of n joints in a batch's simulations, without dry friction."""

    def __init__(self, batch: Batch, model: mujoco.MjModel, joints: tuple[str, ...]) -> None:
        self._batch = batch
        self._at, self._dof = joint_addresses(model, joints)
        self._qpos = batch.bind("qpos")
        self._qvel = batch.bind("qvel")
        self._bias = batch.bind("qfrc_bias")
        self._passive = batch.bind("qfrc_passive")
        self._inertia = Inertia(batch, model, self._dof)

    def set_state(self, data: mujoco.MjData) -> None:
        """Copy positions and velocities of a scene, (nq,) rad and (nv,) rad/s."""
        self._qpos[:] = data.qpos
        self._qvel[:] = data.qvel

    def torques(self, qpos: Array, qvel: Array, qacc: Array) -> tuple[Array, Array]:
        """Return the torque of motions (num, n), rad and its derivatives, and the part of gravity
        and Coriolis forces, (num, n) N·m.
        """
        self._qpos[:, self._at] = qpos
        self._qvel[:, self._dof] = qvel
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        load = self._bias[:, self._dof]
        inertia = self._inertia.matrix(self._batch.nsim)
        torque = load - self._passive[:, self._dof] + np.einsum("kij,kj->ki", inertia, qacc)
        return torque, load


@dataclass(frozen=True)
class PositionServos:
    """Position actuators of n joints, and the joints' friction; (num, n), or (1, n) where all
    simulations have the same.

    Attributes:
        kp, kd: Gains, N·m/rad and N·m·s/rad.
        offset: Zero offset, rad.
        delay: Age of the target in force, s.
        low, high: Least and largest torque at rest, (n,) N·m; ±inf without a limit.
        frictionloss, damping: Of the joints, N·m and N·m·s/rad.
        terms: Terms of the servo model, as of `present`.
    """

    kp: Array
    kd: Array
    offset: Array
    delay: Array
    low: Array
    high: Array
    frictionloss: Array
    damping: Array
    terms: ServoTerms

    @classmethod
    def of(cls, batch: Batch, model: mujoco.MjModel, joints: tuple[str, ...]) -> PositionServos:
        """Return the servos of a batch's simulations.

        Raises:
            UsageError: A joint without exactly one position actuator.
        """
        _, dof = joint_addresses(model, joints)
        act = np.array([_position_actuator(model, name) for name in joints])
        bias = _own(batch, model, "actuator_biasprm")[:, act]
        kp = _own(batch, model, "actuator_gainprm")[:, act, 0]
        low, high = _most_torque(model, joints, act)
        terms = {}
        if model.nuser_actuator == len(SERVO_TERMS):
            terms = dict(zip(SERVO_TERMS, model.actuator_user[act].T, strict=True))
        return cls(
            kp=kp,
            kd=-bias[..., 2],
            offset=bias[..., 0] / kp,
            delay=_own(batch, model, "actuator_delay")[:, act],
            low=low,
            high=high,
            frictionloss=_own(batch, model, "dof_frictionloss")[:, dof],
            damping=_own(batch, model, "dof_damping")[:, dof],
            terms=present(terms),
        )

    def torque_limits(self, speed: Array) -> tuple[Array, Array]:
        """Return the least and the largest torque at joint speeds (…, n) rad/s, in N·m; (n,) where
        they do not depend on them.
        """
        no_load = self.terms.get("no_load_speed")
        if no_load is None:
            return self.low, self.high
        low, high = torque_range(self.high, speed / no_load)
        return low, high


class PhysicsSteps:
    """Physics steps within the control periods of num simulations, whose motion is known at the
    periods' ends.

    Attributes:
        h: Length of a physics step, (num, 1) s.
        dt: Length of a period, (num, 1) s.
    """

    def __init__(self, periods: ControlPeriods) -> None:
        nstep = periods.nstep
        self.h = periods.timestep[:, None]
        self.dt = periods.seconds[:, None]
        within = [weights_within_period(int(n), int(nstep.max())) for n in nstep]
        positions, speeds = zip(*within, strict=True)
        self._positions = np.array(positions).transpose(1, 2, 0)[..., None]
        self._speeds = np.array(speeds).transpose(1, 2, 0)[..., None]
        # of each physics step, (steps, num)
        self._share = (np.arange(nstep.max())[:, None] < nstep) / nstep

    def states(self, period: Period) -> tuple[Array, Array]:
        """Return positions at the start of each step, (steps, num, n) rad, and speeds at the start
        of the first and at the end of each, (steps + 1, num, n) rad/s.
        """
        displacement = period.next_qpos - period.qpos
        ends = np.stack([self.h * period.qvel, self.h * period.next_qvel, displacement])
        qpos = period.qpos + np.einsum("ibkx,bkj->ikj", self._positions, ends)
        speeds = np.einsum("ibkx,bkj->ikj", self._speeds, ends) / self.h
        return qpos, speeds

    def mean(self, values: Array) -> Array:
        """Return the mean over the steps of a period, (steps, num, n) → (num, n)."""
        mean: Array = np.einsum("ik,ikj->kj", self._share, values)
        return mean


def weights_within_period(count: int, rows: int) -> tuple[Array, Array]:
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


class AnalyticInverse:
    """Targets of position actuators along a motion, without contacts and joint limits.

    Attributes:
        servos: The actuators.
        steps: Physics steps of a control period.
        dynamics: Torque of motion.
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
        periods: ControlPeriods,
    ) -> None:
        """
        Args:
            batch: Simulations to compute in, one per robot, with `model`; payloads may differ.
                Nothing else may use them.
            periods: Their control periods.

        Raises:
            UsageError: A joint without exactly one position actuator.
        """
        self.servos = PositionServos.of(batch, model, joints)
        self.steps = PhysicsSteps(periods)
        self.dynamics = InverseDynamics(batch, model, joints)
        # kd takes the speed before the step
        self._explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        self.ahead = int(np.ceil((self.servos.delay / self.steps.dt).max() - 1e-9))
        self.saturated = np.zeros((batch.nsim, len(joints)), bool)

    @classmethod
    def of(cls, sim: BatchSim) -> AnalyticInverse:
        """Return the inverse of a simulation that nothing else uses."""
        return cls(sim.batch, next(iter(sim.models.values())), sim.joint_names, sim.periods)

    def __call__(self, periods: ListOf[Period]) -> Array:
        """Return the targets to send, (num, n) rad, not limited to any range.

        periods: The coming one and `ahead` more.
        """
        held = np.stack([self.targets_in_force(period) for period in periods])
        if not self.ahead:
            undelayed: Array = held[0]
            return undelayed
        late = np.broadcast_to(self.servos.delay / self.steps.dt, held[0].shape)
        whole = np.minimum(late.astype(int), self.ahead - 1)
        first = np.take_along_axis(held, whole[None], axis=0)[0]
        second = np.take_along_axis(held, whole[None] + 1, axis=0)[0]
        delayed: Array = first + (late - whole) * (second - first)
        return delayed

    def targets_in_force(self, period: Period) -> Array:
        """Return the targets that must be in force in a period, (num, n) rad, not limited to any
        range.
        """
        servos = self.servos
        mean = self.steps.mean
        qpos, speeds = self.steps.states(period)
        before = speeds[:-1]
        after = speeds[1:]
        qacc = (period.next_qvel - period.qvel) / self.steps.dt
        torque = self._torque(mean(qpos), mean(before), qacc, period.friction)
        torque += servos.damping * (mean(after) - mean(before))
        damped = before if self._explicit else after
        back = servos.kp * (qpos - servos.offset) + servos.kd * damped
        low, high = servos.torque_limits(before)
        mean_low = low
        mean_high = high
        if low.ndim == before.ndim:
            mean_low = mean(low)
            mean_high = mean(high)
        self.saturated = (torque < mean_low) | (torque > mean_high)
        return self._targets(np.clip(torque, mean_low, mean_high), back, low, high)

    def _torque(self, qpos: Array, qvel: Array, qacc: Array, friction: Array) -> Array:
        """Return the motors' torque in motion, (num, n) N·m; friction over its limit."""
        servos = self.servos
        torque, load = self.dynamics.torques(qpos, qvel, qacc)
        against = overcome_friction(servos.terms, servos.frictionloss, qvel, friction, torque, load)
        return np.asarray(torque + against)

    def _targets(self, torque: Array, back: Array, low: Array, high: Array) -> Array:
        """Return targets u (num, n) for which the mean over steps of kp·u − back, (steps, num, n),
        within the motors' limits, (n,) or (steps, num, n), is torque (num, n).
        """
        kp = self.servos.kp
        mean = self.steps.mean
        out = (torque + mean(back)) / kp
        for _ in range(len(back)):
            requested = kp * out - back
            applied = np.clip(requested, low, high)
            if (applied == requested).all():
                break
            free = np.maximum(mean((applied == requested).astype(float)), 1 / len(back))
            out = out + (torque - mean(applied)) / (kp * free)
        result: Array = out
        return result

    def agrees_with(self, other: AnalyticInverse, limits: Array) -> bool:
        """Return True if the inverses of two simulators of the same joints, limits (n, 2) rad,
        agree for any motion.
        """
        if self.ahead != other.ahead or not np.allclose(self.steps.dt, other.steps.dt):
            return False
        rng = np.random.default_rng(0)
        n = len(limits)
        for _ in range(COMPARED_MOTIONS):
            low, high = np.clip(limits, -np.pi, np.pi).T
            q = low + (high - low) * rng.random((1, n))
            v = rng.uniform(-1.0, 1.0, (1, n))
            a = rng.uniform(-5.0, 5.0, (1, n))
            friction = rng.uniform(-1.0, 1.0, (1, n))
            q_end = q + self.steps.dt * (v + 0.5 * self.steps.dt * a)
            v_end = v + self.steps.dt * a
            period = Period(q, v, q_end, v_end, friction)
            mine = self([period] * (1 + self.ahead))
            theirs = other([period] * (1 + other.ahead))
            if np.abs(mine - theirs).max() > MAX_TARGET_DIFFERENCE_RAD:
                return False
        return True


def _own(batch: Batch, model: mujoco.MjModel, name: str) -> Array:
    """Return a field of the model by simulation, (num or 1, …)."""
    values = batch.expanded(name)
    result: Array = getattr(model, name)[None] if values is None else values
    return result


def _most_torque(model: mujoco.MjModel, joints: tuple[str, ...], actuators: Array) -> Array:
    """Return the least and the largest torque of motors, (2, n) N·m; ±inf without a limit."""
    at = np.array([model.joint(name).id for name in joints])
    low = np.full(len(joints), -np.inf)
    high = np.full(len(joints), np.inf)
    of_actuators = (model.actuator_forcelimited[actuators], model.actuator_forcerange[actuators])
    of_joints = (model.jnt_actfrclimited[at], model.jnt_actfrcrange[at])
    for limited, limits in (of_actuators, of_joints):
        low = np.where(limited, np.maximum(low, limits[:, 0]), low)
        high = np.where(limited, np.minimum(high, limits[:, 1]), high)
    return np.array([low, high])


def _position_actuator(model: mujoco.MjModel, joint: str) -> int:
    """Return the index of a joint's only actuator; refuses all but position actuators without gear
    and dynamics.
    """
    mine = np.flatnonzero(driven_joints(model) == model.joint(joint).id)
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
