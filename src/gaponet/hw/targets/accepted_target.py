"""Which live targets are accepted, and how the robot approaches the last one."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import State
from gaponet.hw.targets.message import Message, sender_name
from gaponet.robot.spec import RobotSpec

# beyond a joint's range: up to this a target is clipped to the range, else rejected
MAX_BEYOND_RANGE_RAD = 0.2
# control periods for which the speed limit bounds the distance to the last target
MAX_CATCH_UP_PERIODS = 5
MAX_CLOCK_DRIFT = 2e-4  # of the sender's clock, relative to ours


class Rejection(NamedTuple):
    """Why a message is not obeyed."""

    kind: str  # key of counts["refused"]
    reason: str


class Sender:
    """The only sender of a run: that of the first well-formed message. Its clock is compared with
    ours.

    Attributes:
        identity: Of the transport; None before the first message.
        has_ended: True once it has said that the motion is over.
    """

    def __init__(self, max_late_s: float) -> None:
        """A message may take `max_late_s` longer than the fastest one."""
        self.identity: Hashable | None = None
        self.has_ended = False
        self._max_late_s = max_late_s
        self._offset = np.inf  # least arrival − time, s
        self._offset_time = np.inf  # our time of its last update, s
        self._accepted_time = -np.inf  # of the last accepted target, sender's clock

    @property
    def name(self) -> str:
        """The sender in words; empty before the first message."""
        return "" if self.identity is None else sender_name(self.identity)

    def reject(self, message: Message, now: float) -> Rejection | None:
        """Return why sender or time of a message are wrong; None if they are right."""
        if message.error:
            return Rejection("malformed", message.error)
        if self.identity is None:
            self.identity = message.sender
        if message.sender != self.identity:
            return Rejection(
                "stranger",
                "it is from another sender than the first one; start a new run for a new sender",
            )
        if message.end:
            self.has_ended = True
        return None if message.time is None else self._reject_time(message.time, now)

    def _reject_time(self, time: float, now: float) -> Rejection | None:
        if time <= self._accepted_time:
            return Rejection(
                "order", f"its time {time:.6g} s is not after {self._accepted_time:.6g} s"
            )
        drifted = self._offset + MAX_CLOCK_DRIFT * max(now - self._offset_time, 0.0)
        self._offset = min(now - time, drifted)
        self._offset_time = now
        late = now - time - self._offset
        if late > self._max_late_s:
            return Rejection("late", f"it took {late * 1e3:.0f} ms longer than the fastest")
        return None

    def note_accepted(self, message: Message) -> None:
        """Note that a message's target was accepted: later ones must have later times."""
        if message.time is not None:
            self._accepted_time = message.time


class AcceptedTarget:
    """The target in force, of all joints.

    Attributes:
        robot: Joints and ranges.
        commanded: Joints that the driver commands.
        qpos: The last accepted target, (n) rad; None before the first one.
        time: When it was accepted, s of our clock; 0 before the first one.
    """

    def __init__(
        self, robot: RobotSpec, commanded: tuple[str, ...], dt: float, speed: float
    ) -> None:
        """
        Args:
            robot: Joints and ranges.
            commanded: Joints that the driver commands.
            dt: Control period, s.
            speed: Fastest joint, rad/s.
        """
        self.robot = robot
        self.commanded = commanded
        self.qpos: Array | None = None
        self.time = 0.0
        self._dt = dt
        self._speed = speed
        self._joints: tuple[str, ...] = ()  # of the messages

    def accept(self, qpos: Array, now: float) -> None:
        """Put a target (n) rad in force."""
        self.qpos = qpos
        self.time = now

    def of_all_joints(self, message: Message, now: float, state: State) -> Array | Rejection | None:
        """Return the target of all joints (n) rad, or why it is rejected; None for a greeting.

        It is compared with the one in force.
        """
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
        target = np.array(state.qpos if self.qpos is None else self.qpos)
        step = np.abs(np.clip(wanted, low, high) - target[at])
        allowed = self._speed * min(now - self.time + self._dt, MAX_CATCH_UP_PERIODS * self._dt)
        if self.qpos is not None and step.max() > allowed:
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


class Approach:
    """The way to targets, within limits of speed and acceleration.

    Attributes:
        position: (n) rad; empty before the first target.
        step: The last one, (n) rad.
    """

    def __init__(self, max_step: float, max_change: float) -> None:
        """
        Args:
            max_step: Largest step of a control period, rad.
            max_change: Largest change of the step from one control period to the next, rad.
        """
        self.position = np.zeros(0)
        self.step = np.zeros(0)
        self._max_step = max_step
        self._max_change = max_change

    def advance(self, target: Array) -> None:
        """Move on towards a target (n) rad by one control period; begin at the first one."""
        if not self.position.size:
            self.position = target
            self.step = np.zeros_like(target)
        distance = target - self.position
        self.step = next_step(self.step, distance, self._max_step, self._max_change)
        self.position = np.where(self.step == distance, target, self.position + self.step)


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
