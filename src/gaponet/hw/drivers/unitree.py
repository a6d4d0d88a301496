"""UnitreeDriver: the H1-2 over DDS. States from rt/lowstate, commands to rt/arm_sdk or rt/lowcmd.

Motor numbers, topics, the weight of rt/arm_sdk in q of motor 27, mode 1 = enabled, mode_machine
echoed from the state, and mode_pr 0 for pitch/roll ankles are from Unitree's public SDK examples
(h1_2_arm_sdk_dds_example.cpp, h1_2_low_level_example.py). Tested against a virtual robot and
against programs on Unitree's IDL and DDS version only. Not checked, for want of a robot:

- that `tick` counts milliseconds (measured when connecting; arrival times are used where it does
not)
- how the robot behaves when commands cease
- the sign and scale of tau_est
- that slots without a motor stay zero, and that motorstate is 0 without an error

The arm_sdk example numbers the wrists yaw, pitch, roll, the low-level one roll, pitch, yaw (17 to
19 and 24 to 26). This driver follows the latter, as the MJCF does; check it with one small wrist
motion first.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, EndAction, Fault, State
from gaponet.hw.control.hardware import accepted_folder, range_violation, require_known_limits
from gaponet.hw.control.safety import damping_gains
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.sole_source import SoleSource
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from gaponet.hw.drivers.dds import Bus, Writer

Topic = Literal["arm_sdk", "lowcmd"]
Joints = Literal["arms", "upper_body", "all"]

LEG = ("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll")
ARM = (
    "shoulder_pitch",
    "shoulder_roll",
    "shoulder_yaw",
    "elbow",
    "wrist_roll",
    "wrist_pitch",
    "wrist_yaw",
)
MOTOR_NAMES = (
    *(f"left_{joint}_joint" for joint in LEG),
    *(f"right_{joint}_joint" for joint in LEG),
    "torso_joint",
    *(f"left_{joint}_joint" for joint in ARM),
    *(f"right_{joint}_joint" for joint in ARM),
)
FIRST_MOTOR = {"arms": 13, "upper_body": 12, "all": 0}  # of the commanded ones
# Not all 0 in a slot with a motor.
MOTOR_FIELDS = ("mode", "q", "dq", "tau_est", "temperature", "vol", "motorstate")
STATES_TOPIC = "rt/lowstate"
WEIGHT_MOTOR = 27
# of damping: 8 N·m·s/rad at the shoulder, where a straight arm then sinks at about 1 rad/s
KD_FACTOR = 4.0
VIRTUAL_MARK = 0x54524956  # "VIRT" in LowState.reserve[0], written by our virtual robot
TICK_PERIODS_S = (0.001, 0.002)  # that the robot's tick may have
MAX_CLOCK_DRIFT = 2e-4  # of the robot's clock, relative to ours
# mode_machine of a G1 (unitree_ros); 6 may be either, slots decide
G1_MACHINES = (*range(1, 6), *range(10, 17))
# Stop keys in bytes 2 and 3 of wireless_remote.
SELECT = 1 << 3
L2_B = 1 << 5 | 1 << 9
MAX_QUATERNION_ERROR = 0.1  # of its length
CONNECT_TIMEOUT_S = 3.0
LISTEN_S = 0.4  # in which the rate of the robot's tick is measured
MAX_SILENCE_S = 0.5  # without a state after which nobody knows the robot's state


class UnitreeDriver:
    """A `Driver` for the 27 motors of an H1-2.

    Legs are commanded only with joints="all" on rt/lowcmd.
    """

    noisy = True
    reads_back = False
    at_stop = "damps"

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
            robot: The H1-2; its kp and kd before identification are sent with every command.
            topic: arm_sdk leaves legs and balance to the robot; lowcmd switches off all motors that
                are not commanded and is for a robot that hangs.
            joints: arms, upper_body (with torso), or all.
            domain: DDS domain; 0 on a robot.
            interface: Network interface to the robot; lo for a virtual one on this machine.
            sole: Refuse to connect if another participant publishes the topic, or if two robots
                publish their states.
            silent: Only listen: publish nothing, and accept other publishers of the topic.

        Raises:
            UsageError: The robot is no H1-2, or the topic does not take the legs.
            RobotError: Gains or ranges exceed those of the known robot, or effort limits those of
                the motors.
        """
        if set(robot.joint_names) != set(MOTOR_NAMES):
            raise UsageError(
                f"the unitree driver is for the 27 joints of h1_2; {robot.name} has others"
            )
        if joints == "all" and topic != "lowcmd":
            raise UsageError(
                "rt/arm_sdk does not take the legs; use joints arms or upper_body, or topic lowcmd"
            )
        require_known_limits(robot, "h1_2")
        nominal = robot.before_identification
        self.robot = robot
        self.topic = topic
        self.joints = joints
        self.kp = nominal.servo.kp
        self.kd = nominal.servo.kd
        self._effort_limit = nominal.servo.effort_limit
        self.qpos_range: Array | None = None
        self.facts: dict[str, Any] = {}
        self.at_end: EndAction = "hand_over" if topic == "arm_sdk" else "damp"
        self.domain = domain
        self.interface = interface
        self.sole = sole
        self.silent = silent
        self.address = f"unitree dds domain {domain}"
        self.virtual = False
        self.joint_names = robot.joint_names
        first = FIRST_MOTOR[joints]
        self.commanded = tuple(
            name for name in robot.joint_names if MOTOR_NAMES.index(name) >= first
        )
        self._motor = np.array([MOTOR_NAMES.index(name) for name in robot.joint_names])
        self._at = robot.index(self.commanded)
        # As in Unitree's own arm_sdk example: with weight 1 the waist is ours, whether a motion
        # moves it or not.
        held = []
        if topic == "arm_sdk" and "torso_joint" not in self.commanded:
            held.append("torso_joint")
        self._held = robot.index(held)
        self._held_qpos: Array | None = None  # of the held joints at the first command, rad
        self._command = hg.LowCmd.new()
        self._refused = 0  # messages
        self.received = 0  # messages
        self._machine = 0  # mode_machine
        # the first one that the robot reported; it may be in one message only
        self._fault: Fault | None = None
        self._state: State | None = None
        self._clock: TickClock | None = None
        self._bus: Bus | None = None
        self._states: SoleSource | None = None
        self._last_ctrl: Array | None = None  # last position command, all joints, rad
        self._writer: Writer | None = None

    def connect(self) -> None:
        """Find the robot, learn its tick and machine mode, and refuse if another participant
        commands it.
        """
        from gaponet.hw.drivers import dds

        self._bus = dds.Bus(self.domain, self.interface)
        topic = f"rt/{self.topic}"
        self._states = SoleSource(self._bus.reader(STATES_TOPIC, dds.LowState), STATES_TOPIC)
        if not self.silent:
            self._writer = self._bus.writer(topic, dds.LowCmd)
        publishers = self._bus.publishers() if self.sole else {}
        others = [] if self.silent else publishers.get(topic, [])
        if others:
            raise DriverError(
                f"others publish {topic} on {self.interface}: {'; '.join(others)}; stop them "
                "first (on the robot: leave debug programs, and for lowcmd release the motion mode)"
            )
        robots = publishers.get(STATES_TOPIC, [])
        if len(robots) > 1:
            self._refuse_second(robots)
        arrivals, messages = self._listen(self._states)
        if self._states.second and self.sole:
            self._refuse_second([self._states.identity, self._states.second])
        self._require_h1_2(messages)
        self._clock = TickClock(
            arrivals, [int(hg.LowState.view(data, "tick")[0]) for data in messages]
        )
        self._state = self._decode(messages[-1], self._clock, arrivals[-1])
        hg.LowCmd.view(self._command, "mode_machine")[:] = self._machine
        self.facts = {
            "mode_machine": self._machine,
            "topic": self.topic,
            "source": f"{STATES_TOPIC} of {self._states.identity}",
        }

    def _refuse_second(self, robots: list[str]) -> NoReturn:
        """Refuse a bus on which more than one robot publishes its states: all of them would take
        each command.
        """
        raise DriverError(
            f"{len(robots)} robots publish {STATES_TOPIC} on domain {self.domain}, "
            f"{self.interface}: {'; '.join(robots)}. Each of them would move. Leave one on this "
            "domain or network; a program that was killed is remembered for about 10 s"
        )

    def _listen(self, states: SoleSource) -> tuple[list[float], list[Array]]:
        """Return the arrival times, s, of the intact messages of LISTEN_S, and these."""
        arrivals: list[float] = []
        messages: list[Array] = []
        start = time.monotonic()
        while not arrivals or time.monotonic() < arrivals[0] + LISTEN_S:
            now = time.monotonic()
            for data in states.receive()[-1:]:
                if self._intact(data):
                    arrivals.append(now)
                    messages.append(data)
            if now - start > CONNECT_TIMEOUT_S and not arrivals:
                wrong = ""
                if self._refused:
                    wrong = f"; {self._refused} messages came, all damaged or of another type"
                raise DriverError(
                    f"nobody speaks on rt/lowstate, domain {self.domain}, interface "
                    f"{self.interface}, within {CONNECT_TIMEOUT_S:g} s{wrong}. Is the robot on, "
                    "the cable in, the interface right? A virtual one: gaponet virtual serve"
                )
            time.sleep(0.001)
        return arrivals, messages

    def _intact(self, data: Array) -> bool:
        """Return True if size and checksum of a message are right; count the others."""
        intact = len(data) == hg.LowState.wire_size and hg.LowState.intact(data)
        self._refused += not intact
        return intact

    def _require_h1_2(self, messages: list[Array]) -> None:
        """Refuse a robot that is not an H1-2, by its mode_machine and by which of the 35 motor
        slots are not all 0.
        """
        self._machine = int(hg.LowState.view(messages[-1], "mode_machine")[0])
        used = np.zeros(hg.MOTORS, bool)  # slots in which anything is not 0
        for data in messages:
            for name in MOTOR_FIELDS:
                used |= (hg.LowState.motors(data, name).reshape(hg.MOTORS, -1) != 0).any(axis=1)
        strange = np.flatnonzero(used[len(MOTOR_NAMES) :])
        missing = np.flatnonzero(~used[: len(MOTOR_NAMES)])
        if self._machine in G1_MACHINES:
            reason = f"its mode_machine is {self._machine}, a G1's"
        elif len(strange):
            slots = ", ".join(str(len(MOTOR_NAMES) + i) for i in strange)
            reason = f"there are motors in slots {slots}, a G1's"
        elif len(missing):
            reason = f"no motor in slot {missing[0]}, {MOTOR_NAMES[missing[0]]}"
        else:
            return
        raise DriverError(
            f"the robot on {self.interface} is not an H1-2: {reason}; nothing was sent"
        )

    def read(self) -> State:
        """Return the newest state with a right checksum.

        Its time is the robot's, mapped to ours (TickClock).
        """
        assert self._state is not None
        assert self._states is not None
        assert self._clock is not None
        now = time.monotonic()
        newest = None
        messages = self._states.receive()
        if self._states.second and self._fault is None:
            self._fault = Fault(
                "source",
                f"a second robot publishes {STATES_TOPIC} and takes the same commands: "
                f"{self._states.second}",
            )
            self._state = replace(self._state, fault=self._fault)
        for data in messages:
            if self._intact(data):
                newest = data
                self.received += 1
                self._fault = self._fault or self._reported_fault(data)
        if newest is not None:
            self._state = self._decode(newest, self._clock, now)
        elif self._refused != self._state.refused:
            self._state = replace(self._state, refused=self._refused)
        return self._state

    def _reported_fault(self, data: Array) -> Fault | None:
        """Return what the robot itself reports: its operator's stop keys, motor errors, another
        mode_machine.
        """
        keys = int(hg.LowState.view(data, "wireless_remote")[2:4].view("<u2")[0])
        if keys & SELECT or keys & L2_B == L2_B:
            return Fault(
                "stop",
                f"asked to stop: {'select' if keys & SELECT else 'L2 + B'} on the robot's remote",
            )
        machine = int(hg.LowState.view(data, "mode_machine")[0])
        if machine != self._machine:
            return Fault("robot", f"mode_machine changed from {self._machine} to {machine}")
        errors = hg.LowState.motors(data, "motorstate")[: len(MOTOR_NAMES)]
        if errors.any():
            motor = int(errors.argmax())
            return Fault("robot", f"{MOTOR_NAMES[motor]} reports error 0x{errors[motor]:x}")
        return None

    def _decode(self, data: Array, clock: TickClock, now: float) -> State:
        message = hg.LowState
        at = self._motor
        measured = clock.time(int(message.view(data, "tick")[0]), now)
        self.virtual = int(message.view(data, "reserve")[0]) == VIRTUAL_MARK
        q = message.motors(data, "q")[at].astype(float)
        dq = message.motors(data, "dq")[at].astype(float)
        tau = message.motors(data, "tau_est")[at].astype(float)
        case_and_winding = message.motors(data, "temperature")[at]
        temperature = case_and_winding.max(axis=1).astype(float)
        quaternion = message.view(data, "imu_state.quaternion").astype(float)
        _, x, y, _ = quaternion
        # The vertical's component along the trunk; an invalid quaternion gives NaN, which counts as
        # tilt.
        valid = abs(np.linalg.norm(quaternion) - 1.0) < MAX_QUATERNION_ERROR
        upright = 1.0 - 2.0 * (x * x + y * y) if valid else np.nan
        tilt = float(np.arccos(np.clip(upright, -1.0, 1.0)))
        return State(measured, q, dq, tau, temperature, self._refused, tilt, self._fault)

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send targets with the robot's gains; the weight is our share of control on rt/arm_sdk.

        There the torso is held where it was at the first command, if it is not commanded.

        Raises:
            DriverError: A target is outside its joint's range, or DDS refuses the message.
        """
        if problem := range_violation(self.robot, ctrl, self._at):
            raise DriverError(f"{problem}; it was not sent")
        self._last_ctrl = np.array(ctrl, float)
        self._send(ctrl, self.kp, self.kd, weight)

    def verify(self) -> None:
        """Do nothing: nothing can be read back. The controller checks that the joints follow."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Send stiffness 0 and damping gains, at most those that the effort limits allow at the
        present speed.

        The position in the message has no stiffness, but a robot may blend it with its own by the
        weight. So it is the last command, not a reading, which may be what is wrong. The watchdog
        has sent no command: its position is the one that it reads when it begins to damp. A torso
        that is only held stays held until the weight is 0: a trunk must not swing while the arms
        brake.
        """
        state = self._newest_state()
        qpos = np.zeros(len(self._motor)) if state is None else np.nan_to_num(state.qpos)
        qvel = np.zeros(len(self._motor)) if state is None else state.qvel
        if self._last_ctrl is None:
            self._last_ctrl = qpos
        kd = damping_gains(KD_FACTOR * self.kd, qvel, self._effort_limit)
        self._send(self._last_ctrl, np.zeros_like(kd), kd, weight)

    def _newest_state(self) -> State | None:
        """Return the newest state, or the last one if the bus gives none; None before `connect`.

        The watchdog reads nothing until it damps. The state from its connection may be minutes old:
        a torso that is held there, with stiffness, would jump back to it.
        """
        if self._states is not None and self._clock is not None:
            with contextlib.suppress(DriverError):
                self.read()
        return self._state

    def _send(self, ctrl: Array, kp: Array, kd: Array, weight: float) -> None:
        if self._writer is None or self.silent:
            return
        if self._held_qpos is None:
            self._held_qpos = (ctrl if self._state is None else self._state.qpos)[self._held]
        motors = self._motor[self._at]
        held = self._held
        data = self._command
        for name, values, held_values in (
            ("mode", np.ones(len(ctrl)), np.ones(len(held))),
            ("q", ctrl, np.nan_to_num(self._held_qpos)),
            ("kp", kp, np.where(np.isfinite(self._held_qpos), self.kp[held], 0.0)),
            ("kd", kd, self.kd[held]),
        ):
            column = np.zeros(hg.MOTORS)
            column[motors] = values[self._at]
            column[self._motor[held]] = held_values
            if name == "q" and self.topic == "arm_sdk":
                column[WEIGHT_MOTOR] = weight
            hg.LowCmd.set_motors(data, name, column)
        hg.LowCmd.seal(data)
        self._writer.send(data)

    def confirm(self) -> str:
        """Check that the robot still sends states; it reports nothing else of its damping."""
        state = self.read()
        age = time.monotonic() - state.time
        if age > MAX_SILENCE_S:
            raise DriverError(f"nothing was heard of the robot for {age:.1f} s")
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; after damping the last message has weight 0: the arms are the robot's own
        again (arm_sdk).
        """
        if self._bus is None:
            return
        with contextlib.suppress(DriverError):
            if not hold:
                self.damp(0.0)
        self._bus = None
        self._states = None
        self._writer = None

    def publishers(self) -> dict[str, list[str]]:
        """Return the other publishers on the bus: topic → programs.

        The robot's topics are always included.
        """
        assert self._bus is not None
        publishers = self._bus.publishers()
        topics = (STATES_TOPIC, "rt/arm_sdk", "rt/lowcmd", *sorted(publishers))
        return {topic: publishers[topic] for topic in topics}

    def watchdog(self) -> dict[str, object] | None:
        """Return the options of a second participant: connected from the start, and silent until
        it damps.
        """
        return {
            "kind": "unitree",
            "robot": str(self.robot.folder.resolve()),
            "topic": self.topic,
            "joints": self.joints,
            "domain": self.domain,
            "interface": self.interface,
            "sole": False,
            "limits_from": accepted_folder(self.robot),
        }


class TickClock:
    """Maps the robot's tick to this machine's monotonic clock, so that delayed messages are seen
    to be old.

    The offset is the smallest (arrival − tick) seen: that of the fastest message so far. It may
    grow slowly, in case the robot's clock is slower than ours.
    """

    def __init__(self, arrivals: list[float], ticks: list[int]) -> None:
        """Take the arrival times, s of the monotonic clock, and the ticks of the first messages."""
        period = (arrivals[-1] - arrivals[0]) / max((ticks[-1] - ticks[0]) % 2**32, 1)
        # s; None: the tick is no clock, and arrival times are used
        self.period = next((p for p in TICK_PERIODS_S if 0.7 < period / p < 1.4), None)
        self._last_tick = ticks[0]
        self._wraps = 0
        self._offset = np.inf
        self._last_arrival = arrivals[0]
        self._time = arrivals[0]
        for arrival, tick in zip(arrivals, ticks, strict=True):
            self.time(tick, arrival)

    def time(self, tick: int, arrival: float) -> float:
        """Return the time at which the state with this tick was measured, s, at most its arrival.

        The same tick always has the same time.
        """
        if tick == self._last_tick and np.isfinite(self._offset):
            return self._time
        if tick < self._last_tick - 2**31:
            self._wraps += 1
        elif tick < self._last_tick:  # the robot has restarted, and its clock with it
            self._offset = np.inf
        self._last_tick = tick
        if self.period is None:
            self._offset = 0.0
            self._time = arrival
            return arrival
        robot_time = (tick + self._wraps * 2**32) * self.period
        drift = MAX_CLOCK_DRIFT * max(arrival - self._last_arrival, 0.0)
        self._offset = min(arrival - robot_time, self._offset + drift)
        self._last_arrival = arrival
        self._time = robot_time + self._offset
        return self._time
