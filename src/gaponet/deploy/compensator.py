"""The inverse use: commands u that make the robot do what it was asked.

A shadow, the simulator of the robot as it is known (nominal, identified or adapted), is given a′ and shows how the
robot should move. Without a model u = a′: the feed-forward of what is known. With one, the robot that is given u moves
like the shadow that is given u + G(u); so u + G(u) = a′ is solved, by u ← u + γ (a′ − u − G(u)).

    aim "target":     a′ = a + τ / kp, τ the torque with which the shadow would move as the targets do: gravity, and
                      with dynamics what their velocity and acceleration ask for (feedforward.py)
    aim "simulator":  a′ = a, so that the robot does what the simulator does, sag and lag included

G is asked at the shadow's state and history, not at the robot's. If the compensation is right they are the same; and
what is sent does not depend on what is measured: there is no loop that could become unstable, and noise does not reach
the servos. (Evaluated at the measured state, the error was no smaller and the commands four times rougher.)

What is then still missing is integrated, slowly and low-passed: a loaded arm swings on its servo with little damping
(3 kg on H1-2's shoulder yaw: 10 rad/s, damping ratio 0.1), and an integrator alone is unstable there above 2ζω, 2 1/s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, RobotError, UsageError
from gaponet.deploy.feedforward import Feedforward
from gaponet.deploy.payload import PayloadEstimate
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GAIN_TOLERANCE, GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import idle_joints

SETTLE = 100  # control periods in which the shadow comes to rest at a start


@dataclass(frozen=True)
class CompensatorConfig:
    """Settings of the compensator."""

    aim: Literal["target", "simulator"] = "target"
    """target: the commanded positions. simulator: what the simulator makes of them."""
    dynamics: bool = False
    """Whether, with aim target, what moving asks for is fed forward, not only what holding does. For smooth targets:
    planned motions halve their error with it, but 5 mrad of noise on targets becomes 0.2 rad on commands."""
    acceleration_time: float = 0.02
    """Low-pass of the targets' acceleration, s."""
    gain: float = 0.5
    """γ of an iteration; 0.5 converges wherever a change of u changes u + G(u) by a factor between 0 and 4."""
    iterations: int = 2
    """Iterations per control period, which begin at the last period's answer."""
    feedback: float = 0.5
    """Rate at which the remaining error is integrated, 1/s; 0 for none."""
    feedback_time: float = 0.5
    """Time constant of the low-pass before the integrator, s."""
    feedback_limit: float = 0.1
    """Largest integral, rad."""
    limit: float = 0.5
    """Largest |u − a|, rad."""
    blend: float = 1.0
    """Time in which compensation is blended in after a start, s."""
    lead: int = 0
    """How many control periods early targets are given, where the motion is known ahead. Zero is causal."""
    payload_max: float = 3.0
    """Largest payload that is taken or estimated without a model, kg; a model knows which it was trained with."""

    def __post_init__(self) -> None:
        if not (
            0 < self.gain <= 1
            and min(self.limit, self.iterations) > 0
            and min(self.feedback, self.feedback_time, self.blend, self.lead) >= 0
            and min(self.acceleration_time, self.payload_max) >= 0
        ):
            raise UsageError(
                "compensator: gain must be in (0, 1], limit and iterations positive, the rest not negative"
            )


class Compensator:
    """Targets → commands for one robot, or num_envs of them. Causal: past states, the present target.

        compensate = Compensator(load_robot("./my_so101"))  # and a model, where one helps
        compensate.reset(target, payload_mass=3.0)
        u = compensate.step(target, qpos)      # once per control period; send u instead of target

    Arrays hold all joints of the robot, (num_envs, n), or (n,) without num_envs; only operated joints are changed.
    """

    def __init__(
        self,
        robot: RobotSpec,
        model: GapModel | None = None,
        config: CompensatorConfig = CompensatorConfig(),
        dt: float | None = None,
        num_envs: int | None = None,
        payload_side: str = "both",
        payload_step: float = 0.25,
        nthread: int = 1,
        extrapolate: bool = False,
        adaptation: Adaptation | None = None,
    ) -> None:
        """
        Args:
            robot: The robot as it is known: nominal, identified or adapted. With a model, how it should move is
                known from the simulator that the model was trained in, whichever other one is given here; with aim
                simulator no other one is taken.
            model: What training made; None for the feed-forward of the robot alone.
            config: How the robot is made to follow.
            dt: Control period, s; default the robot's.
            num_envs: Robots side by side; None for one, with arrays (n,).
            payload_side: The hands that carry the payload: "both", or the side of one mount.
            payload_step: Masses that the shadow can carry are this far apart, up to the heaviest trained on (without a
                model, config.payload_max), kg.
            nthread: Threads of the shadow simulators.
            extrapolate: Take payloads beyond those trained on, up to the model's payload_max, and servos of other
                gains.
            adaptation: What `adapt` found for the unit that is commanded; the shadow is then that unit.
        """
        self.dt = robot.dt if dt is None else dt
        heaviest = config.payload_max
        if model is not None:
            robot = _corrected(model, robot, self.dt, config)
            heaviest = model.config.payload_max if extrapolate else model.heaviest
        robot = robot if adaptation is None else adaptation.robot(robot)
        self.robot, self.model, self.config, self.single = robot, model, config, num_envs is None
        self.extrapolate = extrapolate
        self.num_envs = num = 1 if num_envs is None else num_envs
        heaviest = heaviest if robot.payload_mounts else 0.0
        self.masses = np.linspace(0.0, heaviest, 1 + int(np.ceil(heaviest / payload_step - 1e-9)))
        locked = idle_joints(robot, robot.operated)
        # The last rows never move: they hold the model with each mass, to be copied when a payload changes.
        carried = [Condition(float(m), payload_side, self.dt) for m in (*[0.0] * num, *self.masses)]
        self.shadow = BatchSim(robot, carried, nthread, locked)
        self.ids, self.op = np.arange(num), robot.operated_index
        self.free = robot.index(self.shadow.joint_names)
        self.at = np.searchsorted(self.free, self.op)  # operated joints among the shadow's
        self.low, self.high = robot.qpos_range[self.op].T
        self.kp, self.zero = robot.kp[self.op], robot.offset[self.op]
        self.bias: Array = self.shadow.batch.bind("qfrc_bias")
        self.loop = None if model is None else model.loop(num)
        self.moving = Feedforward(self.shadow, self.at, robot, self.dt, self.config.acceleration_time)
        self.estimate = PayloadEstimate(self.shadow, self.at, robot, len(self.masses), self.dt)
        self._carried = np.full(num, -1)
        self.payload_mass, self.announced, self.periods = np.zeros(num), False, 0
        self.offset, self.integral, self.missing, self.sent, self.saturated = np.zeros((5, num, len(self.op)))
        self._target: Array | None = None  # the last one that was a number; None before `reset`
        self._aimed: list[Array] = []  # newest last

    # ---- use

    def require_gains(self, joint_names: tuple[str, ...], kp: Array, kd: Array) -> None:
        """Refuse servos with gains (n) other than those that the data were recorded with, unless `extrapolate`.

        Without a model, those are the robot's own before identification.
        """
        if self.extrapolate:
            return
        if self.model is not None:
            self.model.require_gains(joint_names, kp, kd)
            return
        known = self.robot.nominal or self.robot
        for joint, i in zip(known.operated, known.operated_index, strict=True):
            for name, gains in (("kp", kp), ("kd", kd)):
                was, now = float(getattr(known, name)[i]), float(gains[joint_names.index(joint)])
                if abs(now - was) > GAIN_TOLERANCE * max(was, now):
                    raise RobotError(
                        f"{known.folder}: {name} of {joint} is {was:g} there, the servo has {now:.4g}; set the servo, "
                        "or robot.toml and identify on logs made with it, or extrapolate (--extrapolate)"
                    )

    def reset(self, target: Array, payload_mass: Array | float | None = None) -> None:
        """Begin at rest at a target, uncompensated; commands blend in from there.

        Args:
            target: The target in force, rad.
            payload_mass: kg, one number or (num_envs,); None to estimate it from commands and positions.

        Raises:
            ModelError: A payload beyond those trained on, without `extrapolate`.
            UsageError: A target or payload that is not a number.
        """
        self.announced = payload_mass is not None or len(self.masses) == 1
        self.estimate.reset(self.num_envs)
        if payload_mass is None:
            self._carry(np.zeros(self.num_envs))
        else:
            self.set_payload(payload_mass)
        a = self._all(target)
        if not np.isfinite(a).all():
            raise UsageError("compensator: the target to begin at is not a number")
        self._target, self.sent, self.periods = a, a[:, self.op], 0
        if self.loop is not None:
            self.loop.reset()
        self.offset, self.integral, self.missing = np.zeros((3, *self.sent.shape))
        self.moving.reset(self.sent)
        rest = np.clip(a[:, self.free], *self.shadow.range.T)
        self.shadow.reset(self.ids, rest, 0.0, past=rest[:, None])  # type: ignore[arg-type]
        self.shadow.batch.forward(self.ids, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        for _ in range(SETTLE):
            self._shadow_step(rest, self._wanted(rest[:, self.at]))
        self._aimed = [self._shadow_qpos()] * (self.config.lead + 1)

    def set_payload(self, payload_mass: Array | float) -> None:
        """A payload was picked up or put down, kg, one number or (num_envs,); errors as of `reset`."""
        self.require_payload(payload_mass)
        self._carry(np.array(np.broadcast_to(np.asarray(payload_mass, float), self.num_envs)))

    def require_payload(self, payload_mass: Array | float) -> None:
        """Refuse a payload, kg, that is none, or that the model or the shadow does not know."""
        if self.model is not None:
            self.model.require_payload(payload_mass, self.extrapolate)
            return
        mass = np.asarray(payload_mass, float)
        if not ((mass >= 0) & (mass <= self.config.payload_max)).all():
            raise UsageError(
                f"payload_mass is {payload_mass}; give kg, 0 when empty, up to {self.config.payload_max:g}, or raise "
                "payload_max (--compensation.payload-max)"
            )

    def _carry(self, payload_mass: Array) -> None:
        """The shadow carries the nearest of `masses`."""
        self.payload_mass = payload_mass
        nearest = np.abs(self.payload_mass[:, None] - self.masses).argmin(axis=1)
        if (nearest != self._carried).any():
            for field in self.shadow.fields.values():
                field[: self.num_envs] = field[self.num_envs + nearest]
            self._carried = nearest

    def step(self, target: Array, qpos: Array | None, qvel: Array | None = None, tau: Array | None = None) -> Array:
        """Commands for the coming control period, rad.

        Args:
            target: What the robot is asked for, rad; with a lead, that many periods from now. Where it is not a number,
                the last that was one holds.
            qpos: Measured now, rad; None where no fresh state has arrived: feedback then waits, as it does where qpos
                or qvel is not a number.
            qvel: Measured now, rad/s.
            tau: Measured joint torque, N·m, for the payload estimate; default that of the servo law, kp (u − q) − kd q̇.

        Raises:
            UsageError: `reset` was not called before.
        """
        if self._target is None:
            raise UsageError("compensator: step before reset; call reset(target) once, then step every control period")
        given = self._all(target)
        self._target = a_all = np.where(np.isfinite(given), given, self._target)
        a = a_all[:, self.op]
        self._aimed = [*self._aimed[1:], self._shadow_qpos()]
        if qpos is not None:
            v, force = (None if x is None else self._all(x)[:, self.op] for x in (qvel, tau))
            self._observe(self._all(qpos)[:, self.op], v, force)
        self.moving.update(a)
        wanted = self._wanted(a)
        u = self._solve(wanted) + self.integral
        share = min(1.0, self.periods * self.dt / self.config.blend) if self.config.blend else 1.0
        free_u = a + share * (u - a)
        limit = self.config.limit
        self.sent = np.clip(np.clip(free_u, a - limit, a + limit), self.low, self.high)
        self.saturated = np.sign(free_u - self.sent)  # +1 where the command could not be higher
        self.periods += 1
        self._shadow_step(a_all[:, self.free], wanted)
        out = a_all.copy()
        out[:, self.op] = self.sent
        return out[0] if self.single else out

    @property
    def doubt(self) -> str:
        """That one robot holds another payload than was stated, by what its servos have given of late; or nothing."""
        return self.estimate.contradicts(float(self.payload_mass[0])) if self.announced and self.single else ""

    @property
    def aimed(self) -> Array:
        """Where the robot should have been at the last step, operated joints, rad."""
        return self._aimed[0][0] if self.single else self._aimed[0]

    # ---- parts

    def _wanted(self, a: Array) -> Array:
        """a′: what the shadow is given."""
        if self.config.aim == "simulator":
            return np.clip(a, self.low, self.high)
        tau = self.bias[: self.num_envs, self.at]
        if self.config.dynamics:
            tau = tau + self.moving.torque(tau)
        return np.clip(a + tau / self.kp - self.zero, self.low, self.high)

    def _solve(self, wanted: Array) -> Array:
        """u with u + G(u) = wanted, G at the shadow; wanted itself without a model."""
        if self.loop is None:
            return wanted
        q, v, config = *(x[: self.num_envs, self.at] for x in (self.shadow.qpos, self.shadow.qvel)), self.config
        return self.loop.solve(q, v, wanted, self.payload_mass, self.offset, config.gain, config.iterations)

    def _observe(self, q: Array, v: Array | None, tau: Array | None) -> None:
        """Integrate what is missing; anti-windup: not further where the command is at a limit."""
        config = self.config
        v = np.zeros_like(q) if v is None else v
        seen = np.isfinite(q + v + (0.0 if tau is None else tau)).all(axis=1)  # robots
        if self.periods:
            # A blocked joint misses much; it must not take long to forget.
            wrong = np.clip(self._aimed[0] - q, -config.feedback_limit, config.feedback_limit)
            missing = self.missing + (wrong - self.missing) * min(1.0, self.dt / max(config.feedback_time, self.dt))
            further = missing * self.saturated > 0
            grown = self.integral + config.feedback * self.dt * np.where(further, 0.0, missing)
            limited = np.clip(grown, -config.feedback_limit, config.feedback_limit)
            self.missing = np.where(seen[:, None], missing, self.missing)
            self.integral = np.where(seen[:, None], limited, self.integral)
        if not self.announced:
            self._carry(self.estimate.update(q, v, self.sent, tau, seen))
        elif self.single and len(self.masses) > 1:
            self.estimate.update(q, v, self.sent, tau, seen)

    def _shadow_qpos(self) -> Array:
        return self.shadow.qpos[: self.num_envs, self.at]

    def _shadow_step(self, targets: Array, wanted: Array) -> None:
        full = np.zeros((self.shadow.num_envs, self.shadow.n))
        full[: self.num_envs] = targets
        full[: self.num_envs, self.at] = wanted
        self.shadow.step(full, self.ids)

    def _all(self, values: Array) -> Array:
        """(num_envs, n) of what may be (n,)."""
        values = np.asarray(values, float)
        shape = (self.num_envs, len(self.robot.joint_names))
        if values.shape != (shape[1:] if self.single else shape):
            raise UsageError(f"compensator: arrays hold all {shape[1]} joints of {self.robot.name}, got {values.shape}")
        return values.reshape(shape)


def _corrected(model: GapModel, robot: RobotSpec, dt: float, config: CompensatorConfig) -> RobotSpec:
    """The simulator in which a model is asked: the given one, or that of its training; refuses what cannot be."""
    model.require_rate(dt)
    if model.config.holds:
        raise ModelError(f"{model.path}: holds corrections or sensors; to be inverted it must be trained without")
    if model.corrects(robot):
        return robot
    if config.aim == "simulator":
        raise ModelError(
            f"{model.path}: aim simulator is the simulator trained in, {model.card['simulator']}; for "
            f"{robot.folder} train there, or give RUN/robot, or aim at the target"
        )
    return model.simulator()
