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
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.installation import install_command
from gaponet.hw.control.driver import DriverError, EndAction, Fault, State
from gaponet.hw.control.hardware import accepted_folder, require_known_limits
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.serial_port import other_programs
from gaponet.hw.drivers.so101_calibration import (
    JOINTS,
    STEP_RAD,
    ServoRow,
    read_calibration,
    resolve_calibration,
    uncalibrated,
)
from gaponet.robot.spec import RobotSpec

try:
    import fcntl
    import termios
except ImportError:  # Windows, where only one program can open a port
    PORT_ERRORS: tuple[type[Exception], ...] = (OSError,)
    EXCLUSIVE = 0
    SHARED = 0
else:
    # Pyserial's own errors are OSErrors; a removed port also raises the other.
    PORT_ERRORS = (
        OSError,
        termios.error,
    )
    EXCLUSIVE = termios.TIOCEXCL
    SHARED = termios.TIOCNXCL

if TYPE_CHECKING:
    from serial import Serial

STALL_CURRENT_STEPS = 2.7 / 0.0065  # 2.7 A at 12 V (Feetech's data sheet of the STS3215)
BAUD = 1_000_000
STIFFNESS_PER_P = 17.8 / 32  # N·m/rad; robot.toml of the so101 has the source
PORT_TIMEOUT_S = 0.002
WRITE_TIMEOUT_S = 1.0
CONNECT_SILENCE_S = 0.1  # after which missing replies are given up while connecting
CONNECT_TIMEOUT_S = 1.0  # for a first whole state
FULL_TORQUE = 1000  # of TORQUE_LIMIT, 0.1 %
SETTINGS_INTERVAL_S = 1.0  # in which the settings of all servos are read again, one after the other
MAX_MISMATCHES = 3  # readings in a row that differ from what was sent: packets get lost
# sent last; a servo that misses packets holds one of them, or that before the run
REMEMBERED_GOALS = 64
FOREIGN_WINDOW_S = 1.0  # in which signs of another program are counted
MAX_FOREIGN_SIGNS = 2  # one may be noise on the cable
RELATIVE_KP_TOLERANCE = 0.01
GAINS = {
    "p": reg.P,
    "i": reg.I,
    "d": reg.D,
    "max_torque": reg.MAX_TORQUE,
    "protection_current": reg.PROTECTION_CURRENT,
    "mode": reg.MODE,
}
CALIBRATION = {
    "homing_offset": reg.HOMING_OFFSET,
    "range_min": reg.MIN_POSITION,
    "range_max": reg.MAX_POSITION,
}
LIMITS = {
    "acceleration": reg.ACCELERATION,
    "goal_velocity": reg.GOAL_VELOCITY,
    "torque_limit": reg.TORQUE_LIMIT,
}
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
        self.port = port
        self.calibration = calibration
        self.timeout = timeout
        self.silent = silent
        self.address = port
        self.joint_names = robot.joint_names
        self.commanded = robot.joint_names
        self.file_calibration = read_calibration(calibration, robot) if calibration else None
        self.arm = self.file_calibration or uncalibrated(robot)
        self._nominal = robot.before_identification
        self.kp = self._nominal.servo.kp
        self.kd = self._nominal.servo.kd
        self.qpos_range: Array | None = None
        self.facts: dict[str, Any] = {}
        self._serial: Serial | None = None
        self._bus: reg.ServoBus | None = None  # of the open port
        self._state: State | None = None
        self._torque_limit = torque_limit or [FULL_TORQUE] * len(self.joint_names)
        # in force; None: nothing was commanded, or the arm was let go
        self._goal: dict[int, int] | None = None
        self._lowered_from: list[int] | None = None  # torque limits, 0.1 %; None: not lowered yet
        self._torque_on: set[int] = set()  # servos that have reported it
        self._mismatches: Counter[tuple[str, int]] = Counter()
        self._settings: dict[int, dict[str, int]] = {}  # at the start, by servo
        self._settings_index = 0  # servo whose settings were read last
        self._settings_time = 0.0  # when they were read, s
        self._disobedience: Fault | None = None
        self._goals_before: set[int] = set()  # that the servos held when they were found
        self._goals_sent: deque[set[int]] = deque(maxlen=REMEMBERED_GOALS)
        self._foreign_signs: list[float] = []  # times of signs of another program, s
        self._foreign_packets = 0  # of the bus, when they were looked at last
        self._awaits_watchdog = False  # the port is open for others until the next `read`

    def connect(self) -> None:
        """Open the port, and read model, settings and state of every servo; nothing is written."""
        try:
            bus = self._open()
            if self.silent:
                return
            self._claim_port()
            with self._port_errors():
                bus.timeout = max(self.timeout, CONNECT_SILENCE_S)
                self._identify(bus)
            self._state = None
            bus.timeout = self.timeout
            deadline = time.monotonic() + CONNECT_TIMEOUT_S
            while self._state is None:
                self._poll(bus)
                if self._state is None and time.monotonic() > deadline:
                    raise DriverError(
                        f"{self.port}: the servos' readings do not arrive whole; check the cable"
                    )
            if self._state.fault:
                raise DriverError(f"{self.port}: {self._state.fault.text}")
        except BaseException:
            self._close_port()
            raise

    def _open(self) -> reg.ServoBus:
        """Return the bus of the port, which is opened if it is closed."""
        if self._serial is not None and self._bus is not None:
            return self._bus
        try:
            import serial
        except ImportError:
            raise DriverError(
                f"pyserial is not installed; run: {install_command('so101')}"
            ) from None
        try:
            self._serial = serial.Serial(
                self.port,
                BAUD,
                timeout=PORT_TIMEOUT_S,
                write_timeout=max(WRITE_TIMEOUT_S, self.timeout),
            )
        except (serial.SerialException, ValueError, OSError) as error:
            hint = (
                "is the arm plugged in, may you use the port, does another program command the arm?"
            )
            raise DriverError(f"{self.port}: {error}; {hint}") from None
        self._bus = reg.ServoBus(self._serial, self.timeout)
        return self._bus

    def _set_sharing(self, mode: int) -> None:
        """Let other programs open the port (SHARED), or not (EXCLUSIVE).

        Who has it open, as our watchdog, keeps it.
        """
        # A port without a descriptor, or removed.
        with contextlib.suppress(*PORT_ERRORS, AttributeError, ValueError):
            if mode:
                fcntl.ioctl(self._serial.fileno(), mode)  # type: ignore[union-attr]

    def _claim_port(self) -> None:
        """Keep other programs from opening the port, and refuse if one has it open already.

        Raises:
            DriverError: With the programs.
        """
        self._set_sharing(EXCLUSIVE)
        self._awaits_watchdog = False
        others = other_programs(self.port)
        if others:
            raise DriverError(
                f"{self.port}: {', '.join(others)} has the port open and can command the arm; end "
                "it first"
            )

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
        self._settings = {servo: _settings(settings[servo]) for servo in servos}
        stored = {joint: self._stored_calibration(servo) for joint, servo in numbers.items()}
        self.arm = resolve_calibration(self.file_calibration, stored, self.robot, self.port)
        self.qpos_range = self.arm.qpos_range
        servo_facts = {}
        for name in GAINS:
            servo_facts[name] = [self._settings[servo][name] for servo in servos]
        for name, register in (LIMITS | {"voltage": reg.PRESENT_VOLTAGE}).items():
            servo_facts[name] = [register.value_in(reg.RUNNING, running[servo]) for servo in servos]
        self.kp = STIFFNESS_PER_P * np.array(servo_facts["p"], float)
        self._torque_limit = servo_facts["torque_limit"]
        self._goals_before = {
            reg.GOAL_POSITION.value_in(reg.RUNNING, running[servo]) for servo in servos
        }
        self.facts = {
            "source": f"servos {', '.join(map(str, servos))} on {Path(self.port).resolve()}",
            "servos": servo_facts,
            "calibration": {joint: asdict(row) for joint, row in stored.items()},
            "remarks": self._remarks(servo_facts),
        }

    def _require_sts3215(
        self, joint: str, servo: int, settings: dict[int, bytes], running: dict[int, bytes]
    ) -> None:
        """Refuse a servo that did not answer, or is of another model or in another mode."""
        where = f"{self.port}: servo {servo} ({joint})"
        if servo not in settings or servo not in running:
            raise DriverError(f"{where} does not answer; check power and cable")
        model = reg.MODEL.value_in(reg.SETTINGS, settings[servo])
        mode = reg.MODE.value_in(reg.SETTINGS, settings[servo])
        if model != reg.STS3215 or mode != 0:
            raise DriverError(
                f"{where} is model {model} in mode {mode}; the driver needs an STS3215 "
                f"({reg.STS3215}) in position mode (0)"
            )

    def _stored_calibration(self, servo: int) -> ServoRow:
        """Return the calibration that a servo stores."""
        stored = {name: self._settings[servo][name] for name in CALIBRATION}
        return ServoRow(id=servo, drive_mode=0, **stored)

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
        if self._awaits_watchdog:
            self._claim_port()
        with self._port_errors():
            self._poll(self._require_bus())
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
        if self._disobedience is None:
            self._disobedience = (
                self._check_source(bus, blocks, now)
                or self._check_running(blocks)
                or self._check_next_settings(bus, now)
            )
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

    def _check_source(
        self, bus: reg.ServoBus, blocks: dict[int, bytes], now: float
    ) -> Fault | None:
        """Return a fault if another program commands the servos, or speaks on the bus.

        Its goals are seen if they are in force when the servos are read: they were never sent here.
        Its requests, and the replies to them, are seen if they reach this port.
        """
        signs = bus.foreign - self._foreign_packets
        self._foreign_packets = bus.foreign
        what = "packets came that nobody here has asked for"
        for servo, block in blocks.items():
            goal = reg.GOAL_POSITION.value_in(reg.RUNNING, block)
            is_on = reg.TORQUE_ENABLE.value_in(reg.RUNNING, block)
            if self._goal is not None and is_on and not self._was_sent(goal):
                signs += 1
                what = f"servo {servo} holds the goal {goal}, which was never sent here"
        recent = [time_s for time_s in self._foreign_signs if now - time_s <= FOREIGN_WINDOW_S]
        self._foreign_signs = recent + [now] * signs
        if not signs or len(self._foreign_signs) < MAX_FOREIGN_SIGNS:
            return None
        return Fault("source", f"another program is on {self.port}: {what}; end it")

    def _was_sent(self, goal: int) -> bool:
        """Return True if a goal was in a servo before the run, or was sent to any servo lately."""
        return goal in self._goals_before or any(goal in goals for goals in self._goals_sent)

    def _check_running(self, blocks: dict[int, bytes]) -> Fault | None:
        """Return a fault if a servo's torque is off, or its goal or limits are not those that were
        sent or found.
        """
        wrong: list[tuple[int, str]] = []
        for i, (servo, block) in enumerate(blocks.items()):
            if self._goal is not None:
                what = self._check_goal(servo, self._goal[servo], block)
                if what:
                    wrong.append((servo, what))
            for name, register in LIMITS.items():
                if name == "torque_limit" and self._goal is None:
                    continue  # it may change until the first goal is sent
                before = self.facts["servos"][name][i]
                now = register.value_in(reg.RUNNING, block)
                if now != before:
                    what = f"its {name.replace('_', ' ')} went from {before} to {now}"
                    wrong.append((servo, what))
        return self._disobedience_fault(wrong)

    def _check_goal(self, servo: int, sent: int, block: bytes) -> str:
        """Return what is wrong with torque or goal of a servo that was told a goal, or nothing."""
        is_on = reg.TORQUE_ENABLE.value_in(reg.RUNNING, block)
        goal = reg.GOAL_POSITION.value_in(reg.RUNNING, block)
        if is_on:
            self._torque_on.add(servo)
        if not is_on and (servo in self._torque_on or self._mismatch("torque", servo)):
            return "its torque is off, though it was switched on: it has reset itself"
        if goal == sent:
            self._mismatches["goal", servo] = 0
        elif self._mismatch("goal", servo):
            return f"it holds the goal {goal}, not {sent} as it was told"
        return ""

    def _mismatch(self, what: str, servo: int) -> bool:
        """Count a reading that differs from what was sent.

        Return True after more than lost packets can explain.
        """
        self._mismatches[what, servo] += 1
        return self._mismatches[what, servo] >= MAX_MISMATCHES

    def _check_next_settings(self, bus: reg.ServoBus, now: float) -> Fault | None:
        """Read the settings of the next servo again, if it is time for one."""
        servos = self.arm.servos
        if now - self._settings_time < SETTINGS_INTERVAL_S / len(servos):
            return None
        self._settings_index = (self._settings_index + 1) % len(servos)
        self._settings_time = now
        return self._check_settings(bus, [servos[self._settings_index]], retries=0)

    def _check_settings(
        self, bus: reg.ServoBus, servos: list[int], retries: int = reg.RETRIES
    ) -> Fault | None:
        """Return a fault if gains, ranges or zeros have changed.

        A servo that does not answer has changed none.
        """
        wrong = []
        for servo, data in bus.sync_read(servos, reg.SETTINGS, retries).items():
            for name, value in _settings(data).items():
                before = self._settings[servo][name]
                if value != before:
                    what = f"its {name.replace('_', ' ')} went from {before} to {value}"
                    wrong.append((servo, what))
        return self._disobedience_fault(wrong)

    def _disobedience_fault(self, wrong: list[tuple[int, str]]) -> Fault | None:
        """Return the fault of servos and what is wrong with each, by joint; None if nothing is."""
        names = dict(zip(self.arm.servos, self.joint_names, strict=True))
        reports = "; ".join(f"servo {servo} ({names[servo]}): {what}" for servo, what in wrong)
        return Fault("obedience", f"{reports}; look at supply and cables") if wrong else None

    def verify(self) -> Fault | None:
        """Return a fault if anything has changed since the run began; all servos are read."""
        bus = self._require_bus()
        with self._port_errors():
            self._poll(bus)
            self._disobedience = self._disobedience or self._check_settings(bus, self.arm.servos)
        return self._disobedience

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
        return self._disobedience

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send goal positions of all servos in one packet, within the calibrated range.

        The first command switches the torque on. From then on no other program can open the port.
        """
        bus = self._require_bus()
        if self._goal is None:
            self._set_sharing(EXCLUSIVE)
        goal = dict(zip(self.arm.servos, self.arm.steps(np.asarray(ctrl)).tolist(), strict=True))
        with self._port_errors():
            bus.sync_write(reg.GOAL_POSITION, goal)
            without_torque = [servo for servo in goal if servo not in self._torque_on]
            if without_torque:
                bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(without_torque, 1))
        self._goal = goal
        self._goals_sent.append(set(goal.values()))

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Lower the arm: torque limits decrease with `share`.

        At 0 the torque of all servos on the bus is switched off.

        Everything is sent in every period, so that a lost packet does not matter. Nothing is read,
        except by the watchdog before it lowers: the controller may have died while it lowered.
        """
        self._goal = None
        self._torque_on = set()
        bus = self._open()
        with self._port_errors():
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
        bus = self._open()
        with self._port_errors():
            blocks = bus.sync_read(servos, reg.TORQUE_ENABLE)
            stiff = []
            for servo, joint in zip(servos, self.joint_names, strict=True):
                if servo not in blocks or any(blocks[servo]):
                    stiff.append(f"{servo} ({joint})")
            if stiff:
                raise DriverError(
                    f"{self.port}: no word that the torque is off in servo {', '.join(stiff)}"
                )
            bus.sync_write(reg.TORQUE_LIMIT, dict(zip(servos, self._torque_limit, strict=True)))
        return "let go: all servos say that their torque is off"

    def _require_bus(self) -> reg.ServoBus:
        """Return the bus; after a lost port, one whose port is closed, which then fails again."""
        assert self._bus is not None
        return self._bus

    @contextlib.contextmanager
    def _port_errors(self) -> Iterator[None]:
        """Turn errors of the port into DriverErrors and close it.

        The next `damp` opens it again.
        """
        try:
            yield
        except PORT_ERRORS as error:
            self._close_port()
            raise DriverError(f"{self.port}: {error}; is the cable in?") from None

    def close(self, hold: bool = False) -> None:
        """Switch the torque off, unless it shall hold, and close the port."""
        if self._serial is not None and not hold:
            with contextlib.suppress(DriverError):
                self.damp()
                self.confirm()
        self._close_port()

    def _close_port(self) -> None:
        if self._serial is not None:
            self._set_sharing(SHARED)
            with contextlib.suppress(*PORT_ERRORS):
                self._serial.close()
        self._serial = None

    def watchdog(self) -> dict[str, object] | None:
        """Return the options of a driver that is silent until it damps.

        Let it open the port until the next `read`.
        """
        calibration = str(self.calibration) if self.calibration else None
        self._set_sharing(SHARED)
        self._awaits_watchdog = True
        return {
            "kind": "so101",
            "robot": str(self.robot.folder.resolve()),
            "port": self.port,
            "calibration": calibration,
            "silent": True,
            "torque_limit": self._torque_limit,
            "limits_from": accepted_folder(self.robot),
        }


def _settings(block: bytes) -> dict[str, int]:
    """Return gains and calibration in the registers of a servo."""
    registers = GAINS | CALIBRATION
    return {name: register.value_in(reg.SETTINGS, block) for name, register in registers.items()}
