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
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.targets.accepted_target import AcceptedTarget, Approach, Rejection, Sender
from gaponet.hw.targets.message import Message, Transport, decode, sender_name
from gaponet.hw.targets.policy import NotYet
from gaponet.robot.spec import RobotSpec

MAX_OPTIONS = {
    "hold": (60.0, "s"),
    "late": (60.0, "s"),
    "wait": (1e6, "s"),
    "acceleration": (1e6, "rad/s²"),
}


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
        self.clock = clock
        self.config = config
        self.counts: dict[str, Any] = {"taken": 0, "held": 0, "refused": Counter(), "sender": ""}
        self.remarks: list[str] = []
        self.observe: Callable[[Array], tuple[Array, Array] | None] | None = None
        self._sender = Sender(config.late)
        self._target = AcceptedTarget(robot, commanded, dt, speed)
        self._approach = Approach(speed * dt, config.acceleration * dt**2)
        self._start: float | None = None
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
        self.transport.publish(self._sender.identity, self._published(state))
        # Row 0 is also the goal of the blend: it is asked for again and again.
        running = k > 0
        if not (self._sender.has_ended and running):
            unproven = self._target.qpos is None
            self._receive(now, state)
            if unproven and self._has_second_sender():
                return Fault(
                    "source",
                    f"more than one program sends targets to {self.transport.address}; end all "
                    "but one",
                )
        ended = self._sender.has_ended
        if self._target.qpos is None:
            return None if ended else self._still_silent(now - self._start)
        return self._next_position(self._target.qpos, now, ended and running)

    def _next_position(self, target: Array, now: float, ending: bool) -> Array | Fault | None:
        """Return the position, (n) rad, one period further towards an accepted target.

        None: ending, and it is reached. Fault: no target was accepted for long.
        """
        silent = now - self._target.time
        if silent > self.config.hold and not self._sender.has_ended:
            return Fault(
                "silence", f"no target was accepted for {silent * 1e3:.0f} ms{self._rejection}"
            )
        self._approach.advance(target)
        if ending and not self._approach.step.any():
            return None
        if silent > 0 and not ending:
            self.counts["held"] += 1
        return self._approach.position

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

    def _published(self, state: State) -> dict[str, Any]:
        """Return what the sender is told of a state."""
        message: dict[str, Any] = {
            "time": state.time,
            "joint_names": self._target.robot.joint_names,
            "commanded": self._target.commanded,
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
        accepted = None
        for message in self.transport.receive():
            rejection = self._sender.reject(message, now)
            target = rejection or self._target.of_all_joints(message, now, state)
            if isinstance(target, Rejection):
                self._count_rejection(message, target)
            elif target is not None:
                accepted = target
                self._sender.note_accepted(message)
                self.counts["taken"] += 1
        self.counts["sender"] = self._sender.name
        if accepted is not None:
            self._target.accept(accepted, now)
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
