"""VirtualDriver: a virtual robot in this process, in real time or as fast as the control loop
runs.
"""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.driver import DriverError, EndAction, State
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot

STATE_PERIOD_S = 0.002  # 500 Hz, as the H1-2
DAMPING_FACTOR = 4.0  # of the robot's kd while damping; see drivers.unitree
MAX_LAG_S = 0.5  # simulated time behind the clock, once the robot was commanded


class LiveUnit:
    """One virtual unit, stepped in equal periods without a clock.

    Base of every virtual bus and driver.
    """

    def __init__(
        self,
        robot: RobotSpec,
        physics: Physics,
        payload: tuple[float, str],
        seed: int = 0,
        period: float = STATE_PERIOD_S,
    ) -> None:
        """
        Args:
            payload: kg per hand, and side.
            period: Time between two states, s.
        """
        self.robot = robot
        self.period = period
        locked = idle_joints(robot, robot.operated)
        self.unit = VirtualRobot(robot, [physics], [payload], dt=period, locked=locked)
        self.ctrl = robot.qpos_home.copy()
        self.unit.reset(self.ctrl[None], [seed])
        servo = robot.servo
        self._gains = np.array([servo.kp, servo.kd, servo.effort_limit, np.zeros_like(servo.kp)])
        self.steps = 0

    def set_gains(
        self, kp: Array, kd: Array, effort: Array | None = None, torque: Array | float = 0.0
    ) -> None:
        """Set gains, if they change.

        Args:
            kp, kd: N·m/rad, N·m·s/rad.
            effort: Torque limits, N·m; default the robot's.
            torque: Added torque, N·m.
        """
        limit = self.robot.servo.effort_limit if effort is None else effort
        gains = np.array([kp, kd, limit, np.broadcast_to(torque, len(kp))], float)
        if not np.array_equal(gains, self._gains):
            self._gains = gains
            self.unit.set_gains(*gains)

    def step(self) -> None:
        """Simulate one period under the present command and gains."""
        self.unit.step(self.ctrl[None])
        self.steps += 1

    def read(self) -> tuple[Array, Array, Array, Array]:
        """Return the readings of the sensors: qpos, qvel, tau, temperature, (n) each."""
        reading = self.unit.read()
        return reading.qpos[0], reading.qvel[0], reading.tau[0], reading.temperature[0]


class ClockedUnit:
    """A unit whose time is a clock's.

    Until the first command it stands still, so time that passes without a reading (planning, the
    question for consent, compiling) is not simulated. From the first command on all time is.

    Attributes:
        live: The unit.
        state: Its newest state.
        is_commanded: True from the first command on.
    """

    def __init__(self, live: LiveUnit, clock: Clock) -> None:
        self.live = live
        self.is_commanded = False
        self._clock = clock
        self._begun = clock.now()  # s
        self._skipped = 0  # state periods that were not simulated
        self.state = self._measure()

    def periods_due(self) -> int:
        """Return how many state periods are to be simulated until now; at most one before the
        first command.
        """
        elapsed = int((self._clock.now() - self._begun) / self.live.period + 1e-6)
        due = elapsed - self._skipped - self.live.steps
        if due > 1 and not self.is_commanded:
            self._skipped += due - 1
            return 1
        return due

    def advance(self, periods: int) -> None:
        """Simulate some state periods, and measure."""
        for _ in range(periods):
            self.live.step()
        self.state = self._measure()

    def _measure(self) -> State:
        time = self._begun + (self._skipped + self.live.steps) * self.live.period
        return State(time, *self.live.read())


class VirtualDriver:
    """A `Driver` of a virtual robot in this process; its time is the controller's clock."""

    virtual = True
    noisy = True
    reads_back = True
    at_end: EndAction = "hold"
    at_stop = "damps"
    qpos_range: Array | None = None

    def __init__(
        self,
        robot: RobotSpec,
        physics: Physics,
        clock: Clock,
        payload: tuple[float, str] = (0.0, "both"),
        name: str = "unit",
        seed: int = 0,
        period: float = STATE_PERIOD_S,
    ) -> None:
        """
        Args:
            physics: Hidden parameters (virtual.fleet).
            clock: Clock of the controller.
            payload: kg per hand, and side.
            period: Time between two states, s.
        """
        robot = robot.before_identification  # the hidden physics replaces what was identified
        self.kp = robot.servo.kp
        self.kd = robot.servo.kd
        self.facts: dict[str, Any] = {}
        self.address = f"virtual {robot.name} {name} in process {os.getpid()}"
        self.joint_names = robot.joint_names
        self.clock = clock
        self._new_unit = partial(LiveUnit, robot, physics, payload, seed, period)
        self._unit: ClockedUnit | None = None  # from the connection on
        locked = idle_joints(robot, robot.operated)
        self.commanded = tuple(joint for joint in robot.joint_names if joint not in locked)
        self._at = robot.index(self.commanded)

    def connect(self) -> None:
        self._unit = ClockedUnit(self._new_unit(), self.clock)

    @property
    def unit(self) -> ClockedUnit:
        """The simulated unit; it exists once the driver is connected."""
        assert self._unit is not None, "connect first"
        return self._unit

    def read(self) -> State:
        """Simulate until now and return the state.

        Raises:
            DriverError: The simulation of a commanded robot is more than MAX_LAG_S behind the
                clock.
        """
        unit = self.unit
        due = unit.periods_due()
        if due * unit.live.period > MAX_LAG_S:
            raise DriverError(
                f"{self.address}: this machine cannot simulate it in real time; run without real "
                "time (--fast)"
            )
        if due > 0:
            unit.advance(due)
        return unit.state

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send a command; it takes effect after the unit's own delay."""
        self.unit.is_commanded = True
        live = self.unit.live
        live.set_gains(self.kp, self.kd)
        live.ctrl[self._at] = ctrl[self._at]

    def verify(self) -> None:
        """Do nothing: a virtual robot always has the right settings."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Stiffness zero, damping four times the robot's, on the commanded joints."""
        self.unit.is_commanded = True
        kp = self.kp.copy()
        kd = self.kd.copy()
        kp[self._at] = 0.0
        kd[self._at] = DAMPING_FACTOR * kd[self._at]
        self.unit.live.set_gains(kp, kd)

    def confirm(self) -> str:
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Do nothing: the robot ends with the process."""

    def watchdog(self) -> None:
        """Return None: the robot ends with the controller's process."""
        return None
