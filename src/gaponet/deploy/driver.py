"""What a controller needs of a robot: `State` in, position targets out, joints by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gaponet.errors import GAPONetError

Array = np.ndarray


class DriverError(GAPONetError):
    """A robot cannot be reached, does not answer, or answers nonsense; the message says what to check."""


@dataclass(frozen=True)
class State:
    """What a robot said last. All (n) arrays are in the robot's joint order.

    Attributes:
        time: When it was measured, on this machine's monotonic clock, s.
        qpos, qvel, tau, temperature: rad, rad/s, N·m, °C; temperature NaN where a robot does not measure it.
        refused: Messages refused so far because their checksum was wrong.
    """

    time: float
    qpos: Array
    qvel: Array
    tau: Array
    temperature: Array
    refused: int = 0


class Driver(Protocol):
    """One robot.

    Attributes:
        address: What is driven ("unitree domain 0 arm_sdk", "/dev/ttyUSB0"); one controller at a time per address.
        virtual: Whether there is no real robot behind it; None until the driver has found out.
        joint_names: All joints of the robot, (n), in the order of every array.
        commanded: The joints that `write` commands; the others are left to whoever commands them.
        noisy: Readings of a working robot are never twice the same, so equal ones mean that it is frozen.
    """

    address: str
    virtual: bool
    joint_names: tuple[str, ...]
    commanded: tuple[str, ...]
    noisy: bool

    def connect(self) -> None:
        """Open the bus and wait for a first state; commands nothing.

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

    def damp(self, weight: float = 1.0) -> None:
        """No position command: joints only brake, or are free where the hardware cannot brake."""

    def close(self) -> None:
        """Leave the bus, joints damped or free; never raises."""

    def guard(self) -> dict[str, object] | None:
        """How another process can damp this robot if this one dies (deploy.guard); None if it cannot."""
