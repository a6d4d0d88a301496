"""UnitreeDriver: the H1-2 over DDS. State from rt/lowstate, commands to rt/arm_sdk or rt/lowcmd.

Facts from Unitree's public SDK examples (h1_2_arm_sdk_dds_example.cpp, h1_2_low_level_example.py): motor numbers,
topics, the weight of rt/arm_sdk in q of motor 27, mode 1 = enabled, mode_machine echoed from the state, mode_pr 0 for
pitch/roll ankles. Tested against a virtual robot and against programs on Unitree's IDL and DDS version only. Not
checked, for want of a robot: that `tick` counts milliseconds (measured when connecting; arrival times are used where it
does not), how the robot behaves when commands cease, the sign and scale of tau_est, that slots without a motor stay
zero, that motorstate is 0 where all is well. The arm_sdk example numbers the wrists yaw, pitch, roll, the low-level one
roll, pitch, yaw (17 to 19 and 24 to 26): ours follows the latter, as the MJCF does; check it with one small wrist
motion first.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, End, Fault, State
from gaponet.hw.control.hardware import outside_range, require_motor_limits
from gaponet.hw.control.safety import damping
from gaponet.hw.drivers import hg
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.hw.drivers.dds import Bus

Topic = Literal["arm_sdk", "lowcmd"]
Joints = Literal["arms", "upper_body", "all"]

LEG = ("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
MOTOR_NAMES = (
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in LEG),
    "torso_joint",
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in ARM),
)
SPOKEN = ("mode", "q", "dq", "tau_est", "temperature", "vol", "motorstate")
WEIGHT_MOTOR = 27
DAMPING = 4.0  # times the robot's kd: 8 N·m·s/rad at the shoulder, where a straight arm then sinks at about 1 rad/s
VIRTUAL_MARK = 0x54524956  # "VIRT" in LowState.reserve[0], written by our virtual robot
TICKS = (0.001, 0.002)  # s, what a tick may be
DRIFT = 2e-4  # how much slower the robot's clock may run than ours
G1_MACHINES = (1, 2, 3, 4, 5, *range(10, 17))  # mode_machine of a G1 (unitree_ros); 6 is said of both, slots decide
SELECT, L2_B = 1 << 3, 1 << 5 | 1 << 9  # stop keys in bytes 2 and 3 of wireless_remote
CONNECT = 3.0  # s to wait for a robot
LISTEN = 0.4  # s to listen for its rate
SILENT = 0.5  # s without a state after which nobody knows what the robot does


class UnitreeDriver:
    """A `Driver` for the 27 motors of an H1-2. Legs are commanded only with joints="all" on rt/lowcmd."""

    noisy = True
    reads_back = False

    def __init__(
        self,
        robot: RobotSpec,
        topic: Topic = "arm_sdk",
        joints: Joints = "arms",
        domain: int = 0,
        interface: str = "lo",
        sole: bool = True,
        silent: bool = False,
    ) -> None:
        """
        Args:
            robot: The H1-2; its kp and kd, as before any identification, are sent with every command.
            topic: arm_sdk leaves legs and balance to the robot; lowcmd switches off all motors that are not commanded
                and is for a robot that hangs.
            joints: arms, upper_body (with torso), or all.
            domain: DDS domain; 0 on a robot.
            interface: Network interface to the robot; lo for a virtual one on this machine.
            sole: Refuse to connect where somebody else publishes the topic.
            silent: Only listen: nothing is published, and whoever publishes is left in peace.
        """
        if set(robot.joint_names) != set(MOTOR_NAMES):
            raise UsageError(f"the unitree driver is for the 27 joints of h1_2; {robot.name} has others")
        if joints == "all" and topic != "lowcmd":
            raise UsageError("rt/arm_sdk does not take the legs; use joints arms or upper_body, or topic lowcmd")
        require_motor_limits(robot, "h1_2")
        first = {"arms": 13, "upper_body": 12, "all": 0}[joints]
        self.robot, self.topic, self.joints = robot, topic, joints
        self.kp, self.kd = (robot.nominal or robot).kp, (robot.nominal or robot).kd
        self.qpos_range: Array | None = None
        self.facts: dict[str, Any] = {}
        self.at_end: End = "hand_over" if topic == "arm_sdk" else "damp"
        self.at_stop = "damps"
        self.domain, self.interface, self.sole, self.silent = domain, interface, sole, silent
        self.address = f"unitree dds domain {domain}"
        self.virtual = False
        self.joint_names = robot.joint_names
        self.commanded = tuple(name for name in robot.joint_names if MOTOR_NAMES.index(name) >= first)
        self._motor = np.array([MOTOR_NAMES.index(name) for name in robot.joint_names])
        self._at = robot.index(self.commanded)
        # As Unitree's own arm_sdk example does: with weight 1 the waist is ours, whether a motion moves it or not.
        held = [n for n in robot.joint_names if n == "torso_joint" and n not in self.commanded and topic == "arm_sdk"]
        self._held = robot.index(held)
        self._found: Array | None = None  # where the held joints were at the first command, rad
        self._command = hg.LowCmd.new()
        self._refused = self.received = 0
        self._fault: Fault | None = None  # the first one that the robot told; it may be in one message only
        self._state: State | None = None
        self._bus: Bus | None = None

    def connect(self) -> None:
        """Find the robot, learn its tick and machine mode, and make sure that nobody else commands it."""
        from gaponet.hw.drivers import dds

        self._dds = dds
        self._bus = dds.Bus(self.domain, self.interface)
        topic = f"rt/{self.topic}"
        self._reader = self._bus.reader("rt/lowstate", dds.LowState)
        if not self.silent:
            self._writer = self._bus.writer(topic, dds.LowCmd)
        others = self._bus.publishers()[topic] if self.sole and not self.silent else []
        if others:
            raise DriverError(
                f"others publish {topic} on {self.interface}: {'; '.join(others)}; stop them first (on the "
                "robot: leave debug programs, and for lowcmd release the motion mode)"
            )
        heard = self._listen()
        self._require_h1_2([data for _, data in heard])
        self._clock = TickClock([now for now, _ in heard], [int(hg.LowState.view(d, "tick")[0]) for _, d in heard])
        self._state = self._decode(heard[-1][1], heard[-1][0])
        hg.LowCmd.view(self._command, "mode_machine")[:] = self._machine
        self.facts = {"mode_machine": self._machine, "topic": self.topic}

    def _listen(self) -> list[tuple[float, Array]]:
        """Intact messages of a while, and when they came."""
        heard: list[tuple[float, Array]] = []
        start = time.monotonic()
        while not heard or time.monotonic() < heard[0][0] + LISTEN:
            now = time.monotonic()
            for data in self._dds.receive(self._reader)[-1:]:
                if self._intact(data):
                    heard.append((now, data))
            if now - start > CONNECT and not heard:
                wrong = f"; {self._refused} messages came, all damaged or of another type" if self._refused else ""
                raise DriverError(
                    f"nobody speaks on rt/lowstate, domain {self.domain}, interface {self.interface}, within "
                    f"{CONNECT:g} s{wrong}. Is the robot on, the cable in, the interface right? A virtual "
                    "one: gaponet virtual serve"
                )
            time.sleep(0.001)
        return heard

    def _intact(self, data: Array) -> bool:
        """Whether a message is whole; others are counted."""
        intact = len(data) == hg.LowState.wire_size and hg.LowState.intact(data)
        self._refused += not intact
        return intact

    def _require_h1_2(self, heard: list[Array]) -> None:
        """Refuse a robot that is not an H1-2: by its kind, and by which of the 35 motor slots ever say anything."""
        self._machine = int(hg.LowState.view(heard[-1], "mode_machine")[0])
        said = [np.abs(hg.LowState.motors(data, name)).reshape(hg.MOTORS, -1) for data in heard for name in SPOKEN]
        spoken = np.concatenate(said, axis=1).max(axis=1) != 0
        strange, silent = np.flatnonzero(spoken[len(MOTOR_NAMES) :]), np.flatnonzero(~spoken[: len(MOTOR_NAMES)])
        if self._machine in G1_MACHINES:
            found = f"its mode_machine is {self._machine}, a G1's"
        elif len(strange):
            found = f"there are motors in slots {', '.join(str(len(MOTOR_NAMES) + i) for i in strange)}, a G1's"
        elif len(silent):
            found = f"no motor in slot {silent[0]}, {MOTOR_NAMES[silent[0]]}"
        else:
            return
        raise DriverError(f"the robot on {self.interface} is not an H1-2: {found}; nothing was sent")

    def read(self) -> State:
        """The newest state whose checksum is right; its time is the robot's, mapped to ours (TickClock)."""
        self._drain()
        assert self._state is not None
        return self._state

    def _drain(self) -> None:
        now, newest = time.monotonic(), None
        for data in self._dds.receive(self._reader):
            if self._intact(data):
                newest = data
                self.received += 1
                self._fault = self._fault or self._told(data)
        if newest is not None:
            self._state = self._decode(newest, now)
        elif self._state is not None and self._refused != self._state.refused:
            self._state = replace(self._state, refused=self._refused)

    def _told(self, data: Array) -> Fault | None:
        """What a robot says itself: its operator's stop keys, motor errors, that it is another one."""
        keys = int(hg.LowState.view(data, "wireless_remote")[2:4].view("<u2")[0])
        if keys & SELECT or keys & L2_B == L2_B:
            return Fault("stop", f"asked to stop: {'select' if keys & SELECT else 'L2 + B'} on the robot's remote")
        machine = int(hg.LowState.view(data, "mode_machine")[0])
        if machine != self._machine:
            return Fault("robot", f"mode_machine changed from {self._machine} to {machine}")
        errors = hg.LowState.motors(data, "motorstate")[: len(MOTOR_NAMES)]
        if errors.any():
            motor = int(errors.argmax())
            return Fault("robot", f"{MOTOR_NAMES[motor]} reports error 0x{errors[motor]:x}")
        return None

    def _decode(self, data: Array, now: float) -> State:
        message, at = hg.LowState, self._motor
        measured = self._clock.time(int(message.view(data, "tick")[0]), now)
        self.virtual = int(message.view(data, "reserve")[0]) == VIRTUAL_MARK
        q, dq, tau = (message.motors(data, name)[at].astype(float) for name in ("q", "dq", "tau_est"))
        temperature = message.motors(data, "temperature")[at].max(axis=1).astype(float)  # case and winding
        _, x, y, _ = quaternion = message.view(data, "imu_state.quaternion").astype(float)
        # The vertical's share along the trunk; a quaternion that is none gives NaN, which is a tilt too.
        upright = 1.0 - 2.0 * (x * x + y * y) if abs(np.linalg.norm(quaternion) - 1.0) < 0.1 else np.nan
        tilt = float(np.arccos(np.clip(upright, -1.0, 1.0)))
        return State(measured, q, dq, tau, temperature, self._refused, tilt, self._fault)

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Targets with the robot's gains; on rt/arm_sdk the weight tells how far it hands over.

        There the torso is held where it was found at the first command, if it is not commanded.
        """
        if problem := outside_range(self.robot, ctrl, self._at):
            raise DriverError(f"{problem}; it was not sent")
        self._send(ctrl, self.kp, self.kd, weight)

    def verify(self) -> None:
        """Nothing can be asked; whether its joints follow is the controller's to watch."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Stiffness zero and damping gains, no more than the effort limits allow at the present speed.

        A torso that is only held stays held, until the weight is given back: a trunk that swings is no way to brake.
        """
        state = self._state
        qpos = np.nan_to_num(state.qpos) if state else np.zeros(len(self._motor))
        qvel = state.qvel if state else np.zeros(len(self._motor))
        kd = damping(DAMPING * self.kd, qvel, (self.robot.nominal or self.robot).effort_limit)
        self._send(qpos, np.zeros_like(kd), kd, weight)

    def _send(self, ctrl: Array, kp: Array, kd: Array, weight: float) -> None:
        if self._bus is None or self.silent:
            return
        if self._found is None:
            self._found = (ctrl if self._state is None else self._state.qpos)[self._held]
        motors, held, data = self._motor[self._at], self._held, self._command
        for name, values, still in (
            ("mode", np.ones(len(ctrl)), np.ones(len(held))),
            ("q", ctrl, np.nan_to_num(self._found)),
            ("kp", kp, np.where(np.isfinite(self._found), self.kp[held], 0.0)),
            ("kd", kd, self.kd[held]),
        ):
            column = np.zeros(hg.MOTORS)
            column[motors] = values[self._at]
            column[self._motor[held]] = still
            if name == "q" and self.topic == "arm_sdk":
                column[WEIGHT_MOTOR] = weight
            hg.LowCmd.set_motors(data, name, column)
        hg.LowCmd.seal(data)
        self._dds.send(self._writer, self._dds.LowCmd, data)

    def confirm(self) -> str:
        """It is still there and heard the damping, as far as a robot that only tells its state can show."""
        state = self.read()
        if (age := time.monotonic() - state.time) > SILENT:
            raise DriverError(f"nothing was heard of the robot for {age:.1f} s")
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; after damping on rt/arm_sdk the last word is weight 0: the arms are the robot's own again."""
        if self._bus is None:
            return
        with contextlib.suppress(DriverError):
            if not hold:
                self.damp(0.0)
        self._bus = self._reader = self._writer = None  # type: ignore[assignment]

    def publishers(self) -> dict[str, list[str]]:
        """Who else publishes on the bus: topic → programs; those of the robot's topics are always named."""
        assert self._bus is not None
        found = self._bus.publishers()
        return {topic: found[topic] for topic in ("rt/lowstate", "rt/arm_sdk", "rt/lowcmd", *sorted(found))}

    def watchdog(self) -> dict[str, object] | None:
        """A second participant that is connected from the start and silent while the controller lives."""
        return {
            "kind": "unitree", "robot": str(self.robot.folder.resolve()), "early": True, "topic": self.topic,
            "joints": self.joints, "domain": self.domain, "interface": self.interface, "sole": False,
        }  # fmt: skip


class TickClock:
    """Maps the robot's tick to this machine's monotonic clock, so that late messages are seen to be old.

    The offset is the smallest (arrival − tick) seen, that is, the fastest way a message ever took; it may grow slowly,
    in case the robot's clock is slower than ours.
    """

    def __init__(self, arrivals: list[float], ticks: list[int]) -> None:
        passed = (arrivals[-1] - arrivals[0]) / max((ticks[-1] - ticks[0]) % 2**32, 1)
        self.tick = next((t for t in TICKS if 0.7 < passed / t < 1.4), None)  # s; None: not a clock, use arrivals
        self._last_tick, self._turns = ticks[0], 0
        self._offset, self._at, self._time = np.inf, arrivals[0], arrivals[0]
        for arrival, tick in zip(arrivals, ticks, strict=True):
            self.time(tick, arrival)

    def time(self, tick: int, arrival: float) -> float:
        """The time when the state with this tick was measured, s, at most its arrival; one tick always has one time."""
        if tick == self._last_tick and np.isfinite(self._offset):
            return self._time
        if tick < self._last_tick - 2**31:
            self._turns += 1
        elif tick < self._last_tick:  # the robot started again: its clock is another one
            self._offset = np.inf
        self._last_tick = tick
        if self.tick is None:
            self._offset, self._time = 0.0, arrival
            return arrival
        robot = (tick + self._turns * 2**32) * self.tick
        self._offset = min(arrival - robot, self._offset + DRIFT * max(arrival - self._at, 0.0))
        self._at = arrival
        self._time = robot + self._offset
        return self._time
