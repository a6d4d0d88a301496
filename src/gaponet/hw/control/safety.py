"""Limits of commands and checks of states, on arrays; no clock, bus or file is used.

A position command is sent only if it is within

1. the joint range less a margin,
2. the command rate: |u − u_previous| ≤ speed · dt,
3. the torque that it requests: |kp (u − q) − kd q̇| ≤ share · effort limit, wherever the joint can
   be since it was measured, accelerating at most as `acceleration` allows,

all three, for every joint. Each is an interval; the command is moved into their intersection. Range
and rate always intersect, because the previous command was within the range. The torque interval
follows the measured joint and may leave the other two: the joint was pushed away, or moves so fast
that braking alone exceeds the limit. Then no position command is safe, and `feasible` is False: the
controller damps the robot instead. So no limit ever yields to another. Size and rate of a model's
correction are bounded before that; the three limits come last and may cut it further.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import Fault, State
from gaponet.robot.spec import RobotSpec

# Share of a bound that is kept free, so that rounding does not exceed a limit that is computed
# back.
RELATIVE_ROUNDING = 1e-9
# New states in which one joint must read the same; at a turn two may by chance.
MIN_STILL_STATES = 4
CHECKSUM_WINDOW_S = 1.0  # in which wrong checksums are counted
# More is degrees, milliseconds or Fahrenheit, and would switch the check off.
MAX_OPTIONS = {
    "delta": (np.pi, "up to π rad"),
    "frozen_travel": (np.pi, "up to π rad"),
    "frozen_joint": (np.pi, "up to π rad"),
    "jump": (np.pi, "up to π rad"),
    "tilt": (np.pi, "up to π rad"),
    "tracking": (np.pi, "up to π rad"),
    "tracking_time": (60, "up to 60 s"),
    "temperature": (150, "up to 150 °C"),
    "torque_share": (1, "to 1"),
}
# Speed with which a joint comes nearer to where it is asked to be; less is standing.
MIN_APPROACH_RAD_S = 0.2
MIN_SPEED_RAD_S = 1e-6  # below it a joint counts as standing still for damping
MAX_BELIEVED_SPEED_RAD_S = 12.0  # for damping; a joint that moves faster than this has jumped


@dataclass(frozen=True)
class SafetyConfig:
    """Limits and checks of states."""

    margin: float = 0.02
    """Distance that commands keep from each end of a joint's range, rad."""
    speed: float = 5.0
    """Fastest change of a command, rad/s."""
    torque_share: float = 0.95
    """Share of a joint's effort limit that a command may request."""
    acceleration: float = 50.0
    """Largest acceleration of a joint, rad/s². It bounds where a joint can be now, given its last
    state."""
    delta: float = 0.5
    """Largest correction of a model, rad."""
    delta_rate: float = 2.0
    """Fastest change of a model's correction, rad/s."""
    stale: float = 2.0
    """Number of control periods after which a state is too old."""
    frozen: int = 2
    """Number of control periods with new messages but equal readings after which a state counts as
    frozen; 0 means never."""
    frozen_travel: float = 0.3
    """States count as frozen if a command moves this far while no joint moves, rad. For coarse
    encoders, whose readings may repeat."""
    frozen_joint: float = 0.1
    """A joint counts as frozen if its command, or its velocity over time, moves this far while its
    position stands still, rad. For fine encoders."""
    joint_speed: float = 12.0
    """A reading has jumped if its joint moves faster than this between two states, rad/s."""
    jump: float = 0.05
    """Distance beyond that speed that is not yet a jump, rad."""
    temperature: float = 85.0
    """Highest temperature of a motor, °C."""
    tilt: float = 0.7
    """Largest lean of the trunk, rad."""
    tracking: float = 0.6
    """Largest |requested − measured| position, before the torque limit changes the command, rad."""
    tracking_time: float = 0.25
    """How long that difference may be exceeded, s."""
    following: float = 0.25
    """Share of the way of its command that a joint must go. For robots whose commands cannot be
    read back. 0 means no check, for joints that press on something."""
    overrun: float = 2.0
    """How late a control period may start, in periods."""
    refused: int = 20
    """How many messages with a wrong checksum may arrive within one second."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            may_be_zero = name in ("margin", "jump", "frozen", "following")
            most, text = MAX_OPTIONS.get(name, (np.finfo(float).max, "below infinity"))
            if not 0 <= value <= most or (value == 0 and not may_be_zero):
                raise UsageError(f"safety: {name} is {value}; give a positive number {text}")


@dataclass(frozen=True)
class Limits:
    """Bounds of the commands to some joints, (n) each.

    Attributes:
        low, high: Range, rad.
        speed: rad/s.
        effort: N·m.
        kp, kd: Gains of the real servos, N·m/rad and N·m·s/rad.
        delta, delta_rate: Limits of a model's correction, rad and rad/s.
        acceleration: rad/s².
    """

    low: Array
    high: Array
    speed: Array
    effort: Array
    kp: Array
    kd: Array
    delta: Array
    delta_rate: Array
    acceleration: Array

    @classmethod
    def from_robot(
        cls,
        robot: RobotSpec,
        joints: tuple[str, ...],
        config: SafetyConfig,
        gains: tuple[Array, Array] | None = None,
        qpos_range: Array | None = None,
    ) -> Limits:
        """Return the limits of a robot's joints, in the order of `joints`.

        Args:
            robot: Ranges and effort limits.
            gains: kp and kd of the real servos, all joints (n) each; default the robot's, before
                identification.
            qpos_range: Ranges that the real robot reports, all joints (n, 2) rad; they narrow those
                of the MJCF.

        Raises:
            UsageError: The margin is wider than the range of a joint.
        """
        nominal = robot.before_identification
        kp, kd = gains or (nominal.servo.kp, nominal.servo.kd)
        at = robot.index(joints)
        low, high = robot.qpos_range[at].T
        if qpos_range is not None:
            low = np.maximum(low, qpos_range[at, 0])
            high = np.minimum(high, qpos_range[at, 1])
        low = low + config.margin
        high = high - config.margin
        if (low > high).any():
            joint = joints[int(np.argmax(low > high))]
            raise UsageError(
                f"safety: margin {config.margin} leaves nothing of the range of {joint}; make it "
                "smaller"
            )
        n = len(joints)
        return cls(
            low=low,
            high=high,
            speed=np.full(n, config.speed),
            effort=config.torque_share * nominal.servo.effort_limit[at],
            kp=kp[at],
            kd=kd[at],
            delta=np.full(n, config.delta),
            delta_rate=np.full(n, config.delta_rate),
            acceleration=np.full(n, config.acceleration),
        )


class LimitedCommand(NamedTuple):
    """Result of limit_command, (..., n) each.

    Attributes:
        ctrl: The command to send where feasible, rad; else the previous one within range, which
            must not be sent.
        feasible: A command within all three limits exists.
    """

    ctrl: Array
    feasible: Array


def limit_delta(delta: Array, previous: Array, dt: float, limits: Limits) -> Array:
    """Return a correction (..., n) rad bounded in size and rate.

    NaN becomes the previous correction.
    """
    step = limits.delta_rate * dt
    wanted = np.where(np.isfinite(delta), delta, previous)
    wanted = np.clip(wanted, previous - step, previous + step)
    return np.clip(wanted, -limits.delta, limits.delta)


def limit_command(
    target: Array,
    previous: Array,
    qpos: Array,
    qvel: Array,
    dt: float,
    limits: Limits,
    age: Array | float = 0.0,
) -> LimitedCommand:
    """Return the nearest command to `target` within range, rate and torque, and if there is one.

    Args:
        target: Wanted, (..., n) rad.
        previous: The last command, (..., n) rad; one outside the range counts as at its end.
        qpos, qvel: Measured, (..., n) rad and rad/s.
        dt: Control period, s.
        age: Age of the state when the command leaves, s, or (..., n).
    """
    before = np.clip(previous, limits.low, limits.high)
    step = limits.speed * dt * (1 - RELATIVE_ROUNDING)
    low = np.maximum(limits.low, before - step)
    high = np.minimum(limits.high, before + step)
    with np.errstate(divide="ignore", invalid="ignore"):
        brake = limits.kd * qvel / limits.kp
        half = limits.effort * (1 - RELATIVE_ROUNDING) / limits.kp
        # As measured, and where the joint can be by now: it went on and may have accelerated either
        # way.
        spread = limits.acceleration * age * (age / 2 + limits.kd / limits.kp)
        for centre, width in ((qpos + brake, half), (qpos + qvel * age + brake, half - spread)):
            rounding = RELATIVE_ROUNDING * np.abs(centre)
            low = np.maximum(low, centre - width + rounding)
            high = np.minimum(high, centre + width - rounding)
        finite = np.isfinite(target) & np.isfinite(previous) & np.isfinite(qpos) & np.isfinite(qvel)
        feasible = finite & (low <= high)
        ctrl = np.where(feasible, np.minimum(np.maximum(target, low), high), before)
    return LimitedCommand(ctrl, feasible)


def damping_gains(kd: Array, qvel: Array, effort: Array) -> Array:
    """Return gains (n), at most kd, whose torque kd |q̇| stays within the effort limits.

    Where q̇ is unknown they are kd.

    A speed above MAX_BELIEVED_SPEED_RAD_S is a wrong reading, and counts as that speed: a joint
    always brakes.
    """
    speed = np.abs(np.nan_to_num(qvel, nan=0.0, posinf=0.0, neginf=0.0))
    believed = np.clip(speed, MIN_SPEED_RAD_S, MAX_BELIEVED_SPEED_RAD_S)
    result: Array = np.minimum(kd, effort / believed)
    return result


# Faults: what each one puts in doubt, what may still be used afterwards, and how the robot ends.
# After a fault no joint is sent to a position, neither to a target nor to a measured one: a wrong
# reading would move the joint. The robot damps. Damping needs no position. A measured speed may
# only lower a damping gain, and only as far as damping_gains allows. docs/reference/controller.md
# has the same table.


class Ending(StrEnum):
    """What stops the robot after a fault.

    An SO-101 has no brake: it is lowered, or let go at once.
    """

    DAMP_OR_LOWER = "damp; lower an SO-101"
    DAMP_OR_LET_GO = "damp; let an SO-101 go at once"
    NOTHING = "none: nothing was commanded"


@dataclass(frozen=True)
class FaultRule:
    """What follows from one kind of fault."""

    doubted: str
    """What may be wrong."""
    usable: str
    """What may still be used to stop the robot."""
    ending: Ending
    """What is done."""
    is_data: bool = True
    """The recording until the fault can be trusted; False where a joint did not go where it was
    sent."""


LAST_COMMAND = "the last command, without stiffness; damping; torque limits"
NO_GOAL = "the last command, without stiffness; damping; torque off"

FAULTS: dict[str, FaultRule] = {
    "stale": FaultRule("all readings: they are old", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "checksum": FaultRule(
        "all readings: the bus damages messages", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "overrun": FaultRule(
        "the age of readings: this computer was late", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "suspend": FaultRule(
        "all readings from before the suspend", LAST_COMMAND, Ending.DAMP_OR_LOWER
    ),
    "driver": FaultRule(
        "the bus, in both directions",
        "what needs no answer, sent until the bus takes it",
        Ending.DAMP_OR_LOWER,
    ),
    "target": FaultRule("the motion or the model", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "silence": FaultRule("the sender of targets", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "error": FaultRule("the policy, the model or this program", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "stop": FaultRule("nothing: somebody asked for it", LAST_COMMAND, Ending.DAMP_OR_LOWER),
    "obedience": FaultRule(
        "positions, and whether the robot holds its commands and settings",
        LAST_COMMAND,
        Ending.DAMP_OR_LOWER,
        is_data=False,
    ),
    "goal": FaultRule(
        "where a servo goes: it holds another goal than it was told",
        NO_GOAL,
        Ending.DAMP_OR_LET_GO,
        is_data=False,
    ),
    "source": FaultRule(
        "which robot the states are from, or whose goals the servos hold",
        NO_GOAL,
        Ending.DAMP_OR_LET_GO,
        is_data=False,
    ),
    "frozen": FaultRule(
        "position and speed of a joint, or of all", NO_GOAL, Ending.DAMP_OR_LET_GO, is_data=False
    ),
    "nan": FaultRule("all readings of a joint", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "jump": FaultRule(
        "position and speed of a joint", NO_GOAL, Ending.DAMP_OR_LET_GO, is_data=False
    ),
    "temperature": FaultRule("a motor or its sensor", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "tracking": FaultRule(
        "the position of a joint, or that its way is free",
        NO_GOAL,
        Ending.DAMP_OR_LET_GO,
        is_data=False,
    ),
    "torque": FaultRule(
        "position and speed of a joint, or that its way is free", NO_GOAL, Ending.DAMP_OR_LET_GO
    ),
    "robot": FaultRule("a motor, its readings and its goal", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "tilt": FaultRule("the stand of the robot, or its IMU", NO_GOAL, Ending.DAMP_OR_LET_GO),
    "plan": FaultRule("the way to the first target", "all readings", Ending.NOTHING),
}
FAULT_KINDS = tuple(FAULTS)


def lowers(kind: str) -> bool:
    """Return True if a robot without brakes is lowered; False if its torque goes off at once.

    The end of a run without fault has no rule, and lowers nothing.
    """
    return kind in FAULTS and FAULTS[kind].ending is Ending.DAMP_OR_LOWER


def spoils_data(kind: str) -> bool:
    """Return True if a recording with this fault is no data."""
    return kind in FAULTS and not FAULTS[kind].is_data


class FrozenReadings:
    """Finds readings that stand still although the robot is told to move.

    Attributes:
        noisy: Equal readings count as frozen at once; else only after the command has moved by
            frozen_travel.
    """

    def __init__(
        self, joint_names: tuple[str, ...], commanded: Array, noisy: bool, config: SafetyConfig
    ) -> None:
        """commanded: Indices of the commanded joints."""
        self.noisy = noisy
        self._names = joint_names
        self._commanded = commanded
        self._config = config
        self._equal_states = 0  # states in a row whose readings are all equal
        self._travel = np.zeros(len(commanded))  # way of the commands meanwhile, rad
        # Of joints whose position stands still, since it does:
        self._anchor: Array | None = None  # the command when it began, rad
        self._integral = np.zeros(len(commanded))  # of the velocity, rad
        self._still_states = np.zeros(len(commanded), int)

    def check(
        self, state: State, last: State | None, ctrl: Array | None, last_ctrl: Array | None
    ) -> Fault | None:
        """Return the fault of a state.

        Args:
            state: The newest one.
            last: The one before it.
            ctrl, last_ctrl: The command in force when each was read, rad; None: there was none.
        """
        if last is not None and state.time <= last.time:
            return None  # the same state again
        fault = None
        if last is not None:
            fault = self._equal_readings(state, last, ctrl, last_ctrl)
        return fault or self._joint_stands_still(state, last, ctrl)

    def _equal_readings(
        self, state: State, last: State, ctrl: Array | None, last_ctrl: Array | None
    ) -> Fault | None:
        """Return a fault if all readings of several states in a row are equal."""
        if not self._config.frozen:
            return None
        if not _reads_the_same(state, last):
            self._equal_states = 0
            self._travel[:] = 0.0
            return None
        self._equal_states += 1
        if ctrl is not None and last_ctrl is not None:
            self._travel += np.abs(ctrl - last_ctrl)
        repeats = self.noisy or self._travel.max() > self._config.frozen_travel
        if self._equal_states < self._config.frozen or not repeats:
            return None
        return Fault("frozen", f"{self._equal_states + 1} states in a row read exactly the same")

    def _joint_stands_still(
        self, state: State, last: State | None, ctrl: Array | None
    ) -> Fault | None:
        """Return a fault if one encoder stands still while its command or the integral of its
        velocity goes on.
        """
        qpos = state.qpos[self._commanded]
        if last is None or ctrl is None or not self.noisy:
            self._anchor = ctrl
            return None
        moved = qpos != last.qpos[self._commanded]
        anchor = ctrl if self._anchor is None else np.where(moved, ctrl, self._anchor)
        integral = self._integral + state.qvel[self._commanded] * (state.time - last.time)
        self._anchor = anchor
        self._integral = np.where(moved, 0.0, integral)
        self._still_states = np.where(moved, 0, self._still_states + 1)
        distance = np.maximum(np.abs(ctrl - anchor), np.abs(self._integral))
        beyond = np.where(self._still_states < MIN_STILL_STATES, 0.0, distance)
        worst = int(beyond.argmax())
        if beyond[worst] <= self._config.frozen_joint:
            return None
        joint = self._names[int(self._commanded[worst])]
        far = f"{beyond[worst]:.2f} rad"
        return Fault(
            "frozen",
            f"the position of {joint} stands still while its command or velocity goes {far}",
        )


class StateMonitor:
    """Checks successive states; it returns the first fault of each and remembers none."""

    def __init__(
        self,
        joint_names: tuple[str, ...],
        commanded: Array,
        dt: float,
        config: SafetyConfig,
        noisy: bool = True,
    ) -> None:
        """
        Args:
            commanded: Indices of the commanded joints.
            dt: Control period, s.
            noisy: Equal readings count as frozen at once; else only after the command has moved by
                frozen_travel.
        """
        self.names = joint_names
        self.commanded = commanded
        self.dt = dt
        self.config = config
        self.frozen = FrozenReadings(joint_names, commanded, noisy, config)
        self._last: State | None = None
        self._last_ctrl: Array | None = None
        self._tracking_s = 0.0  # for which a joint has been far from its command
        self._refused: list[tuple[float, int]] = []  # time, s, and messages refused until then

    def check(
        self,
        now: float,
        state: State,
        ctrl: Array | None,
        late: float = 0.0,
        requested: Array | None = None,
    ) -> Fault | None:
        """Return the first fault at the start of a control period.

        Args:
            now: s.
            state: The newest one.
            ctrl: The command in force since the last period, (len(commanded),) rad; None where
                there is none.
            late: How late this period starts, s.
            requested: Where the joints are asked to be, as `ctrl`, but without the torque limit.
                That limit keeps the command near the measured position, wherever a wrong reading
                goes; default the command.
        """
        fault = (
            self.overrun(late)
            or self._stale(now, state)
            or self._finite(state)
            or state.fault
            or self._tilt(state)
            or self._jump(state)
            or self._hot(state)
            or self.frozen.check(state, self._last, ctrl, self._last_ctrl)
            or self._tracking(state, ctrl, requested)
            or self._checksum(now, state)
        )
        self._last = state
        self._last_ctrl = ctrl
        return fault

    def overrun(self, late: float) -> Fault | None:
        """Return a fault if a period that was due `late` s ago may not send its command any
        more.
        """
        if late > self.config.overrun * self.dt:
            return Fault(
                "overrun",
                f"the period was {late * 1e3:.0f} ms late; make the loop lighter or slower",
            )
        return None

    def _stale(self, now: float, state: State) -> Fault | None:
        age = now - state.time
        if age > self.config.stale * self.dt * (1 + RELATIVE_ROUNDING):
            return Fault(
                "stale",
                f"the newest state is {age * 1e3:.0f} ms old, {age / self.dt:.1f} control periods",
            )
        return None

    def _finite(self, state: State) -> Fault | None:
        for name in ("qpos", "qvel", "tau"):
            bad = ~np.isfinite(getattr(state, name))
            if bad.any():
                return Fault("nan", f"{name} of {self.names[int(bad.argmax())]} is not a number")
        return None

    def _tilt(self, state: State) -> Fault | None:
        if not state.tilt <= self.config.tilt:
            return Fault("tilt", f"the robot leans by {state.tilt:.2f} rad")
        return None

    def _jump(self, state: State) -> Fault | None:
        if self._last is None:
            return None
        passed = max(state.time - self._last.time, 0.0)
        moved = np.abs(state.qpos - self._last.qpos)
        worst = int(moved.argmax())
        if moved[worst] > self.config.joint_speed * passed + self.config.jump:
            return Fault(
                "jump", f"{self.names[worst]} moved {moved[worst]:.3f} rad in {passed * 1e3:.0f} ms"
            )
        return None

    def _hot(self, state: State) -> Fault | None:
        worst = int(np.nan_to_num(state.temperature, nan=-np.inf).argmax())
        if state.temperature[worst] > self.config.temperature:
            return Fault(
                "temperature",
                f"{self.names[worst]} is at {state.temperature[worst]:.0f} °C; let it cool",
            )
        return None

    def _tracking(self, state: State, ctrl: Array | None, requested: Array | None) -> Fault | None:
        """Return a fault if a joint is far from its command, or from where it is asked to be
        without coming nearer.

        A fast joint may lag far behind the latter while it comes nearer at its full torque.
        """
        if ctrl is None:
            self._tracking_s = 0.0
            return None
        qpos = state.qpos[self.commanded]
        error = np.abs(ctrl - qpos)
        if requested is not None:
            distance = requested - qpos
            approach = np.sign(distance) * self._mean_speed(state)  # rad/s
            stays = approach < MIN_APPROACH_RAD_S
            error = np.where(stays, np.maximum(error, np.abs(distance)), error)
        worst = int(error.argmax())
        if error[worst] > self.config.tracking:
            self._tracking_s += self.dt
        else:
            self._tracking_s = 0.0
        if self._tracking_s > self.config.tracking_time:
            joint = self.names[int(self.commanded[worst])]
            return Fault(
                "tracking",
                f"{joint} is {error[worst]:.2f} rad from its command; is it blocked or unpowered?",
            )
        return None

    def _mean_speed(self, state: State) -> Array:
        """Return the speed of the commanded joints since the last state, rad/s.

        At a low control rate a joint reaches each command and stands again when it is read: its
        velocity then says nothing of how it moves.
        """
        qvel = state.qvel[self.commanded]
        if self._last is None or state.time <= self._last.time:
            result: Array = qvel
            return result
        moved = state.qpos[self.commanded] - self._last.qpos[self.commanded]
        return np.asarray(moved / (state.time - self._last.time))

    def _checksum(self, now: float, state: State) -> Fault | None:
        recent = [
            (time, refused) for time, refused in self._refused if now - time <= CHECKSUM_WINDOW_S
        ]
        self._refused = [*recent, (now, state.refused)]
        _, refused_before = self._refused[0]
        count = state.refused - refused_before
        if count > self.config.refused:
            return Fault(
                "checksum",
                f"{count} messages with a wrong checksum within a second; check cable and firmware",
            )
        return None


def _reads_the_same(state: State, last: State) -> bool:
    """Return True if positions, velocities and torques of two states are equal to the last bit."""
    names = ("qpos", "qvel", "tau")
    return all(np.array_equal(getattr(state, name), getattr(last, name)) for name in names)
