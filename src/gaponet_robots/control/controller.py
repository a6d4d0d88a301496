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
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gaponet.arrays import Array
from gaponet.errors import UsageError
from gaponet.robot import RobotSpec
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model
from gaponet_robots.control.clock import Clock, MonotonicClock, uncollected
from gaponet_robots.control.driver import Driver, DriverError, Fault, State
from gaponet_robots.control.following import Following
from gaponet_robots.control.phases import COMMANDING, NEXT, ControlConfig, Phase
from gaponet_robots.control.plan import MOVED, SLOW, Compensates, Fence, Plan, Planner
from gaponet_robots.control.publisher import sole_publisher
from gaponet_robots.control.recording import Event, Recording
from gaponet_robots.control.rows import Row
from gaponet_robots.control.safety import ASTRAY, SOFT, Limits, SafetyConfig, Watch, limit_command, limit_delta
from gaponet_robots.control.stop import Keys, StopRequest, on_signal
from gaponet_robots.control.watchdog import Watchdog
from gaponet_robots.motion.minjerk import blend
from gaponet_robots.motion.way import Search, Way
from gaponet_robots.targets.policy import NotYet, Policy, play

_T = TypeVar("_T")


HANG = 5.0  # control periods without a sign of life after which the watchdog damps the robot
FRESH = 5  # periods in a row without a fault before anything is commanded
PATIENCE = 5.0  # s to wait for them
PROVEN = 0.3  # weight beyond which a robot is not handed over before a joint has followed, where one goes …
FAR = 0.4  # … rad to the first target: at that weight more than friction may swallow
PAST = 0.05  # rad beyond its range in which a joint may be found, where only the MJCF says where it ends
WEIGHED = 2.0  # s of the run after which what the hands hold is compared with what was told
LOOK = 0.3  # share of a period in which it looks for the way back
PROMPT = 0.001  # s between the last look at the clock and a command's leaving that its limits allow for
MAX_SUSPENDED_S = 0.05  # less than any suspend, more than two clocks that are read in turn differ by


class Controller:
    """Plays targets on one robot, once: ramp to the start, track, hold or damp at the end."""

    def __init__(
        self,
        driver: Driver,
        robot: RobotSpec,
        *,
        config: ControlConfig | None = None,
        safety: SafetyConfig | None = None,
        compensator: Compensates | None = None,
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
            robot: Its type.
            config: Times of the phases.
            safety: Limits and checks of states; default SafetyConfig().
            compensator: Turns targets into commands; without one targets are sent as they are.
            clock: Default the machine's monotonic clock.
            watchdog: Start the process that damps the robot if this one dies, where the driver has one.
            planner: Checks the way to the first target, and targets that are not known in advance while it moves;
                default one without payload, for a robot that has shapes (collision.toml).
            unchecked: Do without one.
            payload_mass: kg per hand, for the compensator and the recording; None if it is not known.
            on_event: Called with every change of phase.
            on_connect: Called with the driver once the robot has answered and nothing was commanded; may refuse it.
            folder: Where the recording is written as it grows, to be saved there; default a temporary file.
            metadata: Saved with the recording (unit, model…).
        """
        self.driver, self.robot, self.compensator = driver, robot, compensator
        self.config, self.safety = config or ControlConfig(), safety or SafetyConfig()
        self.clock, self.dt = clock or MonotonicClock(), 1.0 / self.config.rate
        self.joints = robot.index(driver.commanded)
        self._adopt_servos()
        self.watch = Watch(driver.joint_names, self.joints, self.dt, self.safety, driver.noisy)
        share = 0.0 if driver.reads_back else self.safety.following
        self.following = Following(driver.commanded, self.dt, share)
        self._laden = build_model(robot.nominal or robot, payload_mass or 0.0) if share else None
        self.stop = StopRequest()
        self.phase = Phase.IDLE
        self.recording = Recording(
            robot.name, driver.virtual, driver.joint_names, driver.commanded, self.dt,
            meta=(metadata or {}) | {"payload_mass": payload_mass},
        )  # fmt: skip
        self._folder, self._full_told = folder, False
        self._use_watchdog, self._on_event, self._on_connect = watchdog, on_event, on_connect
        self._watchdog: Watchdog | None = None
        self._payload_mass, self._prepared = payload_mass, compensator is None
        self._ctrl: Array | None = None  # commanded joints
        self._weight: float | None = None  # that was sent last; None: nothing was ever commanded
        self._error: BaseException | None = None
        self._handed, self._passed, self._weighed = 0.0, 0.0, False  # weight, and s on the way, in blend_in
        self._soft = False  # whether a robot that cannot brake is lowered while it damps
        self._loose = False  # whether nobody has confirmed that it is damped
        self._delta, self._followed = np.zeros(len(self.joints)), -np.inf
        self.plan: Plan | None = None  # may be given until it runs: its motion is played
        self._planner = planner
        if planner is None and not unchecked and (robot.folder / "collision.toml").is_file():
            self._planner = Planner(robot, driver.commanded, self.config, self.safety)
        self._fence: Fence | None = None
        self._looking: Search[Any] | None = None  # for the ways to and from targets that are not known in advance
        self._cut = ""  # what a target was cut for in the last period
        self._since = self._fresh = 0
        self._unfresh: Fault | None = None

    def run(self, policy: Policy | None = None, keys: bool = False) -> Recording:
        """Go through all phases and return what was recorded, when the policy ends or the run is stopped.

        Args:
            policy: Says the targets of the run, once a control period; None: the plan's motion is played.
            keys: Whether any key on the terminal, Ctrl-C included, stops the run.

        Raises:
            DriverError: The robot could not be reached; nothing was commanded.
            UsageError: Another process commands it, or this controller has run before.
            Exception: What the policy or the compensator raised, after the robot has damped.
        """
        if self.phase is not Phase.IDLE or self.recording.events:
            raise UsageError("a controller runs once; make a new one")
        with ExitStack() as stack:
            stack.enter_context(uncollected())  # left last: the watchdog would take a collection for silence
            lock = stack.enter_context(sole_publisher(self.driver.address))
            stack.callback(lambda: self.driver.close(hold=not self._damped))
            self.driver.connect()
            self.recording.virtual = self.driver.virtual
            self._adopt_servos()
            self._on_connect(self.driver)
            stack.enter_context(on_signal(self.stop))
            pressed = stack.enter_context(Keys(self.stop)) if keys else None  # from the consent on, not from the loop
            gains = {name: getattr(self.driver, name)[self.joints].tolist() for name in ("kp", "kd")}
            self.recording.meta |= gains | self.driver.facts
            if self._folder:
                self.recording.grow_in(self._folder)
            stack.callback(self.recording.rows.close)
            self._start_watchdog(lock, stack)
            if policy is None:
                if self.plan is None or self.plan.motion is None:
                    raise UsageError("there is nothing to play: give a policy, or a plan with a motion")
                policy = play(self.plan.motion, self.dt)
            self._loop(policy, pressed)
            self._verify()
        if self._error:
            raise self._error
        return self.recording

    def _adopt_servos(self) -> None:
        driver = self.driver
        gains = (driver.kp, driver.kd)
        self.limits = Limits.of(self.robot, driver.commanded, self.safety, gains, driver.qpos_range)

    def _start_watchdog(self, lock: int, stack: ExitStack) -> None:
        spec = self.driver.watchdog() if self._use_watchdog else None
        if spec is None:
            return
        watchdog = self._watchdog = Watchdog(spec, lock, HANG * self.dt, self.config.damp)
        stack.callback(lambda: watchdog.release(self._loose))
        watchdog.wait_ready()

    def _loop(self, policy: Policy, keys: Keys | None) -> None:
        start, k, due = self.clock.now(), 0, 0  # due: the period that should follow the last one; k, the one that can
        for text in ("waiting for fresh states", *self.driver.facts.get("remarks", ())):
            self._note(start, "", text)
        self._began, self._suspended_before = start, self.clock.suspended()
        while self.phase is not Phase.STOPPED:
            now = self.clock.wait_until(start + k * self.dt)
            self._due = start + due * self.dt
            if keys:
                keys.poll()
            if self._watchdog and not self._ended and (trouble := self._watchdog.trouble()):
                self.stop(trouble)
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
            if state is not None:
                self._where = state.qpos[self.joints]
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
            left = max(1.0 - (now - self._damping_since) / self.config.damp, 0.0)
            self._damp(left * (self._weight or 0.0), left * self._soft)
            if not left:
                self._enter(Phase.STOPPED, k, now, *self._confirmed())
        if state is not None:
            ctrl = None if target is None else self._full(self._ctrl, state)
            self.recording.rows.append(Row(now, phase.value, target, ctrl, state))
            trouble = self.recording.rows.trouble
            if trouble and not self._full_told:
                self._full_told = True
                self._note(now, "", f"nothing more is recorded ({trouble.strerror}); what was written is kept")

    def _read(self, now: float) -> tuple[State | None, Fault | None]:
        """The newest state, and what stops the robot now."""
        try:
            state = self.driver.read()
        except (DriverError, OSError) as error:
            return None, self._latched(Fault("driver", str(error)))
        ctrl = None if self.recording.not_obeyed else self._ctrl  # being let go, nothing is asked to follow
        fault = self.watch.check(now, state, ctrl, now - self._due) or self._follows(state)
        if self.phase is Phase.IDLE and (fault is None or fault.kind != "stop"):
            self._fresh, self._unfresh = (0, fault) if fault else (self._fresh + 1, None)
            fault = None
        return state, self._latched(fault)

    def _follows(self, state: State) -> Fault | None:
        """The joint that does not go where the last commands went."""
        if not (self._laden and self._ctrl is not None and self.phase in COMMANDING[:3]):
            self.following.rest()
            return None
        handed = self._handed if self.driver.at_end == "hand_over" else 1.0
        if state.time <= self._followed:  # heard before: it says nothing new of where the joints went
            return None
        self._followed = state.time
        limit = self.limits.effort / self.safety.torque_share
        asked = self._found + handed * (self._asked - self._found)
        load = lambda: static_torque(self._laden, state.qpos[None])[0, self.joints] / limit  # noqa: E731
        return self.following.check(asked, state.qpos[self.joints], state.tau[self.joints] / limit, load)

    def _latched(self, fault: Fault | None) -> Fault | None:
        if self._ended:
            return None
        if self.stop.reason:
            return Fault("stop", f"asked to stop: {self.stop.reason}")
        return self._suspended() or fault

    def _suspended(self) -> Fault | None:
        """Fault if the computer was suspended: time stood still for this process, not for the robot."""
        passed = self.clock.suspended() - self._suspended_before
        if passed <= MAX_SUSPENDED_S:
            return None
        return Fault("suspend", f"the computer was suspended for {passed:.1f} s; keep it awake while a robot moves")

    def _fail(self, k: int, now: float, fault: Fault) -> None:
        """Damp; but send nothing if nothing was commanded, or if the watchdog has damped the robot already."""
        if self._ended:
            return
        if self._weight is None:
            self._enter(Phase.STOPPED, k, now, fault.kind, f"{fault.text}; nothing was commanded")
        elif self._watchdog and self._watchdog.fired():
            self._enter(Phase.STOPPED, k, now, fault.kind, f"{fault.text}; the watchdog has damped the robot")
        elif fault.kind == "obedience" and self.driver.at_end == "hand_over" and self.phase is not Phase.RELEASE:
            self._last = self._where  # whatever listens or not: nothing moves, and the arms become the robot's own
            self._enter(Phase.RELEASE, k, now, fault.kind, fault.text)
        else:
            self._soft = fault.kind in SOFT
            self._enter(Phase.DAMP, k, now, fault.kind, fault.text)

    def _confirmed(self) -> tuple[str, str]:
        """Kind and text of the last word: what the robot itself says after damping."""
        try:
            return "", self.driver.confirm()
        except (DriverError, OSError) as error:
            self._loose = True
            more = "; the watchdog goes on trying" if self._watchdog else ""
            return "driver", f"could NOT be damped: switch the supply off ({error}){more}"

    def _verify(self) -> None:
        """What a run without fault did not notice: at its end the robot is asked once more for all that it holds."""
        if self._weight is None or self.recording.fault:
            return
        try:
            fault = self.driver.verify()
        except (DriverError, OSError) as error:
            fault = Fault("driver", f"at the end: {error}")
        if fault:
            self._note(self.clock.now(), fault.kind, fault.text)
        elif self.following.share and not self.following.shown.any():
            self.recording.not_obeyed = "no joint was told to go far enough to show whether the robot obeys"
            self._note(self.clock.now(), "", f"no data: {self.recording.not_obeyed}")

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
            if isinstance(first, NotYet):
                self._began = now  # all else is well
            elif (
                first.kind != "silence" or not self.plan or now - self._began > PATIENCE
            ):  # senders wait while it plans
                self._fail(k, now, first)
            return
        if first is None or not np.isfinite(first[self.joints]).all():
            self._fail(k, now, Fault("target", "the motion has no first target, or it is not a number"))
            return
        before = self.plan
        unsafe = self._planned(first, state, now) or self._admitted(state.qpos[self.joints])
        if unsafe:
            self._fail(k, now, unsafe)
        if unsafe or (self._planner and (before is None or self.plan is not before)):
            return
        self._found = state.qpos[self.joints].copy()
        self._ctrl, self._asked = self._found.copy(), self._found.copy()
        self._go(self.plan.into if self.plan else None, self._found, first[self.joints], state)
        if self._planner and self.plan and self.plan.motion is None:
            self._fence = Fence(self._planner, state.qpos)
        self._enter(Phase.BLEND_IN, k, now, "", f"to the first target in {self._blend_time:.1f} s")

    def _planned(self, first: Array, state: State, now: float) -> Fault | None:
        """See to it that a plan begins where the robot is, if there is a planner; else wait, or why there is none."""
        if self.plan is not None:
            moved = np.abs(state.qpos - self.plan.found)[self.joints]
            joint = self.driver.commanded[int(moved.argmax())]
            if moved.max() <= MOVED:
                return None
            if self.plan.motion is not None:
                return Fault("plan", f"{joint} moved by {moved.max():.2f} rad since the plan was made; run it again")
            self.plan = None
        if self._planner is not None:
            self._looking = self._looking or self._planner.begin(first, state.qpos)
            try:
                self.plan = self._look(self._looking)
            except UsageError as error:
                return Fault("plan", str(error))
            self._began = now
        return None

    def _look(self, search: Search[_T]) -> _T | None:
        """Go on looking for a share of this period: what was found; None where it is not over; UsageError for none."""
        until = self.clock.now() + LOOK * self.dt
        try:
            while self.clock.now() <= until:
                next(search)
        except StopIteration as end:
            self._looking = None
            return end.value
        return None

    def _admitted(self, found: Array) -> Fault | None:
        """Let the limits reach to where the robot is, so that the first command is that; or why it cannot be there."""
        ranges, told = self.robot.qpos_range[self.joints], self.driver.qpos_range
        spare = PAST if told is None else MOVED  # servos that know their own range cut goals beyond it
        ends = ranges if told is None else told[self.joints]
        low, high = np.minimum(ranges, ends)[:, 0] - spare, np.maximum(ranges, ends)[:, 1] + spare
        beyond = np.maximum(low - found, found - high)
        if beyond.max() > 0:
            at = int(beyond.argmax())
            return Fault(
                "plan",
                f"{self.driver.commanded[at]} was found at {found[at]:.2f} rad, beyond its range of {low[at]:.2f} to "
                f"{high[at]:.2f}; bring it there by hand, or calibrate",
            )
        self.limits = replace(
            self.limits, low=np.minimum(self.limits.low, found), high=np.maximum(self.limits.high, found)
        )
        return None

    def _go(self, way: Way | None, start: Array, goal: Array, state: State) -> None:
        """Enter a way, or the straight one, between two postures of the commanded joints."""
        if way is None:
            points = np.stack([self._full(start, state), self._full(goal, state)])
            way = Way.along(points, self.config.blend_speed, np.inf, self.config.blend)
        self._way, self._blend_time = way, way.duration

    def _along(self, passed: float, start: Array, goal: Array) -> Array:
        """Where the way has got to, with its ends moved to where they truly are; commanded joints, rad."""
        share = float(blend(np.array(passed / self._blend_time)))
        first, last = self._way.points[0][self.joints], self._way.points[-1][self.joints]
        return self._way.at(passed)[self.joints] + (1 - share) * (start - first) + share * (goal - last)

    def _send(self, k: int, now: float, state: State, policy: Policy) -> Array | None:
        """Send this period's command; the target (n) it was made from, or None if there was none to be sent."""
        target, weight = self._target(k, now, state, policy)
        if target is None:
            return None
        if self._fence and np.isfinite(target).all():
            target = self._fenced(target, now, state)
        wanted = self._full(target, state)
        corrected = self.compensator.step(wanted, state.qpos, state.qvel) if self.compensator else wanted
        if not np.isfinite(target).all() or not np.isfinite(corrected[self.joints]).all():
            self._fail(k, now, Fault("target", "the motion or the model gave something that is not a number"))
            return None
        self._delta = limit_delta(corrected[self.joints] - target, self._delta, self.dt, self.limits)
        step = self.limits.speed * self.dt
        asked = np.clip(target + self._delta, self._asked - step, self._asked + step)
        self._asked = np.clip(asked, self.limits.low, self.limits.high)
        fault = self._leave(target + self._delta, weight, state)
        if fault:
            self._fail(k, now, fault)
        return None if fault else wanted

    def _fenced(self, target: Array, now: float, state: State) -> Array:
        """The target (commanded joints) as far as limbs and plane leave the way free."""
        assert self._fence
        measured = np.array(state.qpos, float)
        measured[self.joints] = self._fence.at[self.joints]
        self._fence.at = measured
        out = self._fence.step(self._full(target, state), state.qpos, self.dt)[self.joints]
        if self._fence.near and self._fence.near != self._cut:
            self._note(now, "", f"targets are cut: {self._fence.near} would come too near")
        self._cut = self._fence.near or self._cut
        self._last = out
        return out

    def _leave(self, ctrl: Array, weight: float, state: State) -> Fault | None:
        """Limit a command and write it, or say why none may leave. A period that stood still sends nothing."""
        q, v, before = state.qpos[self.joints], state.qvel[self.joints], self._ctrl
        assert before is not None
        if self._watchdog and not self._watchdog.beat(weight):  # first, so that it counts from before the first command
            return Fault("stop", "the watchdog ended")
        looked = -np.inf
        while (now := self.clock.now()) - looked > PROMPT:
            looked = now
            fault = self.watch.overrun(now - self._due) or self._suspended()
            if fault or (self._watchdog and self._watchdog.fired()):
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
        arrived = self._passed >= self._blend_time + self.config.settle
        if self.phase is Phase.BLEND_IN and arrived and self._handed > 1.0 - 1e-9:
            self._enter(Phase.RUN, k, now, "", "motion")
        asked = None
        if self.phase in (Phase.BLEND_IN, Phase.RUN):
            asked = policy(0 if self.phase is Phase.BLEND_IN else k - self._since, state)
        if isinstance(asked, Fault):
            self._fail(k, now, asked)
            return None, 0.0
        if self.phase is Phase.BLEND_IN:
            goal = self._found if asked is None else asked[self.joints]
            way, watched = np.abs(goal - self._found), bool(self.following.share)
            waiting = watched and way.max() >= FAR and not self.following.shown.any()
            if waiting and arrived:
                self._fail(k, now, self.following.blame(int(way.argmax())))
                return None, 0.0
            at, more = self._passed, self._handed + self.dt / self.config.blend
            self._handed = max(self._handed, min(more, PROVEN if waiting else 1.0))
            lags = self.driver.at_end == "hand_over" and way.max() >= FAR and self._handed < 1.0 - 1e-9
            if waiting or not lags:  # while it is handed over joints lag, each in its own way: it stands meanwhile
                self._passed += self.dt
            self._last = self._along(at, self._found, goal)
            return self._last, self._handed
        passed = (k - self._since) * self.dt
        if self.phase is Phase.RUN:
            if not self._weighed and passed >= WEIGHED:
                self._weighed = True
                if doubt := getattr(self.compensator, "doubt", ""):  # not every compensator weighs
                    self._note(now, "", f"compensation: {doubt}")
            if asked is not None:
                self._last = np.array(asked[self.joints], float)
                return self._last, 1.0
            if not self.config.blend_out:
                return self._end(k, now, "end of the motion")
            self._enter(Phase.BLEND_OUT, k, now, "end", "end of the motion")
            self._from = self._last
            self._go(self.plan.back if self.plan else None, self._last, self._found, state)
            if self._fence and self._planner:
                self._fence.homeward()
                ends = self._full(self._last, state), self._full(self._found, state)
                self._looking = self._planner.back(*ends) if self.dt >= SLOW else None
        if self._looking:
            try:
                way = self._look(self._looking)
            except UsageError as error:
                self._looking = None
                return self._end(k, now, f"where it is: {error}")
            if way is None:
                return self._last, 1.0
            self._since = k
            self._go(way, self._last, self._found, state)
        passed = (k - self._since) * self.dt
        if self.phase is Phase.RELEASE:
            if self._weight == 0.0:
                text = "let go; the robot did not obey" if self.recording.not_obeyed else "handed over"
                self._enter(Phase.STOPPED, k, now, "", text)
                return None, 0.0
            return self._last, max(1.0 - passed / self.config.damp, 0.0) * self._handed
        if passed > self._blend_time + self.config.settle:
            if self._fence and np.abs(self._last - self._found).max() > MOVED:
                return self._end(k, now, f"where it is: {self._fence.near} would come too near on the way back")
            self._last = self._found
            return self._end(k, now, "back where it was found")
        return self._along(passed, self._from, self._found), 1.0

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

    def _damp(self, weight: float, share: float) -> None:
        try:
            if self._watchdog and not self._watchdog.fired():
                self._watchdog.beat(weight)
            self.driver.damp(weight, share)
        except Exception as error:  # whatever a driver raises, it is to damp: again next period; raised at the end
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
        if kind in ASTRAY:
            self.recording.not_obeyed = self.recording.not_obeyed or text
        self.recording.events.append(event)
        try:
            self._on_event(event)
        except Exception as error:  # a listener is the caller's code, and may raise anything: damp, raise it at the end
            self._error = self._error or error
            self.stop(f"its listener failed: {error}")
