"""What the servos of an SO-101 say: which they are, how they are set, and the states of the arm."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import DriverError, Fault, State
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.so101_calibration import (
    STEP_RAD,
    ArmCalibration,
    ServoRow,
    resolve_calibration,
    uncalibrated,
)
from gaponet.hw.drivers.so101_obedience import (
    CALIBRATION,
    GAINS,
    LIMITS,
    Goals,
    Obedience,
    OtherPrograms,
    Settings,
    settings_in,
)
from gaponet.robot.spec import RobotSpec

STALL_CURRENT_STEPS = 2.7 / 0.0065  # 2.7 A at 12 V (Feetech's data sheet of the STS3215)
STIFFNESS_PER_P = 17.8 / 32  # N·m/rad; robot.toml of the so101 has the source
FULL_TORQUE = 1000  # of TORQUE_LIMIT, 0.1 %
RELATIVE_KP_TOLERANCE = 0.01
UNUSUAL_SETTINGS = (  # setting, usual value, what another value means
    ("i", 0, "I is not 0: limits and simulator do not contain an integrator"),
    ("torque_limit", FULL_TORQUE, "the torque limit is below 100 %"),
    ("goal_velocity", 0, "the servo limits its speed"),
)
READINGS = {
    "qpos": reg.PRESENT_POSITION,
    "qvel": reg.PRESENT_VELOCITY,
    "load": reg.PRESENT_LOAD,
    "current": reg.PRESENT_CURRENT,
    "temperature": reg.PRESENT_TEMPERATURE,
}


@dataclass(frozen=True)
class FoundServos:
    """The servos as they were found when the driver connected.

    Attributes:
        arm: Their calibration.
        settings: Their gains and calibration.
        registers: GAINS, LIMITS and voltage by name; one value of each servo, in joint order.
        goals: All goal positions that any of them held, steps.
        facts: Driver.facts.
    """

    arm: ArmCalibration
    settings: Settings
    registers: dict[str, list[int]]
    goals: set[int]
    facts: dict[str, Any]

    @property
    def kp(self) -> Array:
        """Stiffness that follows from P, (n) N·m/rad."""
        return _stiffness(self.registers)


def find_servos(
    bus: reg.ServoBus, robot: RobotSpec, port: str, given: ArmCalibration | None
) -> FoundServos:
    """Read and check model and mode of each servo. Then read its gains, limits and calibration.

    Args:
        bus: On which nothing is written.
        robot: The SO-101.
        port: Name.
        given: Calibration of a file, which must equal that in the servos; None without a file.

    Raises:
        DriverError: A servo does not answer or is another one, or its calibration is not the given
            one.
    """
    servos = (given or uncalibrated(robot)).servos  # ids, in the robot's joint order
    servo_of = dict(zip(robot.joint_names, servos, strict=True))
    settings_blocks = bus.sync_read(servos, reg.SETTINGS)
    running_blocks = bus.sync_read(servos, reg.RUNNING)
    for joint, servo in servo_of.items():
        where = f"{port}: servo {servo} ({joint})"
        if servo not in settings_blocks or servo not in running_blocks:
            raise DriverError(f"{where} does not answer; check power and cable")
        _require_sts3215(where, settings_blocks[servo])
    settings = Settings({servo: settings_in(settings_blocks[servo]) for servo in servos})
    running = [running_blocks[servo] for servo in servos]
    registers = _registers(settings, running)
    stored = {}
    for joint, servo in servo_of.items():
        row = {name: settings.stored[servo][name] for name in CALIBRATION}
        # A servo does not store the direction of its joint, only the file does.
        stored[joint] = ServoRow(id=servo, drive_mode=0, **row)
    arm = resolve_calibration(given, stored, robot, port)
    goals = {reg.GOAL_POSITION.value_in(reg.RUNNING, block) for block in running}
    facts = {
        "source": f"servos {', '.join(map(str, servos))} on {Path(port).resolve()}",
        "servos": registers,
        "calibration": {joint: asdict(row) for joint, row in stored.items()},
        "remarks": _remarks(registers, robot),
    }
    return FoundServos(arm, settings, registers, goals, facts)


def _require_sts3215(where: str, settings: bytes) -> None:
    """Refuse a servo that is of another model or in another mode."""
    model = reg.MODEL.value_in(reg.SETTINGS, settings)
    mode = reg.MODE.value_in(reg.SETTINGS, settings)
    if model != reg.STS3215 or mode != 0:
        raise DriverError(
            f"{where} is model {model} in mode {mode}; the driver needs an STS3215 "
            f"({reg.STS3215}) in position mode (0)"
        )


def _registers(settings: Settings, running: list[bytes]) -> dict[str, list[int]]:
    """Return GAINS, LIMITS and voltage by name; one value of each servo."""
    registers = {}
    for name in GAINS:
        registers[name] = [values[name] for values in settings.stored.values()]
    for name, register in (LIMITS | {"voltage": reg.PRESENT_VOLTAGE}).items():
        registers[name] = [register.value_in(reg.RUNNING, block) for block in running]
    return registers


def _stiffness(registers: dict[str, list[int]]) -> Array:
    return STIFFNESS_PER_P * np.array(registers["p"], float)


def _remarks(registers: dict[str, list[int]], robot: RobotSpec) -> list[str]:
    """Return how the servos' settings differ from the robot's, in sentences."""
    notes = []
    kp = _stiffness(registers)
    nominal = robot.before_identification.servo.kp
    odd = np.flatnonzero(np.abs(kp - nominal) > RELATIVE_KP_TOLERANCE * nominal)
    if odd.size:
        joints = ", ".join(robot.joint_names[i] for i in odd)
        if odd.size == len(nominal):
            joints = "all joints"
        first = odd[0]
        notes.append(
            f"P of {joints} is {registers['p'][first]}, about {kp[first]:.3g} N·m/rad, "
            f"robot.toml says {nominal[first]:.3g}; limits and recordings use what the servos "
            "have"
        )
    for name, usual, what in UNUSUAL_SETTINGS:
        values = zip(robot.joint_names, registers[name], strict=True)
        joints = ", ".join(joint for joint, value in values if value != usual)
        if joints:
            notes.append(f"{joints}: {what}")
    return notes


class ServoStates:
    """Reads the states of an arm, and looks whether its servos obey.

    Attributes:
        found: The servos.
        newest: The newest state; None before the first whole one.
        obedience: What the servos were told, and whether they do it.
    """

    def __init__(self, found: FoundServos, robot: RobotSpec, port: str) -> None:
        """port: Name."""
        self.found = found
        self.newest: State | None = None
        self._names = dict(zip(found.arm.servos, robot.joint_names, strict=True))
        self._effort_limit = robot.before_identification.servo.effort_limit
        self.obedience = Obedience(
            self._names, found.settings, found.registers, Goals(found.goals), OtherPrograms(port)
        )

    def poll(self, bus: reg.ServoBus) -> None:
        """Read all servos; if one does not answer, the newest state stays, with what was
        refused.
        """
        now = time.monotonic()
        arm = self.found.arm
        servos = arm.servos
        old = self.newest
        blocks = bus.sync_read(servos, reg.RUNNING)
        if len(blocks) < len(servos):
            if old is not None:
                self.newest = replace(old, refused=bus.refused, fault=self._fault(bus))
            return
        raw = {}  # registers of all servos, (n,) each
        for name, register in READINGS.items():
            values = [register.value_in(reg.RUNNING, blocks[servo]) for servo in servos]
            raw[name] = np.array(values, float)
        self.obedience.check(bus, blocks, now)
        sign = arm.sign
        share = np.abs(raw["current"]) / STALL_CURRENT_STEPS * np.sign(raw["load"])
        self.newest = State(
            time=now,
            qpos=arm.qpos(raw["qpos"]),
            qvel=raw["qvel"] * STEP_RAD * sign,
            tau=share * self._effort_limit * sign,
            temperature=raw["temperature"],
            refused=bus.refused,
            fault=self._fault(bus),
        )

    def _fault(self, bus: reg.ServoBus) -> Fault | None:
        """Return the errors that the servos have reported in any reply, else their disobedience."""
        reports = []
        for servo, joint in self._names.items():
            errors = bus.errors.get(servo, 0) & reg.FAULTY
            if errors:
                words = [w for bit, w in enumerate(reg.ERRORS) if w and errors >> bit & 1]
                reports.append(f"servo {servo} ({joint}): {', '.join(words)}")
        if reports:
            return Fault("robot", f"{'; '.join(reports)}; look at load, supply and cables")
        return self.obedience.fault
