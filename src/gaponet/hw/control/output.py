"""Output: commands to a robot within its limits, and damping.

Also what all parts of a controller share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.clock import Clock, Periods
from gaponet.hw.control.driver import Driver, DriverError, Fault, State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.plan import MAX_START_DRIFT_RAD, Planner, TargetCompensator
from gaponet.hw.control.safety import Limits, SafetyConfig, StateMonitor, limit_command, limit_delta
from gaponet.hw.control.watchdog import Watchdog
from gaponet.robot.spec import RobotSpec

MAX_BEYOND_RANGE_RAD = 0.05  # at the start, where only the MJCF says where a joint's range ends
MAX_SEND_DELAY_S = 0.001  # between the last reading of the clock and the sending of a command
# Less than any suspend, more than two clocks that are read in turn differ by.
MAX_SUSPENDED_S = 0.05


@dataclass(frozen=True)
class Context:
    """Robot, settings and clock of one controller.

    Attributes:
        payload_mass: kg per hand; None if it is not known.
        payload_side: Hands that carry it: both, or the side of one payload mount.
        joints: Indices of the commanded joints.
        dt: Control period, s.
    """

    driver: Driver
    robot: RobotSpec
    config: ControlConfig
    safety: SafetyConfig
    compensator: TargetCompensator | None
    clock: Clock
    planner: Planner | None
    payload_mass: float | None
    payload_side: str
    joints: Array
    dt: float


class Request:
    """Where the joints are asked to be, (n) rad: targets with their correction, within range and
    rate, but without the torque limit.

    This is not the last command: that never goes further from a joint than its torque limit
    allows, and so stays with a joint that does not move.
    """

    def __init__(self, start: Array) -> None:
        """Begin where the joints are."""
        self._start = start
        self._place = start
        self._correction = np.zeros(len(start))  # the last one

    def go_to(self, target: Array, corrected: Array, dt: float, limits: Limits) -> Array:
        """Take a target; return it with its correction, which is bounded in size and rate."""
        self._correction = limit_delta(corrected - target, self._correction, dt, limits)
        wanted: Array = target + self._correction
        step = limits.speed * dt
        place = np.clip(wanted, self._place - step, self._place + step)
        self._place = np.clip(place, limits.low, limits.high)
        return wanted

    def place(self, handed: float) -> Array:
        """Return where the joints are asked to be, by a share of which the robot is handed over."""
        place: Array = self._start + handed * (self._place - self._start)
        return place


class Output:
    """Corrects, limits and sends commands to one robot, and damps it.

    Arrays are of the commanded joints.

    Attributes:
        monitor: Checks the states; it says whether a period is too late to send a command.
        limits: Limits of commands; final once the driver is connected and `admit` has accepted the
            start.
        watchdog: Gets a heartbeat before each command; None: there is none.
        periods: Of the run.
        ctrl: The command in force, rad; None before the first one, and while the robot is damped.
        weight: Weight of the last command; None if nothing was ever commanded.
        damping_since: s of the clock; None if the robot was not damped.
        unconfirmed: The robot is to be damped and is not known to be.
    """

    def __init__(self, context: Context, monitor: StateMonitor, periods: Periods) -> None:
        self.context = context
        self.monitor = monitor
        self.watchdog: Watchdog | None = None
        self.limits = self.servo_limits()
        self.periods = periods
        self._request = Request(np.zeros(len(context.joints)))
        self.ctrl: Array | None = None
        self.weight: float | None = None
        self.damping_since: float | None = None
        self.unconfirmed = False
        self._lower = False

    def servo_limits(self) -> Limits:
        """Return the limits with gains and ranges of the driver's servos."""
        driver = self.context.driver
        gains = (driver.kp, driver.kd)
        return Limits.from_robot(
            self.context.robot, driver.commanded, self.context.safety, gains, driver.qpos_range
        )

    def suspended(self) -> Fault | None:
        """Return a fault if the computer was suspended: time stood still for this process, not for
        the robot.
        """
        duration = self.periods.suspended()
        if duration <= MAX_SUSPENDED_S:
            return None
        return Fault(
            "suspend",
            f"the computer was suspended for {duration:.1f} s; keep it awake while a robot moves",
        )

    def admit(self, qpos: Array) -> Fault | None:
        """Widen the limits to the measured position, (n) rad, so that it can be the first command.

        If it is too far beyond its range, refuse it.
        """
        driver = self.context.driver
        joints = self.context.joints
        found = qpos[joints]
        ranges = self.context.robot.qpos_range
        tolerance = MAX_BEYOND_RANGE_RAD
        if driver.qpos_range is not None:
            # Such servos cut goals to their own range: they would jump to its end.
            ranges = driver.qpos_range
            tolerance = MAX_START_DRIFT_RAD
        low, high = ranges[joints].T
        beyond = np.maximum(low - found, found - high)
        if beyond.max() > tolerance:
            i = int(beyond.argmax())
            return Fault(
                "plan",
                f"{driver.commanded[i]} was found at {found[i]:.2f} rad, beyond its range of "
                f"{low[i]:.2f} to {high[i]:.2f}; bring it there by hand, or calibrate",
            )
        self.limits = replace(
            self.limits,
            low=np.minimum(self.limits.low, found),
            high=np.maximum(self.limits.high, found),
        )
        return None

    def begin(self, qpos: Array) -> None:
        """Take the measured position, (n) rad, as the command in force."""
        found = qpos[self.context.joints]
        self._request = Request(found)
        self.ctrl = found

    def expected(self) -> Array:
        """Return where the joints are asked to be, rad, as far as the robot is handed over."""
        handed = (self.weight or 0.0) if self.context.driver.at_end == "hand_over" else 1.0
        return self._request.place(handed)

    def send(self, target: Array, weight: float, state: State) -> tuple[Array, Array] | Fault:
        """Send a target, corrected and limited.

        Return target and command of all joints, or why nothing was sent.
        """
        context = self.context
        joints = self.context.joints
        full = state.qpos_with(joints, target)
        corrected = full
        if context.compensator:
            corrected = context.compensator.step(full, state.qpos, state.qvel)
        if not np.isfinite(target).all() or not np.isfinite(corrected[joints]).all():
            return Fault("target", "the motion or the model gave something that is not a number")
        wanted = self._request.go_to(target, corrected[joints], context.dt, self.limits)
        command = self._write(wanted, weight, state)
        return command if isinstance(command, Fault) else (full, command)

    def _write(self, ctrl: Array, weight: float, state: State) -> Array | Fault:
        """Limit a command and write it, or return why none may be sent.

        A period that stood still sends nothing.
        """
        context = self.context
        joints = self.context.joints
        before = self.ctrl
        q = state.qpos[joints]
        v = state.qvel[joints]
        assert before is not None
        # Before the command, so that the watchdog guards the first one too.
        if self.watchdog and not self.watchdog.beat(weight):
            return Fault("stop", "the watchdog ended")
        # The limits hold at the time of the last look at the clock: they are computed again if that
        # was too long ago.
        last_look = -np.inf
        while (now := context.clock.now()) - last_look > MAX_SEND_DELAY_S:
            last_look = now
            fault = self._stood_still(now)
            if fault:
                return fault
            age = now + MAX_SEND_DELAY_S - state.time  # of the state, when the command arrives, s
            out = limit_command(ctrl, before, q, v, context.dt, self.limits, age)
        if not out.feasible.all():
            joint = context.driver.commanded[int(np.argmin(out.feasible))]
            fresh = limit_command(ctrl, before, q, v, context.dt, self.limits)
            if fresh.feasible.all():
                return Fault(
                    "stale",
                    f"the newest state is {(now - state.time) * 1e3:.0f} ms old; no command is "
                    f"safe wherever {joint} can be by now",
                )
            return Fault("torque", f"{joint}: no command is within range, rate and torque")
        self.ctrl = out.ctrl
        self.weight = weight
        full = state.qpos_with(joints, out.ctrl)
        try:
            context.driver.write(full, weight)
        except (DriverError, OSError) as error:
            return Fault("driver", str(error))
        return full

    def _stood_still(self, now: float) -> Fault | None:
        """Return a fault if this period, the computer or this process stood still until now."""
        fault = self.monitor.overrun(now - self.periods.due) or self.suspended()
        if fault:
            return fault
        if self.watchdog and self.watchdog.fired():
            return Fault("overrun", "this process stood still")
        return None

    def begin_damping(self, now: float, lower: bool) -> None:
        """Let `damp` begin now; lower: a robot that cannot brake is lowered, else its torque goes
        off at once.
        """
        self.damping_since = now
        self._lower = lower
        self.ctrl = None

    def damping_left(self, now: float) -> float:
        """Return the share of the damping time that is left."""
        return max(1.0 - (now - (self.damping_since or 0.0)) / self.context.config.damp, 0.0)

    def damp(self, left: float) -> None:
        """Damp for a period, with this share of the last weight.

        May raise whatever a driver raises.
        """
        weight = left * (self.weight or 0.0)
        if self.watchdog and not self.watchdog.fired():
            self.watchdog.beat(weight)
        share = left if self._lower else 0.0
        self.context.driver.damp(weight, share)

    def confirm(self) -> tuple[str, str]:
        """Return what the robot itself reports after damping, and the kind of fault if it does not
        confirm it.
        """
        try:
            return self.context.driver.confirm(), ""
        except (DriverError, OSError) as error:
            self.unconfirmed = True
            more = ""
            if self.watchdog and self.watchdog.can_damp():
                more = "; the watchdog goes on trying"
            return f"could NOT be damped: switch the supply off ({error}){more}", "driver"
