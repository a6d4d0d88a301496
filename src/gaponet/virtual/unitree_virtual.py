"""A VIRTUAL H1-2 behind the real DDS topics: hidden physics in real time, LowState out, arm_sdk
and lowcmd in.

It holds its home posture until the first command, hands its arms over by the weight of rt/arm_sdk,
uses the gains in the commands, and ignores messages with a wrong checksum. When commands stop it
keeps the last one, which is the worst case. It can also simulate faults, to test the reaction of a
controller.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.clock import MonotonicClock, no_garbage_collection
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree_commands import WEIGHT_MOTOR
from gaponet.hw.drivers.unitree_states import MOTOR_NAMES, VIRTUAL_MARK
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_driver import LiveUnit

if TYPE_CHECKING:
    from gaponet.hw.drivers.dds import Writer

FaultKind = Literal[
    "none",
    "stop",
    "freeze",
    "repeat",
    "nan",
    "jump",
    "hot",
    "late",
    "checksum",
    "clock",
    "encoder",
    "motor",
    "remote",
    "fall",
    "machine",
]

Readings = tuple[Array, Array, Array, Array]  # qpos, qvel, tau, temperature, (n) each

MACHINE = 6  # mode_machine of an H1-2, by reports; no document of Unitree states it
LATE_S = 0.3  # delay of messages in the fault "late"
CLOCK_STEP_S = 10.0  # by which the robot's clock is ahead in the fault "clock"
L2_AND_B = (0x20, 0x02)  # keys of the remote, bytes 2 and 3 of wireless_remote
FIRST_ARM_MOTOR = 12  # rt/arm_sdk commands this motor and all after it


class MotorCommands(NamedTuple):
    """Command of a LowCmd message, by motor, (27,) each: rad, N·m/rad, N·m·s/rad, rad/s, N·m."""

    q: Array
    kp: Array
    kd: Array
    dq: Array
    tau: Array
    mode: Array

    @classmethod
    def of_message(cls, data: Array) -> MotorCommands:
        """Read a message."""
        motors = len(MOTOR_NAMES)
        fields = [hg.LowCmd.motors(data, name).astype(float)[:motors] for name in cls._fields]
        return cls(*fields)

    def is_finite(self) -> bool:
        """Return True if all numbers are finite."""
        return all(np.isfinite(values).all() for values in self)


class InjectedFault(NamedTuple):
    """A fault to simulate, and its time after the first command, s."""

    kind: FaultKind
    at: float


class StateSender:
    """Sends the states of a robot as LowState messages, right or with a fault."""

    def __init__(self, writer: Writer, robot: RobotSpec) -> None:
        self._writer = writer
        self._order = robot.index(MOTOR_NAMES)  # motor → place in the robot's order
        self._message = hg.LowState.new()
        hg.LowState.view(self._message, "reserve")[0] = VIRTUAL_MARK
        self._delayed: deque[tuple[float, Array]] = deque()
        self._last: Readings | None = None  # that were sent last

    def send(self, readings: Readings, robot_time: float, now: float, fault: FaultKind) -> None:
        """Send a state.

        Args:
            readings: Of its sensors.
            robot_time: Of the robot's clock, s.
            now: s.
            fault: What is wrong.
        """
        if fault == "stop":
            return
        message = hg.LowState
        data = self._message
        self._last = self._spoiled(readings, fault)
        self._set_readings(self._last)
        if fault != "repeat":
            ahead = CLOCK_STEP_S if fault == "clock" else 0.0
            message.view(data, "tick")[0] = round(1000 * (robot_time + ahead)) % 2**32
        self._set_status(fault)
        message.seal(data)
        if fault == "checksum":
            message.view(data, "crc")[0] ^= 1
        self._delayed.append((now + (LATE_S if fault == "late" else 0.0), data.copy()))
        while self._delayed and self._delayed[0][0] <= now:
            self._writer.send(self._delayed.popleft()[1])

    def _spoiled(self, readings: Readings, fault: FaultKind) -> Readings:
        """Return readings with a fault."""
        if fault in ("freeze", "repeat") and self._last is not None:
            return self._last
        qpos, qvel, tau, temperature = [values.copy() for values in readings]
        joint = self._order[MOTOR_NAMES.index("left_elbow_joint")]
        if fault == "encoder" and self._last is not None:
            qpos[joint] = self._last[0][joint]
        if fault == "nan":
            qpos[joint] = np.nan
        if fault == "jump":
            qpos[joint] += 1.5
        if fault == "hot":
            temperature[joint] = 120.0
        return qpos, qvel, tau, temperature

    def _set_readings(self, readings: Readings) -> None:
        """Set the motors' readings in the message."""
        motors = len(MOTOR_NAMES)
        qpos, qvel, tau, temperature = readings
        for name, values in (("q", qpos), ("dq", qvel), ("tau_est", tau)):
            column = np.zeros(hg.MOTORS)
            column[:motors] = values[self._order]
            hg.LowState.set_motors(self._message, name, column)
        case_and_winding = np.zeros((hg.MOTORS, 2))
        case_and_winding[:motors] = temperature[self._order, None]
        hg.LowState.set_motors(self._message, "temperature", case_and_winding)

    def _set_status(self, fault: FaultKind) -> None:
        """Set the status fields of the message, with a fault."""
        message = hg.LowState
        data = self._message
        half = 0.5 if fault == "fall" else 0.0  # half of the angle by which it leans forward
        message.view(data, "imu_state.quaternion")[:] = (np.cos(half), 0.0, np.sin(half), 0.0)
        message.view(data, "wireless_remote")[2:4] = L2_AND_B if fault == "remote" else 0
        message.view(data, "mode_machine")[0] = 5 if fault == "machine" else MACHINE
        errors = np.zeros(hg.MOTORS)
        if fault == "motor":
            errors[MOTOR_NAMES.index("left_elbow_joint")] = 4
        message.set_motors(data, "motorstate", errors)


class VirtualH12:
    """The robot on the bus.

    Attributes:
        robot: Its model.
        rate: States per second.
        live: Its simulation.
        clock: By which it lives.
        first_command: When it came, s; None before it.
        refused: Damaged or senseless commands.
        missed: Periods in which nothing was simulated.
        heard: Received commands: time (s), topic, weight, and targets, gains, modes and joint
            states then, (n) in motor order.
    """

    def __init__(
        self,
        robot: RobotSpec,
        physics: Physics,
        payload: tuple[float, str] = (0.0, "both"),
        domain: int = 0,
        interface: str = "lo",
        rate: float = 500.0,
    ) -> None:
        """
        Args:
            payload: kg per hand, and side.
            rate: States per second.
        """
        from gaponet.hw.drivers import dds

        robot = robot.before_identification
        bus = dds.Bus(domain, interface)
        self.robot = robot
        self.rate = rate
        self._injected = InjectedFault("none", 0.0)
        self._order = robot.index(MOTOR_NAMES)  # motor → place in the robot's order
        self._states = StateSender(bus.writer("rt/lowstate", dds.LowState), robot)
        self._readers = {
            "arm_sdk": bus.reader("rt/arm_sdk", dds.LowCmd),
            "lowcmd": bus.reader("rt/lowcmd", dds.LowCmd),
        }
        self.live = LiveUnit(robot, physics, payload, period=1.0 / rate)
        self.clock = MonotonicClock()
        self.heard = list[dict[str, Any]]()
        self.first_command: float | None = None
        self.refused = 0
        self.missed = 0

    def inject(self, kind: FaultKind, at: float) -> None:
        """Simulate a fault from `at` s after the first command on."""
        self._injected = InjectedFault(kind, at)

    @no_garbage_collection()
    def run(self, seconds: float = np.inf) -> None:
        """Simulate in real time, until interrupted."""
        start = self.clock.now()
        k = 0
        while (passed := k / self.rate) < seconds:
            now = self.clock.wait_until(start + passed)
            self._receive(now)
            self.live.step()
            self._send_state(k, now)
            behind = int((self.clock.now() - start) * self.rate) - k
            self.missed += max(behind - 1, 0)
            k += max(1, behind)

    def _receive(self, now: float) -> None:
        for topic, reader in self._readers.items():
            for data in reader.receive():
                if len(data) != hg.LowCmd.wire_size or not hg.LowCmd.intact(data):
                    self.refused += 1
                    continue
                self.first_command = self.first_command or now
                self.apply_command(topic, data, now)

    def apply_command(self, topic: str, data: Array, now: float) -> None:
        """Note a command, and set the drives between it and the robot's own by the weight.

        Args:
            topic: "arm_sdk" or "lowcmd".
            data: An intact LowCmd message; one with a number that is not finite is refused.
            now: s.
        """
        command = MotorCommands.of_message(data)
        if not command.is_finite():
            self.refused += 1
            return
        own_weight = hg.LowCmd.motors(data, "q").astype(float)[WEIGHT_MOTOR]
        weight = 1.0 if topic == "lowcmd" else float(np.clip(own_weight, 0.0, 1.0))
        self._note(command, topic, weight, now)

        share = np.zeros(len(MOTOR_NAMES))
        share[0 if topic == "lowcmd" else FIRST_ARM_MOTOR :] = weight
        enabled = (command.mode == 1) | (topic == "arm_sdk")
        kp = np.where(enabled, command.kp, 0.0)
        kd = np.where(enabled, command.kd, 0.0)
        torque = np.where(enabled, command.tau + command.kd * command.dq, 0.0)
        robot = self.robot
        self.live.ctrl[self._order] = self._blend(robot.qpos_home, command.q, share)
        blended_kp = robot.servo.kp.copy()
        blended_kd = robot.servo.kd.copy()
        blended_torque = np.zeros_like(robot.servo.kp)
        blended_kp[self._order] = self._blend(robot.servo.kp, kp, share)
        blended_kd[self._order] = self._blend(robot.servo.kd, kd, share)
        blended_torque[self._order] = self._blend(np.zeros_like(robot.servo.kp), torque, share)
        self.live.set_gains(blended_kp, blended_kd, torque=blended_torque)

    def _blend(self, own: Array, commanded: Array, share: Array) -> Array:
        """Return the robot's own values, in its order, and commanded ones, by motor, as shared."""
        result: Array = (1 - share) * own[self._order] + share * commanded
        return result

    def _note(self, command: MotorCommands, topic: str, weight: float, now: float) -> None:
        """Append a command to `heard`, with the state of the joints."""
        qpos, qvel, *_ = self.live.read()
        self.heard.append(
            {
                "time": now,
                "topic": topic,
                "ctrl": command.q,
                "kp": command.kp,
                "kd": command.kd,
                "mode": command.mode,
                "weight": weight,
                "qpos": qpos[self._order],
                "qvel": qvel[self._order],
            }
        )

    def _send_state(self, k: int, now: float) -> None:
        """Send the state of the k-th period, with the fault if it is time for it."""
        injected = self._injected
        is_wrong = self.first_command is not None and now - self.first_command >= injected.at
        fault = injected.kind if is_wrong else "none"
        self._states.send(self._readings(), k / self.rate, now, fault)

    def _readings(self) -> Readings:
        """Return what its sensors read."""
        return self.live.read()
