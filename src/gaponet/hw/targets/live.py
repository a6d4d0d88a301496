"""Targets that come while the robot moves, from teleoperation or from a policy in another process.

A `Wire` brings what was said; `LiveTargets` judges it and is the controller's policy. A target that cannot be taken
changes nothing: the last good one holds. Where none could be taken for a while the robot damps. What is taken is
followed within a limit of acceleration. That goes through compensator, limits and watchdog as a motion's row does;
docs/deploy-safety.md says what each fault ends in.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
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

LARGEST = 1 << 14  # bytes of a message; 27 joints with long names have 1,500
BEYOND = 0.2  # rad beyond a joint's range: up to there a target is brought into it, further on it is no target
CATCH_UP = 5  # control periods: a target may be as far from the last one as the speed limit allows for in these
DRIFT = 2e-4  # how much slower the sender's clock may run than ours


@dataclass(frozen=True)
class LiveConfig:
    """Which targets are taken while the robot moves, and for how long it does without."""

    hold: float = 0.5
    """How long the last good target is held when none comes that can be taken, s; then the robot damps."""
    late: float = 0.1
    """A target is too old that took this much longer than the fastest one, s."""
    wait: float = 60.0
    """How long to wait for the first target, s; nothing is commanded meanwhile."""
    acceleration: float = 50.0
    """Fastest acceleration with which targets are followed, rad/s²."""

    def __post_init__(self) -> None:
        for name, unit in {"hold": "s", "late": "s", "wait": "s", "acceleration": "rad/s²"}.items():
            if not 0 < getattr(self, name) < np.inf:
                raise UsageError(f"live: {name} is {getattr(self, name)} {unit}; give a positive number")


@dataclass(frozen=True)
class Message:
    """What a sender says: one JSON object, without the fields that are left out.

    Attributes:
        time: On the sender's clock, whichever that is, s; grows from message to message.
        target: Joint → rad; the same joints in every message. Empty: here is somebody who wants to hear states.
        end: The motion is over: the robot goes back to where it was found.
    """

    time: float
    target: dict[str, float] | None = None
    end: bool = False


class Heard(NamedTuple):
    """A message, or what is wrong with it; by whom, as far as the wire can tell; time None where it has no clock."""

    sender: Hashable
    time: float | None = None
    target: dict[str, float] | None = None
    end: bool = False
    wrong: str = ""


def decode(sender: Hashable, data: bytes) -> Heard:
    """A message of JSON."""
    if len(data) > LARGEST:
        return Heard(sender, wrong=f"has more than {LARGEST} bytes")
    try:
        said = parse_json(Message, data, "it", UsageError)
    except UsageError as error:
        return Heard(sender, wrong=str(error))
    return Heard(sender, said.time, said.target, said.end)


class Wire(Protocol):
    """Where targets come from, and where states go if anybody wants them. Nothing here waits."""

    address: str

    def receive(self) -> list[Heard]:
        """What came since the last look, oldest first, at most some dozens of messages."""

    def publish(self, to: Hashable, state: dict[str, Any]) -> None:
        """Tell the sender (or whoever listens) joint_names, commanded, and qpos, qvel, tau in SI."""

    def close(self, why: str) -> None:
        """Tell why the run ended, and leave."""


def follow(step: Array, distance: Array, fastest: float, change: float) -> Array:
    """The next step (n) rad towards a target, which it reaches as soon as it can and never overshoots.

    Args:
        step: The last one, rad per control period.
        distance: To the target, (n) rad.
        fastest: Largest step, rad.
        change: Largest change of the step from one control period to the next, rad.
    """
    # A step of u changes, u from m to m + 1, and the m smaller ones that end it go (m + 1) u - m (m + 1) / 2 changes.
    far = np.abs(distance)
    m = np.floor((np.sqrt(1 + 8 * far / change) - 1) / 2)
    largest = np.where(far <= change, far, change * (far / change + m * (m + 1) / 2) / (m + 1))
    return np.clip(np.copysign(np.minimum(largest, fastest), distance), step - change, step + change)


class LiveTargets:
    """The policy of a controller whose targets come over a wire.

    The first who says anything well formed is the sender until the end; others are not listened to.
    """

    def __init__(
        self,
        wire: Wire,
        robot: RobotSpec,
        commanded: tuple[str, ...],
        clock: Clock,
        dt: float,
        speed: float,
        config: LiveConfig = LiveConfig(),
    ) -> None:
        """
        Args:
            wire: Where targets come from.
            robot: Its joints and ranges.
            commanded: Joints that the driver commands.
            clock: The controller's.
            dt: Control period, s.
            speed: Fastest joint, rad/s (SafetyConfig.speed).
            config: Which targets are taken.
        """
        # The first message of a process takes 20 ms and more to take apart: none shall in a period of the control loop.
        decode("", b'{"time": 0.0, "target": {"joint": 0.0}, "end": false}')
        decode("", b"no message")
        self.wire, self.robot, self.commanded, self.clock = wire, robot, commanded, clock
        self.dt, self.speed, self.config = dt, speed, config
        self.counts: dict[str, Any] = {"taken": 0, "held": 0, "refused": Counter()}  # messages, periods, messages
        self._sender: Hashable | None = None
        self._names: tuple[str, ...] = ()
        self._target: Array | None = None  # all joints, rad
        self._at, self._step = np.zeros(0), np.zeros(0)  # where it is followed to, rad; the last step, rad
        self._offset = self._heard = np.inf  # least arrival − time, s; when that was
        self._time = -np.inf  # of the last target taken, sender's clock
        self._began: float | None = None
        self._taken = 0.0  # when the last target was taken
        self._ended = False
        self._wrong = ""

    def __call__(self, k: int, state: State) -> Array | Fault | None:
        """Where to be on the way to the target in force (n) rad, from the first one on, where it begins at rest.

        None where the sender has ended and its last target is reached; a fault where none could be taken for long.
        """
        now = self.clock.now()
        self._began = now if self._began is None else self._began
        names = {"joint_names": self.robot.joint_names, "commanded": self.commanded}
        readings = {name: getattr(state, name).tolist() for name in ("qpos", "qvel", "tau")}
        self.wire.publish(self._sender, {"time": state.time, **names, **readings})
        if not (self._ended and k > 0):
            self._listen(now, state)
        ending = self._ended and (k > 0 or self._target is None)  # row 0 is also the goal of the blend
        if self._target is None:
            if ending:
                return None
            waited = now - self._began
            kind = NotYet if waited < self.config.wait else Fault
            return kind("silence", f"no target came on {self.wire.address} in {waited:.0f} s{self._wrong}")
        silent = now - self._taken
        if silent > self.config.hold and not ending:
            return Fault("silence", f"no target that could be taken for {silent * 1e3:.0f} ms{self._wrong}")
        self._advance(self._target)
        if ending and not self._step.any():
            return None
        self.counts["held"] += int(silent > 0 and not ending)
        return self._at

    def _advance(self, target: Array) -> None:
        """Go on by one control period towards a target (n) rad."""
        if not self._at.size:
            self._at, self._step = target, np.zeros_like(target)
        distance = target - self._at
        self._step = follow(self._step, distance, self.speed * self.dt, self.config.acceleration * self.dt**2)
        self._at = np.where(self._step == distance, target, self._at + self._step)

    def close(self, why: str) -> None:
        """Tell the sender that the run is over, and leave the wire."""
        self.wire.close(why)

    def _listen(self, now: float, state: State) -> None:
        """Take the newest target that can be taken; each is compared with the one in force before this look."""
        before, since, taken = self._target, now - self._taken, None
        for heard in self.wire.receive():
            kind, why = self._refused(heard, now)
            target, kind, why = (None, kind, why) if kind else self._aim(heard, before, since, state)
            if kind:
                self.counts["refused"][kind] += 1
                self._wrong = f"; the last one refused: {why}"
            elif target is not None:
                taken, self._time = target, heard.time if heard.time is not None else self._time
                self.counts["taken"] += 1
        if taken is not None:
            self._target, self._taken, self._wrong = taken, now, ""

    def _refused(self, heard: Heard, now: float) -> tuple[str, str]:
        """Kind and reason where a message is not listened to; empty where it is."""
        if heard.wrong:
            return "malformed", heard.wrong
        if self._sender is None:
            self._sender = heard.sender
        if heard.sender != self._sender:
            return "stranger", "it is of another sender than the first; one that was started again needs a new run"
        if heard.end:
            self._ended = True
        if heard.time is None:
            return "", ""
        if heard.time <= self._time:
            return "order", f"its time {heard.time:.6g} s is not after {self._time:.6g} s"
        drifted = self._offset + DRIFT * max(now - self._heard, 0.0)
        self._offset, self._heard = min(now - heard.time, drifted), now
        late = now - heard.time - self._offset
        if late > self.config.late:
            return "late", f"it took {late * 1e3:.0f} ms longer than the fastest"
        return "", ""

    def _aim(self, heard: Heard, before: Array | None, since: float, state: State) -> tuple[Array | None, str, str]:
        """The target of all joints (n) rad, None in a greeting; or kind and reason where it cannot be one."""
        if not heard.target:
            return None, "", ""
        names = self._names or tuple(heard.target)
        if heard.target.keys() != set(names) or not set(names) <= set(self.commanded):
            odd = sorted(heard.target.keys() ^ set(names)) or [n for n in names if n not in self.commanded]
            return None, "joints", f"joint '{odd[0]}' is new, left out, or not one that is commanded"
        at = self.robot.index(names)
        asked, (low, high) = np.array([heard.target[name] for name in names], float), self.robot.qpos_range[at].T
        beyond = np.maximum(low - asked, asked - high)
        if not beyond.max() <= BEYOND:  # NaN too
            worst = int(np.argmax(beyond))
            return None, "range", f"{names[worst]} at {asked[worst]:.3g} rad is out of its range"
        target = np.array(state.qpos if before is None else before)
        step = np.abs(np.clip(asked, low, high) - target[at])
        allowed = self.speed * min(since + self.dt, CATCH_UP * self.dt)
        if before is not None and step.max() > allowed:
            worst = int(step.argmax())
            return None, "speed", f"{names[worst]} goes {step[worst]:.2f} rad at once, {allowed:.2f} would be possible"
        target[at] = np.clip(asked, low, high)
        self._names = names
        return target, "", ""
