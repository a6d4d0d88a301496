"""Live targets in simulated time: what is taken, what is held, and what ends in damping."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from arm import commands
from hw.noted_arm import DT, QUICK, NotedArm, control, phases, run

from gaponet.base.errors import UsageError
from gaponet.base.structure import type_adapter
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import Limits, SafetyConfig
from gaponet.hw.targets.accepted_target import next_step
from gaponet.hw.targets.live import LiveConfig, LiveTargets
from gaponet.hw.targets.message import MAX_MESSAGE_BYTES, Message, decode
from gaponet.motion.motion import Motion

# S; from FAULT on a sender goes wrong; HOLD is the default.
FAULT = 1.5
HOLD = 0.5
NAN = float("nan")
ROUNDING_S = 1e-9  # of the difference of two times of a clock that began at up to 10⁶ s


class Scripted:
    """A transport on which a sender says `say(t)` at each look, t s after the first."""

    address = "nowhere"

    def __init__(self, clock, say):
        self.clock = clock
        self.say = say
        self.began = None
        self.looked = None
        self.states = []

    def receive(self):
        looked = self.looked
        self.looked = self.clock.now()
        self.began = self.looked if self.began is None else self.began
        return [] if looked == self.looked else self.say(self.looked - self.began)

    def senders(self):
        return set()

    def publish(self, to, state):
        self.states.append((to, state))


def wave(t):
    return {"shoulder": 0.4 * np.sin(3 * t), "elbow": -0.5 * np.sin(2 * t)}


def good(t, sender="a"):
    return Message(sender, 100.0 + t, wave(t))


def live(arm, say, seconds=2.6, config=LiveConfig(wait=3.0)):  # noqa: B008
    """Recording, driver, transport and targets after a run; the sender ends after `seconds`."""
    driver = NotedArm(arm)
    transport = Scripted(
        driver.clock, lambda t: say(t) if t < seconds else [Message("a", 100.0 + t, end=True)]
    )
    targets = LiveTargets(
        transport, arm, driver.commanded, driver.clock, DT, SafetyConfig().speed, config
    )
    return control(driver).run(targets), driver, transport, targets


def judge(arm, recording):
    """Every command that left was within range, rate and torque."""
    limits = Limits.from_robot(arm, arm.joint_names, SafetyConfig())
    rows = [r for r in recording.rows if r.ctrl is not None]
    ctrl, qpos, qvel = (
        np.array(x) for x in zip(*((r.ctrl, r.state.qpos, r.state.qvel) for r in rows), strict=True)
    )
    assert ((ctrl >= limits.low) & (ctrl <= limits.high)).all()
    assert (np.abs(np.diff(ctrl, axis=0)) <= limits.speed * DT + 1e-12).all()
    assert (np.abs(limits.kp * (ctrl - qpos) - limits.kd * qvel) <= limits.effort).all()


def test_a_stream_is_played_as_the_same_motion_from_a_file(arm):
    """Whatever a motion's row goes through a live target goes through: the commands are the same
    to the last bit.
    """

    class Corrects:
        def reset(self, target, payload_mass=None):
            self.last = target

        def step(self, target, qpos, qvel):
            before = self.last
            self.last = target
            return target + 0.3 * (target - qpos) + 2.0 * (target - before)

    rows = 0.5 * commands(60, seed=1)  # slow enough to be followed at once

    def say(t):
        k = sum(row.phase == "run" for row in controller.recording.rows) + (
            controller.phase.value == "run"
        )
        row = rows[min(max(k - 1, 0), len(rows) - 1)]
        return [
            Message(
                "a", 100 + t, dict(zip(arm.joint_names, row.tolist(), strict=True)), k > len(rows)
            )
        ]

    driver = NotedArm(arm)
    controller = control(driver, compensator=Corrects())
    transport = Scripted(driver.clock, say)
    controller.run(
        LiveTargets(transport, arm, arm.joint_names, driver.clock, DT, SafetyConfig().speed)
    )
    from_file = run(NotedArm(arm), Motion("sway", "whole_body", DT, rows), compensator=Corrects())
    sent = [[r.ctrl for r in x.rows if r.phase == "run"] for x in (from_file, controller.recording)]
    assert len(sent[0]) == len(sent[1]) == 60
    np.testing.assert_array_equal(*sent)


def test_a_run_that_its_sender_ends_goes_back_and_stops_without_fault(arm):
    recording, driver, transport, targets = live(arm, lambda t: [good(t)])
    assert recording.fault is None
    assert phases(recording)[-3:] == ["run", "blend_out", "stopped"]
    assert driver.sent[-1][1] is not None
    assert targets.counts["refused"] == {}
    to, state = transport.states[-1]
    assert to == "a"
    assert state["commanded"] == arm.joint_names
    assert np.isfinite(state["qpos"] + state["qvel"] + state["tau"]).all()
    judge(arm, recording)


WRONG = {  # from FAULT on, every message is of this kind
    "silent": (lambda t: [], ""),
    "not a number": (lambda t: [Message("a", 100 + t, {"shoulder": NAN, "elbow": 0.0})], "range"),
    "infinite": (lambda t: [Message("a", 100 + t, {"shoulder": -np.inf, "elbow": 0.0})], "range"),
    "another joint": (lambda t: [Message("a", 100 + t, wave(t) | {"wrist": 0.0})], "joints"),
    "a joint fewer": (lambda t: [Message("a", 100 + t, {"elbow": 0.0})], "joints"),
    "a jump": (lambda t: [Message("a", 100 + t, {"shoulder": -1.4, "elbow": 1.4})], "speed"),
    "degrees": (lambda t: [Message("a", 100 + t, {"shoulder": 30.0, "elbow": 4.0})], "range"),
    "too fast": (
        lambda t: [Message("a", 100 + t, {"shoulder": 1.4 * (-1) ** int(t / DT), "elbow": 0.0})],
        "speed",
    ),
    "the same again": (lambda t: [good(FAULT - DT)], "order"),
    "backwards": (lambda t: [good(2 * FAULT - t - DT)], "order"),
    "late": (lambda t: [Message("a", 100 + t - 0.11, wave(t))] if t > FAULT + 0.11 else [], "late"),
    "another sender": (lambda t: [good(t, "b")], "stranger"),
    "malformed": (
        lambda t: [decode("a", b'{"time": 3, "target": {"shoulder": "0.1"}}')],
        "malformed",
    ),
}


def two_senders(t):
    return [good(t), good(t, "b")]


def test_two_senders_before_the_start_are_refused_and_nothing_is_commanded(arm):
    recording, driver, _, _ = live(arm, two_senders)

    assert recording.fault.kind == "source"
    assert "nothing was commanded" in recording.fault.text
    assert driver.sent == []


def test_a_second_sender_that_is_connected_and_silent_is_refused_before_the_start(arm, monkeypatch):
    monkeypatch.setattr(Scripted, "senders", lambda self: {"a", "b"})

    recording, driver, _, _ = live(arm, lambda t: [good(t)])

    assert recording.fault.kind == "source"
    assert driver.sent == []


def test_a_second_sender_during_the_run_is_remarked_once_and_moves_nothing(arm):
    alone, _, _, _ = live(arm, lambda t: [good(t)])

    recording, _, _, targets = live(arm, lambda t: [good(t)] if t < FAULT else two_senders(t))

    remarks = [event.text for event in recording.events if "second sender" in event.text]
    assert remarks == ["targets of a second sender, b, are rejected"]
    assert recording.fault is None
    assert targets.counts["sender"] == "a"
    np.testing.assert_array_equal(alone.run_rows()["ctrl"], recording.run_rows()["ctrl"])


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_taken_is_held_and_then_damped(arm, what):
    wrong, kind = WRONG[what]
    recording, driver, transport, targets = live(
        arm, lambda t: [good(t)] if t < FAULT else wrong(t)
    )
    assert recording.fault is not None
    assert recording.fault.kind == "silence"
    assert set(targets.counts["refused"]) == ({kind} if kind else set())
    judge(arm, recording)
    damped = driver.damped
    assert all(ctrl is None for t, ctrl in driver.sent if t >= damped)
    held = [r for r in recording.rows if r.target is not None][-10:]
    # The last good one, until then.
    np.testing.assert_array_equal(np.ptp([r.target for r in held], axis=0), 0.0)
    # Its first one may be where the last good one was.
    longest = HOLD + (3 * DT if what == "too fast" else DT)
    assert HOLD - 2 * DT < damped - transport.began - FAULT <= longest + ROUNDING_S


@pytest.mark.parametrize(
    "what", ["silent", "not a number", "a jump", "too fast", "late", "another sender"]
)
def test_a_burst_of_it_shorter_than_the_hold_is_survived(arm, what):
    def say(t):
        return WRONG[what][0](t) if FAULT <= t < FAULT + HOLD - 2 * DT else [good(t)]

    recording, _, _, targets = live(arm, say)
    assert recording.fault is None
    assert targets.counts["held"] >= 8 or what == "too fast"
    judge(arm, recording)


def test_a_target_that_is_less_than_a_tenth_of_a_second_late_is_taken(arm):
    recording, _, _, targets = live(
        arm, lambda t: [Message("a", 100 + t - 0.09 * (t > FAULT), wave(t))]
    )
    assert recording.fault is None
    assert set(targets.counts["refused"]) <= {"order"}, "as far as newer ones came before"


def test_a_flood_is_read_to_its_newest_and_can_move_no_faster(arm):
    """Fifty messages a period, each a little further: together they go no further than one may."""

    def say(t):
        if t < FAULT:
            return [good(t)]
        start = wave(FAULT)
        return [
            Message("a", 100 + t + 1e-5 * i, start | {"shoulder": 0.02 * i + start["shoulder"]})
            for i in range(50)
        ]

    recording, _, _, targets = live(arm, say)
    shoulder = np.array(
        [r.target[0] for r in recording.rows if r.target is not None and r.phase == "run"]
    )
    assert np.abs(np.diff(shoulder)).max() <= SafetyConfig().speed * 2 * DT + 1e-9
    assert targets.counts["refused"]["speed"] > 1000
    judge(arm, recording)


def test_a_target_a_little_out_of_range_is_brought_into_it(arm):
    recording, *_ = live(
        arm, lambda t: [Message("a", 100 + t, {"shoulder": min(1.65, t), "elbow": 0.0})]
    )
    assert recording.fault is None
    assert max(r.target[0] for r in recording.rows if r.target is not None) == 1.5
    judge(arm, recording)


@pytest.mark.parametrize("most", [50.0, 10.0])
@pytest.mark.parametrize(
    "shoulder",
    [
        lambda t: 0.09 * (-1) ** round(t / DT),
        lambda t: 0.5 * np.sin(3.5 * t),
        lambda t: 0.05 * min(int(t / DT), 14),
    ],
    ids=["buzz", "swing", "a ramp that stops"],
)
def test_no_sender_makes_a_command_accelerate_beyond_the_limit(arm, shoulder, most):
    config = LiveConfig(hold=HOLD, wait=3.0, acceleration=most)
    recording, *_ = live(
        arm,
        lambda t: [Message("a", 100 + t, {"shoulder": shoulder(t), "elbow": 0.0})],
        config=config,
    )
    assert recording.fault is None
    at = np.array([r.ctrl[0] for r in recording.rows if r.phase == "run"])
    assert np.abs(np.diff(at, 2)).max() <= most * DT**2 * (1 + 1e-9)
    assert np.abs(np.diff(at)).max() <= SafetyConfig().speed * DT + 1e-12
    judge(arm, recording)


@pytest.mark.parametrize("rate", [0.2, 1.0, 3.0, 5.0])
def test_a_target_is_reached_without_overshoot_and_a_ramp_is_followed_as_near_as_it_can_be_stopped(
    rate,
):
    change = 50.0 * DT**2
    fastest = 5.0 * DT
    at = step = np.zeros(1)
    for k in range(200):
        target = np.array([rate * DT * min(k, 100)])
        before = step
        step = next_step(step, target - at, fastest, change)
        at = at + step
        assert at <= target + 1e-12
        assert np.abs(step - before) <= change + 1e-12
        if k == 100:
            behind = rate**2 / 100 - rate * DT / 2  # v²/2a, less half of this period's step
            assert target - at == pytest.approx(max(behind, 0), abs=1e-9)
    assert at == pytest.approx(target)
    assert step == pytest.approx(0, abs=1e-12)


def test_after_its_end_a_sender_moves_the_robot_no_more(arm):
    clock = SimulatedClock()
    transport = Scripted(clock, lambda t: [Message("a", 100 + t, {"shoulder": 2 * t}, end=t > 0.2)])
    targets = LiveTargets(transport, arm, arm.joint_names, clock, DT, SafetyConfig().speed)
    state = SimpleNamespace(time=0.0, qpos=np.zeros(2), qvel=np.zeros(2), tau=np.zeros(2))
    out = []
    for k in range(100):
        out.append(targets(k if k > 1 else 0, state))
        if out[-1] is None:
            break
        clock.wait_until(clock.now() + DT)
    last = np.array([x[0] for x in out[2:-1]])
    assert last[-1] == pytest.approx(2 * 0.22, abs=0.05)  # the target that came with the end
    assert last[-1] - last[-2] <= 50 * DT**2 + 1e-12  # at rest, as far as one period can tell


def test_joints_that_are_not_named_stay_where_they_were_found(arm):
    recording, *_ = live(arm, lambda t: [Message("a", 100 + t, {"elbow": wave(t)["elbow"]})])
    assert recording.fault is None
    assert np.ptp([r.target[0] for r in recording.rows if r.target is not None]) < 0.01


def test_until_the_first_target_nothing_is_commanded_and_not_for_ever(arm):
    recording, driver, *_ = live(arm, lambda t: [], seconds=4.0)
    assert phases(recording) == ["idle", "stopped"]
    assert recording.fault.kind == "silence"
    assert "no target came on nowhere in 3 s" in recording.fault.text
    assert driver.sent == []
    recording, driver, *_ = live(
        arm, lambda t: [good(t)] if t > 2.0 else [Message("a", 99.0)], seconds=4.0
    )
    assert recording.fault is None, (
        "patience for the robot begins anew while a target is waited for"
    )


def test_a_sender_that_dies_while_the_robot_goes_to_its_first_target_ends_in_damping(arm):
    recording, *_ = live(arm, lambda t: [good(t)] if t < 0.1 else [], config=LiveConfig(hold=0.1))
    assert phases(recording) == ["idle", "blend_in", "damp", "stopped"]
    assert recording.fault.kind == "silence"
    assert "no target was accepted" in recording.ending, "not how it was damped afterwards"
    judge(arm, recording)


def test_a_sender_that_ends_while_the_robot_goes_to_its_first_target_has_not_died(arm):
    driver = NotedArm(arm)
    transport = Scripted(
        driver.clock,
        lambda t: [good(t)] if t < 0.2 else [Message("a", 100.2, end=True)] if t < 0.3 else [],
    )
    targets = LiveTargets(
        transport, arm, driver.commanded, driver.clock, DT, SafetyConfig().speed, LiveConfig()
    )
    recording = control(driver, config=replace(QUICK, blend=2.0)).run(targets)
    assert recording.fault is None
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]


SEARCH_S = 2.0  # of a long search for a clear path


class Waiting(Scripted):
    """A sender that says something only where it has heard a state."""

    def __init__(self, clock, joints, silence):
        """silence: It says nothing for so many s after its first target."""
        super().__init__(clock, None)
        self.joints = joints
        self.silence = silence
        self.said = []
        self.first = None

    def receive(self):
        said = self.said
        self.said = []
        return said

    def publish(self, to, state):
        now = self.clock.now()
        if self.first is not None and now < self.first + self.silence:
            return
        self.first = now if self.first is None else self.first
        self.said = [Message("a", now, dict.fromkeys(self.joints, 0.0))]


@pytest.mark.parametrize("silence", [0.0, SEARCH_S + 0.5])
def test_a_sender_that_waits_survives_a_search_that_takes_long(so101, silence):
    clock = SimulatedClock()
    transport = Waiting(clock, so101.joint_names, silence)
    config = ControlConfig(blend=0.3, blend_speed=2.0, settle=0.1, damp=0.1)
    targets = LiveTargets(transport, so101, so101.joint_names, clock, DT, 5.0)
    controller = Controller(NotedArm(so101, clock), so101, config=config, clock=clock)
    begin = controller.readiness.context.planner.begin

    def slow(first, found):
        until = clock.now() + SEARCH_S
        while clock.now() < until:
            clock.advance(0.005)
            yield
        return (yield from begin(first, found))

    controller.readiness.context.planner.begin = slow
    recording = controller.run(lambda k, state: targets(k, state) if k < 20 else None)
    assert recording.fault is None, recording.fault
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]


def test_a_message_without_a_clock_is_taken_as_it_comes(arm):
    recording, *_ = live(arm, lambda t: [good(t)._replace(time=None)])
    assert recording.fault is None


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"null",
        b"[]",
        b"{}",
        b'{"time": NaN, "target": {}}',
        b'{"time": 1, "target": {"a": Infinity}}',
        b"\xff\xfe",
        b'{"time": 1, "target": [1, 2]}',
        b'{"time": 1, "targets": {}}',
        b'{"time": true}',
        b"[" * 10000,
        b'{"time": 1' + b"0" * 10000 + b"}",
        b" " * (MAX_MESSAGE_BYTES + 1),
        b'{"time": 1, "target": {"a": ' + b"[" * 9000,
    ],
)
def test_what_is_no_message_says_so(data):
    heard = decode("a", data)
    assert heard.error
    assert heard.target is None
    assert not heard.end


def test_times_and_acceleration_must_be_positive():
    for name in ("hold", "late", "wait", "acceleration"):
        with pytest.raises(UsageError, match=name):
            LiveConfig(**{name: -1})
    for name in ("hold", "late"):
        with pytest.raises(UsageError, match=name):
            LiveConfig(**{name: 500})


def test_nothing_is_taken_apart_for_the_first_time_while_the_robot_moves(arm):
    type_adapter.cache_clear()
    LiveTargets(SimpleNamespace(address="here"), arm, arm.joint_names, SimulatedClock(), DT, 5.0)
    made = type_adapter.cache_info().misses
    assert decode("a", b'{"time": 1.0, "target": {"shoulder": 0.1}}').error == ""
    assert made == type_adapter.cache_info().misses == 1


def test_the_sender_is_told_what_a_policy_is_to_see_beside_what_is_measured(arm):
    driver = NotedArm(arm)
    transport = Scripted(driver.clock, lambda t: [good(t)] if t < 1.0 else [])
    targets = LiveTargets(transport, arm, driver.commanded, driver.clock, DT, SafetyConfig().speed)
    targets.observe = lambda qpos: (qpos + 0.1, np.full(2, 0.2))

    control(driver).run(targets)

    _, told = transport.states[-1]
    np.testing.assert_allclose(told["nominal_qpos"], np.array(told["qpos"]) + 0.1)
    assert told["nominal_qvel"] == [0.2, 0.2]
