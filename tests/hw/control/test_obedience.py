"""Faulty and disobedient robots behind their drivers, in simulated time: held or damped, never
data.
"""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hw.control.loopback import RATE, judge, living, received
from hw.noted_arm import fake_watchdog, phases
from servos import Wire

from gaponet.base.errors import LogError
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.sequence import SequenceMeta, to_sequence
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers import feetech as reg
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.so101_virtual import PERIOD, VirtualSO101
from gaponet.virtual.unitree_virtual import VirtualH12

serial = pytest.importorskip("serial", reason="pip install 'gaponet[so101]'")

QUICK = ControlConfig(blend=0.5, blend_speed=2.0, settle=0.1, damp=0.6)
LOWERING_S = 2.0  # longer than the second in which somebody may catch the arm
# Servos.
ELBOW = 3
ROLL = 5
FAULT_S = 2.2 - 1e-6  # after the first command; just before a state and a period
WHOLE = reg.Register(0, 128)

# Fault of an H1-2 that is not seen as disobedience: what is limp or weak falls away from where it
# is asked to be.
KIND_OF_WAY = {"zero": "jump", "limp": "tracking", "all limp": "tracking", "weak": "tracking"}

RNG = random.Random(1)
SPOILT = {  # what reaches the driver of what servos say
    "mute": lambda said: b"",
    "corrupt": lambda said: said[:-1] + bytes(b ^ 255 for b in said[-1:]),
    "babble": lambda said: RNG.randbytes(600),
    "lossy": lambda said: said if RNG.random() > 0.03 else b"",
    "noisy": lambda said: said if RNG.random() > 0.03 else RNG.randbytes(len(said)),
}


class Bus(Wire):
    """A virtual arm on a wire that ages with the controller's clock; some time after its first
    goal it goes wrong.
    """

    def __init__(self, arm: VirtualSO101, clock: SimulatedClock) -> None:
        super().__init__(self)  # type: ignore[arg-type]
        self.arm = arm
        self.clock = clock
        self.way = ""
        self.at = np.inf
        self.first = np.inf
        self.done = False
        self.writes = 0
        # Time, register, the rest of a packet that writes.
        self.written: list[tuple[float, int, bytes]] = []

    def put(
        self, register: reg.Register, value: int, servos: range | tuple[int, ...] = range(1, 7)
    ) -> None:
        for servo in servos:
            at = register.address
            self.arm.memory[servo - 1][at : at + register.size] = register.encode(value)

    def get(self, register: reg.Register) -> list[int]:
        return [register.value_in(WHOLE, bytes(memory)) for memory in self.arm.memory]

    def answer(self, data: bytes) -> bytes:
        now = self.clock.now()
        while self.arm.live.steps * PERIOD <= now:
            self.arm.live.step()
        self.note(data, now)
        wrong = now - self.first >= self.at
        if wrong and not self.done:
            self.done = True
            self.go_wrong()
        said = self.arm.receive(b"" if wrong and self.drops(data) else data)
        if wrong and self.way == "crossed" and self.is_goal(data):
            self.cross()
        if wrong and self.way in SPOILT:
            said = SPOILT[self.way](said)
        return data + said if self.way == "echo" else said

    def is_goal(self, data: bytes) -> bool:
        return data[4] == reg.SYNC_WRITE and data[5] == reg.GOAL_POSITION.address

    def note(self, data: bytes, now: float) -> None:
        if data[4] in (reg.WRITE, reg.SYNC_WRITE):
            self.written.append((now, data[5], data[6:-1]))
        if data[4] == reg.SYNC_WRITE:
            self.writes += 1
        if self.is_goal(data):
            self.first = min(self.first, now)

    def go_wrong(self) -> None:
        """What goes wrong once."""
        if self.way in WAYS:
            happens, _ = WAYS[self.way]
            happens(self)
        elif self.way in ERRORS:
            ERRORS[self.way](self)
        self.arm._apply()

    def drops(self, data: bytes) -> bool:
        """Whether what is written does not arrive."""
        if data[4] == reg.SYNC_READ:
            return False
        # Two of seven, the first among them.
        return self.way == "ignores" or (self.way == "drops" and self.writes % 7 in (1, 2))

    def cross(self) -> None:
        """Exchange the goals of elbow and roll."""
        goals = self.get(reg.GOAL_POSITION)
        self.put(reg.GOAL_POSITION, goals[ROLL - 1], (ELBOW,))
        self.put(reg.GOAL_POSITION, goals[ELBOW - 1], (ROLL,))
        self.arm._apply()

    def lose(self) -> None:
        self.lost = True
        self._there()

    def reset(self, *servos: int) -> None:
        self.put(reg.TORQUE_ENABLE, 0, servos)
        self.put(reg.GOAL_POSITION, 0, servos)

    def shift(self) -> None:
        self.put(
            reg.HOMING_OFFSET, self.arm.calibration.rows["elbow_flex"].homing_offset + 33, (ELBOW,)
        )
        self.arm.calibration.zero[2] -= 33  # 0.05 rad


# What goes wrong once, and what the driver says of it.
WAYS: dict[str, tuple[Callable[[Bus], object], str]] = {
    "ignores": (lambda bus: None, "it holds the goal"),
    "crossed": (lambda bus: None, "elbow_flex.*: it holds the goal"),
    "resets": (lambda bus: bus.reset(ROLL), r"servo 5 \(wrist_roll\): its torque is off"),
    "brown-out": (lambda bus: bus.reset(*range(1, 7)), "shoulder_pan.*its torque is off.*gripper"),
    "gain": (
        lambda bus: bus.put(reg.P, 128, (ELBOW,)),
        r"servo 3 \(elbow_flex\): its p went from "
        r"32 to 128",
    ),
    "zero": (Bus.shift, "elbow_flex.*: its homing offset went from"),
    "mode": (lambda bus: bus.put(reg.MODE, 1, (ELBOW,)), "elbow_flex.*: its mode went from 0 to 1"),
    "limit": (
        lambda bus: bus.put(reg.TORQUE_LIMIT, 200, (ELBOW,)),
        "elbow_flex.*: its torque limit went from 1000 to 200",
    ),
}
GOAL_WAYS = ("ignores", "crossed")  # a servo holds another goal: the fault `goal`
ERRORS: dict[str, Callable[[Bus], object]] = {
    "lost": Bus.lose,
    "silent": lambda bus: setattr(bus.arm, "silent", {4}),
}


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def bus(
    so101: RobotSpec, clock: SimulatedClock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Bus]:
    from gaponet.hw.drivers import so101 as driver
    from gaponet.hw.drivers import so101_servos

    # Other processes may run this test.
    monkeypatch.setattr("gaponet.hw.control.publisher.LOCK_FOLDER", tmp_path)
    arm = VirtualSO101(so101, load_fleet("easy", so101).unit("virtual-1"))
    arm.live.steps = round(clock.now() / PERIOD)
    bus = Bus(arm, clock)
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: bus)
    for module in (driver, so101_servos):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=clock.now))
    yield bus
    arm.close()


def play(
    so101: RobotSpec,
    clock: SimulatedClock,
    stop: float = np.inf,
    watchdog: bool = False,
    config: ControlConfig = QUICK,
) -> Recording:
    """One and a half second in which all joints swing."""
    from gaponet.hw.drivers.so101 import SO101Driver

    def policy(k: int, state: object) -> np.ndarray | None:
        if k * 0.02 >= stop:
            controller.stop("the operator")
        return (
            so101.qpos_home + 0.3 * np.sin(0.08 * k) * np.array([1, 0.5, -1, 0.8, 1, 0.5])
            if k < 75
            else None
        )

    controller = Controller(
        SO101Driver(so101, timeout=0.001), so101, config=config, clock=clock, watchdog=watchdog
    )
    return controller.run(policy)


def assert_no_data(recording: Recording, robot: RobotSpec, folder: Path, saved: bool) -> None:
    """It is no log, and if its rows are saved at all, they say so and are not imported."""
    with pytest.raises(LogError, match="servo"):
        recording.log()
    path = recording.save(folder / "logs", "sway")
    assert path.exists() == saved
    if saved:
        request = ImportRequest(unit_id="a", payload_mass=0.0, position_unit="rad", time_unit="s")
        with pytest.raises(LogError, match="servo"):
            import_logs(path, robot, folder / "set", request)
    assert not json.loads((folder / "logs" / "sway.json").read_text())["obeyed"]


@pytest.mark.parametrize(
    ("way", "at"),
    [*((way, 1.0) for way in WAYS), ("ignores", 0.05), ("gain", 2.35), ("zero", 2.35)],
)
def test_servos_that_do_not_as_told_are_named_and_their_run_is_no_data(
    so101, clock, bus, way, at, tmp_path
):
    bus.way = way
    bus.at = at
    recording = play(so101, clock)
    assert recording.fault is not None
    kind = "goal" if way in GOAL_WAYS else "obedience"
    assert recording.fault.kind == kind, recording.fault
    assert re.search(WAYS[way][1], recording.fault.text)
    # Each state tells; three in a row count.
    if at == 1.0 and way in ("ignores", "resets", "brown-out", "crossed"):
        assert recording.fault.time - bus.first - at <= 5 * 0.02
    # else it was noticed at the very end, where the arm is held
    if recording.fault.phase == "damp":
        off = bus.get(reg.TORQUE_ENABLE) == [0] * 6
        assert off != recording.events[-1].text.startswith(
            "could NOT be damped: switch the supply off"
        )
    assert_no_data(recording, so101, tmp_path, saved=at > 0.5)


def test_servos_that_hold_other_goals_are_let_go_at_once_and_not_lowered(so101, clock, bus):
    bus.way = "crossed"
    bus.at = 1.0

    recording = play(so101, clock, config=replace(QUICK, damp=LOWERING_S))

    assert recording.fault.kind == "goal"
    assert torque_off(bus) == pytest.approx(recording.fault.time, abs=0.02)
    assert torque_limits(bus, torque_off(bus)) == []


def test_an_arm_does_not_move_towards_a_goal_of_an_earlier_run(so101, clock, bus, monkeypatch):
    earlier = 800  # steps, 1.2 rad from where the elbow lies
    bus.put(reg.GOAL_POSITION, earlier, (ELBOW,))
    store = bus.arm._store

    def take(servo: int, at: int, data: bytes) -> None:
        if servo != ELBOW or at != reg.GOAL_POSITION.address:
            store(servo, at, data)

    monkeypatch.setattr(bus.arm, "_store", take)

    recording = play(so101, clock)

    assert recording.fault.kind == "driver"
    assert "elbow_flex" in recording.fault.text
    elbow = [row.state.qpos[ELBOW - 1] for row in recording.rows]
    assert elbow[0] - min(elbow) < 0.02, "it may sink the other way"


def test_a_setting_that_changes_is_noticed_within_a_second(so101, clock, bus):
    bus.way = "gain"
    bus.at = 0.3
    assert play(so101, clock).fault.time - bus.first - bus.at <= 1.0 + 2 * 0.02


@pytest.mark.parametrize("way", ["", "lossy", "noisy", "echo", "drops"])
def test_an_honest_arm_is_believed_also_on_a_bus_that_now_and_then_loses_damages_or_echoes(
    so101, clock, bus, way
):
    bus.way = way
    bus.at = -np.inf
    recording = play(so101, clock)
    assert recording.fault is None
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]
    assert bus.get(reg.TORQUE_ENABLE) == [1] * 6


def test_what_is_remarked_about_the_servos_hinders_no_recording(so101, clock, bus):
    bus.put(reg.P, 16)  # as LeRobot leaves them
    recording = play(so101, clock)
    assert any("16" in remark for remark in recording.meta["remarks"])
    meta = SequenceMeta("so101", "lab", "sway", 0.0, "hand", "joint", 0, True, "sway.parquet")
    assert len(to_sequence(recording.log(), so101, meta)) == 75


# ---- ends


def told(bus: Bus, register: reg.Register) -> list[tuple[float, bytes]]:
    return [(time, words) for time, address, words in bus.written if address == register.address]


def torque_limits(bus: Bus, until: float) -> list[int]:
    """The torque limits that servos were told before that time."""
    limits = []
    for time, words in told(bus, reg.TORQUE_LIMIT):
        if time < until:
            limits.append(int.from_bytes(words[2:4], "little"))
    return limits


def torque_off(bus: Bus) -> float:
    """When servos were first told to let go."""
    return next(time for time, words in told(bus, reg.TORQUE_ENABLE) if words == b"\0")


def test_a_stop_lowers_the_arm_and_only_then_takes_its_torque(so101, clock, bus):
    recording = play(so101, clock, stop=1.0, config=replace(QUICK, damp=LOWERING_S))
    assert [e.kind for e in recording.events if e.phase == "damp"] == ["stop"]
    assert recording.events[-1].text == "let go: all servos say that their torque is off"
    off = torque_off(bus)
    began = recording.events[-2].time
    assert off == pytest.approx(began + LOWERING_S, abs=0.05)
    limits = torque_limits(bus, off)
    assert limits == sorted(limits, reverse=True)
    assert limits[0] > 900
    assert limits[-1] <= 10
    assert bus.get(reg.TORQUE_ENABLE) == [0] * 6
    assert bus.get(reg.TORQUE_LIMIT) == [1000] * 6, "the next user finds the limits that there were"
    held = [row.state.qpos for row in recording.rows if row.phase == "damp"][:50]
    assert np.ptp(held, axis=0).max() < 0.1, "for a second somebody may catch it"


def test_a_cable_that_is_out_is_never_said_to_be_damped_and_the_watchdog_goes_on(
    so101, clock, bus, monkeypatch
):
    ends: list[bool] = []
    monkeypatch.setattr(
        "gaponet.hw.control.controller.Watchdog", lambda *_: fake_watchdog(release=ends.append)
    )
    bus.way = "lost"
    bus.at = 1.0
    recording = play(so101, clock, watchdog=True)
    assert recording.fault.kind == "driver"
    last = recording.events[-1]
    assert (last.phase, last.kind) == ("stopped", "driver")
    assert last.text.startswith("could NOT be damped: switch the supply off")
    assert set(ends) == {True}
    assert bus.get(reg.TORQUE_ENABLE) == [1] * 6


def test_one_servo_that_says_nothing_more_is_named_and_the_others_are_lowered(so101, clock, bus):
    bus.way = "silent"
    bus.at = 1.0
    recording = play(so101, clock)
    assert recording.fault.kind == "stale"
    assert told(bus, reg.TORQUE_LIMIT)
    assert "could NOT be damped: switch the supply off" in recording.events[-1].text
    assert "servo 4 (wrist_flex)" in recording.events[-1].text


@pytest.mark.parametrize("way", ["mute", "corrupt", "babble"])
def test_a_bus_that_says_nothing_true_any_more_carries_at_most_two_more_goals(
    so101, clock, bus, way
):
    bus.way = way
    bus.at = 1.0
    assert play(so101, clock).fault.kind in ("stale", "checksum")
    assert sum(time >= bus.first + bus.at for time, _ in told(bus, reg.GOAL_POSITION)) <= 1 + 2
    assert bus.get(reg.TORQUE_ENABLE) == [0] * 6


# ---- an H1-2, which cannot be asked what it was told


def swing(
    monkeypatch: pytest.MonkeyPatch,
    way: str = "",
    at: float = 0.0,
    told: float | None = None,
    fault: str = "none",
    during: Callable[[int, VirtualH12], None] = lambda k, robot: None,
    size: float = 0.5,
    **unit: object,
) -> tuple[Recording, VirtualH12]:
    """Both elbows go half a radian and then swing by as much, the right one the other way; told a
    payload.

    Args:
        way: How the robot disobeys, `at` s after the first command.
        fault: What is wrong with it, from then on.
        during: Called in each period of the run.
        size: Of the swing, rad; at 0 nothing moves.
    """
    robot = load_robot("h1_2")
    clock = living(monkeypatch, robot, **unit)  # type: ignore[arg-type]
    clock.robot.way = way
    clock.robot.at = at
    clock.robot.inject(fault, at)  # type: ignore[arg-type]
    left, right = robot.index(["left_elbow_joint", "right_elbow_joint"])

    def policy(k: int, state: object) -> np.ndarray | None:
        during(k, clock.robot)
        target = robot.qpos_home.copy()
        target[[left, right]] += size * (1 + np.array([1, -1]) * np.sin(0.06 * k))
        return target if k < 150 else None

    config = ControlConfig(blend=1.5, settle=0.1, blend_out=bool(way), damp=1.0)
    driver = UnitreeDriver(robot, domain=200 + os.getpid() % 30)
    recording = Controller(
        driver, robot, config=config, clock=clock, watchdog=False, payload_mass=told
    ).run(policy)
    return recording, clock.robot


@pytest.mark.parametrize(
    ("fault", "kind", "periods"),
    [
        ("stop", "stale", 3),
        ("repeat", "stale", 3),
        ("late", "stale", 3),
        ("checksum", "stale", 3),
        ("freeze", "frozen", 2),
        ("nan", "nan", 1),
        ("jump", "jump", 1),
        ("hot", "temperature", 1),
        ("encoder", "frozen", 25),
        ("motor", "robot", 1),
        ("remote", "stop", 1),
        ("fall", "tilt", 1),
        ("machine", "robot", 1),
    ],
)
def test_a_fault_of_an_h1_2_ends_in_damp(monkeypatch, fault, kind, periods):
    recording, robot = swing(monkeypatch, fault=fault, at=FAULT_S, size=0.25)
    assert recording.fault.kind == kind, recording.fault
    assert phases(recording)[-3:] == ["run", "damp", "stopped"]
    damped = next(row["time"] for row in robot.heard if row["kp"][16] == 0)
    # A fault is in the next state, which the controller reads in the next period.
    state_age = 1 / RATE
    assert 0 < damped - (robot.first_command + FAULT_S) <= periods * 0.02 + state_age + 1e-6
    judge(recording, received(robot), robot.robot, SafetyConfig())
    silent = fault in ("stop", "repeat", "checksum")
    text = (
        "could NOT be damped: switch the supply off (nothing was heard"
        if silent
        else "damped and let go"
    )
    assert recording.events[-1].text.startswith(text)


def test_a_step_of_the_robots_clock_is_no_fault_and_hides_none(monkeypatch):
    """10 s ahead, and back again: the run goes on. Messages that cease are then seen as ever."""

    def step(k: int, robot: VirtualH12) -> None:
        if fault := {10: "clock", 30: "none", 50: "clock", 70: "stop"}.get(k):
            robot.inject(fault, 0.0)

    recording, robot = swing(monkeypatch, during=step)
    assert recording.fault.kind == "stale", recording.fault
    assert 71 <= sum(r.phase == "run" for r in recording.rows) <= 74
    judge(recording, received(robot), robot.robot, SafetyConfig())


def assert_damped(recording: Recording, way: str) -> None:
    """What is limp or weak falls away from where it is asked to be; the rest does not obey."""
    if recording.fault.kind == "obedience":
        assert phases(recording)[-2:] == ["damp", "stopped"]
        assert recording.events[-1].text.startswith("let go; the robot did not obey")
    else:
        assert recording.fault.kind == KIND_OF_WAY[way]
        assert recording.fault.phase == "damp"


@pytest.mark.parametrize(
    ("way", "at"),
    [
        ("ignores", 0.0),
        ("ignores", 2.0),
        ("listens midway", 2.5),
        ("limp", 2.0),
        ("all limp", 2.0),
        ("weak", 2.0),
        ("crossed", 0.0),
        ("mirrored", 0.0),
        ("blocked", 0.5),
        ("blocked", 2.6),
        ("blocked", 3.4),
        ("zero", 2.5),
    ],
)
def test_a_robot_whose_joints_do_not_follow_is_damped_and_its_run_is_no_data(monkeypatch, way, at):
    recording, _ = swing(monkeypatch, way, at)
    assert recording.fault is not None
    assert "elbow" in recording.fault.text
    assert_damped(recording, way)
    with pytest.raises(LogError, match="told"):
        recording.log()
    steps = np.abs(np.diff([row.state.qpos for row in recording.rows], axis=0))
    assert steps.max() < 0.06 or "limp" in way or way == "zero", (
        "nothing jumps when a robot listens again, and what is limp falls"
    )
    if at == 0.0 and way == "ignores":
        blended_in = max(row.time for row in recording.rows if row.phase == "blend_in")
        assert blended_in < recording.rows[0].time + 3.0


def test_the_weight_waits_until_a_joint_has_followed(monkeypatch):
    _, robot = swing(monkeypatch, "listens midway", 2.5)
    assert 0.0 < max(received(robot)["weight"]) <= 0.3 + 1e-6
    recording, robot = swing(monkeypatch)
    assert recording.fault is None
    assert max(received(robot)["weight"]) == 1.0
    assert recording.events[-1].text == "handed over"
    assert recording.summary()["obeyed"]


OVERLOAD_KG = 6.0  # in each hand: an elbow cannot raise it, and hardly moves


def test_an_arm_that_is_too_weak_for_its_load_but_pushes_obeys(monkeypatch):
    recording, robot = swing(monkeypatch, told=OVERLOAD_KG, payload=OVERLOAD_KG, fleet="hard")
    assert recording.fault is None
    elbows = robot.robot.index(["left_elbow_joint", "right_elbow_joint"])
    qpos = recording.run_rows()["qpos"][:, elbows]
    assert np.ptp(qpos, axis=0).max() < 0.2, "of the 1 rad that they are told to swing"


def test_an_arm_that_pushes_against_a_load_that_nobody_stated_does_not_obey(monkeypatch):
    recording, _ = swing(monkeypatch, told=0.0, payload=OVERLOAD_KG, fleet="hard")
    assert recording.fault.kind == "obedience"


def test_a_run_in_which_nothing_moves_shows_nothing_and_is_no_data(monkeypatch):
    recording, _ = swing(monkeypatch, size=0.0)
    assert recording.fault is None
    assert (
        recording.events[-1].text
        == "no data: no joint was told to go far enough to show whether the robot obeys"
    )
    with pytest.raises(LogError, match="far"):
        recording.log()
