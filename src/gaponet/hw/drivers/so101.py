"""SO101Driver: an SO-101 arm, six Feetech STS3215 servos on a serial bus.

Units: 4096 encoder steps a turn; velocity in steps/s; current in 6.5 mA. tau is current times a constant, signed by the
load: the constant makes the stall current the effort limit; it was not calibrated. so101_calibration.py says where a
joint's 0 rad is.

The servos cannot damp: `damp` lowers the arm by their torque limits, then switches their torque off. They keep their
last target when commands cease, so a run without fault ends held. What they were told is read back with every state:
torque, goal, limits; gains and zeros a servo at a time. Not checked on a real arm: everything was tested against buses
that answer by Feetech's documents, well and badly.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, End, Fault, State
from gaponet.hw.control.hardware import require_motor_limits
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.so101_calibration import SPEAK, STEP, ServoRow, numbered, read_calibration, settle
from gaponet.robot.spec import RobotSpec

try:
    import fcntl
    import termios
except ImportError:  # Windows, where a port is opened by one program anyway
    LOST: tuple[type[Exception], ...] = (OSError,)
    ALONE = SHARED = 0
else:
    LOST = (OSError, termios.error)  # pyserial's own errors are OSErrors; a port that is gone also raises the other
    ALONE, SHARED = termios.TIOCEXCL, termios.TIOCNXCL

if TYPE_CHECKING:
    from serial import Serial

STALL_CURRENT = 2.7 / 0.0065  # steps: 2.7 A at 12 V (Feetech's data sheet of the STS3215)
BAUD = 1_000_000
STIFFNESS = 17.8 / 32  # N·m/rad of an STS3215 for each unit of its P; robot.toml of the so101 says whence
PATIENT = 0.1  # s of silence while connecting, when nothing hurries
FULL = 1000  # of TORQUE_LIMIT, 0.1 %
TURN = 1.0  # s in which the settings of all servos are read again, one after the other
DOUBTS = 3  # readings in a row that a servo may not have heard what was said once: packets get lost
SET = {
    "p": reg.P, "i": reg.I, "d": reg.D, "max_torque": reg.MAX_TORQUE, "protection_current": reg.PROTECTION_CURRENT,
    "mode": reg.MODE,
}  # fmt: skip
HELD = {"homing_offset": reg.HOMING_OFFSET, "range_min": reg.MIN_POSITION, "range_max": reg.MAX_POSITION}
LIMITS = {"acceleration": reg.ACCELERATION, "goal_velocity": reg.GOAL_VELOCITY, "torque_limit": reg.TORQUE_LIMIT}
READINGS = {
    "qpos": reg.PRESENT_POSITION, "qvel": reg.PRESENT_VELOCITY, "load": reg.PRESENT_LOAD,
    "current": reg.PRESENT_CURRENT, "temperature": reg.PRESENT_TEMPERATURE,
}  # fmt: skip


class SO101Driver:
    """A `Driver` for six servos; gripper included, which a motion leaves at home."""

    virtual = False
    noisy = False  # a resting encoder reads the same for ever
    reads_back = True
    at_end: End = "hold"
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
            calibration: JSON file that LeRobot's calibration wrote; default what the servos hold of it.
            timeout: Longest silence of the bus while replies are awaited, s.
            silent: `connect` opens the port and says nothing: for the watchdog, because a bus has one speaker.
            torque_limit: The limit of each servo, for a driver that does not connect, 0.1 %; default full.
        """
        if set(robot.joint_names) != set(SPEAK):
            raise UsageError(f"the so101 driver is for the joints {', '.join(SPEAK)}; {robot.name} has others")
        require_motor_limits(robot, "so101")
        self.robot, self.port, self.calibration = robot, port, calibration
        self.timeout, self.silent = timeout, silent
        self.address = port
        self.joint_names = self.commanded = robot.joint_names
        self.given = read_calibration(calibration, robot) if calibration else None
        self.steps = self.given or numbered(robot)
        self.kp, self.kd = (robot.nominal or robot).kp, (robot.nominal or robot).kd
        self.qpos_range: Array | None = None
        self.facts: dict[str, Any] = {}
        self._serial: Serial | None = None
        self._state: State | None = None
        self._limit = torque_limit or [FULL] * len(self.joint_names)
        self._goal: dict[int, int] | None = None  # that holds; None: no servo was told any, or all were let go
        self._on: set[int] = set()  # servos that have said that their torque is on
        self._doubts: Counter[tuple[str, int]] = Counter()
        self._settings: dict[int, dict[str, int]] = {}
        self._turn, self._asked = 0, 0.0
        self._disobeyed: Fault | None = None

    def connect(self) -> None:
        """Open the port, ask every servo what it is, how it is set and how it is; nothing moves, nothing is written."""
        try:
            self._open()
            if self.silent:
                return
            with self._bus_errors():
                self._bus.timeout = max(self.timeout, PATIENT)
                self._meet()
            self._state, self._bus.timeout = None, self.timeout
            deadline = time.monotonic() + 1.0
            while self._state is None:
                self._poll()
                if self._state is None and time.monotonic() > deadline:
                    raise DriverError(f"{self.port}: the servos' readings do not arrive whole; check the cable")
            if self._state.fault:
                raise DriverError(f"{self.port}: {self._state.fault.text}")
        except BaseException:
            self._shut()
            raise

    def _open(self) -> None:
        try:
            import serial
        except ImportError:
            raise DriverError("pyserial is not installed; run: pip install 'gaponet[so101]'") from None
        try:
            self._serial = serial.Serial(self.port, BAUD, timeout=0.002, write_timeout=max(1.0, self.timeout))
        except (serial.SerialException, ValueError, OSError) as error:
            hint = "is the arm plugged in, may you use the port, does another program command the arm?"
            raise DriverError(f"{self.port}: {error}; {hint}") from None
        self._bus = reg.ServoBus(self._serial, self.timeout)

    def _say_exclusive(self, how: int) -> None:
        """Let no other program open the port (ALONE; whoever has it open, as our watchdog, keeps it), or let them."""
        with contextlib.suppress(*LOST, AttributeError, ValueError):  # a port without a descriptor, or one that is gone
            if how:
                fcntl.ioctl(self._serial.fileno(), how)  # type: ignore[union-attr]

    def _meet(self) -> None:
        """Model and mode of each servo; then its gains, limits and calibration."""
        servos = self.steps.servos
        numbers = dict(zip(self.joint_names, servos, strict=True))
        settings, running = (self._bus.sync_read(servos, block) for block in (reg.SETTINGS, reg.RUNNING))
        for joint, servo in numbers.items():
            if servo not in settings or servo not in running:
                raise DriverError(f"{self.port}: servo {servo} ({joint}) does not answer; check power and cable")
            model, mode = (register.cut(reg.SETTINGS, settings[servo]) for register in (reg.MODEL, reg.MODE))
            if model != reg.STS3215 or mode != 0:
                raise DriverError(
                    f"{self.port}: servo {servo} ({joint}) is model {model} in mode {mode}; the driver needs an "
                    f"STS3215 ({reg.STS3215}) in position mode (0)"
                )
        self._settings = {servo: _settings(settings[servo]) for servo in servos}
        held = {
            joint: ServoRow(id=servo, drive_mode=0, **{name: self._settings[servo][name] for name in HELD})
            for joint, servo in numbers.items()
        }
        self.steps = settle(self.given, held, self.robot, self.port)
        self.qpos_range = self.steps.qpos_range
        servo_facts = {name: [self._settings[servo][name] for servo in servos] for name in SET}
        for name, register in (LIMITS | {"voltage": reg.PRESENT_VOLTAGE}).items():
            servo_facts[name] = [register.cut(reg.RUNNING, running[servo]) for servo in servos]
        self.kp, self._limit = STIFFNESS * np.array(servo_facts["p"], float), servo_facts["torque_limit"]
        self.facts = {
            "servos": servo_facts,
            "calibration": {joint: asdict(row) for joint, row in held.items()},
            "remarks": self._remarks(servo_facts),
        }

    def _remarks(self, facts: dict[str, list[int]]) -> list[str]:
        """How the servos are set otherwise than the robot says, in sentences."""
        notes, said = [], (self.robot.nominal or self.robot).kp
        odd = [(j, p, kp, k) for j, p, kp, k in zip(self.joint_names, facts["p"], self.kp, said, strict=True)
               if abs(kp - k) > 0.01 * k]  # fmt: skip
        if odd:
            joints = "all joints" if len(odd) == len(said) else ", ".join(j for j, *_ in odd)
            _, p, kp, k = odd[0]
            notes.append(
                f"P of {joints} is {p}, about {kp:.3g} N·m/rad, robot.toml says {k:.3g}; "
                "limits and recordings use what the servos have"
            )
        for name, usual, what in (
            ("i", 0, "I is not 0: an integrator of which limits and simulator know nothing"),
            ("torque_limit", FULL, "the torque limit is below 100 %"),
            ("goal_velocity", 0, "the servo limits its speed"),
        ):
            joints = ", ".join(j for j, x in zip(self.joint_names, facts[name], strict=True) if x != usual)
            notes += [f"{joints}: {what}"] if joints else []
        return notes

    def read(self) -> State:
        """Ask all servos; the last state again where one did not answer."""
        with self._bus_errors():
            self._poll()
        assert self._state is not None
        return self._state

    def _poll(self) -> None:
        now = time.monotonic()
        servos, old = self.steps.servos, self._state
        blocks = self._bus.sync_read(servos, reg.RUNNING)
        if len(blocks) < len(servos):
            if old is not None:
                self._state = State(
                    old.time, old.qpos, old.qvel, old.tau, old.temperature, self._bus.refused, fault=self._fault()
                )
            return
        raw = {
            name: np.array([field.cut(reg.RUNNING, blocks[s]) for s in servos], float)
            for name, field in READINGS.items()
        }
        self._disobeyed = self._disobeyed or self._running(blocks) or self._in_turn(now)
        sign = self.steps.sign
        tau = (
            np.abs(raw["current"])
            / STALL_CURRENT
            * (self.robot.nominal or self.robot).effort_limit
            * np.sign(raw["load"])
            * sign
        )
        self._state = State(
            now, self.steps.qpos(raw["qpos"]), raw["qvel"] * STEP * sign, tau, raw["temperature"], self._bus.refused,
            fault=self._fault(),
        )  # fmt: skip

    def _running(self, blocks: dict[int, bytes]) -> Fault | None:
        """Whether each servo has its torque on, holds the goal and has the limits that it was told or found with."""
        wrong: list[tuple[int, str]] = []
        for i, (servo, block) in enumerate(blocks.items()):
            if self._goal is not None:
                on, goal = (register.cut(reg.RUNNING, block) for register in (reg.TORQUE_ENABLE, reg.GOAL_POSITION))
                if on:
                    self._on.add(servo)
                told = self._goal[servo]
                if not on and (servo in self._on or self._doubt("torque", servo)):
                    wrong.append((servo, "its torque is off, though it was switched on: it has reset itself"))
                elif goal == told:
                    self._doubts["goal", servo] = 0
                elif self._doubt("goal", servo):
                    wrong.append((servo, f"it holds the goal {goal}, not {told} as it was told"))
            for name, register in LIMITS.items():
                found, now = self.facts["servos"][name][i], register.cut(reg.RUNNING, block)
                if now != found and not (name == "torque_limit" and self._goal is None):
                    wrong.append((servo, f"its {name.replace('_', ' ')} went from {found} to {now}"))
        return self._blame(wrong)

    def _doubt(self, what: str, servo: int) -> bool:
        """Whether a servo has not done something for so many readings that no lost packet explains it."""
        self._doubts[what, servo] += 1
        return self._doubts[what, servo] >= DOUBTS

    def _in_turn(self, now: float) -> Fault | None:
        """Read the settings of one servo again, where it is time for one."""
        servos = self.steps.servos
        if now - self._asked < TURN / len(servos):
            return None
        self._turn, self._asked = (self._turn + 1) % len(servos), now
        return self._changed([servos[self._turn]], retries=0)

    def _changed(self, servos: list[int], retries: int | None = None) -> Fault | None:
        """Gains, ranges and zeros that are no longer what they were; a servo that does not answer has changed none."""
        found = self._bus.sync_read(servos, reg.SETTINGS, retries)
        return self._blame([
            (servo, f"its {name.replace('_', ' ')} went from {self._settings[servo][name]} to {value}")
            for servo, data in found.items() for name, value in _settings(data).items()
            if value != self._settings[servo][name]
        ])  # fmt: skip

    def _blame(self, wrong: list[tuple[int, str]]) -> Fault | None:
        """The fault of servos that are not what they were or do not what they were told, by joint."""
        names = dict(zip(self.steps.servos, self.joint_names, strict=True))
        said = "; ".join(f"servo {servo} ({names[servo]}): {what}" for servo, what in wrong)
        return Fault("obedience", f"{said}; look at supply and cables") if wrong else None

    def verify(self) -> Fault | None:
        """What is no longer as it was when the run began, asked of all servos at once."""
        with self._bus_errors():
            self._poll()
            self._disobeyed = self._disobeyed or self._changed(self.steps.servos)
        return self._disobeyed

    def _fault(self) -> Fault | None:
        """What the servos have said is wrong with them, in any reply; then what they did not do as told."""
        numbers = dict(zip(self.steps.servos, self.joint_names, strict=True))
        said = [
            f"servo {servo} ({joint}): " + ", ".join(w for bit, w in enumerate(reg.ERRORS) if w and errors >> bit & 1)
            for servo, joint in numbers.items() if (errors := self._bus.errors.get(servo, 0) & reg.FAULTY)
        ]  # fmt: skip
        return Fault("robot", "; ".join(said) + "; look at load, supply and cables") if said else self._disobeyed

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Goal positions of all servos in one packet, within the calibrated range; torque comes on with the first.

        From then on no other program can open the port.
        """
        if self._goal is None:
            self._say_exclusive(ALONE)
        goal = dict(zip(self.steps.servos, self.steps.steps(np.asarray(ctrl)).tolist(), strict=True))
        with self._bus_errors():
            self._bus.sync_write(reg.GOAL_POSITION, goal)
            if not self._on.issuperset(goal):
                off = {servo: 1 for servo in goal if servo not in self._on}
                self._bus.sync_write(reg.TORQUE_ENABLE, off)
        self._goal = goal

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Lower the arm: its torque limits go with `share`; at 0 torque off, to every servo on the bus.

        No servo is asked anything, and all is said every period: a lost packet must not matter.
        """
        self._goal, self._on = None, set()
        if self._serial is None:
            self._open()
        with self._bus_errors():
            if share > 0:
                limits = [round(share * limit) for limit in self._limit]
                self._bus.sync_write(reg.TORQUE_LIMIT, dict(zip(self.steps.servos, limits, strict=True)))
            else:
                self._bus.broadcast(reg.TORQUE_ENABLE, 0)
                self._bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(self.steps.servos, 0))

    def confirm(self) -> str:
        """Ask all servos whether their torque is off; only then they get back the torque limits that they had."""
        servos = self.steps.servos
        if self._serial is None:
            self._open()
        with self._bus_errors():
            blocks = self._bus.sync_read(servos, reg.TORQUE_ENABLE)
            stiff = [
                f"{servo} ({joint})" for servo, joint in zip(servos, self.joint_names, strict=True)
                if servo not in blocks or any(blocks[servo])
            ]  # fmt: skip
            if stiff:
                raise DriverError(f"{self.port}: no word that the torque is off in servo {', '.join(stiff)}")
            self._bus.sync_write(reg.TORQUE_LIMIT, dict(zip(servos, self._limit, strict=True)))
        return "let go: all servos say that their torque is off"

    @contextlib.contextmanager
    def _bus_errors(self) -> Any:
        """A lost port becomes a DriverError, and is opened again by the next `damp`."""
        try:
            yield
        except LOST as error:
            self._shut()
            raise DriverError(f"{self.port}: {error}; is the cable in?") from None

    def close(self, hold: bool = False) -> None:
        """Torque off unless it shall hold, port closed."""
        if self._serial is not None and not hold:
            with contextlib.suppress(DriverError):
                self.damp()
                self.confirm()
        self._shut()

    def _shut(self) -> None:
        if self._serial is not None:
            self._say_exclusive(SHARED)
            with contextlib.suppress(*LOST):
                self._serial.close()
        self._serial = None

    def watchdog(self) -> dict[str, object] | None:
        """Has the port open before it is exclusive, and speaks only when this process is gone or hangs."""
        calibration = str(self.calibration) if self.calibration else None
        return {
            "kind": "so101", "robot": str(self.robot.folder.resolve()), "early": True, "port": self.port,
            "calibration": calibration, "silent": True, "torque_limit": self._limit,
        }  # fmt: skip


def _settings(block: bytes) -> dict[str, int]:
    return {name: register.cut(reg.SETTINGS, block) for name, register in (SET | HELD).items()}
