"""Controller: plays targets on a robot at a fixed rate, within limits, and stops it after a fault.

phases.TRANSITIONS is its state machine. A fault is latched, and a controller that has stopped
cannot be started again. docs/deploy-safety.md lists the guarantees.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import Clock, MonotonicClock, no_garbage_collection
from gaponet.hw.control.driver import Driver, DriverError, Fault, State
from gaponet.hw.control.following import FollowingMonitor
from gaponet.hw.control.output import Context, Output
from gaponet.hw.control.phases import (
    COMMANDING,
    ENDED,
    MOVING,
    TRANSITION_TABLE,
    Action,
    ControlConfig,
    Phase,
    Trigger,
)
from gaponet.hw.control.plan import Plan, Planner, TargetCompensator
from gaponet.hw.control.publisher import sole_publisher
from gaponet.hw.control.recording import Event, Recording
from gaponet.hw.control.rows import Row
from gaponet.hw.control.safety import Limits, SafetyConfig, StateMonitor, lowers, spoils_data
from gaponet.hw.control.stop import StopKeys, StopRequest, stop_on_signals
from gaponet.hw.control.target import PhaseChange, Readiness, TargetGenerator
from gaponet.hw.control.watchdog import Watchdog
from gaponet.hw.targets.policy import Policy, motion_policy
from gaponet.robot.spec import RobotSpec

# Control periods without a heartbeat after which the watchdog damps the robot.
WATCHDOG_PERIODS = 5.0


class Controller:
    """Plays targets on one robot, once: go to the first target, track, hold or damp at the end."""

    def __init__(
        self,
        driver: Driver,
        robot: RobotSpec,
        *,
        config: ControlConfig | None = None,
        safety: SafetyConfig | None = None,
        compensator: TargetCompensator | None = None,
        clock: Clock | None = None,
        watchdog: bool = True,
        planner: Planner | None = None,
        unchecked: bool = False,
        payload_mass: float | None = None,
        on_event: Callable[[Event], None] = lambda event: None,
        on_connect: Callable[[Driver], None] = lambda driver: None,
        folder: Path | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """
        Args:
            driver: The robot; not yet connected.
            robot: Its model and nominal values.
            config: Times of the phases.
            safety: Limits and checks of states; default SafetyConfig().
            compensator: Turns targets into commands; without one targets are sent as they are.
            clock: Default the machine's monotonic clock.
            watchdog: Start the process that damps the robot if this one dies, if the driver
                supports one.
            planner: Checks the path to the first target, and live targets while the robot moves;
                default one without payload, for a robot that has shapes (collision.toml).
            unchecked: Use no default planner.
            payload_mass: kg per hand, for the compensator and the recording; None if it is not
                known.
            on_event: Called with every change of phase.
            on_connect: Called with the driver once the robot has answered and nothing was
                commanded; it refuses the run by an exception.
            folder: Folder in which the recording is written period by period; default a temporary
                file.
            metadata: Saved with the recording (unit id, model …).
        """
        self.driver = driver
        self.clock = clock or MonotonicClock()
        self.config = config or ControlConfig()
        self.dt = 1.0 / self.config.rate
        safety = safety or SafetyConfig()
        if planner is None and not unchecked and (robot.folder / "collision.toml").is_file():
            planner = Planner(robot, driver.commanded, self.config, safety)
        self.context = Context(
            driver,
            robot,
            self.config,
            safety,
            compensator,
            self.clock,
            planner,
            payload_mass,
            robot.index(driver.commanded),
            self.dt,
        )
        self.phase = Phase.CONNECT
        self.stop = StopRequest()
        self.recording = Recording(
            robot.name,
            driver.virtual,
            driver.joint_names,
            driver.commanded,
            self.dt,
            meta=(metadata or {}) | {"payload_mass": payload_mass},
        )
        self.monitor = StateMonitor(
            driver.joint_names, self.context.joints, self.dt, safety, driver.noisy
        )
        self.following = FollowingMonitor(self.context)
        self.output = Output(self.context, self.monitor)
        self.readiness = Readiness(self.context, self.output)
        self._targets: TargetGenerator | None = None
        self._folder = folder
        self._use_watchdog = watchdog
        self._on_event = on_event
        self._on_connect = on_connect
        self._k = 0  # this period
        self._now = 0.0  # its start, s
        self._phase_start = 0  # first period of the phase
        self._state: State | None = None  # last one
        self._error: BaseException | None = None  # of other code; raised when the robot is damped
        self._reported_full_disk = False

    @property
    def plan(self) -> Plan | None:
        """Plan whose motion is played; may be set until the run begins."""
        return self.readiness.plan

    @plan.setter
    def plan(self, plan: Plan) -> None:
        self.readiness.plan = plan

    @property
    def limits(self) -> Limits:
        """Limits of the commanded joints."""
        return self.output.limits

    def run(self, policy: Policy | None = None, keys: bool = False) -> Recording:
        """Go through all phases; return the recording when the policy ends or the run is stopped.

        Args:
            policy: Gives the target of each control period; None: the plan's motion is played.
            keys: Any key on the terminal, Ctrl-C included, stops the run.

        Raises:
            DriverError: The robot could not be reached; nothing was commanded.
            UsageError: Another process commands it, or this controller has run before.
            Exception: Any error of the policy or the compensator, raised after the robot has
                damped.
        """
        if self.phase is not Phase.CONNECT:
            raise UsageError("a controller runs once; make a new one")
        driver = self.driver
        output = self.output
        with ExitStack() as stack:
            # Left last: during a collection no heartbeat is sent.
            stack.enter_context(no_garbage_collection())
            lock = stack.enter_context(sole_publisher(driver.address))
            stack.callback(lambda: driver.close(hold=output.damping_since is None))
            driver.connect()
            self.recording.virtual = driver.virtual
            output.limits = output.servo_limits()
            self._on_connect(driver)
            stack.enter_context(stop_on_signals(self.stop))
            # Keys count from the consent on.
            pressed = stack.enter_context(StopKeys(self.stop)) if keys else None
            joints = self.context.joints
            gains = {"kp": driver.kp[joints].tolist(), "kd": driver.kd[joints].tolist()}
            self.recording.meta |= gains | driver.facts
            if self._folder:
                self.recording.write_to(self._folder)
            stack.callback(self.recording.rows.close)
            spec = driver.watchdog() if self._use_watchdog else None
            if spec is not None:
                patience = WATCHDOG_PERIODS * self.dt
                watchdog = Watchdog(spec, lock, patience, self.config.damp)
                output.watchdog = watchdog
                stack.callback(lambda: watchdog.release(output.unconfirmed))
                watchdog.wait_ready()
            self._loop(policy or self._policy_of_plan(), pressed)
            self._verify()
        if self._error:
            raise self._error
        return self.recording

    def _policy_of_plan(self) -> Policy:
        """Return the policy that plays the motion of the plan.

        Raises:
            UsageError: There is no plan, or it has no motion.
        """
        if self.plan is None or self.plan.motion is None:
            raise UsageError("there is nothing to play: give a policy, or a plan with a motion")
        return motion_policy(self.plan.motion, self.dt)

    def _loop(self, policy: Policy, keys: StopKeys | None) -> None:
        """Run periods until the robot has stopped."""
        start = self.clock.now()
        due = 0  # the period after the last one; self._k is the next one that is possible
        self._now = start
        self.readiness.since = start
        self._fire(Trigger.CONSENT, "waiting for fresh states")
        for remark in self.driver.facts.get("remarks", ()):
            self._note(remark)
        self.output.suspended_before = self.clock.suspended()
        while self.phase is not Phase.STOPPED:
            self._now = self.clock.wait_until(start + self._k * self.dt)
            self.output.due = start + due * self.dt
            self.recording.late.append(self._now - self.output.due)
            self._period(policy, keys)
            passed = int((self.clock.now() - start) / self.dt) - self._k  # whole periods
            self.recording.missed += max(passed - 1, 0)
            due = self._k + 1
            self._k += max(1, passed)

    def _period(self, policy: Policy, keys: StopKeys | None) -> None:
        """Look for stops, read, check, send, record. After any error in it the robot damps."""
        state = None
        sent = None
        try:
            self._look_for_stops(keys)
            state, fault = self._read()
            self._state = state or self._state
            if fault:
                self._fail(fault)
            if self.phase is Phase.IDLE and state:
                self._start(state, policy)
            if state:
                sent = self._send(state, policy)
        except BaseException as error:  # raised again at the end
            self._error = self._error or error
            self._fail(Fault("error", f"{type(error).__name__}: {error}"))
        phase = self.phase
        if phase is Phase.DAMP:
            self._damp()
        if state:
            self._record(phase, state, sent)

    def _record(self, phase: Phase, state: State, sent: tuple[Array, Array] | None) -> None:
        """Append a row; sent: target and command, (n) rad each, if there was one."""
        target, ctrl = sent or (None, None)
        rows = self.recording.rows
        rows.append(Row(self._now, phase.value, target, ctrl, state))
        if rows.error and not self._reported_full_disk:
            self._reported_full_disk = True
            reason = rows.error.strerror
            self._note(f"nothing more is recorded ({reason}); what was written is kept")

    def _look_for_stops(self, keys: StopKeys | None) -> None:
        """Request a stop if a key was pressed, or if the watchdog could not damp the robot."""
        if keys:
            keys.poll()
        watchdog = None if self.phase in ENDED else self.output.watchdog
        if watchdog and (problem := watchdog.problem()):
            self.stop(problem)

    def _read(self) -> tuple[State | None, Fault | None]:
        """Return the newest state, and the fault that stops the robot now."""
        state = None
        try:
            state = self.driver.read()
        except (DriverError, OSError) as error:
            fault: Fault | None = Fault("driver", str(error))
        else:
            fault = self._check(state)
        if self.stop.reason:
            return state, Fault("stop", f"asked to stop: {self.stop.reason}")
        return state, self.output.suspended() or fault

    def _check(self, state: State) -> Fault | None:
        """Return what is wrong with a state; while the robot is idle only readiness hears of it."""
        # While the robot is let go no joint must follow.
        ctrl = None if self.recording.disobedience else self.output.ctrl
        requested = None if ctrl is None else self.output.expected()
        late = self._now - self.output.due
        fault = self.monitor.check(self._now, state, ctrl, late, requested)
        if self.phase in MOVING:
            return fault or self.following.check(state, self.output)
        if self.phase is Phase.IDLE and (fault is None or fault.kind != "stop"):
            self.readiness.count(fault)
            return None
        return fault

    def _start(self, state: State, policy: Policy) -> None:
        """Leave idle if the robot may be commanded."""
        first = self.readiness.first_target(self._now, state, policy)
        if isinstance(first, Fault):
            self._fail(first)
        elif first is not None:
            self.output.begin(state.qpos)
            self._targets = TargetGenerator(self.context, self.following, self.plan, state, first)
            self._fire(Trigger.READY, f"to the first target in {self._targets.path.duration:.1f} s")

    def _send(self, state: State, policy: Policy) -> tuple[Array, Array] | None:
        """Send this period's command.

        Return target and command of all joints, (n) rad; None if none was sent.
        """
        while self._targets and self.phase in COMMANDING:
            target = self._targets.step(self.phase, self._k - self._phase_start, state, policy)
            while self._targets.remarks:
                self._note(self._targets.remarks.pop(0))
            if isinstance(target, PhaseChange):
                self._fire(*target)
                continue
            weight = self._targets.weight
            sent = target if isinstance(target, Fault) else self.output.send(target, weight, state)
            if not isinstance(sent, Fault):
                return sent
            self._fail(sent)
            break
        return None

    def _damp(self) -> None:
        left = self.output.damping_left(self._now)
        try:
            self.output.damp(left)
        except Exception as error:  # of any kind: damp again next period, raise it at the end
            if not isinstance(error, DriverError | OSError):
                self._error = self._error or error
            if not any(e.text == str(error) for e in self.recording.events):
                self._note(str(error), "driver", self.clock.now())
        if not left:
            text, kind = self.output.confirm()
            fault = self.recording.fault
            obeys = fault is None or fault.kind != "obedience" or self.driver.reads_back
            if not kind and not obeys:
                text = "let go; the robot did not obey, and cannot say whether it damped"
            self._fire(Trigger.DAMPED, text, kind)

    def _verify(self) -> None:
        """Read back all that the robot holds, at the end of a run without fault."""
        if self.output.weight is None or self.recording.fault:
            return
        try:
            fault = self.driver.verify()
        except (DriverError, OSError) as error:
            fault = Fault("driver", f"at the end: {error}")
        if fault:
            self._note(fault.text, fault.kind, self.clock.now())
        elif self.following.share and not self.following.shown.any():
            self.recording.disobedience = (
                "no joint was told to go far enough to show whether the robot obeys"
            )
            self._note(f"no data: {self.recording.disobedience}", now=self.clock.now())

    def _fail(self, fault: Fault) -> None:
        """Stop the robot after a fault, as TRANSITIONS has it."""
        output = self.output
        trigger = Trigger.FAULT
        text = fault.text
        if output.weight is None:
            trigger = Trigger.FAULT_BEFORE_COMMAND
            text = f"{text}; nothing was commanded"
        elif output.watchdog and output.watchdog.fired():
            trigger = Trigger.FAULT_AFTER_WATCHDOG
            text = f"{text}; the watchdog has damped the robot"
        self._fire(trigger, text, fault.kind)

    def _fire(self, trigger: Trigger, text: str, kind: str = "") -> None:
        """Make the transition of an event, and record it."""
        phase, action = TRANSITION_TABLE[self.phase, trigger]
        if action is Action.IGNORE:
            return
        if action is Action.RAISE:
            raise AssertionError(f"{trigger.name} in phase {self.phase}: {text}")
        self.phase = phase
        self._phase_start = self._k
        if action is Action.DAMP:
            self.output.begin_damping(self._now, lowers(kind))
        elif action is Action.GO_BACK and self._targets and self._state:
            self._targets.go_back(self._state)
        self._note(text, kind)

    def _note(self, text: str, kind: str = "", now: float | None = None) -> None:
        event = Event(self._now if now is None else now, self.phase.value, kind, text)
        if spoils_data(kind):
            self.recording.disobedience = self.recording.disobedience or text
        self.recording.events.append(event)
        try:
            self._on_event(event)
        except Exception as error:  # the caller's code: damp, raise it at the end
            self._error = self._error or error
            self.stop(f"its listener failed: {error}")
