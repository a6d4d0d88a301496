"""The controller on a virtual arm in simulated time: phases, faults, what is sent, what is recorded."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
from arm import commands

from gaponet.base.errors import LogError, UsageError
from gaponet.data.importer import import_logs
from gaponet.data.sequence import SequenceMeta, to_sequence
from gaponet.hw.control.clock import MonotonicClock, SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError, Fault
from gaponet.hw.control.phases import COMMANDING, ControlConfig
from gaponet.hw.control.plan import Plan
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.targets.policy import play
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.motion.motion import Motion
from gaponet.sysid.motion.path_planner import Trajectory
from gaponet.testing.fleet import load_fleet
from gaponet.testing.virtual_driver import VirtualDriver

QUICK = ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1, damp=0.1)
MOTION = Motion("sway", "whole_body", 0.02, commands(40, seed=1))


class Tampered(VirtualDriver):
    """A virtual arm that lies, is late or goes silent from some time after its connection on; notes what it is sent."""

    def __init__(self, robot: RobotSpec, clock: SimulatedClock, at: float = np.inf, kind: str = "") -> None:
        super().__init__(robot, load_fleet("easy", robot).unit("virtual-1"), clock, period=0.01)
        self.at, self.kind = at, kind
        self.sent: list[tuple[float, np.ndarray | None]] = []

    def read(self):
        honest = super().read()
        passed = self.clock.now() - self._begun
        if passed < self.at:
            self.last = honest
            return honest
        wrong = np.eye(2)[0]
        return {
            "stops": lambda: self.last,
            "late": lambda: dataclasses.replace(honest, time=honest.time - 0.1),
            "freezes": lambda: dataclasses.replace(self.last, time=honest.time),
            "nan": lambda: dataclasses.replace(honest, qpos=honest.qpos + np.nan * wrong),
            "jumps": lambda: dataclasses.replace(honest, qpos=honest.qpos + 0.8 * wrong),
            "hot": lambda: dataclasses.replace(honest, temperature=honest.temperature + 70 * wrong),
            "bus": self._fail,
            "encoder": lambda: dataclasses.replace(honest, qpos=np.where(wrong, self.last.qpos, honest.qpos)),
            "leans": lambda: dataclasses.replace(honest, tilt=0.8),
            "told": lambda: dataclasses.replace(honest, fault=Fault("robot", "a motor reports an error")),
        }[self.kind]()

    def _fail(self):
        raise DriverError("the cable is out")

    def write(self, ctrl, weight=1.0):
        self.sent.append((self.clock.now(), ctrl.copy()))
        super().write(ctrl, weight)

    def damp(self, weight=1.0, share=0.0):
        self.sent.append((self.clock.now(), None))
        super().damp(weight, share)


def run(robot: RobotSpec, driver: VirtualDriver, motion: Motion = MOTION, **how: object) -> Recording:
    controller = Controller(driver, robot, config=how.pop("config", QUICK), clock=driver.clock, **how)
    return controller.run(play(motion, controller.dt))


def watchdog(**how: object) -> SimpleNamespace:
    """A watchdog without a process, to which nothing happens but `how`."""
    quiet = {"trouble": str, "fired": bool, "beat": lambda weight: True}
    return SimpleNamespace(**quiet | {"release": lambda loose: None, "wait_ready": lambda: None} | how)


def phases(recording: Recording) -> list[str]:
    return [event.phase for event in recording.events]


def test_a_run_goes_through_all_phases_and_follows_the_motion(arm):
    driver = Tampered(arm, SimulatedClock())
    recording = run(arm, driver)
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]
    assert recording.fault is None
    log = recording.log()
    np.testing.assert_allclose(log.channels["ctrl"].values, MOTION.ctrl, atol=1e-12)
    assert np.abs(log.channels["ctrl"].values - log.channels["qpos"].values).max() < 0.2
    assert recording.virtual
    assert recording.missed == 0


def test_nothing_is_collected_while_it_runs_and_nothing_piles_up_for_it(arm):
    passes: list[bool] = []

    class Watching(Tampered):
        def read(self):
            passes.append(gc.isenabled())
            return super().read()

    run(arm, Watching(arm, SimulatedClock()))
    assert passes
    assert not any(passes)
    assert gc.isenabled()
    gc.collect()
    gc.disable()  # else the first pass afterwards might come before we count
    try:
        recording = run(arm, Tampered(arm, SimulatedClock()))
        assert gc.collect() < len(recording.rows) / 2, "cycles, which only a collection frees"
    finally:
        gc.enable()


def test_its_recording_can_be_imported_and_trained_on(arm, tmp_path):
    recording = run(arm, Tampered(arm, SimulatedClock()), metadata={"unit_id": "virtual-1"}, payload_mass=0.0)
    meta = SequenceMeta(arm.name, "virtual-1", "sway", 0.0, virtual=True)
    sequence = to_sequence(recording.log(), arm, meta)
    assert sequence.meta.notes["rows"] == "as recorded"
    assert sequence.dt == 0.02
    recording.save(tmp_path / "logs", "sway")
    report = import_logs(tmp_path / "logs", arm, "virtual-1", 0.0, tmp_path / "set", position_unit="rad", time_unit="s")
    stored = report.dataset.read(report.entries[0])
    np.testing.assert_allclose(stored.ctrl, sequence.ctrl, atol=1e-6)
    np.testing.assert_allclose(stored.qpos, sequence.qpos, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "reason", "periods"),
    [
        ("stops", "stale", 3), ("late", "stale", 1), ("freezes", "frozen", 2), ("nan", "nan", 1), ("jumps", "jump", 1),
        ("hot", "temperature", 1), ("bus", "driver", 1),
        ("encoder", "frozen", 25), ("leans", "tilt", 1), ("told", "robot", 1),
    ],
)  # fmt: skip
def test_every_fault_ends_in_damp_with_its_reason(arm, kind, reason, periods):
    driver = Tampered(arm, SimulatedClock(), at=0.801, kind=kind)
    recording = run(arm, driver)
    assert phases(recording) == ["idle", "blend_in", "run", "damp", "stopped"]
    assert recording.fault is not None
    assert recording.fault.kind == reason
    damped = next(t for t, ctrl in driver.sent if ctrl is None)
    assert 0 < damped - 0.801 <= periods * 0.02
    assert all(ctrl is None for t, ctrl in driver.sent if t >= damped), "a position command after the fault"


def test_a_robot_that_is_never_well_is_never_commanded(arm, monkeypatch):
    monkeypatch.setattr("gaponet.hw.control.target.PATIENCE_S", 0.3)
    driver = Tampered(arm, SimulatedClock(), at=0.0, kind="hot")
    recording = run(arm, driver)
    assert phases(recording) == ["idle", "stopped"]
    assert driver.sent == []
    with pytest.raises(LogError, match="0 periods of phase 'run', nothing to learn from; it ended with: never ready"):
        recording.log()


def test_a_robot_is_commanded_after_five_good_states_in_a_row(arm):
    class Once(Tampered):
        reads = 0

        def read(self):
            self.reads += 1
            state = super().read()
            return dataclasses.replace(state, tilt=0.8) if self.reads == 4 else state

    recording = run(arm, Once(arm, SimulatedClock()))
    assert recording.fault is None
    assert sum(r.phase == "idle" for r in recording.rows) == 4 + 5 - 1, "the fifth one is commanded already"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"])
def test_a_signal_takes_effect_in_the_next_period(arm, name):
    driver, motion = Tampered(arm, SimulatedClock()), play(MOTION, 0.02)

    def policy(k, state):
        if k == 20:
            os.kill(os.getpid(), signal.Signals[name])
            time.sleep(0)
        return motion(k, state)

    recording = Controller(driver, arm, config=QUICK, clock=driver.clock).run(policy)
    assert (recording.fault.kind, recording.fault.text) == ("stop", f"asked to stop: {name}")
    assert sum(r.phase == "run" for r in recording.rows) == 21


@pytest.mark.parametrize("phase", ["idle", *COMMANDING])
def test_a_stop_in_any_phase_damps_a_robot_that_was_commanded(arm, phase):
    class Watched(Tampered):
        at_end = "hand_over"

        def read(self):
            if controller.phase == phase and len(controller.recording.rows) % 3 == 2:
                controller.stop("the operator")
            return super().read()

    driver = Watched(arm, SimulatedClock())
    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    recording = controller.run(play(MOTION, 0.02))
    assert "asked to stop: the operator" in recording.fault.text
    assert phases(recording)[-3:] == (["idle", "stopped"] if phase == "idle" else [phase, "damp", "stopped"])
    assert [t for t, ctrl in driver.sent if ctrl is not None and t >= recording.fault.time] == []
    assert bool(driver.sent) == (phase != "idle"), "nothing was commanded, so nothing is sent"


def test_a_robot_is_damped_for_two_seconds_and_no_longer(arm):
    driver = Tampered(arm, SimulatedClock(), at=0.801, kind="hot")
    recording = run(arm, driver, config=ControlConfig(blend=0.3, blend_speed=4.0, settle=0.1))
    damping = [t for t, ctrl in driver.sent if ctrl is None]
    assert 2.0 <= damping[-1] - damping[0] <= 2.02
    assert recording.events[-1].phase == "stopped"
    assert recording.events[-1].time == pytest.approx(damping[-1])


def test_a_joint_that_is_far_from_its_command_for_a_quarter_of_a_second_stops_the_robot(arm):
    class Blocked(Tampered):
        def read(self):
            state = super().read()
            if self.clock.now() < 0.8:
                self.held = state.qpos
                return state
            noise = 1e-5 * np.sin(1e3 * self.clock.now() * np.ones(2))
            return dataclasses.replace(state, qpos=self.held + noise, qvel=np.zeros(2))

    driver, safety = Blocked(arm, SimulatedClock()), SafetyConfig(tracking=0.1)
    away = Motion("away", "whole_body", 0.02, np.clip(0.01 * np.arange(100)[:, None] - [0.2, 0.2], -0.2, 0.5))
    recording = run(arm, driver, away, safety=safety)
    assert recording.fault.kind == "tracking"
    near = [r.time for r in recording.rows if r.ctrl is not None and np.abs(r.ctrl - r.state.qpos).max() <= 0.1]
    damped = next(t for t, ctrl in driver.sent if ctrl is None)
    assert 0.25 < damped - near[-1] <= 0.25 + 3 * 0.02, "the first command beyond it is a period later"


def test_a_stop_is_latched(arm):
    driver = Tampered(arm, SimulatedClock())
    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    controller.stop("first")
    controller.stop("second")
    assert phases(controller.run(play(MOTION, 0.02))) == ["idle", "stopped"]
    assert driver.sent == [], "nothing was commanded, so nothing is sent"
    assert "first" in controller.recording.events[1].text
    with pytest.raises(UsageError, match="runs once"):
        controller.run(play(MOTION, 0.02))


@pytest.mark.parametrize(("field", "value"), [("rate", 0.5), ("rate", 1001.0), ("rate", np.nan), ("damp", 0.0)])
def test_times_that_no_run_can_have_are_refused(field, value):
    with pytest.raises(UsageError, match=f"{field} is {value:g}"):
        ControlConfig(**{field: value})


def test_a_policy_that_gives_nan_or_crashes_leaves_the_robot_damped(arm):
    driver = Tampered(arm, SimulatedClock())
    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    recording = controller.run(lambda k, state: np.full(2, np.nan if k == 10 else 0.0))
    assert recording.fault.kind == "target"
    assert sum(r.phase == "run" for r in recording.rows) == 10, "damped in the period in which it is seen"

    driver = Tampered(arm, SimulatedClock())
    with pytest.raises(ZeroDivisionError):
        Controller(driver, arm, config=QUICK, clock=driver.clock).run(
            lambda k, state: np.zeros(2) / (1 if k < 9 else 1 // 0)
        )
    damping = [t for t, ctrl in driver.sent if ctrl is None]
    assert damping[-1] - damping[0] >= QUICK.damp, "the whole damping, as after any other fault"
    assert driver.sent[-1][1] is None


def test_a_listener_that_fails_does_not_keep_the_robot_from_damping(arm):
    def broken(event):
        if event.phase in ("run", "damp"):
            raise BrokenPipeError("no terminal")

    driver = Tampered(arm, SimulatedClock())
    with pytest.raises(BrokenPipeError):
        Controller(driver, arm, config=QUICK, clock=driver.clock, on_event=broken).run(play(MOTION, 0.02))
    assert driver.sent[-1][1] is None


@pytest.mark.parametrize("where", ["read", "policy", "compensator"])
def test_a_period_that_stood_still_sends_nothing(arm, where):
    clock = SimulatedClock()

    class Standing(Tampered):
        def read(self):
            state = super().read()
            stand("read")
            return state

    def stand(here, at=0.9):
        if here == where and clock.now() >= at and not stood:
            stood.append(clock.now())
            clock.wait_until(clock.now() + 0.7)

    class Model:
        def reset(self, target, payload_mass=None): ...

        def step(self, target, qpos, qvel):
            stand("compensator")
            return target

    stood: list[float] = []
    driver, motion = Standing(arm, clock), play(MOTION, 0.02)

    def policy(k, state):
        stand("policy")
        return motion(k, state)

    recording = Controller(driver, arm, config=QUICK, compensator=Model(), clock=clock).run(policy)
    assert recording.fault.kind == "overrun"
    assert recording.missed == round(0.7 / 0.02) - 1
    assert all(ctrl is None for t, ctrl in driver.sent if t > stood[0])


def test_handing_over_holds_the_arms_while_the_weight_goes_to_zero(arm):
    class Shared(Tampered):
        at_end = "hand_over"
        closed: list[bool]

        def write(self, ctrl, weight=1.0):
            weights.append((self.clock.now(), weight))
            super().write(ctrl, weight)

        def close(self, hold=False):
            self.closed = [hold]

    weights: list[tuple[float, float]] = []
    driver = Shared(arm, SimulatedClock())
    recording = run(arm, driver)
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "release", "stopped"]
    assert QUICK.damp <= recording.events[-1].time - recording.events[-2].time <= QUICK.damp + 2 * 0.02
    released = [w for t, w in weights if t >= recording.events[-2].time]
    assert released[0] == 1.0
    assert released[-1] == 0.0
    assert np.diff(released).max() <= 0
    assert all(ctrl is not None for _, ctrl in driver.sent), "no damping: the arms would sink"
    assert driver.closed == [True], "leaving sends nothing more"


def test_a_fault_while_little_is_handed_over_damps_with_that_little(arm):
    weights: list[float] = []

    class Shared(Tampered):
        def damp(self, weight=1.0, share=0.0):
            weights.append(weight)
            super().damp(weight, share)

    driver = Shared(arm, SimulatedClock(), at=0.2, kind="hot")
    recording = run(arm, driver)
    assert recording.fault.kind == "temperature"
    assert 0 < max(weights) < 0.7, "the robot keeps what it held"


@pytest.mark.parametrize("rows", [0, 1])
def test_a_policy_that_ends_at_its_first_step_goes_back(arm, rows):
    """Its only target is the goal of the blend: row 0, or where the robot was found if even that is no more given."""
    driver, controller = Tampered(arm, SimulatedClock()), None

    def policy(k, state):
        return np.full(2, 0.2) if controller.phase.value in ("idle", "blend_in")[: 1 + rows] else None

    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    recording = controller.run(policy)
    assert recording.fault is None
    assert phases(recording) == ["idle", "blend_in", "run", "blend_out", "stopped"]
    furthest = max(ctrl[0] for _, ctrl in driver.sent)
    assert furthest == pytest.approx(0.2 if rows else driver.sent[0][1][0], abs=0.02)


def test_the_wall_clock_may_be_set_while_it_runs(arm, monkeypatch):
    steps = iter(range(10**6))
    monkeypatch.setattr(time, "time", lambda: 1e9 * (-1) ** next(steps))
    monkeypatch.setattr(time, "time_ns", lambda: 10**18 * (-1) ** next(steps))
    assert run(arm, Tampered(arm, SimulatedClock())).fault is None


@pytest.mark.parametrize("during", ["read", "policy"])
@pytest.mark.parametrize("at", [0.06, 0.9])
def test_a_computer_that_was_suspended_sends_no_command_afterwards(arm, at, during):
    clock = SimulatedClock()
    suspended: list[float] = []

    def suspend(here):
        if here == during and clock.now() >= at and not suspended:
            suspended.append(clock.now())
            clock.suspended_s = 600.0

    class Suspended(Tampered):
        def read(self):
            suspend("read")
            return super().read()

    motion = play(MOTION, 0.02)

    def policy(k, state):
        suspend("policy")
        return motion(k, state)

    driver = Suspended(arm, clock)
    recording = Controller(driver, arm, config=QUICK, clock=clock).run(policy)
    assert recording.fault.kind == "suspend"
    assert "the computer was suspended for 600.0 s" in recording.fault.text
    after = [ctrl for t, ctrl in driver.sent if t >= suspended[0]]
    assert all(ctrl is None for ctrl in after)
    commanded = any(ctrl is not None for _, ctrl in driver.sent)
    assert bool(after) == commanded, "damped, or nothing was ever commanded"
    assert ("nothing was commanded" in recording.fault.text) == (not commanded)
    assert commanded or at < 0.5


def test_suspends_before_a_run_are_none_of_it(arm):
    driver = Tampered(arm, SimulatedClock())
    driver.clock.suspended_s = 3600.0
    assert run(arm, driver).fault is None


def test_time_that_the_computer_was_suspended_is_what_boottime_went_on_by(monkeypatch):
    clock, slept = MonotonicClock(), 12.5
    if not hasattr(time, "CLOCK_BOOTTIME"):
        assert clock.suspended() == 0.0
        return
    before, read = clock.suspended(), time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda which: read(which) + slept * (which == time.CLOCK_BOOTTIME))
    assert clock.suspended() - before == pytest.approx(slept, abs=0.01)


@pytest.mark.parametrize("trouble", ["the watchdog ended", "the watchdog does not answer"])
def test_a_watchdog_that_is_of_no_use_any_more_ends_the_run_damped(arm, trouble):
    driver = Tampered(arm, SimulatedClock())
    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    controller.output.watchdog = watchdog(trouble=lambda: trouble if driver.clock.now() >= 0.9 else "")
    recording = controller.run(play(MOTION, 0.02))
    assert recording.fault.text == f"asked to stop: {trouble}"
    damped = next(t for t, ctrl in driver.sent if ctrl is None)
    assert 0.9 <= damped <= 0.92


def test_a_compensator_acts_within_its_bounds(arm):
    class Greedy:
        def reset(self, target, payload_mass=None):
            assert payload_mass == 0.7
            self.resets = getattr(self, "resets", 0) + 1

        def step(self, target, qpos, qvel):
            return target + np.array([5.0, -0.01])

    greedy = Greedy()
    recording = run(arm, Tampered(arm, SimulatedClock()), compensator=greedy, payload_mass=0.7)
    rows = [r for r in recording.rows if r.phase == "run"]
    delta = np.array([r.ctrl - r.target for r in rows])
    assert greedy.resets == 1
    assert delta[:, 0].max() <= 0.5 + 1e-12
    np.testing.assert_allclose(delta[:, 1], -0.01, atol=1e-12)


def test_a_slow_start_of_the_compensator_is_not_taken_for_a_hang(arm):
    class Slow:
        def reset(self, target, payload_mass=None):
            assert not beats  # from the first beat on, the watchdog damps a robot that it hears nothing of
            clock.wait_until(clock.now() + 0.4)

        def step(self, target, qpos, qvel):
            return target

    def beat(weight):
        assert beats or not driver.sent, "from the first beat on it would damp the robot"
        beats.append(weight)
        return True

    beats: list[float] = []
    clock = SimulatedClock()
    driver = Tampered(arm, clock)
    controller = Controller(driver, arm, config=QUICK, compensator=Slow(), clock=clock)
    controller.output.watchdog = watchdog(beat=beat)
    assert controller.run(play(MOTION, controller.dt)).fault is None
    assert len(beats) > 40


def test_a_watchdog_damps_after_five_periods_for_as_long_as_the_controller_would(arm, monkeypatch):
    given: list[tuple[float, float]] = []
    monkeypatch.setattr(
        "gaponet.hw.control.controller.Watchdog",
        lambda spec, lock, hang, damp: given.append((hang, damp)) or watchdog(),
    )
    driver = Tampered(arm, SimulatedClock())
    driver.watchdog = dict
    assert run(arm, driver).fault is None
    assert given == [(pytest.approx(5 * 0.02), QUICK.damp)]


def test_no_command_leaves_once_the_watchdog_has_damped_the_robot(arm):
    fired: list[float] = []
    driver, motion = Tampered(arm, SimulatedClock()), play(MOTION, 0.02)

    def policy(k, state):
        if k == 20:
            fired.append(driver.clock.now())
        return motion(k, state)

    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    controller.output.watchdog = watchdog(fired=lambda: bool(fired))
    recording = controller.run(policy)
    assert recording.fault.text.endswith("the watchdog has damped the robot")
    assert driver.sent[-1][0] < fired[0], "neither a command nor a message that damps with another weight"


@pytest.mark.parametrize(("moved", "kind"), [(0.015, None), (0.025, "plan"), (1.0, "plan")])
def test_a_plan_counts_only_where_the_robot_still_is_where_it_was_found(arm, moved, kind):
    driver = Tampered(arm, SimulatedClock())
    driver.connect()
    controller = Controller(driver, arm, config=QUICK, clock=driver.clock)
    found = driver.read().qpos + np.array([0.0, moved])
    controller.plan = Plan(found, Trajectory.minimum_jerk(np.stack([found, MOTION.ctrl[0]]), 4.0, 50.0, 0.3), MOTION)
    recording = controller.run()
    assert (recording.fault.kind if recording.fault else None) == kind, recording.fault
    if kind:
        assert "elbow moved by" in recording.fault.text
        assert driver.sent == []


def test_damping_takes_the_stiffness_away_and_brakes(arm):
    driver = Tampered(arm, SimulatedClock())
    driver.connect()
    held = driver.read().qpos
    driver.clock.wait_until(0.5)
    assert np.abs(driver.read().qpos - held).max() < 0.02
    driver.damp()
    driver.clock.wait_until(0.9)
    sinking = driver.read()
    assert np.abs(sinking.qpos - held).max() > 0.05
    assert (np.abs(sinking.qvel) < 5).all()


def test_the_watchdog_tries_again_until_it_has_damped(capsys):
    from gaponet.hw.control.watchdog import _damp

    def fails(*calls: int, error: Exception, result: str = ""):
        def call(*values):
            made.append(values)
            if len(made) in calls:
                raise error
            return result

        made: list[tuple] = []
        call.made = made
        return call

    robot = SimpleNamespace(
        address="/dev/loose", connect=fails(1, 2, error=DriverError("the cable is out")), close=fails(error=OSError()),
        damp=fails(2, 3, error=OSError("a glitch")),
        confirm=fails(1, 2, error=DriverError("one servo does not answer"), result="let go"),
    )  # fmt: skip
    _damp(robot, 0.1, 0.5, connected=False)
    assert [len(call.made) for call in (robot.connect, robot.confirm, robot.close)] == [3, 3, 1]
    assert 0.5 >= robot.damp.made[0][0] > robot.damp.made[-1][0]
    said = capsys.readouterr().err
    assert "could NOT be damped: switch the supply off (the cable is out); trying again" in said
    assert "(one servo does not answer)" in said
    assert said.endswith("watchdog: /dev/loose let go\n")


def test_a_payload_that_torques_contradict_is_noted_two_seconds_into_the_run(arm):
    compensator = SimpleNamespace(reset=lambda *_: None, step=lambda target, *_: target, doubt="0.4 kg were stated")
    driver = Tampered(arm, SimulatedClock())
    recording = run(arm, driver, Motion("sway", "whole_body", 0.02, commands(120, seed=1)), compensator=compensator)
    started = next(event.time for event in recording.events if event.phase == "run")
    noted = [event.time for event in recording.events if event.text == "compensation: 0.4 kg were stated"]
    assert noted == [pytest.approx(started + 2.0, abs=0.021)]
