"""The controller on a virtual arm in simulated time: phases, faults, what is sent, what is
recorded.
"""

from __future__ import annotations

import gc
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arm import commands
from hw.noted_arm import DT, MOTION, QUICK, NotedArm, acting, control, fake_watchdog, phases, run

from gaponet.base.errors import LogError, UsageError
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.sequence import SequenceMeta, to_sequence
from gaponet.hw.control.clock import MonotonicClock
from gaponet.hw.control.driver import DriverError, Fault
from gaponet.hw.control.phases import COMMANDING, ControlConfig, Phase
from gaponet.hw.control.plan import Plan
from gaponet.hw.targets.policy import motion_policy
from gaponet.motion.motion import Motion
from gaponet.motion.path_planner import Trajectory
from gaponet.robot.spec import RobotSpec

FAULT_S = 0.801  # after the connection: in the middle of the motion


class FaultyArm(NotedArm):
    """A virtual arm that goes wrong some time after its connection."""

    def __init__(self, robot: RobotSpec, at: float, kind: str) -> None:
        super().__init__(robot)
        self.at = at
        self.kind = kind

    def connect(self):
        super().connect()
        self.connected = self.clock.now()

    def read(self):
        honest = super().read()
        if self.clock.now() - self.connected < self.at:
            self.last = honest
            return honest
        if self.kind == "bus":
            raise DriverError("the cable is out")
        wrong = np.eye(2)[0]
        return {
            "stops": self.last if self.at else honest,
            "nan": replace(honest, qpos=honest.qpos + np.nan * wrong),
            "hot": replace(honest, temperature=honest.temperature + 70 * wrong),
            "error": replace(honest, fault=Fault("robot", "a motor reports an error")),
            "remote": replace(honest, fault=Fault("stop", "the operator's remote")),
        }[self.kind]


def test_a_run_goes_through_all_phases_follows_the_motion_and_ends_held(arm):
    driver = NotedArm(arm)
    recording = run(driver)
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]
    assert recording.fault is None
    log = recording.log()
    np.testing.assert_allclose(log.channels["ctrl"].values, MOTION.ctrl, atol=1e-12)
    assert np.abs(log.channels["ctrl"].values - log.channels["qpos"].values).max() < 0.2
    assert (recording.virtual, recording.missed) == (True, 0)
    assert driver.closed == [True], "leaving sends nothing more"


def test_no_garbage_is_collected_while_it_runs_and_none_piles_up(arm):
    passes: list[bool] = []
    run(NotedArm(arm, change=lambda state: [passes.append(gc.isenabled()), state][1]))
    assert passes
    assert not any(passes)
    assert gc.isenabled()
    gc.collect()
    gc.disable()  # else the first pass afterwards might come before we count
    try:
        recording = run(NotedArm(arm))
        assert gc.collect() < len(recording.rows) / 2, "cycles, which only a collection frees"
    finally:
        gc.enable()


def test_its_recording_can_be_imported_and_trained_on(arm, tmp_path):
    recording = run(NotedArm(arm), metadata={"unit_id": "virtual-1"}, payload_mass=0.0)
    sequence = to_sequence(
        recording.log(), arm, SequenceMeta(arm.name, "virtual-1", "sway", 0.0, virtual=True)
    )
    assert (sequence.meta.notes["rows"], sequence.dt) == ("as recorded", DT)
    recording.save(tmp_path / "logs", "sway")
    report = import_logs(
        tmp_path / "logs",
        arm,
        tmp_path / "set",
        ImportRequest(unit_id="virtual-1", payload_mass=0.0),
    )
    stored = report.dataset.read(report.entries[0])
    np.testing.assert_allclose(
        [stored.ctrl, stored.qpos], [sequence.ctrl, sequence.qpos], atol=1e-6
    )


def test_a_second_recording_of_a_name_does_not_replace_the_first(arm, tmp_path):
    recording = run(NotedArm(arm))
    first = recording.save(tmp_path / "logs", "sway")
    second = recording.save(tmp_path / "logs", "sway")
    third = recording.save(tmp_path / "logs", "sway")
    names = [Path(file).stem for file in (first, second, third)]
    assert names == ["sway", "sway-2", "sway-3"]


@pytest.mark.parametrize(
    ("kind", "reason", "periods"),
    [
        ("stops", "stale", 3),
        ("nan", "nan", 1),
        ("hot", "temperature", 1),
        ("bus", "driver", 1),
        ("error", "robot", 1),
        ("remote", "stop", 1),
    ],
)
def test_a_fault_of_state_driver_or_operator_ends_in_damp_with_its_reason(
    arm, kind, reason, periods
):
    driver = FaultyArm(arm, FAULT_S, kind)
    recording = run(driver)
    assert phases(recording) == ["idle", "blend_in", "run", "damp", "stopped"]
    assert recording.fault.kind == reason
    assert 0 < driver.damped - driver.clock.start - FAULT_S <= periods * DT
    assert all(t < driver.damped for t, _ in driver.commands), "a position command after the fault"
    assert driver.closed == [False], "it is not left with its last command"
    assert (max(driver.shares) > 0.9) == (reason in ("stale", "driver", "stop")), (
        "lowered, or let go at once"
    )


@pytest.mark.parametrize(("kind", "seconds"), [("hot", 0.3), ("remote", 0.0)])
def test_a_robot_that_is_never_well_is_never_commanded(arm, monkeypatch, kind, seconds):
    monkeypatch.setattr("gaponet.hw.control.target.MAX_WAIT_S", 0.3)
    driver = FaultyArm(arm, 0.0, kind)
    recording = run(driver)
    assert phases(recording) == ["idle", "stopped"]
    assert driver.sent == []
    waited = recording.events[-1].time - recording.events[0].time
    assert seconds <= waited <= seconds + 2 * DT, "a stop is not waited out"
    with pytest.raises(LogError, match="ended"):
        recording.log()


def test_a_robot_is_commanded_after_five_good_states_in_a_row(arm):
    reads = iter(range(10**6))
    recording = run(
        NotedArm(arm, change=lambda state: replace(state, tilt=0.8) if next(reads) == 3 else state)
    )
    assert recording.fault is None
    assert sum(r.phase == "idle" for r in recording.rows) == 4 + 5 - 1, (
        "the fifth one is commanded already"
    )


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"])
def test_a_signal_takes_effect_in_the_next_period(arm, name):
    recording = control(NotedArm(arm)).run(
        acting(lambda: os.kill(os.getpid(), signal.Signals[name]))
    )
    assert (recording.fault.kind, recording.fault.text) == ("stop", f"asked to stop: {name}")
    assert sum(r.phase == "run" for r in recording.rows) == 21


@pytest.mark.parametrize("phase", ["idle", *COMMANDING])
def test_a_stop_in_any_phase_damps_a_robot_that_was_commanded(arm, phase):
    def stop(state):
        if controller.phase == phase and len(controller.recording.rows) % 3 == 2:
            controller.stop("the operator")
        return state

    driver = NotedArm(arm, change=stop)
    driver.at_end = "hand_over"
    controller = control(driver)
    recording = controller.run(motion_policy(MOTION, DT))
    assert "asked to stop: the operator" in recording.fault.text
    assert phases(recording)[-3:] == (
        ["idle", "stopped"] if phase == "idle" else [phase, "damp", "stopped"]
    )
    assert [t for t, _ in driver.commands if t >= recording.fault.time] == []
    assert bool(driver.sent) == (phase != "idle"), "nothing was commanded, so nothing is sent"


def test_a_robot_is_damped_for_two_seconds_while_its_weight_goes_to_zero_and_the_watchdog_is_fed(
    arm,
):
    beats: list[float] = []
    driver = FaultyArm(arm, FAULT_S, "hot")
    controller = control(driver, config=ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1))
    controller.output.watchdog = fake_watchdog(beat=lambda weight: beats.append(weight) or True)
    recording = controller.run(motion_policy(MOTION, DT))
    damping = [t for t, ctrl in driver.sent if ctrl is None]
    assert 2.0 <= damping[-1] - damping[0] <= 2.02
    last = recording.events[-1]
    assert last.phase == "stopped"
    assert last.time - damping[-1] == pytest.approx(0.0, abs=1e-6)
    weights = [weight for t, weight in driver.weights if t >= driver.damped]
    assert (weights[0], weights[-1]) == (1.0, 0.0)
    assert (np.diff(weights) < 0).all()
    assert beats == [weight for _, weight in driver.weights], (
        "else it would damp with an old weight"
    )


def test_a_stop_is_latched(arm):
    driver = NotedArm(arm)
    controller = control(driver)
    controller.stop("first")
    controller.stop("second")
    assert phases(controller.run(motion_policy(MOTION, DT))) == ["idle", "stopped"]
    assert driver.sent == [], "nothing was commanded, so nothing is sent"
    assert "first" in controller.recording.events[1].text
    with pytest.raises(UsageError, match="once"):
        controller.run(motion_policy(MOTION, DT))


def test_a_driver_with_another_order_of_joints_is_refused_before_it_connects(arm):
    driver = NotedArm(arm)
    driver.joint_names = arm.joint_names[::-1]
    with pytest.raises(UsageError, match="one order"):
        control(driver)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate", 0.5),
        ("rate", 1001.0),
        ("rate", np.nan),
        ("damp", 0.0),
        ("settle", -1.0),
        ("settle", np.nan),
        ("blend", np.inf),
    ],
)
def test_times_that_no_run_can_have_are_refused(field, value):
    with pytest.raises(UsageError, match=field):
        ControlConfig(**{field: value})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_first_target_that_ceases_to_be_a_number_is_refused_without_a_warning(arm, wrong):
    targets = iter([0.3])

    recording = control(NotedArm(arm)).run(lambda k, state: np.full(2, next(targets, wrong)))

    assert recording.fault.kind == "target"


def test_a_policy_that_gives_nan_leaves_the_robot_damped(arm):
    driver = NotedArm(arm)
    recording = control(driver).run(lambda k, state: np.full(2, np.nan if k == 10 else 0.0))
    assert recording.fault.kind == "target"
    assert sum(r.phase == "run" for r in recording.rows) == 10, (
        "damped in the period in which it is seen"
    )
    assert driver.sent[-1][1] is None


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_compensator_that_gives_no_number_leaves_the_robot_damped(arm, wrong):
    driver = NotedArm(arm)
    periods: list[int] = []

    def step(target, *_):
        periods.append(len(periods))
        return target + (wrong if len(periods) == 30 else 0.0)

    broken = SimpleNamespace(reset=lambda *_: None, step=step)
    recording = run(driver, compensator=broken)
    assert recording.fault.kind == "target"
    assert len(driver.commands) == 29
    assert driver.sent[-1][1] is None


@pytest.mark.parametrize(
    ("where", "error"),
    [
        ("policy", ZeroDivisionError),
        ("policy", SystemExit),
        ("policy", KeyboardInterrupt),
        ("listener", BrokenPipeError),
        ("damp", ZeroDivisionError),
    ],
)
def test_an_error_of_other_code_is_raised_after_the_robot_has_damped_for_the_whole_time(
    arm, where, error
):
    class Broken(NotedArm):
        def damp(self, weight=1.0, share=0.0):
            super().damp(weight, share)
            if where == "damp" and len(self.shares) < 3:
                raise error("not a bus error")

    def policy(k, state):
        if k == 9 and where == "policy":
            raise error
        return np.zeros(2) if k < 20 or where != "damp" else np.full(2, np.nan)

    def listen(event):
        if where == "listener" and event.phase in ("run", "damp"):
            raise error("no terminal")

    driver = Broken(arm)
    with pytest.raises(error):
        control(driver, on_event=listen).run(policy)
    damping = [t for t, ctrl in driver.sent if ctrl is None]
    assert damping[-1] - damping[0] >= QUICK.damp, "as after any other fault"
    assert driver.sent[-1][1] is None


def test_an_error_while_it_looks_for_stops_is_raised_after_the_robot_has_damped(arm):
    driver = NotedArm(arm)

    def problem() -> str:
        if len(driver.commands) > 20:
            raise ZeroDivisionError
        return ""

    controller = control(driver)
    controller.output.watchdog = fake_watchdog(problem=problem)
    with pytest.raises(ZeroDivisionError):
        controller.run(motion_policy(MOTION, DT))

    damping = [t for t, ctrl in driver.sent if ctrl is None]
    assert damping[-1] - damping[0] >= QUICK.damp
    assert driver.closed == [False]


@pytest.mark.parametrize("where", ["read", "policy", "compensator"])
def test_a_period_that_stood_still_sends_nothing(arm, where):
    stood: list[float] = []

    def stand(here, value):
        if here == where and driver.elapsed >= 0.9 and not stood:
            stood.append(driver.clock.now())
            driver.clock.wait_until(driver.clock.now() + 35.5 * DT)
        return value

    driver = NotedArm(arm, change=lambda state: stand("read", state))
    motion = motion_policy(MOTION, DT)
    model = SimpleNamespace(
        reset=lambda *_: None, step=lambda target, *_: stand("compensator", target)
    )
    recording = control(driver, compensator=model).run(
        lambda k, state: stand("policy", motion(k, state))
    )
    assert recording.fault.kind == "overrun"
    assert recording.missed == 34
    assert all(t <= stood[0] for t, _ in driver.commands)


def test_handing_over_holds_the_arms_while_the_weight_goes_to_zero(arm):
    driver = NotedArm(arm)
    driver.at_end = "hand_over"
    recording = run(driver)
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "release", "stopped"]
    assert (
        QUICK.damp <= recording.events[-1].time - recording.events[-2].time <= QUICK.damp + 2 * DT
    )
    released = [w for t, w in driver.weights if t >= recording.events[-2].time]
    assert (released[0], released[-1]) == (1.0, 0.0)
    assert np.diff(released).max() <= 0
    assert all(ctrl is not None for _, ctrl in driver.sent), "no damping: the arms would sink"
    assert driver.closed == [True], "leaving sends nothing more"


def test_a_run_that_ends_in_damping_sends_no_position_after_it(arm):
    driver = NotedArm(arm)
    driver.at_end = "damp"
    recording = run(driver)
    assert recording.fault is None
    assert phases(recording)[-2:] == ["damp", "stopped"]
    assert driver.commands[-1][0] < driver.damped
    assert driver.closed == [False]


def test_a_fault_while_little_is_handed_over_damps_with_that_little(arm):
    driver = FaultyArm(arm, 0.2, "hot")
    assert run(driver).fault.kind == "temperature"
    weights = [weight for t, weight in driver.weights if t >= driver.damped]
    assert 0 < max(weights) < 0.7, "the robot keeps what it held"


@pytest.mark.parametrize("rows", [0, 1])
def test_a_policy_that_ends_at_its_first_step_goes_back(arm, rows):
    """Its only target is the goal of the blend: row 0, or where the robot was found if even that
    is no more given.
    """
    driver = NotedArm(arm)
    controller = control(driver)
    given = ("idle", "blend_in")[: 1 + rows]
    recording = controller.run(
        lambda k, state: np.full(2, 0.2) if controller.phase.value in given else None
    )
    assert recording.fault is None
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]
    furthest = max(ctrl[0] for _, ctrl in driver.commands)
    assert furthest == pytest.approx(0.2 if rows else driver.commands[0][1][0], abs=0.02)


def test_the_wall_clock_may_be_set_while_it_runs(arm, monkeypatch):
    steps = iter(range(10**6))
    monkeypatch.setattr(time, "time", lambda: 1e9 * (-1) ** next(steps))
    monkeypatch.setattr(time, "time_ns", lambda: 10**18 * (-1) ** next(steps))
    assert run(NotedArm(arm)).fault is None


def sent_since(driver: NotedArm, time: float) -> list[np.ndarray | None]:
    return [ctrl for sent, ctrl in driver.sent if sent >= time]


@pytest.mark.parametrize("during", ["read", "policy"])
@pytest.mark.parametrize(("at", "slept"), [(0.06, 600.0), (0.9, 600.0), (0.9, 0.06)])
def test_a_computer_that_was_suspended_sends_no_command_afterwards(arm, at, slept, during):
    suspended: list[float] = []

    def suspend(here, value):
        if here == during and driver.elapsed >= at and not suspended:
            suspended.append(driver.clock.now())
            driver.clock.suspended_s = slept
        return value

    driver = NotedArm(arm, change=lambda state: suspend("read", state))
    motion = motion_policy(MOTION, DT)
    recording = control(driver).run(lambda k, state: suspend("policy", motion(k, state)))
    assert recording.fault.kind == "suspend"
    assert f"the computer was suspended for {slept:.1f} s" in recording.fault.text
    after = sent_since(driver, suspended[0])
    assert all(ctrl is None for ctrl in after)
    assert bool(after) == bool(driver.commands), "damped, or nothing was ever commanded"
    assert ("nothing was commanded" in recording.fault.text) == (not driver.commands)
    assert driver.commands or at < 0.5


def test_suspends_before_a_run_and_differences_between_clocks_are_no_fault(arm):
    def drift(state):
        driver.clock.suspended_s = 3600.0 + 0.04 * (driver.elapsed > 0.5)
        return state

    driver = NotedArm(arm, change=drift)
    driver.clock.suspended_s = 3600.0
    assert run(driver).fault is None


def test_time_that_the_computer_was_suspended_is_the_difference_of_two_clocks(monkeypatch):
    clock = MonotonicClock()
    slept = 12.5
    if not hasattr(time, "CLOCK_BOOTTIME"):
        assert clock.suspended() == 0.0
        return
    before = clock.suspended()
    read = time.clock_gettime
    monkeypatch.setattr(
        time, "clock_gettime", lambda number: read(number) + slept * (number == time.CLOCK_BOOTTIME)
    )
    assert clock.suspended() - before == pytest.approx(slept, abs=0.01)


# ---- watchdog


@pytest.mark.parametrize(
    ("part", "text"),
    [
        ("problem", "asked to stop: it hangs"),
        ("beat", "the watchdog ended"),
        ("fired", "the watchdog damps the robot"),
    ],
)
def test_no_command_leaves_that_the_watchdog_does_not_guard(arm, part, text):
    driver = NotedArm(arm)
    late = lambda: driver.elapsed >= 0.89  # noqa: E731
    parts = {
        "problem": lambda: "it hangs" * late(),
        "beat": lambda weight: not late(),
        "fired": late,
    }
    controller = control(driver)
    changes = {part: parts[part]}
    if part == "fired":
        changes["is_damping"] = late
    controller.output.watchdog = fake_watchdog(**changes)
    recording = controller.run(motion_policy(MOTION, DT))
    assert recording.fault.text.endswith(text)
    told = driver.clock.start + 0.89
    assert driver.commands[-1][0] < told
    if part == "fired":
        assert driver.sent[-1][0] < told, "nor a message that damps with another weight"
    else:
        assert told <= driver.damped <= told + DT


def test_a_controller_damps_the_robot_if_the_watchdog_died_of_it(arm):
    driver = NotedArm(arm)
    controller = control(driver)
    controller.output.watchdog = fake_watchdog(fired=lambda: driver.elapsed >= 0.89)
    recording = controller.run(motion_policy(MOTION, DT))
    assert phases(recording)[-2:] == ["damp", "stopped"]
    assert driver.damped <= driver.clock.start + 0.89 + DT


def test_a_robot_that_the_watchdog_took_at_the_end_is_not_said_to_hold(arm, monkeypatch):
    driver = NotedArm(arm)
    released: list[bool] = []
    monkeypatch.setattr(driver, "verify", lambda: released[0] or None, raising=False)
    controller = control(driver)
    controller.output.watchdog = fake_watchdog(
        release=released.append, fired=lambda: bool(released)
    )
    recording = controller.run(motion_policy(MOTION, DT))
    assert recording.fault.kind == "overrun"
    assert "the watchdog damps the robot" in recording.fault.text


@pytest.mark.parametrize("watched", [True, False])
def test_an_error_between_two_periods_leaves_no_robot_in_mid_motion_and_is_recorded(
    arm, monkeypatch, watched
):
    driver = NotedArm(arm)
    released: list[bool] = []
    if watched:
        dog = fake_watchdog(release=released.append)
        monkeypatch.setattr("gaponet.hw.control.controller.Watchdog", lambda *_: dog)
        driver.watchdog = dict
    controller = control(driver)
    end = controller.periods.end

    def end_or_fail() -> int:
        if driver.elapsed >= 0.89:
            raise RuntimeError("odd")
        return end()

    monkeypatch.setattr(controller.periods, "end", end_or_fail)
    with pytest.raises(RuntimeError, match="odd"):
        controller.run(motion_policy(MOTION, DT))
    assert controller.recording.ending == "RuntimeError: odd"
    if watched:
        assert set(released) == {True}, "the watchdog damps it"
    assert driver.closed == [watched], "without a watchdog the driver lets go"


@pytest.mark.parametrize("lives", [True, False])
def test_an_error_while_the_robot_is_lowered_leaves_it_to_a_watchdog_that_lives(
    arm, monkeypatch, lives
):
    driver = NotedArm(arm)
    released: list[bool] = []
    dog = fake_watchdog(release=released.append, can_damp=lambda: lives)
    monkeypatch.setattr("gaponet.hw.control.controller.Watchdog", lambda *_: dog)
    driver.watchdog = dict
    controller = control(driver)
    end = controller.periods.end

    def end_or_fail() -> int:
        if controller.phase is Phase.DAMP:
            raise MemoryError
        return end()

    monkeypatch.setattr(controller.periods, "end", end_or_fail)
    with pytest.raises(MemoryError):
        controller.run(acting(lambda: controller.stop("enough")))
    assert set(released) == {True}
    assert driver.closed == [lives], "two would write to one bus"


@pytest.mark.parametrize("survives", [True, False])
def test_a_robot_left_to_the_watchdog_is_damped_if_the_watchdog_dies_of_it(
    arm, monkeypatch, survives
):
    driver = NotedArm(arm)
    released: list[bool] = []
    late = lambda: driver.elapsed >= 0.89  # noqa: E731
    dog = fake_watchdog(
        fired=late,
        is_damping=late,
        release=released.append,
        can_damp=lambda: survives or not released,
    )
    monkeypatch.setattr("gaponet.hw.control.controller.Watchdog", lambda *_: dog)
    driver.watchdog = dict
    run(driver)
    assert driver.closed == [survives], "closed without a hold it is let go"


def test_while_the_watchdog_damps_the_controller_sends_nothing(arm, monkeypatch):
    driver = NotedArm(arm)
    late = lambda: driver.elapsed >= 0.95  # noqa: E731
    dog = fake_watchdog(fired=late, is_damping=late)
    monkeypatch.setattr("gaponet.hw.control.controller.Watchdog", lambda *_: dog)
    driver.watchdog = dict
    controller = control(driver)

    def stop_late() -> str:
        return "enough" * (driver.elapsed >= 0.89)

    dog.problem = stop_late
    recording = controller.run(motion_policy(MOTION, DT))
    told = driver.clock.start + 0.95
    assert driver.damped < told
    assert driver.sent[-1][0] < told, "two would write to one bus"
    assert "the watchdog damps the robot" in recording.events[-1].text
    assert driver.closed == [True]


def test_nobody_is_told_to_trust_a_watchdog_that_has_died(arm):
    driver = NotedArm(arm)
    driver.confirm = refusing
    controller = control(driver)
    controller.output.watchdog = fake_watchdog(can_damp=lambda: False)
    recording = controller.run(acting(lambda: controller.stop("enough")))
    assert "could NOT be damped" in recording.events[-1].text
    assert "goes on trying" not in recording.events[-1].text


def refusing() -> str:
    raise DriverError("no word that the torque is off")


def test_a_row_that_cannot_be_recorded_lowers_the_robot(arm, monkeypatch):
    driver = NotedArm(arm)
    controller = control(driver)
    append = controller.recording.rows.append

    def append_or_fail(row: object) -> None:
        if driver.elapsed >= 0.89:
            raise MemoryError
        append(row)

    monkeypatch.setattr(controller.recording.rows, "append", append_or_fail)
    with pytest.raises(MemoryError):
        controller.run(motion_policy(MOTION, DT))
    assert driver.damped <= driver.clock.start + 0.89 + 2 * DT
    assert driver.closed == [False]


def test_a_disk_that_is_full_in_mid_run_is_noted_once_and_stops_no_robot(arm):
    controller = control(NotedArm(arm))
    rows = controller.recording.rows

    def fill_disk() -> None:
        rows.error = "No space left on device"

    recording = controller.run(acting(fill_disk))
    assert recording.fault is None
    assert phases(recording)[-2:] == ["blend_out", "stopped"]
    assert sum("No space left" in event.text for event in recording.events) == 1


def test_without_a_place_for_its_recording_a_run_does_not_begin(arm, monkeypatch):
    driver = NotedArm(arm)

    def no_place(**_: object) -> None:
        raise FileNotFoundError("no usable temporary directory")

    monkeypatch.setattr("gaponet.hw.control.rows.tempfile.TemporaryFile", no_place)
    with pytest.raises(FileNotFoundError):
        run(driver)
    assert not driver.sent
    assert driver.closed == [True]


def test_a_watchdog_damps_after_five_periods_for_as_long_as_the_controller_would(arm, monkeypatch):
    given: list[tuple[float, float]] = []
    monkeypatch.setattr(
        "gaponet.hw.control.controller.Watchdog",
        lambda spec, lock, timeout, damp: given.append((timeout, damp)) or fake_watchdog(),
    )
    driver = NotedArm(arm)
    driver.watchdog = dict
    assert run(driver).fault is None
    assert given == [(pytest.approx(5 * DT), QUICK.damp)]


# ---- compensator, limits, plan


def test_a_compensator_acts_within_its_bounds(arm):
    masses: list[float] = []
    greedy = SimpleNamespace(
        reset=lambda target, mass: masses.append(mass),
        step=lambda target, *_: target + np.array([5.0, -0.01]),
    )
    recording = run(NotedArm(arm), compensator=greedy, payload_mass=0.7)
    delta = np.array([r.ctrl - r.target for r in recording.rows if r.phase == "run"])
    assert masses == [0.7]
    assert delta[:, 0].max() <= 0.5 + 1e-12
    np.testing.assert_allclose(delta[:, 1], -0.01, atol=1e-12)


def test_a_slow_start_of_the_compensator_is_not_taken_for_a_hang(arm):
    def reset(*_):
        assert not beats, (
            "from the first beat on, the watchdog damps a robot that it hears nothing of"
        )
        driver.clock.wait_until(driver.clock.now() + 0.4)

    def beat(weight):
        assert beats or not driver.sent, "from the first beat on it would damp the robot"
        beats.append(weight)
        return True

    beats: list[float] = []
    driver = NotedArm(arm)
    controller = control(
        driver, compensator=SimpleNamespace(reset=reset, step=lambda target, *_: target)
    )
    controller.output.watchdog = fake_watchdog(beat=beat)
    assert controller.run(motion_policy(MOTION, DT)).fault is None
    assert len(beats) > 40


def test_a_payload_that_torques_contradict_is_noted_two_seconds_into_the_run(arm):
    compensator = SimpleNamespace(
        reset=lambda *_: None, step=lambda target, *_: target, doubt="0.4 kg were stated"
    )
    recording = run(
        NotedArm(arm),
        Motion("sway", "whole_body", DT, commands(120, seed=1)),
        compensator=compensator,
    )
    started = next(event.time for event in recording.events if event.phase == "run")
    noted = [
        event.time for event in recording.events if event.text == "compensation: 0.4 kg were stated"
    ]
    assert noted == [pytest.approx(started + 2.0, abs=0.021)]


def test_limits_are_those_of_the_servos_once_they_are_connected(arm):
    class Soft(NotedArm):
        def connect(self):
            super().connect()
            self.kp = self.kp / 2
            self.qpos_range = np.array([[-0.1, 0.1], [-9.0, 9.0]])

    driver = Soft(arm)
    controller = control(driver)
    controller.run(motion_policy(MOTION, DT))
    np.testing.assert_array_equal(controller.limits.kp, arm.servo.kp / 2)
    assert max(abs(ctrl[0]) for _, ctrl in driver.commands) <= 0.08 + 1e-12


@pytest.mark.parametrize(("moved", "kind"), [(0.015, None), (0.025, "plan"), (1.0, "plan")])
def test_a_plan_counts_only_if_the_robot_still_is_at_its_start(arm, moved, kind):
    driver = NotedArm(arm)
    driver.connect()
    controller = control(driver)
    start = driver.read().qpos + np.array([0.0, moved])
    controller.plan = Plan(
        start, Trajectory.minimum_jerk(np.stack([start, MOTION.ctrl[0]]), 4.0, 50.0, 0.3), MOTION
    )
    recording = controller.run()
    assert (recording.fault.kind if recording.fault else None) == kind, recording.fault
    if kind:
        assert "elbow moved by" in recording.fault.text
        assert driver.sent == []


def test_a_controller_without_policy_and_plan_commands_nothing(arm):
    driver = NotedArm(arm)
    with pytest.raises(UsageError, match="play"):
        control(driver).run()
    assert (driver.sent, driver.closed) == ([], [True])


def test_damping_takes_the_stiffness_away_and_brakes(arm):
    driver = NotedArm(arm)
    driver.connect()
    held = driver.read().qpos
    driver.clock.wait_until(driver.clock.start + 0.5)
    assert np.abs(driver.read().qpos - held).max() < 0.02
    driver.damp()
    driver.clock.wait_until(driver.clock.start + 0.9)
    sinking = driver.read()
    assert np.abs(sinking.qpos - held).max() > 0.05
    assert (np.abs(sinking.qvel) < 5).all()
