"""Controller: plays targets on a robot at a fixed rate, within limits, and stops it after a fault.

phases.TRANSITIONS is its state machine. A fault is latched, and a controller that has stopped
cannot be started again. docs/deploy-safety.md lists the guarantees.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import Clock, MonotonicClock, Periods, no_garbage_collection
from gaponet.hw.control.driver import Driver, DriverError, Fault, State
from gaponet.hw.control.following import FollowingMonitor
from gaponet.hw.control.output import Context, Output
from gaponet.hw.control.phases import (
    COMMANDING,
    ENDED,
    MOVING,
    Action,
    ControlConfig,
    Phase,
    PhaseMachine,
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

# Control periods without a heartbeat after which the watchdog damps the robot. More than three:
# with the default of SafetyConfig.overrun, two heartbeats are so far apart if a period is only
# just in time to send its command.
WATCHDOG_PERIODS = 5.0


@dataclass(frozen=True)
class Session:
    """What is around the periods of one run: the lock, the connection, stop keys and signals, the
    file of the recording, and the watchdog.

    Attributes:
        output: Gets the watchdog.
        recording: Of the run.
        stop: Is called by keys and signals.
        on_connect: Called with the driver once the robot has answered and nothing was commanded;
            it refuses the run by an exception.
        is_watched: A watchdog is started, if the driver supports one.
        folder: Of the recording; None: a temporary file.
    """

    output: Output
    recording: Recording
    stop: StopRequest
    on_connect: Callable[[Driver], None]
    is_watched: bool
    folder: Path | None

    def start(self, stack: ExitStack, keys: bool) -> StopKeys | None:
        """Connect, ask `on_connect`, and start all else; `stack` ends it in the opposite order.

        Return the keys that stop the run, if `keys`.

        Raises:
            DriverError: The robot or the watchdog could not be reached; nothing was commanded.
            UsageError: Another process commands the robot.
        """
        output = self.output
        context = output.context
        driver = context.driver
        # Left last: during a collection no heartbeat is sent.
        stack.enter_context(no_garbage_collection())
        lock = stack.enter_context(sole_publisher(driver.address))
        stack.callback(self._close)
        driver.connect()
        self.recording.virtual = driver.virtual
        output.limits = output.servo_limits()
        self.on_connect(driver)
        stack.enter_context(stop_on_signals(self.stop))
        # Keys count from the consent on.
        pressed = stack.enter_context(StopKeys(self.stop)) if keys else None
        joints = context.joints
        gains = {"kp": driver.kp[joints].tolist(), "kd": driver.kd[joints].tolist()}
        self.recording.meta |= gains | driver.facts
        # Here, since no file can be made later on a full disk.
        self.recording.write_to(self.folder)
        stack.callback(self.recording.rows.close)
        spec = driver.watchdog() if self.is_watched else None
        if spec is not None:
            patience = WATCHDOG_PERIODS * context.dt
            output.watchdog = Watchdog(spec, lock, patience, context.config.damp)
            stack.callback(self.release_watchdog)
            output.watchdog.wait_ready()
        return pressed

    def release_watchdog(self) -> None:
        """Let the watchdog end, unless it is needed: to damp a robot that is not known to be
        damped.
        """
        if self.output.watchdog:
            self.output.watchdog.release(self.output.unconfirmed)

    def _close(self) -> None:
        """Close the connection. The robot holds, unless it was to be damped and no watchdog is
        there to do it.
        """
        output = self.output
        watchdog = output.watchdog
        if watchdog is not None and (watchdog.fired() or output.unconfirmed):
            nothing_to_do = watchdog.can_damp()
        else:
            nothing_to_do = output.damping_since is None and not output.unconfirmed
        output.context.driver.close(hold=nothing_to_do)


def _require_same_joints(driver: Driver, robot: RobotSpec) -> None:
    """Refuse a driver with other joints, or another order: commands would go to the wrong ones."""
    if tuple(driver.joint_names) != robot.joint_names:
        raise UsageError(
            f"the driver of {driver.address} has the joints {', '.join(driver.joint_names)}, robot "
            f"'{robot.name}' has {', '.join(robot.joint_names)}; both must name the same ones in "
            "one order, or commands go to the wrong joints"
        )


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
        payload_side: str = "both",
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
            payload_side: Hands that carry the payload: both, or the side of one payload mount. It
                tells which blocked arm may push as if it carried a load.
            on_event: Called with every change of phase.
            on_connect: Called with the driver once the robot has answered and nothing was
                commanded; it refuses the run by an exception.
            folder: Folder in which the recording is written period by period; default a temporary
                file.
            metadata: Saved with the recording (unit id, model …).

        Raises:
            UsageError: The driver has other joints than the robot, or another order of them.
        """
        _require_same_joints(driver, robot)
        config = config or ControlConfig()
        safety = safety or SafetyConfig()
        if planner is None and not unchecked and (robot.folder / "collision.toml").is_file():
            planner = Planner(robot, driver.commanded, config, safety)
        joints = robot.index(driver.commanded)
        dt = 1.0 / config.rate
        self.context = Context(
            driver,
            robot,
            config,
            safety,
            compensator,
            clock or MonotonicClock(),
            planner,
            payload_mass,
            payload_side,
            joints,
            dt,
        )
        self.stop = StopRequest()
        self.recording = Recording(
            robot.name,
            driver.virtual,
            driver.joint_names,
            driver.commanded,
            dt,
            meta=(metadata or {}) | {"payload_mass": payload_mass},
        )
        self.periods = Periods(self.context.clock, dt)
        monitor = StateMonitor(driver.joint_names, joints, dt, safety, driver.noisy)
        self.following = FollowingMonitor(self.context)
        self.output = Output(self.context, monitor, self.periods)
        self.readiness = Readiness(self.context, self.output)
        self._machine = PhaseMachine()
        self._session = Session(
            self.output, self.recording, self.stop, on_connect, watchdog, folder
        )
        self._targets: TargetGenerator | None = None
        self._on_event = on_event
        self._error: BaseException | None = None  # of other code; raised when the robot is damped

    @property
    def phase(self) -> Phase:
        """Present phase of the run."""
        return self._machine.phase

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
        with ExitStack() as stack:
            pressed = self._session.start(stack, keys)
            try:
                self._loop(policy or self._policy_of_plan(), pressed)
            except BaseException as error:
                self.output.unconfirmed |= self.phase in (*COMMANDING, Phase.DAMP)
                self._note(f"{type(error).__name__}: {error}", "error", self.context.clock.now())
                raise
            # It would take the reading back of all registers for a controller that hangs.
            self._session.release_watchdog()
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
        return motion_policy(self.plan.motion, self.context.dt)

    def _loop(self, policy: Policy, keys: StopKeys | None) -> None:
        """Run periods until the robot has stopped."""
        periods = self.periods
        periods.begin()
        self.readiness.since = periods.now
        self._fire(Trigger.CONSENT, "waiting for fresh states")
        for remark in self.context.driver.facts.get("remarks", ()):
            self._note(remark)
        periods.forget_suspends()
        while self.phase is not Phase.STOPPED:
            self.recording.late.append(periods.wait())
            self._period(policy, keys)
            self.recording.missed += periods.end()

    def _period(self, policy: Policy, keys: StopKeys | None) -> None:
        """Look for stops, read, check, send, record. After any error in it the robot damps."""
        state = None
        sent = None
        try:
            self._look_for_stops(keys)
            state, fault = self._read()
            if fault:
                self._fail(fault)
            if self.phase is Phase.IDLE and state:
                self._start(state, policy)
            if state:
                sent = self._send(state, policy)
        except BaseException as error:  # raised again at the end
            self._fail_for(error)
        phase = self.phase
        if phase is Phase.DAMP:
            self._damp()
        if state:
            try:
                self._record(phase, state, sent)
            except Exception as error:
                self._fail_for(error)

    def _fail_for(self, error: BaseException) -> None:
        """Stop the robot after an error that no driver raised; it is raised at the end."""
        self._error = self._error or error
        self._fail(Fault("error", f"{type(error).__name__}: {error}"))

    def _record(self, phase: Phase, state: State, sent: tuple[Array, Array] | None) -> None:
        """Append a row; sent: target and command, (n) rad each, if there was one."""
        target, ctrl = sent or (None, None)
        rows = self.recording.rows
        rows.append(Row(self.periods.now, phase.value, target, ctrl, state))
        if rows.error:
            text = f"nothing more is recorded ({rows.error}); what was written is kept"
            if not self._has_noted(text):
                self._note(text)

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
            state = self.context.driver.read()
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
        now = self.periods.now
        late = now - self.periods.due
        fault = self.output.monitor.check(now, state, ctrl, late, requested)
        if self.phase in MOVING:
            return fault or self.following.check(state, self.output)
        if self.phase is Phase.IDLE and (fault is None or fault.kind != "stop"):
            self.readiness.count(fault)
            return None
        return fault

    def _start(self, state: State, policy: Policy) -> None:
        """Leave idle if the robot may be commanded."""
        first = self.readiness.first_target(self.periods.now, state, policy)
        if isinstance(first, Fault):
            self._fail(first)
        elif first is not None:
            self.output.begin(state.qpos)
            self._targets = TargetGenerator(self.context, self.following, self.plan, state, first)
            duration = self._targets.approach.path.duration
            self._fire(Trigger.READY, f"to the first target in {duration:.1f} s")

    def _send(self, state: State, policy: Policy) -> tuple[Array, Array] | None:
        """Send this period's command. If its phase is over, the next one gives the target.

        Return target and command of all joints, (n) rad; None if none was sent.
        """
        while self._targets and self.phase in COMMANDING:
            period = self.periods.number - self._machine.begun
            target = self._targets.step(self.phase, period, state, policy)
            while self._targets.remarks:
                self._note(self._targets.remarks.pop(0))
            if isinstance(target, PhaseChange):
                self._fire(*target)
                continue
            if isinstance(target, Fault):
                self._fail(target)
                return None
            sent = self.output.send(target, self._targets.weight, state)
            if isinstance(sent, Fault):
                self._fail(sent)
                return None
            return sent
        return None

    def _damp(self) -> None:
        """Damp for a period, unless the watchdog does it by now."""
        watchdog = self.output.watchdog
        if watchdog and watchdog.is_damping():
            self._fire(Trigger.DAMPED, "this process stood still; the watchdog damps the robot")
            return
        left = self.output.damping_left(self.periods.now)
        try:
            self.output.damp(left)
        except Exception as error:  # of any kind: damp again next period, raise it at the end
            if not isinstance(error, DriverError | OSError):
                self._error = self._error or error
            if not self._has_noted(str(error)):
                self._note(str(error), "driver", self.context.clock.now())
        if not left:
            text, kind = self.output.confirm()
            fault = self.recording.fault
            obeys = fault is None or fault.kind != "obedience" or self.context.driver.reads_back
            if not kind and not obeys:
                text = "let go; the robot did not obey, and cannot say whether it damped"
            self._fire(Trigger.DAMPED, text, kind)

    def _verify(self) -> None:
        """Read back all that the robot holds, at the end of a run without fault."""
        if self.output.weight is None or self.recording.fault:
            return
        watchdog = self.output.watchdog
        if watchdog and watchdog.fired():
            text = "this process stood still at the end; the watchdog damps the robot"
            self._note(text, "overrun", self.context.clock.now())
            return
        try:
            fault = self.context.driver.verify()
        except (DriverError, OSError) as error:
            fault = Fault("driver", f"at the end: {error}")
        if fault:
            self._note(fault.text, fault.kind, self.context.clock.now())
        elif self.following.share and not self.following.shown.any():
            self.recording.disobedience = (
                "no joint was told to go far enough to show whether the robot obeys"
            )
            self._note(f"no data: {self.recording.disobedience}", now=self.context.clock.now())

    def _fail(self, fault: Fault) -> None:
        """Stop the robot after a fault, as TRANSITIONS has it."""
        output = self.output
        trigger = Trigger.FAULT
        text = fault.text
        if output.weight is None:
            trigger = Trigger.FAULT_BEFORE_COMMAND
            text = f"{text}; nothing was commanded"
        elif output.watchdog and output.watchdog.is_damping():
            trigger = Trigger.FAULT_AFTER_WATCHDOG
            text = f"{text}; the watchdog damps the robot"
        self._fire(trigger, text, fault.kind)

    def _fire(self, trigger: Trigger, text: str, kind: str = "") -> None:
        """Make the transition of an event, and record it."""
        action = self._machine.fire(trigger, self.periods.number)
        if action is Action.IGNORE:
            return
        if action is Action.DAMP:
            self.output.begin_damping(self.periods.now, lowers(kind))
        self._note(text, kind)

    def _has_noted(self, text: str) -> bool:
        return any(event.text == text for event in self.recording.events)

    def _note(self, text: str, kind: str = "", now: float | None = None) -> None:
        time = self.periods.now if now is None else now
        event = Event(time, self.phase.value, kind, text)
        if spoils_data(kind):
            self.recording.disobedience = self.recording.disobedience or text
        self.recording.events.append(event)
        try:
            self._on_event(event)
        except Exception as error:  # the caller's code: damp, raise it at the end
            self._error = self._error or error
            self.stop(f"its listener failed: {error}")
