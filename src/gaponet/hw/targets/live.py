"""Live targets: positions that arrive while the robot moves, from teleoperation or from a policy
in another process.

A `Transport` delivers messages. `LiveTargets` checks them and is the controller's policy. A
rejected target changes nothing: the last accepted one is held. If no target is accepted for
`LiveConfig.hold`, the robot damps. An accepted target is approached within an acceleration limit,
and then passes compensator, limits and watchdog like a motion's row. docs/reference/controller.md
lists the end of each fault.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.structure import parse_json
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.targets.policy import NotYet
from gaponet.robot.spec import RobotSpec

MAX_MESSAGE_BYTES = 1 << 14  # a message of 27 joints with long names has 1,500
# beyond a joint's range: up to this a target is clipped to the range, else rejected
MAX_BEYOND_RANGE_RAD = 0.2
# control periods for which the speed limit bounds the distance to the last target
MAX_CATCH_UP_PERIODS = 5
MAX_OPTIONS = {
    "hold": (60.0, "s"),
    "late": (60.0, "s"),
    "wait": (1e6, "s"),
    "acceleration": (1e6, "rad/s²"),
}
MAX_CLOCK_DRIFT = 2e-4  # of the sender's clock, relative to ours


@dataclass(frozen=True)
class LiveConfig:
    """Which live targets are accepted, and for how long the last one is held."""

    hold: float = 0.5
    """How long the last accepted target is held without another one, s; then the robot damps."""
    late: float = 0.1
    """A target is rejected if it took this much longer than the fastest one, s."""
    wait: float = 60.0
    """How long to wait for the first target, s; nothing is commanded meanwhile."""
    acceleration: float = 50.0
    """Fastest acceleration with which targets are followed, rad/s²."""

    def __post_init__(self) -> None:
        for name, (most, unit) in MAX_OPTIONS.items():
            if not 0 < getattr(self, name) <= most:
                raise UsageError(
                    f"live: {name} is {getattr(self, name)} {unit}; give a positive number up to "
                    f"{most:g}"
                )


@dataclass(frozen=True)
class MessageFields:
    """Fields of a message in JSON; optional fields may be left out.

    Attributes:
        time: On the sender's own clock, s; increases from message to message.
        target: Joint → rad; the same joints in every message. Empty: the sender only wants to
            receive states.
        end: The motion is over: the robot goes back to where it started.
    """

    time: float
    target: dict[str, float] | None = None
    end: bool = False


class Message(NamedTuple):
    """A received message; time None without a clock; error: why it cannot be read, else empty."""

    sender: Hashable
    time: float | None = None
    target: dict[str, float] | None = None
    end: bool = False
    error: str = ""


def sender_name(sender: Hashable) -> str:
    """Return a sender in words: a DDS handle or the bytes of a ZeroMQ connection as hexadecimal
    digits.
    """
    if isinstance(sender, bytes):
        return sender.hex()
    if isinstance(sender, int):
        return f"{sender:x}"
    return str(sender)


def decode(sender: Hashable, data: bytes) -> Message:
    """Return a message from JSON; it carries its error if the bytes are not one."""
    if len(data) > MAX_MESSAGE_BYTES:
        return Message(sender, error=f"has more than {MAX_MESSAGE_BYTES} bytes")
    try:
        fields = parse_json(MessageFields, data, "it", UsageError)
    except UsageError as error:
        return Message(sender, error=str(error))
    return Message(sender, fields.time, fields.target, fields.end)


class Transport(Protocol):
    """Receives targets and publishes states; no method blocks."""

    address: str

    def receive(self) -> list[Message]:
        """Return the messages since the last call, oldest first, at most some dozens."""

    def senders(self) -> set[Hashable]:
        """Return the senders that are connected now.

        Empty where a transport knows them by their messages alone.
        """

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Send joint_names, commanded, and qpos, qvel, tau in SI units to the sender, or to all
        listeners.
        """

    def close(self, reason: str) -> None:
        """Send the reason why the run ended, and close."""


def next_step(step: Array, distance: Array, max_step: float, max_change: float) -> Array:
    """Return the next step (n) rad towards a target: the fastest approach without overshoot.

    Args:
        step: The last one, rad per control period.
        distance: To the target, (n) rad.
        max_step: Largest step, rad.
        max_change: Largest change of the step from one control period to the next, rad.
    """
    # A step of u changes, u from m to m + 1, and the m smaller ones that end it go (m + 1) u - m (m
    # + 1) / 2 changes.
    far = np.abs(distance)
    m = np.floor((np.sqrt(1 + 8 * far / max_change) - 1) / 2)
    largest = np.where(
        far <= max_change, far, max_change * (far / max_change + m * (m + 1) / 2) / (m + 1)
    )
    result: Array = np.clip(
        np.copysign(np.minimum(largest, max_step), distance), step - max_change, step + max_change
    )
    return result


class Rejection(NamedTuple):
    """Why a message is not obeyed."""

    kind: str  # key of counts["refused"]
    reason: str


class LiveTargets:
    """Policy of a controller whose targets arrive over a transport.

    The sender of the first well-formed message is the only sender of the run. If another one speaks
    before a first target is accepted, nobody knows which of the two was meant, and the run is
    refused. Later its messages are rejected, with a remark, and the robot follows the first one.
    They cannot move the robot, and a stop would let every program that reaches the address drop an
    arm in the middle of a motion.

    Attributes:
        counts: accepted (`taken`) and rejected (`refused`, by kind) messages; periods in which a
            target was `held`; the `sender`.
        remarks: Sentences for the recording; the controller takes them out.
        observe: Returns positions and velocities, (n) rad and rad/s, that a policy is to see
            instead of the measured position, which it is given; None, or returning None: there are
            none.
    """

    def __init__(
        self,
        transport: Transport,
        robot: RobotSpec,
        commanded: tuple[str, ...],
        clock: Clock,
        dt: float,
        speed: float,
        config: LiveConfig = LiveConfig(),
    ) -> None:
        """
        Args:
            commanded: Joints that the driver commands.
            clock: The controller's.
            dt: Control period, s.
            speed: Fastest joint, rad/s (SafetyConfig.speed).
        """
        # Decoding the first message of a process takes 20 ms or more, which no control period has.
        decode("", b'{"time": 0.0, "target": {"joint": 0.0}, "end": false}')
        decode("", b"no message")
        self.transport = transport
        self.robot = robot
        self.commanded = commanded
        self.clock = clock
        self.dt = dt
        self.speed = speed
        self.config = config
        self.counts: dict[str, Any] = {"taken": 0, "held": 0, "refused": Counter(), "sender": ""}
        self.remarks: list[str] = []
        self.observe: Callable[[Array], tuple[Array, Array] | None] | None = None
        self._sender: Hashable | None = None
        self._joints: tuple[str, ...] = ()
        self._target: Array | None = None  # the last accepted one, all joints, rad
        self._position = np.zeros(0)  # on the way to the target, rad
        self._step = np.zeros(0)  # the last one, rad
        self._offset = np.inf  # least arrival − time, s
        self._offset_time = np.inf  # our time of its last update, s
        self._sender_time = -np.inf  # of the last accepted target, sender's clock
        self._start: float | None = None
        self._accepted_time = 0.0  # our time of the last accepted target
        self._ended = False
        self._rejection = ""

    def __call__(self, k: int, state: State) -> Array | Fault | None:
        """Return the position on the way to the target, (n) rad.

        It begins at the first target, at rest.

        None: the sender has ended the motion and its last target is reached. Fault: no target was
        accepted for long.
        """
        now = self.clock.now()
        if self._start is None:
            self._start = now
        self.transport.publish(self._sender, self._published(state))
        # Row 0 is also the goal of the blend: it is asked for again and again.
        running = k > 0
        if not (self._ended and running):
            unproven = self._target is None
            self._receive(now, state)
            if unproven and self._has_second_sender():
                return Fault(
                    "source",
                    f"more than one program sends targets to {self.transport.address}; end all "
                    "but one",
                )
        if self._target is None:
            return None if self._ended else self._still_silent(now - self._start)
        return self._next_position(self._target, now, self._ended and running)

    def _next_position(self, target: Array, now: float, ending: bool) -> Array | Fault | None:
        """Return the position, (n) rad, one period further towards an accepted target.

        None: ending, and it is reached. Fault: no target was accepted for long.
        """
        silent = now - self._accepted_time
        if silent > self.config.hold and not ending:
            return Fault(
                "silence", f"no target was accepted for {silent * 1e3:.0f} ms{self._rejection}"
            )
        self._advance(target)
        if ending and not self._step.any():
            return None
        if silent > 0 and not ending:
            self.counts["held"] += 1
        return self._position

    def _still_silent(self, waited: float) -> Fault:
        """Return why there is no first target after some s: not yet, or a fault."""
        kind = NotYet if waited < self.config.wait else Fault
        return kind(
            "silence",
            f"no target came on {self.transport.address} in {waited:.0f} s{self._rejection}",
        )

    def close(self, reason: str) -> None:
        """Send the sender the reason why the run is over, and close the transport."""
        self.transport.close(reason)

    def _has_second_sender(self) -> bool:
        """Return True if another sender than that of the run has spoken, or is connected."""
        if self.counts["refused"]["stranger"]:
            return True
        return len(self.transport.senders()) > 1

    def _advance(self, target: Array) -> None:
        """Move on towards a target (n) rad by one control period."""
        if not self._position.size:
            self._position = target
            self._step = np.zeros_like(target)
        distance = target - self._position
        self._step = next_step(
            self._step, distance, self.speed * self.dt, self.config.acceleration * self.dt**2
        )
        self._position = np.where(self._step == distance, target, self._position + self._step)

    def _published(self, state: State) -> dict[str, Any]:
        """Return what the sender is told of a state."""
        message: dict[str, Any] = {
            "time": state.time,
            "joint_names": self.robot.joint_names,
            "commanded": self.commanded,
        }
        for name in ("qpos", "qvel", "tau"):
            message[name] = getattr(state, name).tolist()
        seen = None if self.observe is None else self.observe(state.qpos)
        if seen is not None:
            message["nominal_qpos"] = seen[0].tolist()
            message["nominal_qvel"] = seen[1].tolist()
        return message

    def _receive(self, now: float, state: State) -> None:
        """Accept the newest valid target.

        Each is compared with the one in force before this call.
        """
        before = self._target
        since = now - self._accepted_time
        accepted = None
        for message in self.transport.receive():
            target = self._reject(message, now) or self._full_target(message, before, since, state)
            if isinstance(target, Rejection):
                self._count_rejection(message, target)
            elif target is not None:
                accepted = target
                if message.time is not None:
                    self._sender_time = message.time
                self.counts["taken"] += 1
        if accepted is not None:
            self._target = accepted
            self._accepted_time = now
            self._rejection = ""

    def _count_rejection(self, message: Message, rejection: Rejection) -> None:
        """Count a rejected message; remark on the first one of a second sender."""
        refused = self.counts["refused"]
        if rejection.kind == "stranger" and not refused["stranger"]:
            self.remarks.append(
                f"targets of a second sender, {sender_name(message.sender)}, are rejected"
            )
        refused[rejection.kind] += 1
        self._rejection = f"; the last one was rejected: {rejection.reason}"

    def _reject(self, message: Message, now: float) -> Rejection | None:
        """Return why sender or time of a message are wrong; None if they are right."""
        if message.error:
            return Rejection("malformed", message.error)
        if self._sender is None:
            self._sender = message.sender
            self.counts["sender"] = sender_name(message.sender)
        if message.sender != self._sender:
            return Rejection(
                "stranger",
                "it is from another sender than the first one; start a new run for a new sender",
            )
        if message.end:
            self._ended = True
        if message.time is None:
            return None
        if message.time <= self._sender_time:
            return Rejection(
                "order", f"its time {message.time:.6g} s is not after {self._sender_time:.6g} s"
            )
        drifted = self._offset + MAX_CLOCK_DRIFT * max(now - self._offset_time, 0.0)
        self._offset = min(now - message.time, drifted)
        self._offset_time = now
        late = now - message.time - self._offset
        if late > self.config.late:
            return Rejection("late", f"it took {late * 1e3:.0f} ms longer than the fastest")
        return None

    def _full_target(
        self, message: Message, before: Array | None, since: float, state: State
    ) -> Array | Rejection | None:
        """Return the target of all joints (n) rad, or why it is rejected; None for a greeting."""
        if not message.target:
            return None
        names = self._joints or tuple(message.target)
        odd = self._odd_joints(message.target, names)
        if odd:
            return Rejection(
                "joints", f"joint '{odd[0]}' is new, left out, or not one that is commanded"
            )
        at = self.robot.index(names)
        wanted = np.array([message.target[name] for name in names], float)
        low, high = self.robot.qpos_range[at].T
        beyond = np.maximum(low - wanted, wanted - high)
        if not beyond.max() <= MAX_BEYOND_RANGE_RAD:  # NaN too
            worst = int(np.argmax(beyond))
            return Rejection(
                "range", f"{names[worst]} at {wanted[worst]:.3g} rad is out of its range"
            )
        target = np.array(state.qpos if before is None else before)
        step = np.abs(np.clip(wanted, low, high) - target[at])
        allowed = self.speed * min(since + self.dt, MAX_CATCH_UP_PERIODS * self.dt)
        if before is not None and step.max() > allowed:
            worst = int(step.argmax())
            return Rejection(
                "speed",
                f"{names[worst]} goes {step[worst]:.2f} rad at once, {allowed:.2f} would be "
                "possible",
            )
        target[at] = np.clip(wanted, low, high)
        self._joints = names
        return target

    def _odd_joints(self, target: Mapping[str, float], names: tuple[str, ...]) -> list[str]:
        """Return joints that are not in both, or else those that are not commanded."""
        odd = sorted(target.keys() ^ set(names))
        if odd:
            return odd
        return [name for name in names if name not in self.commanded]
