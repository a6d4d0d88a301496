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


class VirtualDriver:
    """A `Driver` of a virtual robot in this process; its time is the controller's clock.

    Until the first command the robot stands still, so time that passes without a reading (planning,
    the question for consent, compiling) is not simulated. From the first command on all time is.
    """

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
        self.period = period
        self._new_unit = partial(LiveUnit, robot, physics, payload, seed, period)
        self._live: LiveUnit | None = None  # from the connection on
        self._state: State | None = None  # the newest one, from the connection on
        self._begun = 0.0  # clock's time at the connection, s
        self._skipped = 0  # state periods that were not simulated, before the first command
        self._commanded = False
        locked = idle_joints(robot, robot.operated)
        self.commanded = tuple(joint for joint in robot.joint_names if joint not in locked)
        self._at = robot.index(self.commanded)

    def connect(self) -> None:
        self._live = self._new_unit()
        self._begun = self.clock.now()
        self._skipped = 0
        self._commanded = False
        self._state = self._measure()

    def read(self) -> State:
        """Simulate until now and return the state.

        Raises:
            DriverError: The simulation of a commanded robot is more than MAX_LAG_S behind the
                clock.
        """
        assert self._state is not None, "connect first"
        due = self._periods_due()
        if due <= 0:
            return self._state
        if not self._commanded:
            self._skipped += due - 1
            due = 1
        if due * self.period > MAX_LAG_S:
            raise DriverError(
                f"{self.address}: this machine cannot simulate it in real time; run without real "
                "time (--fast)"
            )
        for _ in range(due):
            self.live.step()
        self._state = self._measure()
        return self._state

    @property
    def live(self) -> LiveUnit:
        """The simulated unit; it exists once the driver is connected."""
        assert self._live is not None, "connect first"
        return self._live

    def _periods_due(self) -> int:
        """Return how many state periods the simulation is behind the clock."""
        elapsed = int((self.clock.now() - self._begun) / self.period + 1e-6)
        return elapsed - self._skipped - self.live.steps

    def _measure(self) -> State:
        time = self._begun + (self._skipped + self.live.steps) * self.period
        return State(time, *self.live.read())

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send a command; it takes effect after the unit's own delay."""
        self._commanded = True
        self.live.set_gains(self.kp, self.kd)
        self.live.ctrl[self._at] = ctrl[self._at]

    def verify(self) -> None:
        """Do nothing: a virtual robot always has the right settings."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Stiffness zero, damping four times the robot's, on the commanded joints."""
        self._commanded = True
        kp = self.kp.copy()
        kd = self.kd.copy()
        kp[self._at] = 0.0
        kd[self._at] = DAMPING_FACTOR * kd[self._at]
        self.live.set_gains(kp, kd)

    def confirm(self) -> str:
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Do nothing: the robot ends with the process."""

    def watchdog(self) -> None:
        """Return None: the robot ends with the controller's process."""
        return None
