"""Transfer: commands with which one simulator, the target, moves like another one, the reference.

A model is trained in one simulator, the reference. In each control period, the reference is set to
the state of the target simulator and steps with the model's correction. The target's command is the
inverse dynamics of that step (sim/inverse.py).

In free motion the result is exact, except for what happens within a control period. The simulators
may differ in gains, damping, friction, inertia, payload, offsets, delays up to the reference's,
torque limits, integrator and time step. After a push, the reference continues from the target's
state. In contact, the motors have the torques of the reference in free space, and the target's
contacts respond to them. Where the reference itself has a contact (the table of an identified
robot), the target's motors stop the motion.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError
from gaponet.data.sequence import Sequence, is_same_rate
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.inverse import AnalyticInverse, Period
from gaponet.sim.replay import idle_limbs

Reference = GapModel | RobotSpec  # a model with the simulator of its run, or a simulator alone

# Ranges in which transfer was measured.
KP_RATIO_BOUNDS = (0.15, 5.0)  # target to reference
MAX_FRICTION_BAND_RAD = 0.06  # frictionloss / kp
MAX_TIMESTEP_S = 0.0051
MAX_EXTRA_DELAY_S = 0.005  # of the target's servos
RANGE_TOLERANCE = 1e-6  # of the ends of these ranges
# rad/s at which three quarters of the friction act, for joints that are blocked by a contact
STICTION_SPEED = 0.02


class HeldCorrection:
    """Corrections of a network, which has the control period of its training.

    That can be several control periods of the simulations: the correction is held meanwhile.
    """

    def __init__(
        self, model: GapModel, robot: RobotSpec, conditions: list[Condition], operated: Array
    ) -> None:
        """
        Args:
            robot: Simulator of training.
            conditions: Payload and control period of each simulation.
            operated: Operated joints among the simulations', (n_operated,).

        Raises:
            ModelError: The control period does not fit the model.
        """
        self._periods = max(control_periods_of(model, c.dt) for c in dict.fromkeys(conditions))
        self._loop = model.loop(len(conditions), own_context(model, robot, conditions))
        self._payload_mass = np.array([c.payload_mass for c in conditions])
        self._operated = operated
        self._delta = np.zeros((len(conditions), len(operated)))
        self._elapsed = 0  # control periods since the start

    def reset(self, ids: Array | slice) -> None:
        """Start simulations anew, without history."""
        self._delta[ids] = 0.0
        self._loop.reset(ids)
        num = len(self._delta)
        if len(np.arange(num)[ids]) == num:
            self._elapsed = 0

    def corrected(self, qpos: Array, qvel: Array, target: Array) -> Array:
        """Return target + Δa, (num, n) rad. Call this once per control period.

        Args:
            qpos, qvel: Present state, (num, n) rad, rad/s.
            target: Targets of the coming period, (num, n) rad.
        """
        corrected = np.array(target, float)
        op = self._operated
        if self._elapsed % self._periods == 0:
            self._delta[:] = self._loop.delta(
                qpos[:, op], qvel[:, op], corrected[:, op], self._payload_mass
            )
        self._elapsed += 1
        corrected[:, op] += self._delta
        return corrected


class Transfer:
    """Commands for simulations of the target, each with one of the reference.

    Arrays are (num_envs, n) in the order of `sim.joint_names`, the reference's joints that are not
    locked.

    Attributes:
        inverse: Inverse dynamics of the target.
        sim: Simulations of the reference.
    """

    def __init__(
        self,
        reference: Reference,
        inverse: AnalyticInverse,
        conditions: list[Condition],
        locked: tuple[str, ...] = (),
        nthread: int = 1,
        extrapolate: bool = False,
    ) -> None:
        """
        Args:
            reference: The model, or the simulator that the target is to move like.
            inverse: The target's inverse dynamics, for the same joints.
            conditions: Payloads and control period of the reference.
            locked: Joints that the reference has clamped at home.
            nthread: Threads of the reference, 0 for all cores.
            extrapolate: Accept a target outside the measured ranges.

        Raises:
            ModelError: The control period does not fit the model, or the target is outside the
                measured ranges.
        """
        robot = reference.simulator() if isinstance(reference, GapModel) else reference
        self.inverse = inverse
        sim = BatchSim(robot, conditions, nthread, locked)
        self.sim = sim
        if not extrapolate:
            _require_measured(inverse, AnalyticInverse.of(sim), sim.joint_names)
        self._correction: HeldCorrection | None = None
        if isinstance(reference, GapModel):
            operated = np.array([sim.joint_names.index(name) for name in robot.operated])
            self._correction = HeldCorrection(reference, robot, conditions, operated)
        self._frictionloss = sim.batch.expand("dof_frictionloss")  # the servo model writes it
        self._constraint_force: Array = sim.batch.bind("qfrc_constraint")
        self._dt = sim.periods.seconds[:, None]

    def reset(self, ids: Array | slice, qpos: Array, qvel: Array, past: Array) -> None:
        """Reset simulations to a state, (k, n), with targets of past periods, (k, depth, n)."""
        self.sim.reset(ids, qpos, qvel, past=past)
        if self._correction is not None:
            self._correction.reset(ids)

    def command(self, qpos: Array, qvel: Array, target: Array) -> Array:
        """Return the commands of the coming control period, rad, without joint limits.

        Call this once per period.

        Args:
            qpos, qvel: State of the target simulator, rad, rad/s.
            target: Targets of the robot, rad.
        """
        self.sim.qpos[:] = qpos
        self.sim.qvel[:] = qvel
        corrected = np.asarray(target, float)
        if self._correction is not None:
            corrected = self._correction.corrected(qpos, qvel, corrected)
        periods = [self.step_reference(corrected)]
        if self.inverse.ahead:
            state = self.sim.state()
            for _ in range(self.inverse.ahead):
                periods.append(self.step_reference(corrected))
            self.sim.set_state(state)
        return self.inverse(periods)

    def step_reference(self, targets: Array) -> Period:
        """Simulate a control period of the reference under targets, rad, without the model."""
        sim = self.sim
        qpos = sim.qpos.copy()
        qvel = sim.qvel.copy()
        sim.step(targets)
        next_qpos = sim.qpos.copy()
        next_qvel = sim.qvel.copy()
        return Period(qpos, qvel, next_qpos, next_qvel, self._friction_share(next_qpos - qpos))

    def _friction_share(self, motion: Array) -> Array:
        """Return `Period.friction`, (num_envs, n), in [−1, 1].

        It follows from the simulator's constraint force. Where that holds the force of stops or
        contacts too, it follows from the speed.

        motion: Of the period, (num_envs, n) rad.
        """
        share = -self._constraint_force / np.maximum(self._frictionloss, 1e-9)
        by_speed = np.tanh(motion / self._dt / STICTION_SPEED)
        blocked = (np.abs(share) > 1.05) | (self._frictionloss == 0)
        return np.asarray(np.where(blocked, by_speed, np.clip(share, -1.0, 1.0)))


class TransferCorrector:
    """Transfer in rollouts of sim.replay."""

    def __init__(self, reference: Reference, target: RobotSpec, extrapolate: bool = False) -> None:
        """
        Args:
            reference: The model, or the simulator that the target is to move like.
            target: The simulator of the rollout.
            extrapolate: Accept a target outside the measured ranges.
        """
        self.reference = reference
        self.target = target
        self.extrapolate = extrapolate
        self.robot = reference.simulator() if isinstance(reference, GapModel) else reference
        self.transfer: Transfer | None = None
        self.free = np.zeros(0, int)  # joints that are not locked

    def reset(self, start: ListOf[Sequence]) -> None:
        """Start one simulation per sequence at its first row."""
        locked = idle_limbs(start, self.robot)
        own = BatchSim(self.target, [Condition.of(s, self.target) for s in start], locked=locked)
        reference = [Condition.of(s, self.robot).without_change for s in start]
        self.transfer = Transfer(
            self.reference, AnalyticInverse.of(own), reference, locked, 0, self.extrapolate
        )
        self.free = self.robot.index(self.transfer.sim.joint_names)
        qpos = np.stack([s.qpos[0, self.free] for s in start])
        qvel = np.stack([s.qvel[0, self.free] for s in start])
        ctrl = np.stack([s.ctrl[0, self.free] for s in start])
        self.transfer.reset(slice(None), qpos, qvel, past=ctrl[:, None])

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Return commands, (k, n_all) rad."""
        assert self.transfer is not None
        commands = np.array(target, float)
        free = self.free
        commands[:, free] = self.transfer.command(qpos[:, free], qvel[:, free], target[:, free])
        return commands


def _require_measured(
    inverse: AnalyticInverse, reference: AnalyticInverse, joints: tuple[str, ...]
) -> None:
    """Refuse a target outside the measured ranges."""
    extra_delay = (inverse.servos.delay - reference.servos.delay).max(axis=0)  # (n,)
    if extra_delay.max() > MAX_EXTRA_DELAY_S:
        joint = joints[extra_delay.argmax()]
        raise ModelError(
            f"joint '{joint}': its servo is {1e3 * extra_delay.max():.0f} ms later than the "
            "reference's, and cannot follow it: the reference moves before this servo receives a "
            "target. Make the reference as late (delay in robot.toml; gaponet identify), or "
            "extrapolate (extrapolate=True, --extrapolate)"
        )
    require_measured_range(inverse, reference, joints)


def require_measured_range(
    inverse: AnalyticInverse, reference: AnalyticInverse, joints: tuple[str, ...]
) -> None:
    """Refuse gains, friction and physics steps with which transfer was not measured.

    Raises:
        ModelError: It names the joint and the quantity.
    """
    friction_band = inverse.servos.frictionloss / inverse.servos.kp
    timestep = np.tile(inverse.steps.h, len(joints))
    kp_ratio = inverse.servos.kp / reference.servos.kp
    measured = (
        ("kp, as a ratio to the reference's,", kp_ratio, KP_RATIO_BOUNDS),
        ("frictionloss / kp, rad,", friction_band, (0.0, MAX_FRICTION_BAND_RAD)),
        ("the physics step, s,", timestep, (0.0, MAX_TIMESTEP_S)),
    )
    for quantity, values, bounds in measured:
        for joint, column in zip(joints, values.T, strict=True):
            _require_between(f"joint '{joint}': {quantity}", column, bounds)


def _require_between(what: str, values: Array, bounds: tuple[float, float]) -> None:
    """Refuse values outside the bounds; `what` begins the message."""
    low, high = bounds
    outside = (values < low * (1 - RANGE_TOLERANCE)) | (values > high * (1 + RANGE_TOLERANCE))
    if not outside.any():
        return
    raise ModelError(
        f"{what} is {values[outside][0]:.3g}; transfer was measured from {low:g} to {high:g}. "
        "Train in this simulator, or extrapolate (extrapolate=True, --extrapolate)"
    )


def own_context(model: GapModel, robot: RobotSpec, conditions: list[Condition]) -> Array | None:
    """Return the context of a network in its simulator, (conditions, 8n) rad.

    None for most networks: the context that is stored with them holds for every payload. A network
    that is not told the payload reads it from the simulator's answers with the payload in hand. The
    answers depend on the control period too, so those of training at several rates are measured at
    the period at which the network runs.

    Args:
        robot: Simulator of training.
        conditions: With the control period of the loop.

    Raises:
        ModelError: The control period does not fit the model.
    """
    if not model.config.context:
        return None
    if model.has_one_rate and not model.config.context_is_loaded:
        return None
    running = []
    for condition in conditions:
        periods = control_periods_of(model, condition.dt)
        running.append(condition._replace(dt=periods * condition.dt))
    return model.contexts_of(robot, running)


def control_periods_of(model: GapModel, dt: float) -> int:
    """Return the number of control periods of dt s in a control period of training.

    Raises:
        ModelError: It is not a whole number.
    """
    for trained in model.card.get("dt") or [dt]:
        count = max(1, round(float(trained) / dt))
        if is_same_rate(dt * count, trained):
            return count
    rates = ", ".join(f"{1 / trained:.1f}" for trained in model.card["dt"])
    raise ModelError(
        f"{model.path}: trained at {rates} Hz, the loop has {1 / dt:.1f} Hz; run it at a trained "
        "rate or a whole multiple of it, or train on logs of this rate"
    )
