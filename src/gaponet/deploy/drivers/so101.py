"""SO101Driver: an SO-101 arm, six Feetech STS3215 servos on a serial bus.

Units: 4096 encoder steps a turn; velocity in steps/s; current in 6.5 mA. tau is current times a constant, signed by the
load: the constant makes the stall current the effort limit; it was not calibrated. Zero of a joint is the middle of its
calibrated range (LeRobot's convention), or step 2048 without a calibration; it is not exactly the MJCF's zero.

The servos cannot damp: `damp` switches their torque off and the gears brake. They keep their last target when commands
cease. Not checked on a real arm: everything was tested against a bus that answers by Feetech's document.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet.deploy.driver import DriverError, End, State
from gaponet.deploy.drivers import feetech as reg
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec

if TYPE_CHECKING:
    from serial import Serial

Array = np.ndarray

STEPS = 4096
STEP = 2 * np.pi / STEPS  # rad
STALL_CURRENT = 2.7 / 0.0065  # steps: 2.7 A at 12 V (Feetech's data sheet of the STS3215)
BAUD = 1_000_000
SPEAK = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")  # servo 1 to 6


class SO101Driver:
    """A `Driver` for six servos; gripper included, which a motion leaves at home."""

    virtual = False
    noisy = False  # a resting encoder reads the same for ever
    at_end: End = "hold"

    def __init__(
        self, robot: RobotSpec, port: str = "/dev/ttyACM0", calibration: str | Path | None = None, timeout: float = 0.01
    ) -> None:
        """
        Args:
            robot: so101.
            port: Serial port.
            calibration: JSON file that LeRobot's calibration wrote.
            timeout: Longest wait for a servo's reply, s.
        """
        if set(robot.joint_names) != set(SPEAK):
            raise UsageError(f"the so101 driver is for the joints {', '.join(SPEAK)}; {robot.name} has others")
        self.robot, self.port, self.calibration = robot, port, calibration
        self.timeout = timeout
        self.address = port
        self.joint_names = self.commanded = robot.joint_names
        self.servos, self.middle, self.sign = read_calibration(calibration, robot)
        self.kp, self.kd = (robot.nominal or robot).kp, (robot.nominal or robot).kd
        self.facts: dict[str, Any] = {}
        self._serial: Serial | None = None
        self._enabled = False

    def connect(self) -> None:
        """Open the port and see that every servo is there and is an STS3215 in position mode; nothing moves."""
        try:
            import serial
        except ImportError:
            raise DriverError("pyserial is not installed; run: pip install 'gaponet[so101]'") from None
        try:
            self._serial = serial.Serial(self.port, BAUD, timeout=0.002, write_timeout=0.1)
        except (serial.SerialException, ValueError, OSError) as error:
            raise DriverError(f"{self.port}: {error}; is the arm plugged in, and may you use the port?") from None
        self._lost = serial.SerialException
        self._bus = reg.ServoBus(self._serial, self.timeout)
        for joint, servo in zip(self.joint_names, self.servos, strict=True):
            if not self._bus.ping(servo):
                raise DriverError(f"{self.port}: servo {servo} ({joint}) does not answer; check power and cable")
            model, mode = self._bus.read(servo, reg.MODEL), self._bus.read(servo, reg.MODE)
            if model != reg.STS3215 or mode != 0:
                raise DriverError(
                    f"{self.port}: servo {servo} ({joint}) is model {model} in mode {mode}; the driver needs an "
                    f"STS3215 ({reg.STS3215}) in position mode (0)"
                )
        self._state: State | None = None
        deadline = time.monotonic() + 1.0
        while self._state is None and time.monotonic() < deadline:
            self._poll()
        if self._state is None:
            raise DriverError(f"{self.port}: the servos' readings do not arrive whole; check the cable")

    def read(self) -> State:
        """Ask all servos; the last state again where one did not answer."""
        self._poll()
        assert self._state is not None
        return self._state

    def _poll(self) -> None:
        now = time.monotonic()
        try:
            blocks = self._bus.sync_read(self.servos, reg.PRESENT)
        except self._lost as error:
            raise DriverError(f"{self.port}: {error}") from None
        old = self._state
        if len(blocks) < len(self.servos):
            if old is not None:
                self._state = State(old.time, old.qpos, old.qvel, old.tau, old.temperature, self._bus.refused)
            return
        values = {
            name: np.array([field.decode(_cut(blocks[s], field)) for s in self.servos], float)
            for name, field in (
                ("q", reg.PRESENT_POSITION), ("v", reg.PRESENT_VELOCITY), ("load", reg.PRESENT_LOAD),
                ("i", reg.PRESENT_CURRENT), ("t", reg.PRESENT_TEMPERATURE),
            )
        }  # fmt: skip
        tau = np.abs(values["i"]) / STALL_CURRENT * self.robot.effort_limit * np.sign(values["load"]) * self.sign
        qpos = (values["q"] - self.middle) * STEP * self.sign
        self._state = State(now, qpos, values["v"] * STEP * self.sign, tau, values["t"], self._bus.refused)

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Goal positions of all servos in one packet; torque comes on with the first one."""
        steps = np.rint(np.asarray(ctrl) / (STEP * self.sign) + self.middle).astype(int)
        goal = dict(zip(self.servos, np.clip(steps, 0, STEPS - 1).tolist(), strict=True))
        self._sync(reg.GOAL_POSITION, goal)
        if not self._enabled:
            self._sync(reg.TORQUE_ENABLE, dict.fromkeys(self.servos, 1))
            self._enabled = True

    def damp(self, weight: float = 1.0) -> None:
        """Torque off, said again every period: a lost packet must not matter."""
        self._enabled = False
        if self._serial is not None:
            self._sync(reg.TORQUE_ENABLE, dict.fromkeys(self.servos, 0))

    def _sync(self, register: reg.Register, values: dict[int, int]) -> None:
        try:
            self._bus.sync_write(register, values)
        except self._lost as error:
            raise DriverError(f"{self.port}: {error}") from None

    def close(self, hold: bool = False) -> None:
        """Torque off, or as it is, and port closed."""
        if self._serial is None:
            return
        with contextlib.suppress(DriverError):
            if not hold:
                self.damp()
        self._serial.close()
        self._serial = None

    def guard(self) -> dict[str, object] | None:
        """Opens the port only when this process is gone: a bus has one speaker."""
        calibration = str(self.calibration) if self.calibration else None
        return {
            "kind": "so101", "robot": str(self.robot.mjcf.parent), "early": False, "port": self.port,
            "calibration": calibration,
        }  # fmt: skip


def read_calibration(path: str | Path | None, robot: RobotSpec) -> tuple[list[int], Array, Array]:
    """Servo number, encoder step at 0 rad and sign of each joint, in the robot's order.

    Raises:
        UsageError: The file is not a calibration, or lacks a joint.
    """
    if path is None:
        return [SPEAK.index(j) + 1 for j in robot.joint_names], np.full(6, STEPS / 2), np.ones(6)
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
        rows = [table[joint] for joint in robot.joint_names]
        servos = [int(row["id"]) for row in rows]
        middle = np.array([(row["range_min"] + row["range_max"]) / 2 for row in rows], float)
        sign = np.array([-1.0 if row["drive_mode"] else 1.0 for row in rows])
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise UsageError(f"{path}: not a calibration of LeRobot for {', '.join(SPEAK)} ({error!r})") from None
    return servos, middle, sign


def _cut(block: bytes, field: reg.Register) -> bytes:
    start = field.address - reg.PRESENT.address
    return block[start : start + field.size]
