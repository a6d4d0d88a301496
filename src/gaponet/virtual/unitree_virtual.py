"""A VIRTUAL H1-2 behind the real DDS topics: hidden physics in real time, LowState out, arm_sdk
and lowcmd in.

It holds its home posture until the first command, hands its arms over by the weight of rt/arm_sdk,
uses the gains in the commands, and ignores messages with a wrong checksum. When commands stop it
keeps the last one, which is the worst case. It can also simulate faults, to test the reaction of a
controller.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.clock import MonotonicClock, no_garbage_collection
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree import MOTOR_NAMES, VIRTUAL_MARK, WEIGHT_MOTOR
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_driver import LiveUnit

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

LATE_S = 0.3  # delay of messages in the fault "late"
CLOCK_STEP_S = 10.0  # by which the robot's clock is ahead in the fault "clock"
FIRST_ARM_MOTOR = 12  # rt/arm_sdk commands this motor and all after it


class VirtualH12:
    """The robot on the bus.

    Attributes:
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
        fault: FaultKind = "none",
        fault_at: float = 0.0,
        seed: int = 0,
    ) -> None:
        """
        Args:
            payload: kg per hand, and side.
            rate: States per second.
            fault_at: s after the first command.
        """
        from gaponet.hw.drivers import dds

        robot = robot.nominal or robot
        bus = dds.Bus(domain, interface)
        self.robot = robot
        self.rate = rate
        self.fault = fault
        self.fault_at = fault_at
        self._order = robot.index(MOTOR_NAMES)  # motor → place in the robot's order
        self._writer = bus.writer("rt/lowstate", dds.LowState)
        self._readers = {
            name: bus.reader(f"rt/{name}", dds.LowCmd) for name in ("arm_sdk", "lowcmd")
        }
        self.live = LiveUnit(robot, physics, payload, seed=seed, period=1.0 / rate)
        self.clock = MonotonicClock()
        self.heard = list[dict[str, Any]]()
        self.first_command: float | None = None
        self.refused = self.missed = 0
        self._message = hg.LowState.new()
        hg.LowState.view(self._message, "reserve")[0] = VIRTUAL_MARK
        self.machine = 6  # mode_machine of an H1-2, by reports; no document of Unitree states it
        self._delayed: deque[tuple[float, Array]] = deque()
        self._frozen: tuple[Array, ...] | None = None

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
                self._apply(topic, data, now)

    def _apply(self, topic: str, data: Array, now: float) -> None:
        names = ("q", "kp", "kd", "mode", "dq", "tau")
        q, kp, kd, mode, dq, tau = (hg.LowCmd.motors(data, name).astype(float) for name in names)
        if not all(np.isfinite(values).all() for values in (q, kp, kd, dq, tau)):
            self.refused += 1
            return
        weight = 1.0 if topic == "lowcmd" else float(np.clip(q[WEIGHT_MOTOR], 0.0, 1.0))
        robot = self.robot
        motors = len(MOTOR_NAMES)
        qpos, qvel, *_ = self.live.read()
        self.heard.append(
            {
                "time": now,
                "topic": topic,
                "ctrl": q[:motors],
                "kp": kp[:motors],
                "kd": kd[:motors],
                "mode": mode[:motors],
                "weight": weight,
                "qpos": qpos[self._order],
                "qvel": qvel[self._order],
            }
        )
        share = np.zeros(motors)
        share[0 if topic == "lowcmd" else FIRST_ARM_MOTOR :] = weight
        enabled = (mode[:motors] == 1) | (topic == "arm_sdk")
        gains = robot.kp.copy()
        dampers = robot.kd.copy()
        torque = np.zeros_like(robot.kp)
        forward = tau[:motors] + kd[:motors] * dq[:motors]
        for out, mine, theirs in (
            (self.live.ctrl, robot.qpos_home, q[:motors]),
            (gains, robot.kp, np.where(enabled, kp[:motors], 0.0)),
            (dampers, robot.kd, np.where(enabled, kd[:motors], 0.0)),
            (torque, np.zeros_like(robot.kp), np.where(enabled, forward, 0.0)),
        ):
            out[self._order] = (1 - share) * mine[self._order] + share * theirs
        self.live.set_gains(gains, dampers, torque=torque)

    def _send_state(self, k: int, now: float) -> None:
        wrong = self.first_command is not None and now - self.first_command >= self.fault_at
        fault = self.fault if wrong else "none"
        if fault == "stop":
            return
        readings = self._readings(fault)
        message = hg.LowState
        data = self._message
        if fault != "repeat":
            ahead = CLOCK_STEP_S if fault == "clock" else 0.0
            message.view(data, "tick")[0] = round(1000 * (k / self.rate + ahead)) % 2**32
        self._set_status(fault)
        for name, values in zip(("q", "dq", "tau_est", "temperature"), readings, strict=True):
            column = np.zeros((hg.MOTORS, 2) if name == "temperature" else hg.MOTORS)
            column[: len(MOTOR_NAMES)] = (
                values[self._order, None] if name == "temperature" else values[self._order]
            )
            message.set_motors(data, name, column)
        message.seal(data)
        if fault == "checksum":
            message.view(data, "crc")[0] ^= 1
        self._delayed.append((now + (LATE_S if fault == "late" else 0.0), data.copy()))
        while self._delayed and self._delayed[0][0] <= now:
            self._writer.send(self._delayed.popleft()[1])

    def _set_status(self, fault: str) -> None:
        """Set the status fields of the message, with a fault."""
        message = hg.LowState
        data = self._message
        half = 0.5 if fault == "fall" else 0.0  # half of the angle by which it leans forward
        message.view(data, "imu_state.quaternion")[:] = (np.cos(half), 0.0, np.sin(half), 0.0)
        # L2 + B
        message.view(data, "wireless_remote")[2:4] = (0x20, 0x02) if fault == "remote" else 0
        message.view(data, "mode_machine")[0] = 5 if fault == "machine" else self.machine
        errors = np.zeros(hg.MOTORS)
        errors[MOTOR_NAMES.index("left_elbow_joint")] = 4 * (fault == "motor")
        message.set_motors(data, "motorstate", errors)

    def _readings(self, fault: str) -> tuple[Array, ...]:
        """Return qpos, qvel, tau, temperature, (n) each, with a fault."""
        if fault in ("freeze", "repeat") and self._frozen is not None:
            return self._frozen
        qpos, qvel, tau, temperature = (values.copy() for values in self.live.read())
        joint = self.robot.index(["left_elbow_joint"])[0]
        if fault == "encoder" and self._frozen is not None:
            qpos[joint] = self._frozen[0][joint]
        if fault == "nan":
            qpos[joint] = np.nan
        if fault == "jump":
            qpos[joint] += 1.5
        if fault == "hot":
            temperature[joint] = 120.0
        self._frozen = qpos, qvel, tau, temperature
        return self._frozen
