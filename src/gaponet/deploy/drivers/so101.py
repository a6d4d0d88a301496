"""SO101Driver: an SO-101 arm, six Feetech STS3215 servos on a serial bus.

Units: 4096 encoder steps a turn; velocity in steps/s; current in 6.5 mA. tau is current times a constant, signed by the
load: the constant makes the stall current the effort limit; it was not calibrated. so101_calibration.py says where a
joint's 0 rad is.

The servos cannot damp: `damp` switches their torque off and the gears brake. They keep their last target when commands
cease, so a run without fault ends held. Not checked on a real arm: everything was tested against buses that answer by
Feetech's documents, well and badly.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.arrays import Array
from gaponet.deploy.driver import DriverError, End, Fault, State
from gaponet.deploy.drivers import feetech as reg
from gaponet.deploy.drivers.so101_calibration import SPEAK, STEP, ServoRow, numbered, read_calibration, settle
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec

try:
    from termios import error as termios_error
except ImportError:  # Windows
    LOST: tuple[type[Exception], ...] = (OSError,)
else:
    LOST = (OSError, termios_error)  # pyserial's own errors are OSErrors; a port that is gone also raises the other

if TYPE_CHECKING:
    from serial import Serial

STALL_CURRENT = 2.7 / 0.0065  # steps: 2.7 A at 12 V (Feetech's data sheet of the STS3215)
BAUD = 1_000_000
STIFFNESS = 17.8 / 32  # N·m/rad of an STS3215 for each unit of its P; robot.toml of the so101 says whence
PATIENT = 0.1  # s of silence while connecting, when nothing hurries
FULL = 1000  # of TORQUE_LIMIT, 0.1 %
FACTS = {
    "p": reg.P, "i": reg.I, "d": reg.D, "max_torque": reg.MAX_TORQUE, "torque_limit": reg.TORQUE_LIMIT,
    "protection_current": reg.PROTECTION_CURRENT, "acceleration": reg.ACCELERATION, "goal_velocity": reg.GOAL_VELOCITY,
    "voltage": reg.PRESENT_VOLTAGE,
}  # fmt: skip
HELD = {"homing_offset": reg.HOMING_OFFSET, "range_min": reg.MIN_POSITION, "range_max": reg.MAX_POSITION}
READINGS = {
    "qpos": reg.PRESENT_POSITION, "qvel": reg.PRESENT_VELOCITY, "load": reg.PRESENT_LOAD,
    "current": reg.PRESENT_CURRENT, "temperature": reg.PRESENT_TEMPERATURE,
}  # fmt: skip


class SO101Driver:
    """A `Driver` for six servos; gripper included, which a motion leaves at home."""

    virtual = False
    noisy = False  # a resting encoder reads the same for ever
    at_end: End = "hold"

    def __init__(
        self,
        robot: RobotSpec,
        port: str = "/dev/ttyACM0",
        calibration: str | Path | None = None,
        timeout: float = 0.01,
        silent: bool = False,
    ) -> None:
        """
        Args:
            calibration: JSON file that LeRobot's calibration wrote; default what the servos hold of it.
            timeout: Longest silence of the bus while replies are awaited, s.
            silent: `connect` leaves the port alone: for the guard, because a bus has one speaker. `damp` opens it.
        """
        if set(robot.joint_names) != set(SPEAK):
            raise UsageError(f"the so101 driver is for the joints {', '.join(SPEAK)}; {robot.name} has others")
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
        self._enabled = False

    def connect(self) -> None:
        """Open the port, ask every servo what it is, how it is set and how it is; nothing moves, nothing is written."""
        if self.silent:
            return
        try:
            self._open()
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
            raise DriverError(f"{self.port}: {error}; is the arm plugged in, and may you use the port?") from None
        self._bus = reg.ServoBus(self._serial, self.timeout)

    def _meet(self) -> None:
        """Number, model and mode of each servo; then its gains, limits and calibration."""
        bus, servos = self._bus, self.steps.servos
        for joint, servo in zip(self.joint_names, servos, strict=True):
            if not bus.ping(servo):
                raise DriverError(f"{self.port}: servo {servo} ({joint}) does not answer; check power and cable")
            model, mode = bus.read(servo, reg.MODEL), bus.read(servo, reg.MODE)
            if model != reg.STS3215 or mode != 0:
                raise DriverError(
                    f"{self.port}: servo {servo} ({joint}) is model {model} in mode {mode}; the driver needs an "
                    f"STS3215 ({reg.STS3215}) in position mode (0)"
                )
        numbers = dict(zip(self.joint_names, servos, strict=True))
        held = {
            joint: ServoRow(id=servo, drive_mode=0, **{name: bus.read(servo, r) for name, r in HELD.items()})
            for joint, servo in numbers.items()
        }
        self.steps = settle(self.given, held, self.robot, self.port)
        self.qpos_range = self.steps.qpos_range
        servo_facts = {name: [bus.read(servo, r) for servo in servos] for name, r in FACTS.items()}
        self.kp = STIFFNESS * np.array(servo_facts["p"], float)
        self.facts = {
            "servos": servo_facts,
            "calibration": {joint: asdict(row) for joint, row in held.items()},
            "notes": self._notes(servo_facts),
        }

    def _notes(self, facts: dict[str, list[int]]) -> list[str]:
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
        blocks = self._bus.sync_read(servos, reg.PRESENT)
        if len(blocks) < len(servos):
            if old is not None:
                self._state = State(
                    old.time, old.qpos, old.qvel, old.tau, old.temperature, self._bus.refused, fault=self._fault()
                )
            return
        raw = {
            name: np.array([field.decode(_cut(blocks[s], field)) for s in servos], float)
            for name, field in READINGS.items()
        }
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

    def _fault(self) -> Fault | None:
        """What the servos have said is wrong with them, in any reply."""
        numbers = dict(zip(self.steps.servos, self.joint_names, strict=True))
        said = [
            f"servo {servo} ({joint}): " + ", ".join(w for bit, w in enumerate(reg.ERRORS) if w and errors >> bit & 1)
            for servo, joint in numbers.items() if (errors := self._bus.errors.get(servo, 0) & reg.FAULTY)
        ]  # fmt: skip
        return Fault("robot", "; ".join(said) + "; look at load, supply and cables") if said else None

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Goal positions of all servos in one packet, within the calibrated range; torque comes on with the first."""
        goal = dict(zip(self.steps.servos, self.steps.steps(np.asarray(ctrl)).tolist(), strict=True))
        with self._bus_errors():
            self._bus.sync_write(reg.GOAL_POSITION, goal)
            if not self._enabled:
                self._bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(goal, 1))
                self._enabled = True

    def damp(self, weight: float = 1.0) -> None:
        """Torque off, to every servo on the bus, asking none; said every period: a lost packet must not matter."""
        self._enabled = False
        if self._serial is None:
            self._open()
        with self._bus_errors():
            self._bus.broadcast(reg.TORQUE_ENABLE, 0)
            self._bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(self.steps.servos, 0))

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
        self._shut()

    def _shut(self) -> None:
        if self._serial is not None:
            with contextlib.suppress(*LOST):
                self._serial.close()
        self._serial = None

    def guard(self) -> dict[str, object] | None:
        """Opens the port only when this process is gone or hangs: a bus has one speaker."""
        calibration = str(self.calibration) if self.calibration else None
        return {
            "kind": "so101", "robot": str(self.robot.folder.resolve()), "early": True, "port": self.port,
            "calibration": calibration, "silent": True,
        }  # fmt: skip


def _cut(block: bytes, field: reg.Register) -> bytes:
    start = field.address - reg.PRESENT.address
    return block[start : start + field.size]
