"""Compensator: commands with which the real robot does what it is asked to do.

A shadow simulates the robot, with nominal, identified or adapted parameters (shadow.py). It
receives targets a′ and shows how the robot should move. Without a model, the command is u = a′.
With a model, the robot with command u moves like the shadow with target u + G(u), G being the
model's correction. So u + G(u) = a′ is solved by u ← u + γ (a′ − u − G(u)) (network_inverse.py).

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

The remaining error is integrated, slowly and with a low-pass (feedback.py). Commands are limited
(command_limits.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from gaponet.base.arrays import Array, within
from gaponet.base.errors import ModelError, RobotError, UsageError
from gaponet.data.describe.plausibility import require_radians
from gaponet.data.sequence import is_same_rate
from gaponet.deploy.command_limits import CommandLimits
from gaponet.deploy.feedback import Feedback, LowPass
from gaponet.deploy.feedforward import Feedforward, MotionTorque
from gaponet.deploy.follow import Follower
from gaponet.deploy.network_inverse import NetworkInverse
from gaponet.deploy.payload import Carrier, Payload, PayloadFields
from gaponet.deploy.payload_estimate import PayloadEstimate
from gaponet.deploy.shadow import Shadow
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GAIN_TOLERANCE, GapModel
from gaponet.robot.spec import RobotSpec, as_robot
from gaponet.sim.batch import Condition
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
    """Largest integral, rad; also the largest error, and deviation for `observe`, that counts."""
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
        is_aim = self.aim in ("target", "simulator")
        in_range = 0 < self.gain <= 1 and self.limit > 0 and self.iterations > 0
        numbers = np.array([x for x in vars(self).values() if not isinstance(x, str)], float)
        finite = ((numbers >= 0) & (numbers < np.inf)).all()  # and no NaN
        if not is_aim or not in_range or not finite:
            raise UsageError(
                "compensator: aim is target or simulator; gain must be in (0, 1], limit and "
                "iterations > 0, the rest finite and ≥ 0"
            )


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
        robot: RobotSpec | str | Path,
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
            robot: Nominal, identified or adapted parameters of the robot, or what `load_robot`
                takes. With a model and aim target, the simulator of training replaces another one.
                With aim simulator, another one is refused.
            model: The trained model; None for the feed-forward of the robot alone.
            dt: Control period of your loop, s. Default: the robot's, or the only period of the
                model's training if the model refuses the robot's. Commands are wrong in a loop with
                another period.
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
        robot = as_robot(robot)
        if dt is None:
            dt = _default_period(robot, model)
        if follow is not None and model is not None:
            raise UsageError(
                "compensator: follow takes no model. A model of the nominal simulator follows it "
                'with CompensatorConfig(aim="simulator")'
            )
        if model is not None:
            robot = _simulator_of(model, robot, dt, config)
        if adaptation is not None:
            robot = adaptation.robot(robot)
        num = 1 if num_envs is None else num_envs
        masses = _possible_masses(robot, model, config, extrapolate, payload_step)
        loads = [Condition(float(mass), payload_side, dt) for mass in masses]
        locked = idle_joints(robot, robot.operated)
        self.robot = robot
        self.model = model
        self.extrapolate = extrapolate
        self.shadow = Shadow(robot, loads[0], num, nthread, locked)
        # Everything that must change with the payload.
        carriers: list[Carrier] = [PayloadFields(self.shadow.sim, loads, locked)]
        self.inverse: NetworkInverse | None = None
        self.follower: Follower | None = None
        self.feedforward: Feedforward | None = None
        if model is not None:
            self.inverse = NetworkInverse(model, robot, loads, num, config.gain, config.iterations)
            carriers.append(self.inverse)
        shape = (num, len(robot.operated))
        if follow is not None:
            deviation = LowPass(config.observation_time, config.feedback_limit, dt, shape)
            self.follower = Follower(robot, loads, locked, deviation, extrapolate)
            carriers.append(self.follower)
        elif config.aim == "target":
            self.feedforward = _feedforward(self.shadow, robot, config, dt)
        error = LowPass(config.feedback_time, config.feedback_limit, dt, shape)
        self.feedback = Feedback(config.feedback, error, dt)
        self.limits = CommandLimits(
            config.limit, config.blend, dt, self.shadow.low, self.shadow.high, num
        )
        estimate = PayloadEstimate(robot, loads, num, locked)
        compared = num_envs is None  # `doubt` speaks of one robot
        max_stated = config.payload_max if robot.payload_mounts else None
        self.payload = Payload(masses, max_stated, num, carriers, estimate, compared)
        self._rows = JointRows(robot, num_envs)
        self._target: Array | None = None  # last finite target; None before `reset`

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
        if payload_mass is not None:
            self.require_payload(payload_mass)
        self.payload.reset(payload_mass)
        targets = self._rows.all_joints(target)
        if not np.isfinite(targets).all():
            raise UsageError("compensator: the target to begin at is not a number")
        require_radians(
            targets,
            self.robot.joint_names,
            self.robot,
            lambda row: "compensator: the target to begin at",
        )
        self._target = targets.copy()  # the caller's array may change
        a = targets[:, self._rows.operated]
        self.limits.reset(a)
        self.feedback.reset()
        if self.inverse is not None:
            self.inverse.reset()
        if self.feedforward is not None:
            self.feedforward.reset(a)
        rest = within(targets[:, self.shadow.free], *self.shadow.sim.commands.range.T)
        self.shadow.reset(rest)
        if self.follower is not None:
            self.follower.reset(rest, SETTLING_PERIODS)
        for _ in range(SETTLING_PERIODS):
            self.shadow.step(rest, self._shadow_target(rest))

    def set_payload(self, payload_mass: Array | float) -> None:
        """State the payload after a pick or place, kg, one number or (num_envs,).

        It holds until the next `reset` or `set_payload`; it is not estimated meanwhile. Errors as
        of `reset`.
        """
        self.require_payload(payload_mass)
        self.payload.state(payload_mass)

    def require_payload(self, payload_mass: Array | float) -> None:
        """Refuse payloads, kg, that are not physical, or that model or shadow cannot carry."""
        if self.model is not None:
            self.model.require_payload(payload_mass, self.extrapolate)
        else:
            self.payload.require(payload_mass)

    def step(
        self, target: Array, qpos: Array | None, qvel: Array | None = None, tau: Array | None = None
    ) -> Array:
        """Return the commands for the coming control period, rad.

        All arrays are (num_envs, n), or (n,) for a single robot.

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
        given = self._rows.all_joints(target)
        targets = np.where(np.isfinite(given), given, self._target)
        self._target = targets
        if qpos is not None:
            self._process_state(qpos, qvel, tau)
        a = targets[:, self._rows.operated]
        if self.feedforward is not None:
            self.feedforward.update(a)
        free_targets = targets[:, self.shadow.free]
        shadow_target = self._shadow_target(free_targets)
        u = shadow_target
        if self.inverse is not None:
            u = self.inverse.command(
                self.shadow.qpos, self.shadow.qvel, shadow_target, self.payload.mass
            )
        u = u + self.feedback.integral
        commands = targets.copy()
        commands[:, self._rows.operated] = self.limits.apply(a, u, self._exhausted())
        self.shadow.step(free_targets, shadow_target)
        return self._rows.back(commands)

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
        op = self._rows.operated
        deviation = None
        if qpos is None:
            positions = np.tile(self.robot.qpos_home, (len(self._target), 1))
        else:
            positions = self._rows.all_joints(qpos).copy()
            deviation = positions[:, op] - self.shadow.qpos
        velocities = np.zeros_like(positions)
        positions[:, op], velocities[:, op] = self.follower.observe(deviation)
        return self._rows.back(positions), self._rows.back(velocities)

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
        sentences.append(self.payload.contradiction)
        return "; ".join(sentence for sentence in sentences if sentence)

    @property
    def limited_shares(self) -> dict[str, float]:
        """Joint → share of the periods in which it could not do what was asked of it.

        Its command or its feedback was at a limit or, where the nominal simulator is followed, its
        motor. Joints with a share below MIN_LIMITED_SHARE are left out; of several robots the mean
        counts.
        """
        named = zip(self.robot.operated, self.limits.limited_shares.tolist(), strict=True)
        return {joint: share for joint, share in named if share >= MIN_LIMITED_SHARE}

    @property
    def refused_answers(self) -> int:
        """Number of the network's answers that were not finite.

        One answer per robot and iteration.
        """
        return 0 if self.inverse is None else self.inverse.loop.refused_answers

    # ---- internals

    def _shadow_target(self, targets: Array) -> Array:
        """Return a′, the shadow's targets of the operated joints, (num_envs, n) rad.

        Call this once per step of the shadow: a follower steps its nominal simulators in it.

        targets: Of the free joints, (num_envs, n_free) rad.
        """
        if self.follower is not None:
            wanted = self.follower.command(targets)
        else:
            wanted = targets[:, self.shadow.operated]
            if self.feedforward is not None:
                wanted = self.feedforward.targets(wanted)
        return within(wanted, self.shadow.low, self.shadow.high)

    def _exhausted(self) -> Array:
        """Return the joints whose feedback, or whose motor, can give no more, (num_envs, n)."""
        # A motor that is weaker than the identified one cannot follow, whatever the feedback adds.
        exhausted = self.feedback.exhausted
        if self.follower is not None:
            exhausted = exhausted | self.follower.saturated
        return exhausted

    def _process_state(self, qpos: Array, qvel: Array | None, tau: Array | None) -> None:
        """Update feedback and payload from a measured state, arrays as of `step`."""
        started = self.limits.periods > 0
        if not started:
            require_radians(
                self._rows.all_joints(qpos),
                self.robot.joint_names,
                self.robot,
                lambda row: "compensator: the position",
            )
        q = self._rows.operated_joints(qpos)
        v = np.zeros_like(q) if qvel is None else self._rows.operated_joints(qvel)
        torque = None if tau is None else self._rows.operated_joints(tau)
        measured = q + v  # finite where both are
        if torque is not None:
            measured = measured + torque
        valid = np.isfinite(measured).all(axis=1)  # (num_envs,)
        if started:
            self.feedback.update(self.shadow.qpos - q, valid, self.limits.saturation)
        self.payload.observe(q, v, self.limits.command, torque, valid)


class JointRows:
    """Arrays of all joints, as they are given and returned, and one row for each robot.

    Attributes:
        operated: Operated joints among all, (n_operated,).
    """

    def __init__(self, robot: RobotSpec, num_envs: int | None) -> None:
        n = len(robot.joint_names)
        self.operated = robot.operated_index
        self._robot = robot.name
        self._shape = (n,) if num_envs is None else (num_envs, n)

    def all_joints(self, values: Array) -> Array:
        """Return (n,) or (num_envs, n) as (num_envs, n)."""
        values = np.asarray(values, float)
        if values.shape != self._shape:
            raise UsageError(
                f"compensator: arrays hold all {self._shape[-1]} joints of {self._robot}, got "
                f"{values.shape}"
            )
        return values.reshape(-1, self._shape[-1])

    def operated_joints(self, values: Array) -> Array:
        """Return the columns of the operated joints, (num_envs, n_operated)."""
        return self.all_joints(values)[:, self.operated]

    def back(self, rows: Array) -> Array:
        """Return (num_envs, n) as the arrays that are given, (n,) for a single robot."""
        return rows.reshape(self._shape)


def _default_period(robot: RobotSpec, model: GapModel | None) -> float:
    """Return the control period of a loop that does not state it, s."""
    trained = [] if model is None else model.card.get("dt", [])
    if len(trained) == 1 and not is_same_rate(robot.dt, trained[0]):
        return float(trained[0])
    return robot.dt


def _feedforward(
    shadow: Shadow, robot: RobotSpec, config: CompensatorConfig, dt: float
) -> Feedforward:
    """Return the feed-forward of holding or, with dynamics, of motion too."""
    motion = None
    if config.dynamics:
        motion = MotionTorque(shadow.sim, shadow.operated, robot, dt, config.acceleration_time)
    return Feedforward(shadow, robot, motion)


def _possible_masses(
    robot: RobotSpec,
    model: GapModel | None,
    config: CompensatorConfig,
    extrapolate: bool,
    step: float,
) -> Array:
    """Return the masses that the shadow can carry in each hand, at most `step` apart, kg."""
    largest = _max_payload(robot, model, config, extrapolate)
    steps = int(np.ceil(largest / step - 1e-9))  # rounding must not add a step
    return np.linspace(0.0, largest, 1 + steps)


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
