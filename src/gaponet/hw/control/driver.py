"""What a controller needs of a robot: `State` in, position targets out, joints by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError

End = Literal["hand_over", "hold", "damp"]


class DriverError(GAPONetError):
    """A robot cannot be reached, does not answer, or answers nonsense; the message says what to check."""


@dataclass(frozen=True)
class Fault:
    """Why a robot was stopped: a kind of safety.FAULTS, and a sentence."""

    kind: str
    text: str


@dataclass(frozen=True)
class State:
    """What a robot said last. All (n) arrays are in the robot's joint order.

    Attributes:
        time: When it was measured, on this machine's monotonic clock, s.
        qpos, qvel, tau, temperature: rad, rad/s, N·m, °C; temperature NaN where a robot does not measure it.
        refused: Messages refused so far because their checksum was wrong.
        tilt: Angle of the trunk against the vertical, rad; 0 where a robot does not measure it.
        fault: What the robot itself says is wrong, or that its operator pressed stop; the driver remembers it.
    """

    time: float
    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array
    refused: int = 0
    tilt: float = 0.0
    fault: Fault | None = None

    def qpos_with(self, joints: Array, values: Array) -> Array:
        """Return the measured position, (n) rad, with other values at some joints."""
        out = np.array(self.qpos, float)
        out[joints] = values
        return out


class Driver(Protocol):
    """The way to one robot: connect, read states, write targets, damp.

    Attributes:
        address: What is driven ("unitree domain 0 arm_sdk", "/dev/ttyUSB0"); one controller at a time per address.
        virtual: Whether there is no real robot behind it; None until the driver has found out.
        joint_names: All joints of the robot, (n), in the order of every array.
        commanded: The joints that `write` commands; the others are left to whoever commands them.
        noisy: Readings of a working robot are never twice the same, so equal ones mean that it is frozen.
        reads_back: `read` and `verify` find out whether the robot holds what it was told (state.fault); of others it is
            found out by whether the joints follow.
        kp, kd: Gains that the real servos follow under `write`, (n), N·m/rad and N·m·s/rad; final once connected.
        qpos_range: Where the real joints end, (n, 2) rad, where the robot itself was told; final once connected.
        facts: What a recording keeps about the servos beside (registers, kind of machine; remarks, sentences for who
            runs it); final once connected.
        at_end: After a run without fault: hand_over (hold while the weight goes from 1 to 0; the robot's own controller
            takes over), hold (servos keep the last target after `close`), damp (nobody holds it afterwards).
        at_stop: What `damp` does to it, as a verb: damps, lowers.
    """

    address: str
    virtual: bool
    joint_names: tuple[str, ...]
    commanded: tuple[str, ...]
    noisy: bool
    reads_back: bool
    kp: Array
    kd: Array
    qpos_range: Array | None
    facts: dict[str, Any]
    at_end: End
    at_stop: str

    def connect(self) -> None:
        """Open the bus and wait for a first state; commands nothing, publishes nothing.

        Raises:
            DriverError: Nobody answers, or not the robot that was expected.
        """

    def read(self) -> State:
        """The newest state, at once; the same one again if nothing newer has come."""

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Position targets (n) rad for the commanded joints.

        Args:
            ctrl: Targets; entries of joints that are not commanded are ignored.
            weight: 0 to 1: how far the robot hands itself over; ignored by robots that cannot share.
        """

    def verify(self) -> Fault | None:
        """What the robot no longer holds of what it was told, of all that can be asked; may take several periods."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """No position command: joints only brake; where the hardware cannot, they sink as their torque is taken away.

        Args:
            weight: The same as `write`'s; goes to 0.
            share: The share of their torque that joints which cannot brake keep; goes from 1 to 0, or is 0 at once.
        """

    def confirm(self) -> str:
        """After `damp`: what the robot itself says of it, in words.

        Raises:
            DriverError: It does not say that it is damped or let go.
        """

    def close(self, hold: bool = False) -> None:
        """Leave the bus; never raises.

        Args:
            hold: Send nothing: nothing was commanded, or what was commanded last shall stay. Otherwise joints are left
                damped or free.
        """

    def watchdog(self) -> dict[str, object] | None:
        """How another process can damp this robot if this one dies (deploy.watchdog); None if it cannot."""
