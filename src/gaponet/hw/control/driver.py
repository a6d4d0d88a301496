"""Interface between controller and robot: `State` in, position targets out, joints by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError

EndAction = Literal["hand_over", "hold", "damp"]


class DriverError(GAPONetError):
    """A robot cannot be reached, does not answer, or gives invalid answers.

    The message says what to check.
    """


@dataclass(frozen=True)
class Fault:
    """Reason why a robot is stopped: a kind of safety.FAULTS, and a sentence."""

    kind: str
    text: str


@dataclass(frozen=True)
class State:
    """Last readings of a robot. All (n) arrays are in the robot's joint order.

    Attributes:
        time: When it was measured, on this machine's monotonic clock, s.
        qpos, qvel, tau, temperature: rad, rad/s, N·m, °C. Of a robot that does not measure them,
            tau is 0 and temperature is NaN.
        refused: Number of messages with a wrong checksum so far.
        tilt: Angle of the trunk against the vertical, rad; 0 where a robot does not measure it.
        fault: Reported by the robot itself, or a stop by its operator; the driver keeps it for
            good.
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
    """Connection to one robot: connect, read states, write targets, damp.

    What the properties below say is final once the driver is connected.

    Attributes:
        address: Name of the connection ("unitree dds domain 0", "/dev/ttyUSB0"); one controller at
            a time per address.
        joint_names: All joints of the robot, (n), in the order of every array.
        commanded: Joints that `write` commands; other controllers command the rest.
        noisy: Readings of a working robot are never twice the same, so equal ones mean that it is
            frozen.
        reads_back: `read` and `verify` check that the robot holds its commands and settings
            (state.fault). For other robots the controller checks that the joints follow.
        at_end: After a run without fault: hand_over (hold while the weight goes from 1 to 0; the
            robot's own controller takes over), hold (servos keep the last target after `close`),
            damp (nothing holds it afterwards).
        at_stop: Effect of `damp`, as a verb: damps, lowers.
    """

    address: str
    joint_names: tuple[str, ...]
    commanded: tuple[str, ...]
    noisy: bool
    reads_back: bool
    at_end: EndAction
    at_stop: str

    @property
    def virtual(self) -> bool:
        """True without a real robot."""

    @property
    def kp(self) -> Array:
        """Stiffness of the real servos under `write`, (n) N·m/rad."""

    @property
    def kd(self) -> Array:
        """Damping of the real servos under `write`, (n) N·m·s/rad."""

    @property
    def qpos_range(self) -> Array | None:
        """Joint ranges that the robot itself reports, (n, 2) rad, or None."""

    @property
    def facts(self) -> dict[str, Any]:
        """What is stored with a recording (registers, kind of machine).

        `remarks`: sentences for the user; `source`: the one robot that the states are from, in
        words; `interface`: network interface by which it is reached.
        """

    def connect(self) -> None:
        """Open the bus and wait for a first state; commands nothing, publishes nothing.

        Raises:
            DriverError: No robot answers, or not the expected one.
        """

    def read(self) -> State:
        """Return the newest state; the same one again if no newer one has come.

        It may take a small part of a control period.
        """

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send position targets of the commanded joints.

        Args:
            ctrl: (n) rad; entries of joints that are not commanded are ignored.
            weight: Our share of control, 0 to 1; ignored by robots that cannot share.
        """

    def verify(self) -> Fault | None:
        """Compare all that can be read back with what was sent; may take several periods."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Brake all joints without a position command.

        Joints that cannot brake sink as their torque is reduced.

        Args:
            weight: Our share of control; decreases to 0.
            share: Share of their torque that joints keep which cannot brake; decreases from 1 to 0,
                or is 0 at once. The watchdog begins with 1 also where the controller has reduced
                the torque already: never raise it.
        """

    def confirm(self) -> str:
        """Return what the robot itself reports after `damp`, in words.

        Raises:
            DriverError: It does not report that it is damped or let go.
        """

    def close(self, hold: bool = False) -> None:
        """Leave the bus; never raises.

        Args:
            hold: Send nothing: nothing was commanded, or the last command shall stay. Otherwise
                joints are left damped or free.
        """

    def watchdog(self) -> dict[str, object] | None:
        """Return the arguments of open_driver with which another process connects to this robot to
        damp it.

        `kind` is the driver's name, `robot` the folder of its robot; the others are parameters of
        the driver. The process connects before the first command and must send nothing until it
        damps (control.watchdog). None: no other process can damp the robot.
        """
