"""Compensator: commands with which the real robot does what it is asked to do.

A shadow simulates the robot, with nominal, identified or adapted parameters. It receives targets a′
and shows how the robot should move. Without a model, the command is u = a′. With a model, the robot
with command u moves like the shadow with target u + G(u), G being the model's correction. So u +
G(u) = a′ is solved by u ← u + γ (a′ − u − G(u)).

    aim "target":     a′ = a + τ / kp. τ is the torque with which the shadow follows the targets:
                      gravity and, with dynamics, the torque for their velocity and acceleration
                      (feedforward.py)
    aim "simulator":  a′ = a, so that the robot moves like the simulator, including sag and lag
    follow "nominal": a′ moves the shadow as the nominal simulator moves under a (follow.py);
        without a model

G is evaluated at the state and history of the shadow, not of the robot. If the compensation is
right, both are the same. The command does not depend on measurements, so there is no loop that can
become unstable, and measurement noise does not reach the servos. (With the measured state, the
error was not smaller and commands were four times rougher.)

Where the network's answer is not finite, G counts as zero (nn/bound.py). The iteration then forgets
the correction: it falls to (1 − γ)² of itself in each control period, and what remains is the
feed-forward.

The remaining error is integrated, slowly and with a low-pass. A loaded arm swings on its servo with
little damping (3 kg on H1-2's shoulder yaw: 10 rad/s, damping ratio 0.1). There, an integrator
alone is unstable above 2ζω, 2 1/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from gaponet.base.arrays import Array, within
from gaponet.base.errors import ModelError, RobotError, UsageError
from gaponet.data.describe.plausibility import require_radians
from gaponet.deploy.feedforward import Feedforward
from gaponet.deploy.follow import Follower
from gaponet.deploy.payload import PayloadEstimate, PayloadFields
from gaponet.deploy.transfer import own_context
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GAIN_TOLERANCE, GapModel
from gaponet.nn.loop import DeltaLoop
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import idle_joints

SETTLING_PERIODS = 100  # control periods in which the shadow comes to rest at a start
MIN_LIMITED_SHARE = 0.05  # of the periods, from which on a joint at its limits is reported


@dataclass(frozen=True)
class CompensatorConfig:
    """Settings of the compensator."""

    aim: Literal["target", "simulator"] = "target"
    """target: the robot reaches the commanded positions. simulator: it moves like the simulator."""
    dynamics: bool = False
    """Feed forward the torque of motion too, not only of holding; aim target alone.

    For smooth targets: it halves the error of planned motions, but amplifies 5 mrad of noise on
    targets to 0.2 rad on commands.
    """
    acceleration_time: float = 0.02
    """Low-pass of the targets' acceleration, s."""
    gain: float = 0.5
    """γ of the iteration; 0.5 converges if the derivative of u + G(u) is between 0 and 4."""
    iterations: int = 2
    """Iterations per control period. They start at the last period's solution."""
    feedback: float = 0.5
    """Gain of the integrator of the remaining error, 1/s; 0 for none."""
    feedback_time: float = 0.5
    """Time constant of the low-pass before the integrator, s."""
    feedback_limit: float = 0.1
    """Largest integral, rad."""
    observation_time: float = 0.5
    """Time constant with which `observe` takes over what the robot does differently, s."""
    limit: float = 0.5
    """Largest |u − a|, rad."""
    blend: float = 1.0
    """Time in which the compensation increases from 0 to 1 after a start, s."""
    payload_max: float = 3.0
    """Largest payload without a model, stated or estimated, kg.

    With a model, the training data give it.
    """

    def __post_init__(self) -> None:
        numbers = np.array([x for x in vars(self).values() if not isinstance(x, str)], float)
        in_range = 0 < self.gain <= 1 and self.limit > 0 and self.iterations > 0
        finite = ((numbers >= 0) & (numbers < np.inf)).all()
        if self.aim not in ("target", "simulator") or not in_range or not finite:
            text = "gain must be in (0, 1], limit and iterations > 0, the rest finite and ≥ 0"
            raise UsageError(f"compensator: aim is target or simulator; {text}")


class Compensator:
    """Targets → commands for one robot, or for num_envs robots. It is causal.

        compensate = Compensator(load_robot("./my_so101"))  # and a model, where one helps
        compensate.reset(target, payload_mass=3.0)
        u = compensate.step(target, qpos)      # once per control period; send u instead of target

    With follow="nominal" the robot moves as the nominal simulator does under the targets, instead
    of reaching them: for policies that were trained in an ordinary simulator.

    Arrays hold all joints of the robot, (num_envs, n), or (n,) without num_envs; only operated
    joints are changed.
    """

    def __init__(
        self,
        robot: RobotSpec,
        model: GapModel | None = None,
        *,
        config: CompensatorConfig = CompensatorConfig(),
        dt: float | None = None,
        num_envs: int | None = None,
        payload_side: str = "both",
        payload_step: float = 0.25,
        nthread: int = 1,
        extrapolate: bool = False,
        adaptation: Adaptation | None = None,
        follow: Literal["nominal"] | None = None,
    ) -> None:
        """
        Args:
            robot: Nominal, identified or adapted parameters of the robot. With a model and aim
                target, the simulator of training replaces another one. With aim simulator, another
                one is refused.
            model: The trained model; None for the feed-forward of the robot alone.
            dt: Control period, s; default the robot's.
            num_envs: Number of robots; None for one, with arrays (n,).
            payload_side: The hands that carry the payload: "both", or the side of one mount.
            payload_step: Distance between the masses that the shadow can carry, kg.
            nthread: Threads of the shadow simulators.
            extrapolate: Accept payloads beyond the training data, up to the model's payload_max,
                and other servo gains.
            adaptation: Result of `adapt` for this unit; the shadow then has the unit's parameters.
            follow: "nominal": let the robot move as its nominal simulator does under the targets.
                It needs an identified robot and takes no model; the aim of the configuration does
                not count.

        Raises:
            ModelError: The model does not fit the robot, the control period or the aim; or the
                robot is too different from the nominal one to follow it, without `extrapolate`.
            UsageError: `follow` with a model, or with a robot that is not identified.
        """
        self.dt = robot.dt if dt is None else dt
        if follow is not None and model is not None:
            raise UsageError(
                "compensator: follow takes no model. A model of the nominal simulator follows it "
                'with CompensatorConfig(aim="simulator")'
            )
        if model is not None:
            robot = _simulator_of(model, robot, self.dt, config)
        if adaptation is not None:
            robot = adaptation.robot(robot)
        self.robot = robot
        self.model = model
        self.config = config
        self.single = num_envs is None
        self.extrapolate = extrapolate
        num = 1 if num_envs is None else num_envs
        self.num_envs = num
        max_mass = _max_payload(robot, model, config, extrapolate)
        steps = int(np.ceil(max_mass / payload_step - 1e-9))
        self.masses = np.linspace(0.0, max_mass, 1 + steps)
        locked = idle_joints(robot, robot.operated)
        empty = Condition(0.0, payload_side, self.dt)
        loads = [Condition(float(mass), payload_side, self.dt) for mass in self.masses]
        self.shadow = BatchSim(robot, [empty] * num, nthread, locked)
        self._loaded = PayloadFields(self.shadow, loads, locked)
        self.op = robot.operated_index
        self.free = robot.index(self.shadow.joint_names)
        self.operated = np.searchsorted(self.free, self.op)  # operated joints among the shadow's
        self.low, self.high = robot.qpos_range[self.op].T
        self.kp = robot.servo.kp[self.op]
        self.zero_offset = robot.servo.offset[self.op]
        self.bias: Array = self.shadow.batch.bind("qfrc_bias")
        self.loop: DeltaLoop | None = None
        self._contexts: Array | None = None
        if model is not None:
            self.loop = model.loop(num)
            self._contexts = own_context(model, robot, loads)
        self.feedforward = Feedforward(
            self.shadow, self.operated, robot, self.dt, config.acceleration_time
        )
        self.feedback = Feedback(config, self.dt)
        self.payload_estimate = PayloadEstimate(robot, max_mass, payload_side, self.dt, locked)
        self._carried = np.full(num, -1)  # index of the mass that each shadow carries
        self.follower: Follower | None = None
        if follow is not None:
            self.follower = Follower(robot, empty, self.masses, num, locked, extrapolate)
        self.payload_mass = np.zeros(num)
        self.payload_stated = False
        self.periods = 0
        self.offset = np.zeros((num, len(self.op)))  # u − a′ of the iteration, rad
        self.command = np.zeros((num, len(self.op)))  # the last one, rad
        self._target: Array | None = None  # last finite target; None before `reset`
        self._deviation = np.zeros((num, len(self.op)))  # of the robot from the shadow, slow, rad
        # Control periods in which a motor or the command was at its limit, (num, n).
        self.limited_periods = np.zeros((num, len(self.op)), int)

    # ---- use

    def require_gains(self, joint_names: tuple[str, ...], kp: Array, kd: Array) -> None:
        """Refuse servo gains, (n,), that differ from those of the recordings, unless `extrapolate`.

        Without a model, these are the robot's gains before identification.
        """
        if self.extrapolate:
            return
        if self.model is not None:
            self.model.require_gains(joint_names, kp, kd)
            return
        nominal = self.robot.nominal or self.robot
        for joint, i in zip(nominal.operated, nominal.operated_index, strict=True):
            for name, gains in (("kp", kp), ("kd", kd)):
                was = float(nominal.servo[name][i])
                now = float(gains[joint_names.index(joint)])
                if abs(now - was) > GAIN_TOLERANCE * max(was, now):
                    raise RobotError(
                        f"{nominal.folder}: {name} of {joint} is {was:g} there, the servo has "
                        f"{now:.4g}; set the servo, or robot.toml and identify on logs made with "
                        "it, or extrapolate (--extrapolate)"
                    )

    def reset(self, target: Array, payload_mass: Array | float | None = None) -> None:
        """Start at rest at a target, without compensation, which then blends in.

        Args:
            target: The target in force, rad.
            payload_mass: kg, one number or (num_envs,); None to estimate it from commands and
                positions.

        Raises:
            ModelError: The payload is outside the training data, without `extrapolate`.
            UsageError, LogError: The target or the payload is not finite; the target is in degrees.
        """
        self.payload_stated = payload_mass is not None or len(self.masses) == 1
        self.payload_estimate.reset(self.num_envs)
        if payload_mass is None:
            self._carry(np.zeros(self.num_envs))
        else:
            self.set_payload(payload_mass)
        a = self._as_rows(target)
        if not np.isfinite(a).all():
            raise UsageError("compensator: the target to begin at is not a number")
        require_radians(
            a, self.robot.joint_names, self.robot, lambda row: "compensator: the target to begin at"
        )
        self._target = a
        self.command = a[:, self.op]
        self.periods = 0
        if self.loop is not None:
            self.loop.reset()
        self.offset = np.zeros(self.command.shape)
        self.feedback.reset(self.command.shape)
        self.feedforward.reset(self.command)
        rest = within(a[:, self.free], *self.shadow.range.T)
        self.shadow.reset(slice(None), rest, 0.0, past=rest[:, None])  # type: ignore[arg-type]
        self.shadow.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        if self.follower is not None:
            self.follower.reset(rest, SETTLING_PERIODS)
        for _ in range(SETTLING_PERIODS):
            self._step_shadow(rest, self._shadow_target(rest))
        self.limited_periods[:] = 0
        self._deviation[:] = 0.0

    def set_payload(self, payload_mass: Array | float) -> None:
        """Set the payload after a pick or place, kg, one number or (num_envs,).

        Errors as of `reset`.
        """
        self.require_payload(payload_mass)
        self._carry(np.array(np.broadcast_to(np.asarray(payload_mass, float), self.num_envs)))

    def require_payload(self, payload_mass: Array | float) -> None:
        """Refuse payloads, kg, that are not physical, or that model or shadow cannot carry."""
        if self.model is not None:
            self.model.require_payload(payload_mass, self.extrapolate)
            return
        mass = np.asarray(payload_mass, float)
        if not ((mass >= 0) & (mass <= self.config.payload_max)).all():
            raise UsageError(
                f"payload_mass is {payload_mass}; give kg, 0 when empty, up to "
                f"{self.config.payload_max:g}, or raise payload_max (--compensation.payload-max)"
            )

    def _carry(self, payload_mass: Array) -> None:
        """Let the shadow carry the nearest of `masses`."""
        self.payload_mass = payload_mass
        nearest = np.abs(self.payload_mass[:, None] - self.masses).argmin(axis=1)
        if (nearest != self._carried).any():
            robots = np.arange(self.num_envs)
            self._loaded.carry(robots, nearest)
            if self.follower is not None:
                self.follower.carry(robots, nearest)
            if self.loop is not None and self._contexts is not None:
                self.loop.set_context(self._contexts[nearest])
            self._carried = nearest

    def step(
        self, target: Array, qpos: Array | None, qvel: Array | None = None, tau: Array | None = None
    ) -> Array:
        """Commands for the coming control period, rad.

        Args:
            target: Target of the robot, rad. If it is not finite, the last finite one holds.
            qpos: Measured position, rad; None if no new state has arrived. Feedback then pauses, as
                it does for a qpos or qvel that is not finite.
            qvel: Measured velocity, rad/s.
            tau: Measured joint torque, N·m, for the payload estimate; default kp (u − q) − kd q̇.

        Raises:
            UsageError, LogError: `reset` was not called before; the first position is in degrees.
        """
        if self._target is None:
            raise UsageError(
                "compensator: step before reset; call reset(target) once, then step every control "
                "period"
            )
        given = self._as_rows(target)
        targets = np.where(np.isfinite(given), given, self._target)
        self._target = targets
        a = targets[:, self.op]
        if qpos is not None:
            if self.periods == 0:
                measured = self._as_rows(qpos)
                require_radians(
                    measured,
                    self.robot.joint_names,
                    self.robot,
                    lambda row: "compensator: the position",
                )
            q = self._as_rows(qpos)[:, self.op]
            v = np.zeros_like(q) if qvel is None else self._as_rows(qvel)[:, self.op]
            torque = None if tau is None else self._as_rows(tau)[:, self.op]
            self._process_state(q, v, torque)
        if self.config.dynamics:
            self.feedforward.update(a)
        shadow_target = self._shadow_target(targets[:, self.free])
        u = self._invert(shadow_target) + self.feedback.integral
        share = min(1.0, self.periods * self.dt / self.config.blend) if self.config.blend else 1.0
        unlimited = a + share * (u - a)
        limit = self.config.limit
        self.command = within(within(unlimited, a - limit, a + limit), self.low, self.high)
        self.feedback.saturation = np.sign(unlimited - self.command)
        self.limited_periods += self._at_limit()
        self.periods += 1
        self._step_shadow(targets[:, self.free], shadow_target)
        commands = targets.copy()
        commands[:, self.op] = self.command
        return commands[0] if self.single else commands

    @property
    def started(self) -> bool:
        """True after the first `reset`."""
        return self._target is not None

    def observe(self, qpos: Array | None = None) -> tuple[Array, Array]:
        """Return what a policy of the nominal simulator is to see.

        These are positions, rad, and velocities, rad/s.

        They are the nominal simulator's, which has no delay, plus the slow part of what
        distinguishes the robot from its identified simulator. A policy that sees the measured state
        instead is a loop with the delay of the servos, for which it was not trained. Only with
        follow="nominal"; once per control period, before `step`.

        Args:
            qpos: Measured position, rad; None if no new state has arrived. Joints that are not
                operated are returned as measured, or at home.

        Raises:
            UsageError: Nothing is followed, or `reset` was not called before.
        """
        if self.follower is None or self._target is None:
            raise UsageError('compensator: observe needs follow="nominal", and reset before')
        shape = (self.num_envs, len(self.robot.joint_names))
        positions = np.tile(self.robot.qpos_home, (self.num_envs, 1))
        velocities = np.zeros(shape)
        if qpos is not None:
            positions = self._as_rows(qpos).copy()
            self._update_deviation(positions[:, self.op])
        positions[:, self.op] = self.follower.qpos[:, self.operated] + self._deviation
        velocities[:, self.op] = self.follower.qvel[:, self.operated]
        if self.single:
            return positions[0], velocities[0]
        return positions, velocities

    def _update_deviation(self, measured: Array) -> None:
        """Update the slow deviation of robots from their shadows; (num_envs, n) rad."""
        deviation = measured - self.shadow.qpos[:, self.operated]
        valid = np.isfinite(deviation).all(axis=1, keepdims=True)
        limit = self.config.feedback_limit
        share = min(1.0, self.dt / max(self.config.observation_time, self.dt))
        change = share * (within(deviation, -limit, limit) - self._deviation)
        self._deviation += np.where(valid, change, 0.0)

    @property
    def doubt(self) -> str:
        """Message if the network fails or servo torques contradict the stated payload; else ""."""
        sentences = []
        if self.refused_answers:
            sentences.append(
                f"{self.refused_answers} answers of the network were not finite; it corrected "
                "nothing there"
            )
        if self.limited_shares:
            shares = [f"{joint} {share:.0%}" for joint, share in self.limited_shares.items()]
            sentences.append(f"at a limit of torque or correction: {', '.join(shares)} of the time")
        if self.payload_stated and self.single:
            sentences.append(self.payload_estimate.contradiction(float(self.payload_mass[0])))
        return "; ".join(sentence for sentence in sentences if sentence)

    @property
    def limited_shares(self) -> dict[str, float]:
        """Joint → share of the periods in which it could not do what was asked of it.

        Its command or its feedback was at a limit or, where the nominal simulator is followed, its
        motor. Joints with a share below MIN_LIMITED_SHARE are left out; of several robots the mean
        counts.
        """
        shares = self.limited_periods.mean(axis=0) / max(self.periods, 1)
        named = zip(self.robot.operated, shares.tolist(), strict=True)
        return {joint: share for joint, share in named if share >= MIN_LIMITED_SHARE}

    @property
    def refused_answers(self) -> int:
        """Number of the network's answers that were not finite.

        One answer per robot and iteration.
        """
        return 0 if self.loop is None else self.loop.refused_answers

    # ---- internals

    def _at_limit(self) -> Array:
        """Return which commands, or motors that follow, are at their limits, (num_envs, n)."""
        # A motor that is weaker than the identified one cannot follow, whatever the feedback adds.
        feedback_limit = self.config.feedback_limit
        exhausted = (feedback_limit > 0) & (np.abs(self.feedback.integral) >= feedback_limit)
        at_limit: Array = (self.feedback.saturation != 0) | exhausted
        if self.follower is not None:
            at_limit = at_limit | self.follower.saturated[:, self.operated]
        return at_limit

    def _shadow_target(self, targets: Array) -> Array:
        """Return a′, the shadow's targets of the operated joints, (num_envs, n) rad.

        Targets of the free ones.
        """
        if self.follower is not None:
            commands = self.follower.command(targets)[:, self.operated]
            return np.asarray(within(commands, self.low, self.high))
        a = targets[:, self.operated]
        if self.config.aim == "simulator":
            return np.asarray(within(a, self.low, self.high))
        tau = self.bias[:, self.operated]
        if self.config.dynamics:
            tau = tau + self.feedforward.torque(tau)
        held = a + tau / self.kp - self.zero_offset
        return np.asarray(within(held, self.low, self.high))

    def _invert(self, shadow_target: Array) -> Array:
        """Return u with u + G(u) = a′. Without a model, u = a′."""
        if self.loop is None:
            return shadow_target
        q = self.shadow.qpos[:, self.operated]
        v = self.shadow.qvel[:, self.operated]
        gain = self.config.gain
        iterations = self.config.iterations
        return self.loop.solve(
            q, v, shadow_target, self.payload_mass, self.offset, gain, iterations
        )

    def _process_state(self, q: Array, v: Array, tau: Array | None) -> None:
        """Update feedback and payload estimate from a measured state."""
        valid = np.isfinite(q + v + (0.0 if tau is None else tau)).all(axis=1)  # robots
        if self.periods:
            self.feedback.update(self.shadow.qpos[:, self.operated] - q, valid)
        doubts = self.payload_stated and self.single and len(self.masses) > 1
        if doubts or not self.payload_stated:
            self.payload_estimate.observe(q, v, self.command, tau, valid)
        if not self.payload_stated:
            self._carry(self.payload_estimate.update())

    def _step_shadow(self, targets: Array, operated_targets: Array) -> None:
        full = targets.copy()
        full[:, self.operated] = operated_targets
        self.shadow.step(full)

    def _as_rows(self, values: Array) -> Array:
        """Return (n,) or (num_envs, n) as (num_envs, n)."""
        values = np.asarray(values, float)
        shape = (self.num_envs, len(self.robot.joint_names))
        if values.shape != (shape[1:] if self.single else shape):
            raise UsageError(
                f"compensator: arrays hold all {shape[1]} joints of {self.robot.name}, got "
                f"{values.shape}"
            )
        return values.reshape(shape)


class Feedback:
    """Integrator of the remaining position error, with a low-pass, limits and anti-windup.

    Arrays are (num_envs, n).

    Attributes:
        integral: Correction of the command, rad.
        saturation: +1 where the command is at its upper limit, −1 at its lower one, else 0.
    """

    def __init__(self, config: CompensatorConfig, dt: float) -> None:
        """dt: Control period, s."""
        self.config = config
        self.dt = dt
        self.integral, self.saturation, self._filtered = np.zeros((3, 0, 0))

    def reset(self, shape: tuple[int, ...]) -> None:
        """Start without correction."""
        self.integral, self.saturation, self._filtered = np.zeros((3, *shape))

    def update(self, error: Array, valid: Array) -> None:
        """Process position errors, rad, of the robots `valid`, (num_envs,)."""
        config = self.config
        limit = self.config.feedback_limit
        # A blocked joint has a large error, which must not take long to decrease.
        limited = within(error, -limit, limit)
        filtered = self._filtered + (limited - self._filtered) * min(
            1.0, self.dt / max(config.feedback_time, self.dt)
        )
        winds_up = filtered * self.saturation > 0
        integral = self.integral + config.feedback * self.dt * np.where(winds_up, 0.0, filtered)
        self._filtered = np.where(valid[:, None], filtered, self._filtered)
        self.integral = np.where(valid[:, None], within(integral, -limit, limit), self.integral)


def _max_payload(
    robot: RobotSpec, model: GapModel | None, config: CompensatorConfig, extrapolate: bool
) -> float:
    """Return the largest mass that the shadow can carry in each hand, kg."""
    if not robot.payload_mounts:
        return 0.0
    if model is None:
        return config.payload_max
    return model.config.payload_max if extrapolate else model.max_payload


def _simulator_of(
    model: GapModel, robot: RobotSpec, dt: float, config: CompensatorConfig
) -> RobotSpec:
    """Return the simulator that the model corrects: the given one or that of training."""
    model.require_rate(dt)
    if model.config.holds:
        raise ModelError(
            f"{model.path}: holds corrections or sensors; to be inverted it must be trained without"
        )
    if model.is_trained_in(robot):
        return robot
    if config.aim == "simulator":
        raise ModelError(
            f"{model.path}: aim simulator is the simulator trained in, {model.card['simulator']}; "
            f"for {robot.folder} train there, or give RUN/robot, or aim at the target"
        )
    return model.simulator()
