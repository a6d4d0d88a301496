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
    ArmCalibration,
    read_calibration,
    uncalibrated,
)
from gaponet.hw.drivers.so101_port import SO101Port
from gaponet.hw.drivers.so101_servos import FULL_TORQUE, ServoStates, find_servos
from gaponet.robot.spec import RobotSpec

CONNECT_SILENCE_S = 0.1  # after which missing replies are given up while connecting
CONNECT_TIMEOUT_S = 1.0  # for a first whole state
# Times that goals are sent and read back before torque comes on, because packets get lost. By baud
# rate and timeout, three take about 6 ms, or 36 ms if a servo is silent: less than the two periods
# at 50 Hz that the next period may be late.
GOAL_ATTEMPTS = 3


class Lowering:
    """Lowers an arm, whose servos have no brake: their torque limits decrease, then their torque
    goes off.

    Everything is sent in every period, so that a lost packet does not matter.

    Attributes:
        limits: Torque limits of the servos while they are not lowered, 0.1 %.
    """

    def __init__(self, names: dict[int, str], limits: list[int], asks: bool) -> None:
        """
        Args:
            names: Servo → joint.
            limits: Torque limits while they are not lowered, 0.1 %.
            asks: Ask the servos for their limits before lowering them. Only the watchdog must: the
                controller may have died while it lowered.
        """
        self.limits = limits
        self._names = names
        self._asks = asks
        self._lowered_from: list[int] | None = None  # torque limits, 0.1 %; None: not lowered yet

    def lower(self, bus: reg.ServoBus, share: float) -> None:
        """Set the torque limits to a share of those at the beginning."""
        if self._lowered_from is None:
            self._lowered_from = self._limits_in_force(bus)
        limits = [round(share * limit) for limit in self._lowered_from]
        bus.sync_write(reg.TORQUE_LIMIT, dict(zip(self._names, limits, strict=True)))

    def _limits_in_force(self, bus: reg.ServoBus) -> list[int]:
        """Return the torque limits from which the arm is lowered, 0.1 %.

        They are never raised: an arm that has sunk would spring back to its last goal. A servo that
        does not answer counts as not lowered yet.
        """
        if not self._asks:
            return self.limits
        blocks = bus.sync_read(self._names, reg.TORQUE_LIMIT)
        limits = []
        for servo, limit in zip(self._names, self.limits, strict=True):
            in_force = reg.TORQUE_LIMIT.decode(blocks[servo]) if servo in blocks else limit
            limits.append(min(in_force, limit))
        return limits

    def let_go(self, bus: reg.ServoBus) -> None:
        """Switch the torque of all servos on the bus off."""
        bus.broadcast(reg.TORQUE_ENABLE, 0)
        bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(self._names, 0))

    def still_on(self, bus: reg.ServoBus) -> list[str]:
        """Return the servos that do not say that their torque is off."""
        blocks = bus.sync_read(self._names, reg.TORQUE_ENABLE)
        stiff = []
        for servo, joint in self._names.items():
            if servo not in blocks or any(blocks[servo]):
                stiff.append(f"{servo} ({joint})")
        return stiff

    def set_limits_back(self, bus: reg.ServoBus) -> None:
        """Set the torque limits back; call it only if no torque is on."""
        bus.sync_write(reg.TORQUE_LIMIT, dict(zip(self._names, self.limits, strict=True)))


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
        self._file_calibration = read_calibration(calibration, robot) if calibration else None
        self._port = SO101Port(port, timeout)
        self._states: ServoStates | None = None  # from the connection on
        arm = self._file_calibration or uncalibrated(robot)
        self._lowering = Lowering(
            dict(zip(arm.servos, self.joint_names, strict=True)),
            torque_limit or [FULL_TORQUE] * len(self.joint_names),
            asks=silent,
        )

    @property
    def states(self) -> ServoStates:
        """The servos and their states, which exist once the driver is connected."""
        assert self._states is not None, "connect first"
        return self._states

    @property
    def arm(self) -> ArmCalibration:
        """Calibration of the connected arm."""
        return self.states.found.arm

    @property
    def kp(self) -> Array:
        """Stiffness that follows from P of the servos, (n) N·m/rad."""
        if self._states is None:
            return self.robot.before_identification.servo.kp
        return self._states.found.kp

    @property
    def kd(self) -> Array:
        """Damping, (n) N·m·s/rad; the servos do not report it."""
        return self.robot.before_identification.servo.kd

    @property
    def qpos_range(self) -> Array | None:
        """Calibrated range, (n, 2) rad."""
        return None if self._states is None else self._states.found.arm.qpos_range

    @property
    def facts(self) -> dict[str, Any]:
        """Registers and calibration of the servos, remarks about them, and their source."""
        return {} if self._states is None else self._states.found.facts

    def connect(self) -> None:
        """Open the port, and read model, settings and state of every servo; nothing is written."""
        try:
            bus = self._port.open()
            if self.silent:
                return
            self._port.claim()
            with self._port.errors():
                bus.timeout = max(self._port.timeout, CONNECT_SILENCE_S)
                found = find_servos(bus, self.robot, self.address, self._file_calibration)
            states = ServoStates(found, self.robot, self.address)
            names = dict(zip(found.arm.servos, self.joint_names, strict=True))
            self._states = states
            self._lowering = Lowering(names, found.registers["torque_limit"], asks=False)
            bus.timeout = self._port.timeout
            deadline = time.monotonic() + CONNECT_TIMEOUT_S
            while states.newest is None:
                states.poll(bus)
                if states.newest is None and time.monotonic() > deadline:
                    raise DriverError(
                        f"{self.address}: the servos' readings do not arrive whole; check the cable"
                    )
            if states.newest.fault:
                raise DriverError(f"{self.address}: {states.newest.fault.text}")
        except BaseException:
            self._port.close()
            raise

    def read(self) -> State:
        """Return the state of all servos; the last state again if one did not answer.

        The first call after `watchdog` closes the port for other programs again.
        """
        states = self.states
        self._port.take_back()
        with self._port.errors():
            states.poll(self._port.bus)
        assert states.newest is not None
        return states.newest

    def verify(self) -> Fault | None:
        """Return a fault if anything has changed since the run began; all servos are read."""
        states = self.states
        bus = self._port.bus
        with self._port.errors():
            states.poll(bus)
            states.obedience.check_settings(bus)
        return states.obedience.fault

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send goal positions of all servos in one packet, within the calibrated range.

        The first command switches the torque on, but only after all servos have said that they
        hold their goals: the goal of an earlier run may be far from the arm. From then on no other
        program can open the port.

        Raises:
            DriverError: A servo without torque does not hold its goal; no torque was switched on.
        """
        bus = self._port.bus
        goals = self.states.obedience.goals
        if goals.in_force is None:
            self._port.keep_others_out()
        steps = self.arm.steps(np.asarray(ctrl)).tolist()
        asked = dict(zip(self.arm.servos, steps, strict=True))
        without_torque = [servo for servo in asked if servo not in goals.torque_on]
        with self._port.errors():
            if without_torque:
                self._send_until_held(bus, asked, without_torque)
                bus.sync_write(reg.TORQUE_ENABLE, dict.fromkeys(without_torque, 1))
            else:
                bus.sync_write(reg.GOAL_POSITION, asked)
        goals.send(asked)

    def _send_until_held(self, bus: reg.ServoBus, asked: dict[int, int], servos: list[int]) -> None:
        """Send goals, and read back those of some servos, until each holds its own.

        Args:
            asked: Servo → goal, steps.
            servos: Whose goals are read back.

        Raises:
            DriverError: One holds another goal, or does not answer.
        """
        for _ in range(GOAL_ATTEMPTS):
            bus.sync_write(reg.GOAL_POSITION, asked)
            blocks = bus.sync_read(servos, reg.GOAL_POSITION, retries=0)
            held = {servo: reg.GOAL_POSITION.decode(block) for servo, block in blocks.items()}
            if all(held.get(servo) == asked[servo] for servo in servos):
                return
        joint_of = dict(zip(self.arm.servos, self.joint_names, strict=True))
        reports = []
        for servo in servos:
            name = f"servo {servo} ({joint_of[servo]})"
            if servo not in held:
                reports.append(f"{name} does not say which goal it holds")
            elif held[servo] != asked[servo]:
                reports.append(f"{name} holds the goal {held[servo]}, not {asked[servo]} as told")
        raise DriverError(
            f"{self.address}: {'; '.join(reports)}; no torque was switched on; look at supply and "
            "cables"
        )

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Lower the arm: torque limits decrease with `share`.

        At 0 the torque of all servos on the bus is switched off. Nothing is read, except by the
        watchdog before it lowers.
        """
        if self._states is not None:
            self._states.obedience.goals.let_go()
        bus = self._port.open()
        with self._port.errors():
            if share > 0:
                self._lowering.lower(bus, share)
            else:
                self._lowering.let_go(bus)

    def confirm(self) -> str:
        """Check that the torque of all servos is off; only then set their torque limits back."""
        bus = self._port.open()
        with self._port.errors():
            stiff = self._lowering.still_on(bus)
            if stiff:
                raise DriverError(
                    f"{self.address}: no word that the torque is off in servo {', '.join(stiff)}"
                )
            self._lowering.set_limits_back(bus)
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
            "torque_limit": self._lowering.limits,
            "limits_from": accepted_folder(self.robot),
        }
