"""SO101Driver: an SO-101 arm, six Feetech STS3215 servos on a serial bus.

Units: 4096 encoder steps a turn; velocity in steps/s; current in 6.5 mA. tau is current times a
constant, with the sign of the load. The constant makes the stall current the effort limit; it was
not calibrated. so101_calibration.py defines 0 rad of each joint.

The servos cannot damp: `damp` lowers the arm by their torque limits, then switches their torque
off. They keep their last target when commands cease, so a run without fault ends held. Torque, goal
and limits are read back with every state, gains and zeros of one servo at a time. Not checked on a
real arm: everything was tested against buses that answer as Feetech's documents say, correctly and
with errors.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, EndAction, Fault, State
from gaponet.hw.control.hardware import accepted_folder, require_known_limits
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.so101_calibration import (
    JOINTS,
    STEP_RAD,
    ServoRow,
    read_calibration,
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
from gaponet.hw.drivers.so101_port import SO101Port
from gaponet.robot.spec import RobotSpec

STALL_CURRENT_STEPS = 2.7 / 0.0065  # 2.7 A at 12 V (Feetech's data sheet of the STS3215)
STIFFNESS_PER_P = 17.8 / 32  # N·m/rad; robot.toml of the so101 has the source
CONNECT_SILENCE_S = 0.1  # after which missing replies are given up while connecting
CONNECT_TIMEOUT_S = 1.0  # for a first whole state
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


class SO101Driver:
    """A `Driver` for six servos, the gripper included, which a motion leaves at home."""

    virtual = False
    noisy = False  # a resting encoder reads the same for ever
    reads_back = True
    at_end: EndAction = "hold"
    at_stop = "lowers"

    def __init__(
        self,
        robot: RobotSpec,
        port: str = "/dev/ttyACM0",
        calibration: str | Path | None = None,
        timeout: float = 0.01,
        silent: bool = False,
        torque_limit: list[int] | None = None,
    ) -> None:
        """
        Args:
            robot: The SO-101.
            port: Serial port.
            calibration: JSON file that lerobot-calibrate wrote; default the calibration in the
                servos.
            timeout: Longest silence of the bus while replies are awaited, s.
            silent: `connect` opens the port and sends nothing: for the watchdog, because one
                program may speak.
            torque_limit: Limit of each servo for a driver that is silent, 0.1 %; default full.

        Raises:
            UsageError: The robot is no SO-101, or the file is no calibration.
            RobotError: Gains or ranges exceed those of the known robot, or effort limits those of
                the motors.
        """
        if set(robot.joint_names) != set(JOINTS):
            raise UsageError(
                f"the so101 driver is for the joints {', '.join(JOINTS)}; {robot.name} has others"
            )
        require_known_limits(robot, "so101")
        self.robot = robot
        self.address = port
        self.calibration = calibration
        self.silent = silent
        self.joint_names = robot.joint_names
        self.commanded = robot.joint_names
        self.file_calibration = read_calibration(calibration, robot) if calibration else None
        self.arm = self.file_calibration or uncalibrated(robot)
        self._nominal = robot.before_identification
        self.kp = self._nominal.servo.kp
        self.kd = self._nominal.servo.kd
        self.qpos_range: Array | None = None
        self.facts: dict[str, Any] = {}
        self._port = SO101Port(port, timeout)
        self._obedience = _obedience(port, {}, Settings({}), {}, set())  # nothing is known yet
        self._state: State | None = None
        self._torque_limit = torque_limit or [FULL_TORQUE] * len(self.joint_names)
        self._lowered_from: list[int] | None = None  # torque limits, 0.1 %; None: not lowered yet

    def connect(self) -> None:
        """Open the port, and read model, settings and state of every servo; nothing is written."""
        try:
            bus = self._port.open()
            if self.silent:
                return
            self._port.claim()
            with self._port.errors():
                bus.timeout = max(self._port.timeout, CONNECT_SILENCE_S)
                self._identify(bus)
            self._state = None
            bus.timeout = self._port.timeout
            deadline = time.monotonic() + CONNECT_TIMEOUT_S
            while self._state is None:
                self._poll(bus)
                if self._state is None and time.monotonic() > deadline:
                    raise DriverError(
                        f"{self.address}: the servos' readings do not arrive whole; check the cable"
                    )
            if self._state.fault:
                raise DriverError(f"{self.address}: {self._state.fault.text}")
        except BaseException:
            self._port.close()
            raise

    def _identify(self, bus: reg.ServoBus) -> None:
        """Read and check model and mode of each servo.

        Then read its gains, limits and calibration.
        """
        servos = self.arm.servos
        numbers = dict(zip(self.joint_names, servos, strict=True))
        settings = bus.sync_read(servos, reg.SETTINGS)
        running = bus.sync_read(servos, reg.RUNNING)
        for joint, servo in numbers.items():
            self._require_sts3215(joint, servo, settings, running)
        found = Settings({servo: settings_in(settings[servo]) for servo in servos})
        stored = {}
        for joint, servo in numbers.items():
            rows = {name: found.stored[servo][name] for name in CALIBRATION}
            stored[joint] = ServoRow(id=servo, drive_mode=0, **rows)
        self.arm = resolve_calibration(self.file_calibration, stored, self.robot, self.address)
        self.qpos_range = self.arm.qpos_range
        servo_facts = {}
        for name in GAINS:
            servo_facts[name] = [found.stored[servo][name] for servo in servos]
        for name, register in (LIMITS | {"voltage": reg.PRESENT_VOLTAGE}).items():
            servo_facts[name] = [register.value_in(reg.RUNNING, running[servo]) for servo in servos]
        self.kp = STIFFNESS_PER_P * np.array(servo_facts["p"], float)
        self._torque_limit = servo_facts["torque_limit"]
        goals = {reg.GOAL_POSITION.value_in(reg.RUNNING, running[servo]) for servo in servos}
        joints = dict(zip(servos, self.joint_names, strict=True))
        self._obedience = _obedience(self.address, joints, found, servo_facts, goals)
        self.facts = {
            "source": f"servos {', '.join(map(str, servos))} on {Path(self.address).resolve()}",
            "servos": servo_facts,
            "calibration": {joint: asdict(row) for joint, row in stored.items()},
            "remarks": self._remarks(servo_facts),
        }

    def _require_sts3215(
        self, joint: str, servo: int, settings: dict[int, bytes], running: dict[int, bytes]
    ) -> None:
        """Refuse a servo that did not answer, or is of another model or in another mode."""
        where = f"{self.address}: servo {servo} ({joint})"
        if servo not in settings or servo not in running:
            raise DriverError(f"{where} does not answer; check power and cable")
        model = reg.MODEL.value_in(reg.SETTINGS, settings[servo])
        mode = reg.MODE.value_in(reg.SETTINGS, settings[servo])
        if model != reg.STS3215 or mode != 0:
            raise DriverError(
                f"{where} is model {model} in mode {mode}; the driver needs an STS3215 "
                f"({reg.STS3215}) in position mode (0)"
            )

    def _remarks(self, facts: dict[str, list[int]]) -> list[str]:
        """Return how the servos' settings differ from the robot's, in sentences."""
        notes = []
        nominal = self._nominal.servo.kp
        odd = np.flatnonzero(np.abs(self.kp - nominal) > RELATIVE_KP_TOLERANCE * nominal)
        if odd.size:
            joints = ", ".join(self.joint_names[i] for i in odd)
            if odd.size == len(nominal):
                joints = "all joints"
            first = odd[0]
            notes.append(
                f"P of {joints} is {facts['p'][first]}, about {self.kp[first]:.3g} N·m/rad, "
                f"robot.toml says {nominal[first]:.3g}; limits and recordings use what the servos "
                "have"
            )
        for name, usual, what in UNUSUAL_SETTINGS:
            values = zip(self.joint_names, facts[name], strict=True)
            joints = ", ".join(joint for joint, value in values if value != usual)
            if joints:
                notes.append(f"{joints}: {what}")
        return notes

    def read(self) -> State:
        """Return the state of all servos; the last state again if one did not answer.

        The first call after `watchdog` closes the port for other programs again.
        """
        self._port.take_back()
        with self._port.errors():
            self._poll(self._port.bus)
        assert self._state is not None
        return self._state

    def _poll(self, bus: reg.ServoBus) -> None:
        now = time.monotonic()
        servos = self.arm.servos
        old = self._state
        blocks = bus.sync_read(servos, reg.RUNNING)
        if len(blocks) < len(servos):
            if old is not None:
                self._state = replace(old, refused=bus.refused, fault=self._fault(bus))
            return
        raw = {}  # registers of all servos, (n,) each
        for name, register in READINGS.items():
            values = [register.value_in(reg.RUNNING, blocks[servo]) for servo in servos]
            raw[name] = np.array(values, float)
        self._obedience.check(bus, blocks, now)
        sign = self.arm.sign
        share = np.abs(raw["current"]) / STALL_CURRENT_STEPS * np.sign(raw["load"])
        self._state = State(
            time=now,
            qpos=self.arm.qpos(raw["qpos"]),
            qvel=raw["qvel"] * STEP_RAD * sign,
            tau=share * self._nominal.servo.effort_limit * sign,
            temperature=raw["temperature"],
            refused=bus.refused,
            fault=self._fault(bus),
        )

    def verify(self) -> Fault | None:
        """Return a fault if anything has changed since the run began; all servos are read."""
        bus = self._port.bus
        with self._port.errors():
            self._poll(bus)
            self._obedience.check_settings(bus)
        return self._obedience.fault

    def _fault(self, bus: reg.ServoBus) -> Fault | None:
        """Return the errors that the servos have reported in any reply, else their disobedience."""
        reports = []
        for servo, joint in zip(self.arm.servos, self.joint_names, strict=True):
            errors = bus.errors.get(servo, 0) & reg.FAULTY
            if errors:
                words = [w for bit, w in enumerate(reg.ERRORS) if w and errors >> bit & 1]
                reports.append(f"servo {servo} ({joint}): {', '.join(words)}")
        if reports:
            return Fault("robot", f"{'; '.join(reports)}; look at load, supply and cables")
        return self._obedience.fault

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send goal positions of all servos in one packet, within the calibrated range.

        The first command switches the torque on. From then on no other program can open the port.
        """
        bus = self._port.bus
        goals = self._obedience.goals
        if goals.in_force is None:
            self._port.keep_others_out()
        asked = dict(zip(self.arm.servos, self.arm.steps(np.asarray(ctrl)).tolist(), strict=True))
        with self._port.errors():
            bus.sync_write(reg.GOAL_POSITION, asked)
            without_torque = [servo for servo in asked if servo not in goals.torque_on]
            if without_torque:
                bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(without_torque, 1))
        goals.send(asked)

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Lower the arm: torque limits decrease with `share`.

        At 0 the torque of all servos on the bus is switched off.

        Everything is sent in every period, so that a lost packet does not matter. Nothing is read,
        except by the watchdog before it lowers: the controller may have died while it lowered.
        """
        self._obedience.goals.let_go()
        bus = self._port.open()
        with self._port.errors():
            if share > 0:
                if self._lowered_from is None:
                    self._lowered_from = self._limits_in_force(bus)
                limits = [round(share * limit) for limit in self._lowered_from]
                bus.sync_write(reg.TORQUE_LIMIT, dict(zip(self.arm.servos, limits, strict=True)))
            else:
                bus.broadcast(reg.TORQUE_ENABLE, 0)
                bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(self.arm.servos, 0))

    def _limits_in_force(self, bus: reg.ServoBus) -> list[int]:
        """Return the torque limits from which the arm is lowered, 0.1 %.

        They are never raised: an arm that has sunk would spring back to its last goal. A silent
        driver asks the servos for theirs; one that does not answer counts as not lowered yet.
        """
        if not self.silent:
            return self._torque_limit
        blocks = bus.sync_read(self.arm.servos, reg.TORQUE_LIMIT)
        limits = []
        for servo, limit in zip(self.arm.servos, self._torque_limit, strict=True):
            in_force = reg.TORQUE_LIMIT.decode(blocks[servo]) if servo in blocks else limit
            limits.append(min(in_force, limit))
        return limits

    def confirm(self) -> str:
        """Check that the torque of all servos is off; only then set their torque limits back."""
        servos = self.arm.servos
        bus = self._port.open()
        with self._port.errors():
            blocks = bus.sync_read(servos, reg.TORQUE_ENABLE)
            stiff = []
            for servo, joint in zip(servos, self.joint_names, strict=True):
                if servo not in blocks or any(blocks[servo]):
                    stiff.append(f"{servo} ({joint})")
            if stiff:
                raise DriverError(
                    f"{self.address}: no word that the torque is off in servo {', '.join(stiff)}"
                )
            bus.sync_write(reg.TORQUE_LIMIT, dict(zip(servos, self._torque_limit, strict=True)))
        return "let go: all servos say that their torque is off"

    def close(self, hold: bool = False) -> None:
        """Switch the torque off, unless it shall hold, and close the port."""
        if self._port.is_open and not hold:
            with contextlib.suppress(DriverError):
                self.damp()
                self.confirm()
        self._port.close()

    def watchdog(self) -> dict[str, object] | None:
        """Return the options of a driver that is silent until it damps.

        Let it open the port until the next `read`.
        """
        calibration = str(self.calibration) if self.calibration else None
        self._port.lend()
        return {
            "kind": "so101",
            "robot": str(self.robot.folder.resolve()),
            "port": self.address,
            "calibration": calibration,
            "silent": True,
            "torque_limit": self._torque_limit,
            "limits_from": accepted_folder(self.robot),
        }


def _obedience(
    port: str,
    joints: dict[int, str],
    settings: Settings,
    limits: dict[str, list[int]],
    goals: set[int],
) -> Obedience:
    """Return the check of servos that were found so.

    Args:
        port: Name.
        joints: Servo → joint.
        settings: Of the servos.
        limits: Their LIMITS, by name.
        goals: That they held, steps.
    """
    return Obedience(joints, settings, limits, Goals(goals), OtherPrograms(port))
