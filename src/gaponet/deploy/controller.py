"""Controller: plays targets on a robot at a fixed rate, within limits, and stops it when something is wrong.

    idle ─ fresh state ─→ blend_in ─ at the first target ─→ run ─ end ─→ blend_out ─ back ─→ release ─ time ─→ stopped
      │                       └── any fault, key, signal or call ──┴────────┴──────────────────┴──→ damp ─ time ─┘
      └── any fault, key, signal or call: nothing was commanded, so nothing is sent ──→ stopped

Only blend_in, run, blend_out and release send position commands. Damp is entered at once and for good: what caused it
is latched, and a controller that has stopped cannot be started again. docs/deploy-safety.md says what this guarantees.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Protocol

import numpy as np

from gaponet.arrays import Array
from gaponet.deploy.clock import Clock, MonotonicClock, uncollected
from gaponet.deploy.driver import Driver, DriverError, Fault, State
from gaponet.deploy.guard import Guard
from gaponet.deploy.phases import COMMANDING, NEXT, ControlConfig, Phase
from gaponet.deploy.publisher import sole_publisher
from gaponet.deploy.recording import Event, Recording, Row
from gaponet.deploy.safety import Limits, SafetyConfig, Watch, limit_command, limit_delta
from gaponet.deploy.stop import Keys, StopRequest, on_signal
from gaponet.deploy.targets.policy import NotYet, Policy
from gaponet.errors import UsageError
from gaponet.motion.minjerk import blend, move_time
from gaponet.robot import RobotSpec


class Compensates(Protocol):
    """Changes a target so that the robot ends up where the target says (deploy.compensator). All joints, (n)."""

    def reset(self, target: Array, payload_mass: float | None = None) -> None:
        """Begin at rest at `target` (n) rad, with a payload in kg or an unknown one; may take a while."""

    def step(self, target: Array, qpos: Array, qvel: Array) -> Array:
        """What to command so that the robot gets to `target`, (n) rad."""


HANG = 5.0  # control periods without a sign of life after which the guard process damps the robot
FRESH = 5  # periods in a row without a fault before anything is commanded
PATIENCE = 5.0  # s to wait for them
PROMPT = 0.001  # s between the last look at the clock and a command's leaving that its limits allow for


class Controller:
    """Plays targets on one robot, once: ramp to the start, track, hold or damp at the end."""

    def __init__(
        self,
        driver: Driver,
        robot: RobotSpec,
        config: ControlConfig | None = None,
        safety: SafetyConfig | None = None,
        compensator: Compensates | None = None,
        clock: Clock | None = None,
        guard: bool = True,
        payload_mass: float | None = None,
        on_event: Callable[[Event], None] = lambda event: None,
        on_connect: Callable[[Driver], None] = lambda driver: None,
        **meta: Any,
    ) -> None:
        """
        Args:
            driver: The robot; not yet connected.
            robot: Its type.
            config: Times of the phases.
            safety: Limits and watchdogs; default SafetyConfig().
            compensator: Turns targets into commands; without one targets are sent as they are.
            clock: Default the machine's monotonic clock.
            guard: Start the process that damps the robot if this one dies, where the driver has one.
            payload_mass: kg per hand, for the compensator and the recording; None if it is not known.
            on_event: Called with every change of phase.
            on_connect: Called with the driver once the robot has answered and nothing was commanded; may refuse it.
            meta: Kept with the recording (unit, model…).
        """
        self.driver, self.robot, self.compensator = driver, robot, compensator
        self.config, self.safety = config or ControlConfig(), safety or SafetyConfig()
        self.clock, self.dt = clock or MonotonicClock(), 1.0 / self.config.rate
        self.joints = robot.index(driver.commanded)
        self._adopt_servos()
        self.watch = Watch(driver.joint_names, self.joints, self.dt, self.safety, driver.noisy)
        self.stop = StopRequest()
        self.phase = Phase.IDLE
        self.recording = Recording(
            robot.name, driver.virtual, driver.joint_names, driver.commanded, self.dt,
            meta=meta | {"payload_mass": payload_mass},
        )  # fmt: skip
        self._use_guard, self._on_event, self._on_connect = guard, on_event, on_connect
        self._guard: Guard | None = None
        self._payload_mass, self._prepared = payload_mass, compensator is None
        self._ctrl: Array | None = None  # commanded joints
        self._weight: float | None = None  # that was sent last; None: nothing was ever commanded
        self._error: BaseException | None = None
        self._delta = np.zeros(len(self.joints))
        self._since = self._fresh = 0
        self._unfresh: Fault | None = None

    def run(self, policy: Policy, keys: bool = False) -> Recording:
        """Go through all phases and return what was recorded, when the policy ends or the run is stopped.

        Args:
            policy: Says the targets of the run, once a control period.
            keys: Whether any key on the terminal stops the run.

        Raises:
            DriverError: The robot could not be reached; nothing was commanded.
            UsageError: Another process commands it, or this controller has run before.
            Exception: What the policy or the compensator raised, after the robot has damped.
        """
        if self.phase is not Phase.IDLE or self.recording.events:
            raise UsageError("a controller runs once; make a new one")
        with ExitStack() as stack:
            stack.enter_context(uncollected())  # left last: the guard would take a collection for silence
            lock = stack.enter_context(sole_publisher(self.driver.address))
            stack.callback(lambda: self.driver.close(hold=not self._damped))
            self.driver.connect()
            self.recording.virtual = self.driver.virtual
            self._adopt_servos()
            self._on_connect(self.driver)
            gains = {name: getattr(self.driver, name)[self.joints].tolist() for name in ("kp", "kd")}
            self.recording.meta |= gains | self.driver.facts
            self._start_guard(lock, stack)
            stack.enter_context(on_signal(self.stop))
            self._loop(policy, stack.enter_context(Keys(self.stop)) if keys else None)
        if self._error:
            raise self._error
        return self.recording

    def _adopt_servos(self) -> None:
        driver = self.driver
        gains = (driver.kp, driver.kd)
        self.limits = Limits.of(self.robot, driver.commanded, self.safety, gains, driver.qpos_range)

    def _start_guard(self, lock: int, stack: ExitStack) -> None:
        spec = self.driver.guard() if self._use_guard else None
        if spec is None:
            return
        self._guard = Guard(spec, lock, HANG * self.dt, self.config.damp)
        stack.callback(self._guard.release)
        self._guard.wait_ready()

    def _loop(self, policy: Policy, keys: Keys | None) -> None:
        start, k, due = self.clock.now(), 0, 0  # due: the period that should follow the last one; k, the one that can
        for text in ("waiting for fresh states", *self.driver.facts.get("notes", ())):
            self._note(start, "", text)
        self._began = start
        while self.phase is not Phase.STOPPED:
            now = self.clock.wait_until(start + k * self.dt)
            self._due = start + due * self.dt
            if keys:
                keys.poll()
            if self._guard and not self._guard.alive() and not self._ended:
                self.stop("the guard process ended")
            self.recording.late.append(now - self._due)
            self._period(k, now, policy)
            lost = int((self.clock.now() - start) / self.dt) - k  # whole periods that this one ran over
            self.recording.missed += max(lost - 1, 0)
            k, due = k + max(1, lost), k + 1

    @property
    def _ended(self) -> bool:
        return self.phase in (Phase.DAMP, Phase.STOPPED)

    @property
    def _damped(self) -> bool:
        return any(event.phase == Phase.DAMP.value for event in self.recording.events)

    def _period(self, k: int, now: float, policy: Policy) -> None:
        """Read, judge, send, note. Whatever fails in it, the robot damps."""
        state = target = None
        try:
            state, fault = self._read(now)
            if fault:
                self._fail(k, now, fault)
            if self.phase is Phase.IDLE and state is not None:
                self._ready(k, now, state, policy)
            if self.phase in COMMANDING and state is not None:
                target = self._send(k, now, state, policy)
        except BaseException as error:  # raised again at the end
            self._error = self._error or error
            self._fail(k, now, Fault("error", f"{type(error).__name__}: {error}"))
        phase = self.phase
        if phase is Phase.DAMP:
            left = 1.0 - (now - self._damping_since) / self.config.damp
            self._damp(max(left, 0.0) * (self._weight or 0.0))
            if left <= 0:
                self._enter(Phase.STOPPED, k, now, "", "damped and let go")
        if state is not None:
            ctrl = None if target is None else self._full(self._ctrl, state)
            self.recording.rows.append(Row(now, phase.value, target, ctrl, state))

    def _read(self, now: float) -> tuple[State | None, Fault | None]:
        """The newest state, and what stops the robot now."""
        try:
            state = self.driver.read()
        except (DriverError, OSError) as error:
            return None, self._latched(Fault("driver", str(error)))
        fault = self.watch.check(now, state, self._ctrl, now - self._due)
        if self.phase is Phase.IDLE and (fault is None or fault.kind != "stop"):
            self._fresh, self._unfresh = (0, fault) if fault else (self._fresh + 1, None)
            fault = None
        return state, self._latched(fault)

    def _latched(self, fault: Fault | None) -> Fault | None:
        if self._ended:
            return None
        return Fault("stop", f"asked to stop: {self.stop.reason}") if self.stop.reason else fault

    def _fail(self, k: int, now: float, fault: Fault) -> None:
        """Damp; but send nothing if nothing was commanded, or if the guard has damped the robot already."""
        if self._ended:
            return
        if self._weight is None:
            self._enter(Phase.STOPPED, k, now, fault.kind, f"{fault.text}; nothing was commanded")
        elif self._guard and self._guard.fired():
            self._enter(Phase.STOPPED, k, now, fault.kind, f"{fault.text}; the guard process has damped the robot")
        else:
            self._enter(Phase.DAMP, k, now, fault.kind, fault.text)

    def _ready(self, k: int, now: float, state: State, policy: Policy) -> None:
        """Leave idle when states have been good for a while, and fix how long the way to the first target takes."""
        if self._fresh < FRESH:
            if now - self._began > PATIENCE:
                fault = self._unfresh or Fault("stale", "no fresh state")
                self._fail(k, now, Fault(fault.kind, f"never ready: {fault.text}"))
            return
        if not self._prepared:  # takes longer than a period; then wait for fresh states again
            assert self.compensator
            self.compensator.reset(state.qpos, self._payload_mass)
            self._prepared, self._fresh = True, 0
            return
        first = policy(0, state)
        if isinstance(first, Fault):
            self._began = now  # all else is well
            if not isinstance(first, NotYet):
                self._fail(k, now, first)
            return
        if first is None or not np.isfinite(first[self.joints]).all():
            self._fail(k, now, Fault("target", "the motion has no first target, or it is not a number"))
            return
        self._found = np.clip(state.qpos[self.joints], self.limits.low, self.limits.high)
        self._ctrl = self._found.copy()
        distance = np.abs(first[self.joints] - self._found).max()
        self._blend_time = float(move_time(distance, self.config.blend_speed, self.config.blend))
        self._enter(Phase.BLEND_IN, k, now, "", f"to the first target in {self._blend_time:.1f} s")

    def _send(self, k: int, now: float, state: State, policy: Policy) -> Array | None:
        """Send this period's command; the target (n) it was made from, or None if there was none to be sent."""
        target, weight = self._target(k, now, state, policy)
        if target is None:
            return None
        wanted = self._full(target, state)
        corrected = self.compensator.step(wanted, state.qpos, state.qvel) if self.compensator else wanted
        if not np.isfinite(target).all() or not np.isfinite(corrected[self.joints]).all():
            self._fail(k, now, Fault("target", "the motion or the model gave something that is not a number"))
            return None
        self._delta = limit_delta(corrected[self.joints] - target, self._delta, self.dt, self.limits)
        fault = self._leave(target + self._delta, weight, state)
        if fault:
            self._fail(k, now, fault)
        return None if fault else wanted

    def _leave(self, ctrl: Array, weight: float, state: State) -> Fault | None:
        """Limit a command and write it, or say why none may leave. A period that stood still sends nothing."""
        q, v, before = state.qpos[self.joints], state.qvel[self.joints], self._ctrl
        assert before is not None
        if self._guard and not self._guard.beat(weight):  # first, so that it counts from before the first command
            return Fault("stop", "the guard process ended")
        looked = -np.inf
        while (now := self.clock.now()) - looked > PROMPT:
            looked = now
            fault = self.watch.overrun(now - self._due)
            if fault or (self._guard and self._guard.fired()):
                return fault or Fault("overrun", "this process stood still")
            out = limit_command(ctrl, before, q, v, self.dt, self.limits, now + PROMPT - state.time)
        if not out.feasible.all():
            joint = self.driver.commanded[int(np.argmin(out.feasible))]
            if limit_command(ctrl, before, q, v, self.dt, self.limits).feasible.all():
                age = f"{(now - state.time) * 1e3:.0f} ms"
                return Fault(
                    "stale", f"the newest state is {age} old; no command is safe wherever {joint} can be by now"
                )
            return Fault("torque", f"{joint}: no command is within range, rate and torque")
        self._ctrl, self._weight = out.ctrl, weight
        try:
            self.driver.write(self._full(out.ctrl, state), weight)
        except (DriverError, OSError) as error:
            return Fault("driver", str(error))
        return None

    def _target(self, k: int, now: float, state: State, policy: Policy) -> tuple[Array | None, float]:
        """Target of the commanded joints, and how far the robot is handed over; None where the phase just ended."""
        passed = (k - self._since) * self.dt
        if self.phase is Phase.BLEND_IN and passed >= self._blend_time + self.config.settle:
            self._enter(Phase.RUN, k, now, "", "motion")
        asked = None
        if self.phase in (Phase.BLEND_IN, Phase.RUN):
            asked = policy(0 if self.phase is Phase.BLEND_IN else k - self._since, state)
        if isinstance(asked, Fault):
            self._fail(k, now, asked)
            return None, 0.0
        if self.phase is Phase.BLEND_IN:
            share = float(blend(np.array(passed / self._blend_time)))
            goal = self._found if asked is None else asked[self.joints]
            return self._found + share * (goal - self._found), min(1.0, passed / self._blend_time)
        if self.phase is Phase.RUN:
            if asked is not None:
                self._last = np.array(asked[self.joints], float)
                return self._last, 1.0
            if not self.config.blend_out:
                return self._end(k, now, "end of the motion")
            self._enter(Phase.BLEND_OUT, k, now, "end", "end of the motion")
            distance = np.abs(self._last - self._found).max()
            self._blend_time = float(move_time(distance, self.config.blend_speed, self.config.blend))
        passed = (k - self._since) * self.dt
        if self.phase is Phase.RELEASE:
            if self._weight == 0.0:
                self._enter(Phase.STOPPED, k, now, "", "handed over")
                return None, 0.0
            return self._last, max(1.0 - passed / self.config.damp, 0.0)
        if passed > self._blend_time + self.config.settle:
            self._last = self._found
            return self._end(k, now, "back where it was found")
        share = float(blend(np.array(passed / self._blend_time)))
        return self._last + share * (self._found - self._last), 1.0

    def _end(self, k: int, now: float, text: str) -> tuple[Array | None, float]:
        """The end of a run without fault, as the driver's robot can have it."""
        how = self.driver.at_end
        if how == "hand_over":
            self._enter(Phase.RELEASE, k, now, "end", f"{text}; held while it is handed over")
            return self._last, 1.0
        self._enter(Phase.STOPPED if how == "hold" else Phase.DAMP, k, now, "end", f"{text}; {how}")
        return None, 1.0

    def _full(self, values: Array | None, state: State) -> Array:
        """(n): values at the commanded joints, the measured position at the others."""
        out = np.array(state.qpos, float)
        out[self.joints] = values
        return out

    def _damp(self, weight: float) -> None:
        try:
            if self._guard and not self._guard.fired():
                self._guard.beat(weight)
            self.driver.damp(weight)
        except Exception as error:  # tried again in the next period
            if not isinstance(error, DriverError | OSError):
                self._error = self._error or error
            if not any(e.text == str(error) for e in self.recording.events):
                self._note(self.clock.now(), "driver", str(error))

    def _enter(self, phase: Phase, k: int, now: float, kind: str, text: str) -> None:
        if phase not in NEXT[self.phase]:
            raise AssertionError(f"{self.phase} → {phase}: {text}")
        self.phase, self._since = phase, k
        if phase is Phase.DAMP:
            self._damping_since, self._ctrl = now, None
        self._note(now, kind, text)

    def _note(self, now: float, kind: str, text: str) -> None:
        event = Event(now, self.phase.value, kind, text)
        self.recording.events.append(event)
        try:
            self._on_event(event)
        except Exception as error:  # a closed terminal, say
            self._error = self._error or error
            self.stop(f"its listener failed: {error}")
