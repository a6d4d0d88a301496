"""States of an H1-2 from its LowState messages: whether it is one, and what it measures and
reports.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import DriverError, Fault, State
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree_link import STATES_TOPIC, SoleSource
from gaponet.robot.spec import RobotSpec

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
# Not all 0 in a slot with a motor.
MOTOR_FIELDS = ("mode", "q", "dq", "tau_est", "temperature", "vol", "motorstate")
VIRTUAL_MARK = 0x54524956  # "VIRT" in LowState.reserve[0], written by our virtual robot
TICK_PERIODS_S = (0.001, 0.002)  # that the robot's tick may have
MAX_CLOCK_DRIFT = 2e-4  # of the robot's clock, relative to ours
# A robot needs longer to restart. Old messages that are repeated step back more often.
MIN_RESTART_INTERVAL_S = 10.0
MAX_TICK_GAP_S = 0.2  # between two readings of one clock; a longer one may be a step of the clock
REMEMBERED_STRETCHES = 64  # of ticks; a robot's clock that steps has one more with each step
# mode_machine of a G1 (unitree_ros); 6 may be either, slots decide
G1_MACHINES = (*range(1, 6), *range(10, 17))
# Stop keys in bytes 2 and 3 of wireless_remote.
SELECT = 1 << 3
L2_B = 1 << 5 | 1 << 9
MAX_QUATERNION_ERROR = 0.1  # of its length
CONNECT_TIMEOUT_S = 3.0
LISTEN_S = 0.4  # in which the rate of the robot's tick is measured


def motor_numbers(robot: RobotSpec) -> Array:
    """Return the number of each joint's motor, (n,)."""
    return np.array([MOTOR_NAMES.index(name) for name in robot.joint_names])


class FirstMessages(NamedTuple):
    """Intact messages from which a robot is known: arrival times, s, bytes of each, and how many
    others were damaged.
    """

    arrivals: list[float]
    messages: list[Array]
    refused: int


def listen(states: SoleSource, place: str) -> FirstMessages:
    """Return the messages of LISTEN_S.

    Args:
        states: Of the robot.
        place: Where it is listened, in words.

    Raises:
        DriverError: No intact one comes within CONNECT_TIMEOUT_S.
    """
    arrivals: list[float] = []
    messages: list[Array] = []
    refused = 0
    start = time.monotonic()
    while not arrivals or time.monotonic() < arrivals[0] + LISTEN_S:
        now = time.monotonic()
        for data in states.receive()[-1:]:
            if is_intact(data):
                arrivals.append(now)
                messages.append(data)
            else:
                refused += 1
        if now - start > CONNECT_TIMEOUT_S and not arrivals:
            wrong = ""
            if refused:
                wrong = f"; {refused} messages came, all damaged or of another type"
            raise DriverError(
                f"nobody speaks on {STATES_TOPIC}, {place}, within {CONNECT_TIMEOUT_S:g} s{wrong}. "
                "Is the robot on, the cable in, the interface right? A virtual one: gaponet "
                "virtual serve"
            )
        time.sleep(0.001)
    return FirstMessages(arrivals, messages, refused)


def is_intact(data: Array) -> bool:
    """Return True if size and checksum of a message are right."""
    return len(data) == hg.LowState.wire_size and hg.LowState.intact(data)


def require_h1_2(messages: list[Array], interface: str) -> None:
    """Refuse a robot that is not an H1-2, by its mode_machine and by which of the 35 motor slots
    are not all 0.
    """
    machine = _machine_in(messages[-1])
    used = np.zeros(hg.MOTORS, bool)  # slots in which anything is not 0
    for data in messages:
        for name in MOTOR_FIELDS:
            used |= (hg.LowState.motors(data, name).reshape(hg.MOTORS, -1) != 0).any(axis=1)
    strange = np.flatnonzero(used[len(MOTOR_NAMES) :])
    missing = np.flatnonzero(~used[: len(MOTOR_NAMES)])
    if machine in G1_MACHINES:
        reason = f"its mode_machine is {machine}, a G1's"
    elif len(strange):
        slots = ", ".join(str(len(MOTOR_NAMES) + i) for i in strange)
        reason = f"there are motors in slots {slots}, a G1's"
    elif len(missing):
        reason = f"no motor in slot {missing[0]}, {MOTOR_NAMES[missing[0]]}"
    else:
        return
    raise DriverError(f"the robot on {interface} is not an H1-2: {reason}; nothing was sent")


def _machine_in(data: Array) -> int:
    return int(hg.LowState.view(data, "mode_machine")[0])


class StateReceiver:
    """Receives the states of one H1-2. What the robot reports stays, also over a new connection.

    Attributes:
        machine: Its mode_machine when it was found.
        virtual: True if it says that it is our virtual robot.
        newest: The newest state; None before the robot was found.
        received: Intact messages since it was found.
    """

    def __init__(self, motors: Array) -> None:
        """motors: Number of each joint's motor, (n,)."""
        self.machine = 0
        self.virtual = False
        self.newest: State | None = None
        self.received = 0
        self._motors = motors
        self._source: SoleSource | None = None
        self._clock: TickClock | None = None
        self._refused = 0  # messages
        # the first one that the robot reported; it may be in one message only
        self._fault: Fault | None = None

    @property
    def is_open(self) -> bool:
        """True between `begin` and `end`."""
        return self._source is not None

    def begin(self, source: SoleSource, first: FirstMessages) -> None:
        """Take the messages of a source from now on; `first` are those in which it was found."""
        self._source = source
        self._refused += first.refused
        ticks = [_tick_in(data) for data in first.messages]
        self._clock = TickClock(first.arrivals, ticks)
        self.machine = _machine_in(first.messages[-1])
        self.newest = self._decode(first.messages[-1], self._clock, first.arrivals[-1])

    def end(self) -> None:
        """Take no more messages."""
        self._source = None

    def read(self) -> State:
        """Take all messages that have come; return the newest state with a right checksum.

        A fault in any of them stays in all later states. The time of a state is the robot's, mapped
        to ours (TickClock). Without a new message the last state is returned again.
        """
        assert self._source is not None
        assert self._clock is not None
        assert self.newest is not None
        now = time.monotonic()
        messages = self._source.receive()
        if self._source.second:
            self.report(
                Fault(
                    "source",
                    f"a second robot publishes {STATES_TOPIC} and takes the same commands: "
                    f"{self._source.second}",
                )
            )
        last_intact = None
        for data in messages:
            if is_intact(data):
                last_intact = data
                self.received += 1
                self._fault = self._fault or self.reported_fault(data)
            else:
                self._refused += 1
        if last_intact is not None:
            self.newest = self._decode(last_intact, self._clock, now)
        elif self._refused != self.newest.refused:
            self.newest = replace(self.newest, refused=self._refused)
        return self.newest

    def report(self, fault: Fault) -> None:
        """Add a fault to all states from now on, unless they have one.

        It is in the newest state too, so that it counts also if no intact message comes.
        """
        if self._fault is None:
            assert self.newest is not None
            self._fault = fault
            self.newest = replace(self.newest, fault=fault)

    def reported_fault(self, data: Array) -> Fault | None:
        """Return what the robot itself reports in a message: its operator's stop keys, motor
        errors, another mode_machine.
        """
        keys = int(hg.LowState.view(data, "wireless_remote")[2:4].view("<u2")[0])
        if keys & SELECT or keys & L2_B == L2_B:
            return Fault(
                "stop",
                f"asked to stop: {'select' if keys & SELECT else 'L2 + B'} on the robot's remote",
            )
        machine = _machine_in(data)
        if machine != self.machine:
            return Fault("robot", f"mode_machine changed from {self.machine} to {machine}")
        errors = hg.LowState.motors(data, "motorstate")[: len(MOTOR_NAMES)]
        if errors.any():
            motor = int(errors.argmax())
            return Fault("robot", f"{MOTOR_NAMES[motor]} reports error 0x{errors[motor]:x}")
        return None

    def _decode(self, data: Array, clock: TickClock, now: float) -> State:
        """Return the state in a message that arrived at `now` s."""
        message = hg.LowState
        at = self._motors
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
        return State(
            time=clock.time(_tick_in(data), now),
            qpos=q,
            qvel=dq,
            tau=tau,
            temperature=temperature,
            refused=self._refused,
            tilt=tilt,
            fault=self._fault,
        )


def _tick_in(data: Array) -> int:
    return int(hg.LowState.view(data, "tick")[0])


class TickClock:
    """Maps the robot's tick to this machine's monotonic clock, so that delayed messages are seen
    to be old.

    The offset is the smallest (arrival − tick) seen: that of the fastest message so far. It may
    grow slowly, in case the robot's clock is slower than ours.

    A tick that steps back is a robot's clock that has restarted, or an old message. It counts as a
    restart only where no tick was seen before, and only once in MIN_RESTART_INTERVAL_S. Otherwise
    the offset stays, and the message is as old as its tick says.
    """

    def __init__(self, arrivals: list[float], ticks: list[int]) -> None:
        """Take the arrival times, s of the monotonic clock, and the ticks of the first messages."""
        period = (arrivals[-1] - arrivals[0]) / max((ticks[-1] - ticks[0]) % 2**32, 1)
        # s; None: the tick is no clock, and arrival times are used
        self.period = next((p for p in TICK_PERIODS_S if 0.7 < period / p < 1.4), None)
        self._last_tick = ticks[0]  # goes on beyond 2³²
        self._seen: deque[range] = deque(maxlen=REMEMBERED_STRETCHES)  # ticks without a long gap
        self._restart = -np.inf  # arrival of the first message after it, s
        self._offset = np.inf
        self._last_arrival = arrivals[0]
        self._time = arrivals[0]
        for arrival, tick in zip(arrivals, ticks, strict=True):
            self.time(tick, arrival)

    def time(self, tick: int, arrival: float) -> float:
        """Return the time at which the state with this tick was measured, s, at most its arrival.

        The same tick always has the same time, if it is a clock.
        """
        if self.period is None:
            return arrival
        step = (tick - self._last_tick + 2**31) % 2**32 - 2**31
        if step == 0 and np.isfinite(self._offset):
            return self._time
        reached = self._last_tick + step  # tick that goes on beyond 2³²
        if step < 0 and self._is_restart(reached, arrival):
            self._offset = np.inf
            self._restart = arrival
        self._remember(reached, round(MAX_TICK_GAP_S / self.period))
        self._last_tick = reached
        robot_time = reached * self.period
        drift = MAX_CLOCK_DRIFT * max(arrival - self._last_arrival, 0.0)
        self._offset = min(arrival - robot_time, self._offset + drift)
        self._last_arrival = arrival
        self._time = robot_time + self._offset
        return self._time

    def _is_restart(self, tick: int, arrival: float) -> bool:
        """Return True if a tick that steps back is of a clock that has begun anew."""
        if arrival - self._restart < MIN_RESTART_INTERVAL_S:
            return False
        return not any(tick in stretch for stretch in self._seen)

    def _remember(self, tick: int, max_gap: int) -> None:
        """Add a tick to the stretch of ticks that it goes on, or begin a new stretch."""
        for i, stretch in enumerate(self._seen):
            if stretch.start <= tick < stretch.stop + max_gap:
                self._seen[i] = range(stretch.start, max(tick + 1, stretch.stop))
                return
        self._seen.append(range(tick, tick + 1))
