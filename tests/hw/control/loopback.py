"""The Unitree driver and the virtual H1-2 on a bus that is a list, in simulated time, and a judge
of what arrives.

Nothing of DDS is needed.
"""

from __future__ import annotations

from collections import defaultdict, deque
from types import SimpleNamespace

import numpy as np

from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import Limits, SafetyConfig
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree import MOTOR_NAMES
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.unitree_virtual import VirtualH12

RATE = 100.0  # states per second
DRIFT_RAD_S = 0.2  # of an encoder


class Loopback:
    """Stands in for drivers.dds: a message that is sent arrives at once, at all readers of its
    topic.
    """

    LowState = "LowState"
    LowCmd = "LowCmd"

    def __init__(self) -> None:
        self.queues: dict[str, list[deque]] = defaultdict(list)
        self.writers: dict[str, list[int]] = defaultdict(list)  # by topic, their handles
        self.opened: list[tuple[int, str]] = []  # domain and interface of each participant

    def Bus(self, domain: int, interface: str) -> LoopbackBus:  # noqa: N802
        self.opened.append((domain, interface))
        return LoopbackBus(self)

    def publishers(self) -> dict[str, list[str]]:
        robots = [f"robot {handle}" for handle in self.writers["rt/lowstate"]]
        return defaultdict(list, {"rt/lowstate": robots})


class LoopbackBus:
    """One participant, as drivers.dds.Bus."""

    def __init__(self, loopback: Loopback) -> None:
        self.publishers = loopback.publishers
        self._loopback = loopback
        self._ignoring: list[deque] = []  # queues for which its own messages are not meant

    def reader(self, topic: str, kind: str, of_others: bool = False) -> LoopbackReader:
        queue: deque = deque(maxlen=64)
        self._loopback.queues[topic].append(queue)
        if of_others:
            self._ignoring.append(queue)
        return LoopbackReader(queue, self._loopback.writers[topic])

    def writer(self, topic: str, kind: str) -> SimpleNamespace:
        writers = self._loopback.writers
        handle = sum(map(len, writers.values())) + 1
        writers[topic].append(handle)

        def send(data: np.ndarray) -> None:
            for queue in self._loopback.queues[topic]:
                if not any(queue is ignoring for ignoring in self._ignoring):
                    queue.append((handle, np.array(data)))

        return SimpleNamespace(send=send)


class LoopbackReader:
    """A reader of one topic, as drivers.dds.Reader."""

    def __init__(self, queue: deque, writers: list[int]) -> None:
        self.queue = queue
        self.writers = writers

    def receive_with_publisher(self) -> list[tuple[int, np.ndarray]]:
        return [self.queue.popleft() for _ in range(len(self.queue))]

    def receive(self) -> list[np.ndarray]:
        return [data for _, data in self.receive_with_publisher()]

    def publishers(self) -> set[int]:
        return set(self.writers)

    def describe(self, handle: int) -> str:
        return f"robot {handle}"


class Disobedient(VirtualH12):
    """From some time after the first command on it does not do as told, in one way."""

    way = ""
    at = 0.0

    def apply_command(self, topic: str, data: np.ndarray, now: float) -> None:
        wrong = now - (self.first_command or now) >= self.at
        if wrong and self.way == "ignores":
            return
        if not wrong and self.way == "listens midway":
            return
        if wrong and self.way in ("limp", "all limp", "crossed", "mirrored"):
            data = self._mistaken(data)
        super().apply_command(topic, data, now)
        if wrong and self.way == "blocked":
            self._block_elbow()
        if wrong and self.way == "weak":
            self._weaken_elbow()

    def _mistaken(self, data: np.ndarray) -> np.ndarray:
        """The command that it follows instead."""
        left = MOTOR_NAMES.index("left_elbow_joint")
        right = MOTOR_NAMES.index("right_elbow_joint")
        q = hg.LowCmd.motors(data, "q")
        kp = hg.LowCmd.motors(data, "kp")
        if self.way == "crossed":
            q[[left, right]] = q[[right, left]]
        elif self.way == "mirrored":
            q[left] = -q[left]
        elif self.way == "limp":
            kp[left] = 0.0
        else:
            kp[12:27] = 0.0
        data = data.copy()
        hg.LowCmd.set_motors(data, "q", q)
        hg.LowCmd.set_motors(data, "kp", kp)
        return data

    def _block_elbow(self) -> None:
        """Something holds the forearm: it creeps."""
        unit = self.live.unit
        joint = self._order[MOTOR_NAMES.index("left_elbow_joint")]
        elbow = np.flatnonzero(unit.active == joint)[0]
        unit.batch.expand("dof_damping")[:, elbow] = 1000.0
        unit.motors.cold_damping[:, elbow] = 1000.0

    def _weaken_elbow(self) -> None:
        kp, kd, effort, torque = self.live._gains
        elbow = self._order[MOTOR_NAMES.index("left_elbow_joint")]
        weak = np.arange(len(kp)) == elbow
        self.live.set_gains(kp, kd, np.where(weak, 0.5, effort), torque)

    def _readings(self) -> tuple[np.ndarray, ...]:
        qpos, *more = super()._readings()
        elbow = self._order[MOTOR_NAMES.index("left_elbow_joint")]
        wrong_for = self.clock.now() - (self.first_command or np.inf) - self.at
        if wrong_for >= 0 and self.way in ("zero", "drifts"):
            qpos = qpos.copy()
            qpos[elbow] += 0.31 if self.way == "zero" else DRIFT_RAD_S * wrong_for
        return qpos, *more


class RobotClock(SimulatedClock):
    """While it waits, the robot lives.

    Attributes:
        robot: The robot on the bus.
        seconds: Other robots on the same bus.
        truth: Time, s, and true joint positions of the robot then, (n) rad, at each of its states.
    """

    def __init__(
        self, robot: RobotSpec, bus: Loopback, unit: str, payload: float, fleet: str
    ) -> None:
        super().__init__()
        self.physics = load_fleet(fleet, robot).unit(unit)
        self.robot = Disobedient(robot, self.physics, (payload, "both"), rate=RATE)
        self.robot.clock = self  # type: ignore[assignment]
        self.seconds: list[VirtualH12] = []
        self.truth: list[tuple[float, np.ndarray]] = []
        self.steps = 0

    def wait_until(self, deadline: float) -> float:
        while self.start + self.steps / RATE <= deadline:
            self._now = max(self._now, self.start + self.steps / RATE)
            for robot in (self.robot, *self.seconds):
                robot._receive(self._now)
                robot.live.step()
                robot._send_state(self.steps, self._now)
            self.truth.append((self._now, self.robot.live.unit.true_qpos()[0].copy()))
            self.steps += 1
        return super().wait_until(deadline)

    def add_robot(self) -> VirtualH12:
        """Let a second robot appear on the bus now; return it."""
        first = self.robot
        second = VirtualH12(first.robot, self.physics, rate=RATE)
        second.clock = self  # type: ignore[assignment]
        self.seconds.append(second)
        return second


def living(
    monkeypatch,
    robot: RobotSpec,
    unit: str = "virtual-4",
    payload: float = 0.0,
    fleet: str = "easy",
) -> RobotClock:
    """A clock by which such a robot lives, and to which the driver's time belongs."""
    import gaponet.hw.drivers as drivers
    from gaponet.hw.drivers import unitree, unitree_states

    bus = Loopback()
    monkeypatch.setattr(drivers, "dds", bus, raising=False)
    clock = RobotClock(robot, bus, unit, payload, fleet)
    sleep = lambda seconds: clock.wait_until(clock.now() + max(seconds, 0.005))  # noqa: E731
    for module in (unitree, unitree_states):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=clock.now, sleep=sleep))
    return clock


def received(robot: VirtualH12) -> dict[str, list]:
    """Return the commands that arrived at a virtual robot, a list per field."""
    return {name: [row[name] for row in robot.heard] for name in robot.heard[0]}


def judge(
    recording: Recording, received: dict[str, list], robot: RobotSpec, safety: SafetyConfig
) -> None:
    """Assert that commands stayed within the limits, and that damping was for good; `received` is
    in motor order.

    Args:
        received: ctrl, kp, weight: what arrived at the robot.
    """
    joints = robot.index(recording.commanded)
    torso = robot.index(["torso_joint"])[0]
    ctrl = np.array(received["ctrl"])
    kp = np.array(received["kp"])
    limits = Limits.from_robot(robot, recording.commanded, safety)
    stiff = (kp[:, joints] > 0).all(axis=1)
    assert (stiff | (kp[:, joints] == 0).all(axis=1)).all()
    assert (np.diff(stiff.astype(int)) <= 0).all(), "a position command after damping"
    assert not stiff[-1]
    sent = ctrl[:, joints][stiff]
    assert (sent >= limits.low - 1e-6).all()
    assert (sent <= limits.high + 1e-6).all()
    assert (np.abs(np.diff(sent, axis=0)) <= limits.speed * recording.dt + 1e-6).all()
    np.testing.assert_array_equal(kp[:, :12], 0.0)  # legs are never commanded
    assert (kp[:, torso] == robot.servo.kp[torso]).all(), "the torso is held"
    assert np.ptp(ctrl[:, torso]) == 0, "where it was found"
    judge_torques(recording, limits, joints)


def judge_torques(recording: Recording, limits: Limits, joints: np.ndarray) -> None:
    """Assert that no command asks for more torque than the limit."""
    for row in recording.rows:
        if row.ctrl is None:
            continue
        spring = limits.kp * (row.ctrl - row.state.qpos)[joints]
        torque = spring - limits.kd * row.state.qvel[joints]
        assert (np.abs(torque) <= limits.effort + 1e-6).all()
