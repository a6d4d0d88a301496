"""VirtualDriver: a virtual robot in this process, in real time or as fast as the loop asks."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.clock import Clock
from gaponet.hw.control.driver import DriverError, EndAction, State
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.testing.physics import Physics
from gaponet.testing.unit import VirtualRobot

STATE_PERIOD = 0.002  # s: a virtual robot speaks at 500 Hz, as the H1-2 does
DAMPING = 4.0  # times the robot's kd while damping; see drivers.unitree
LAG = 0.5  # s of real time that it may be behind before it gives up


class LiveUnit:
    """One virtual unit stepped in equal periods: what every virtual bus is built on. Knows no clock."""

    def __init__(
        self,
        robot: RobotSpec,
        physics: Physics,
        payload: tuple[float, str],
        seed: int = 0,
        period: float = STATE_PERIOD,
    ) -> None:
        """
        Args:
            payload: kg per hand, and side.
            period: Between two states, s.
        """
        self.robot, self.period = robot, period
        locked = idle_joints(robot, robot.operated) if len(robot.operated) < len(robot.joint_names) else ()
        self.unit = VirtualRobot(robot, [physics], [payload], dt=period, locked=locked)
        self.ctrl = robot.qpos_home.copy()
        self.unit.reset(self.ctrl[None], [seed])
        self._law = np.array([robot.kp, robot.kd, robot.effort_limit, np.zeros_like(robot.kp)])
        self.steps = 0

    def set_gains(self, kp: Array, kd: Array, effort: Array | None = None, torque: Array | float = 0.0) -> None:
        """N·m/rad, N·m·s/rad, torque limits (default the robot's) and added torque in N·m, if they are not in force."""
        limit = self.robot.effort_limit if effort is None else effort
        law = np.array([kp, kd, limit, np.broadcast_to(torque, len(kp))], float)
        if not np.array_equal(law, self._law):
            self._law = law
            self.unit.set_gains(*law)

    def step(self) -> None:
        """Let one period pass under the present command and gains."""
        self.unit.step(self.ctrl[None])
        self.steps += 1

    def read(self) -> tuple[Array, Array, Array, Array]:
        """qpos, qvel, tau, temperature as the sensors say, (n) each."""
        reading = self.unit.read()
        return reading.qpos[0], reading.qvel[0], reading.tau[0], reading.temperature[0]


class VirtualDriver:
    """A `Driver` whose robot lives in this process and ages with the controller's clock."""

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
        period: float = STATE_PERIOD,
    ) -> None:
        """
        Args:
            physics: Hidden parameters (virtual.fleet).
            clock: The controller's.
            payload: kg per hand, and side.
            period: Between two states, s.
        """
        robot = robot.nominal or robot  # the hidden physics replaces what was identified
        self.kp, self.kd = robot.kp, robot.kd
        self.facts: dict[str, Any] = {}
        self.address = f"virtual {robot.name} {name} in process {os.getpid()}"
        self.joint_names = robot.joint_names
        self.clock, self.period, self._given = clock, period, (robot, physics, payload, seed, period)
        locked = idle_joints(robot, robot.operated) if len(robot.operated) < len(robot.joint_names) else ()
        self.commanded = tuple(joint for joint in robot.joint_names if joint not in locked)
        self._at = robot.index(self.commanded)

    def connect(self) -> None:
        self.live = LiveUnit(*self._given)
        self._begun = self.clock.now()
        self._state = self._sense()

    def read(self) -> State:
        """Let it live until now."""
        due = int((self.clock.now() - self._begun) / self.period + 1e-6)
        if (due - self.live.steps) * self.period > LAG:
            raise DriverError(f"{self.address}: this machine cannot simulate it in real time; run without real time")
        if due > self.live.steps:
            while self.live.steps < due:
                self.live.step()
            self._state = self._sense()
        return self._state

    def _sense(self) -> State:
        return State(self._begun + self.live.steps * self.period, *self.live.read())

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Takes effect after the unit's own command delay."""
        self.live.set_gains(self.kp, self.kd)
        self.live.ctrl[self._at] = ctrl[self._at]

    def verify(self) -> None:
        """It does what it is told."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Stiffness zero, damping four times the robot's, on the commanded joints."""
        kp, kd = self.kp.copy(), self.kd.copy()
        kp[self._at], kd[self._at] = 0.0, DAMPING * kd[self._at]
        self.live.set_gains(kp, kd)

    def confirm(self) -> str:
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Nothing is left: the robot ends with the process."""

    def watchdog(self) -> None:
        """It dies with the controller's process."""
        return None
