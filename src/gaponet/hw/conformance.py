"""Whether a driver keeps the promises of `Driver`: a test for packages that add one."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import get_args

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError
from gaponet.hw.control.clock import Clock, MonotonicClock
from gaponet.hw.control.driver import Driver, EndAction, Fault, State
from gaponet.hw.drivers.open import missing_members, open_driver
from gaponet.robot.spec import RobotSpec

PERIOD_S = 0.02  # of control
PERIODS = 10  # of reading, of holding, of each move, and of damping
MAX_CALL_S = 0.25 * PERIOD_S  # median duration of `read` and `write`
MAX_AGE_S = 0.5  # of a state
ROUNDING_S = 1e-3  # of the time of a state
MAX_OUTSIDE_RAD = 0.1  # of a reading, outside the range of its joint
MAX_MOTION_RAD = 0.1  # of a joint that is held where it is
MOVE_RAD = 0.1  # to which each joint is told to move
MIN_MOVE_RAD = 0.03  # by which it then moves at least
MAX_OTHER_MOVE_RAD = 0.05  # by which the other joints then move at most
MAX_READING_ERROR_RAD = 0.05
MAX_GAIN_RATIO = 10.0  # of kp to that of the robot folder, or the inverse
STATE_ARRAYS = ("qpos", "qvel", "tau", "temperature")
HINT = "is the order of the joints, a sign or a unit wrong?"


def broken_promises(
    driver: Driver,
    robot: RobotSpec,
    *,
    commands: Callable[[], int] | None = None,
    positions: Callable[[], Array] | None = None,
    clock: Clock | None = None,
) -> list[str]:
    """Use a driver as a run does: connect, read, hold, move, damp, leave.

    The joints are held where they are for 0.2 s. Then each commanded joint is moved by 0.1 rad
    towards the middle of its range, and all are damped. Let a simulated robot be at the other end
    of the bus.

    Args:
        driver: Not yet connected.
        robot: The robot that it was made for.
        commands: Number of commands that have arrived at the simulated robot so far. With it the
            promises to send nothing are tested too.
        positions: Joint positions of the simulated robot, (n) rad, in the order of
            robot.joint_names. With it the readings are compared. Without it a mistake that `read`
            and `write` have in common is not seen.
        clock: That of the states; default: the machine's.

    Returns:
        What the driver does not keep, a sentence each; empty if it keeps all. After an exception,
        and where what follows cannot work, nothing more is tested.
    """
    trial = _Trial(driver, robot, commands, positions, clock or MonotonicClock())
    broken: list[str] = []
    for stage in (
        trial.before_connecting,
        trial.connecting,
        trial.reading,
        trial.holding,
        trial.moving,
        trial.damping,
        trial.watchdog,
        trial.leaving,
    ):
        try:
            for problem in stage():  # those before an exception count too
                broken.append(problem)
        except _UntestableError as error:
            broken.append(str(error))
            break
        except Exception as error:
            broken.append(f"{stage.__name__}: {trial.doing} raised {error!r}")
            break
    try:
        driver.close()
    except Exception as error:
        broken.append(f"close raised {error!r}; it must never raise")
    return list(dict.fromkeys(broken))


class _UntestableError(Exception):
    """A broken promise without which the rest cannot be tested."""


class _Trial:
    """The stages in which a driver is used; each yields what is broken.

    Attributes:
        doing: The call that is tested now.
    """

    def __init__(
        self,
        driver: Driver,
        robot: RobotSpec,
        commands: Callable[[], int] | None,
        positions: Callable[[], Array] | None,
        clock: Clock,
    ) -> None:
        """Arguments as of broken_promises."""
        self.doing = ""
        self._driver = driver
        self._robot = robot
        self._commands = commands
        self._positions = positions
        self._clock = clock
        self._write_s: list[float] = []  # durations of `write`

    def before_connecting(self) -> Iterator[str]:
        """Members, joints, and leaving without having been there."""
        driver = self._driver
        self.doing = "an attribute"
        if missing := missing_members(driver):
            raise _UntestableError(f"the driver lacks {', '.join(missing)}")
        if not driver.address:
            yield "address is empty; it names the robot that one controller at a time may have"
        if driver.joint_names != self._robot.joint_names:
            yield "joint_names are not robot.joint_names, in the same order"
        if not driver.commanded:
            raise _UntestableError("commanded is empty")
        if unknown := set(driver.commanded) - set(self._robot.joint_names):
            names = ", ".join(sorted(unknown))
            raise _UntestableError(f"commanded has {names}, no joint of the robot")
        if driver.at_end not in get_args(EndAction):
            yield f"at_end is {driver.at_end!r}, none of {', '.join(get_args(EndAction))}"
        if driver.at_stop not in ("damps", "lowers"):
            yield f"at_stop is {driver.at_stop!r}, neither 'damps' nor 'lowers'"
        self.doing = "close before connect"
        driver.close(hold=True)

    def connecting(self) -> Iterator[str]:
        """What a connected driver says of its robot."""
        driver = self._driver
        yield from self._silent("connect", driver.connect)
        self.doing = "an attribute after connect"
        yield from self._problems_of_gains()
        n = len(self._robot.joint_names)
        if driver.qpos_range is not None:
            limits = np.asarray(driver.qpos_range, float)
            if limits.shape != (n, 2):
                yield f"qpos_range has shape {limits.shape} instead of ({n}, 2)"
            elif not (limits[:, 0] < limits[:, 1]).all():
                yield "qpos_range has a lower limit that is not below the upper one"
        try:
            json.dumps(driver.facts)
        except TypeError as error:
            yield f"facts cannot be stored as JSON: {error}"

    def _problems_of_gains(self) -> Iterator[str]:
        n = len(self._robot.joint_names)
        for name in ("kp", "kd"):
            gains = np.asarray(getattr(self._driver, name), float)
            if gains.shape != (n,) or not np.isfinite(gains).all() or (gains < 0).any():
                yield f"{name} is not {n} finite numbers that are 0 or more"
            elif name == "kp":
                own = self._robot.before_identification.servo.kp
                for joint, here, there in zip(self._robot.joint_names, gains, own, strict=True):
                    if not there / MAX_GAIN_RATIO <= here <= there * MAX_GAIN_RATIO:
                        yield (
                            f"kp of {joint} is {here:.3g} N·m/rad, and that of the robot folder "
                            f"is {there:.3g}"
                        )

    def reading(self) -> Iterator[str]:
        """States: shapes, units as far as they can be told, and times."""
        durations = []
        states: list[State] = []
        copies: list[Array] = []  # of qpos
        for _ in range(PERIODS):
            yield from self._silent("read", lambda: states.append(self._driver.read()))
            yield from self._problems_of(states[-1])
            copies.append(np.array(states[-1].qpos, float))
            began = time.monotonic()
            self._driver.read()  # nothing new has come since
            durations.append(time.monotonic() - began)
            self._wait()
        if np.median(durations) > MAX_CALL_S:
            yield (
                f"read takes {1e3 * np.median(durations):.1f} ms; it must not wait for the robot"
            )
        pairs = zip(states, copies, strict=True)
        if any(not np.array_equal(state.qpos, copy) for state, copy in pairs):
            yield "a later read changes the arrays of an earlier state"
        yield from self._problems_of_times(states)
        if self._positions is not None:
            joint, error = self._largest(np.abs(states[-1].qpos - self._positions()))
            if error > MAX_READING_ERROR_RAD:
                yield (
                    f"{joint} is read {error:.2f} rad away from where the simulated robot has it; "
                    f"{HINT}"
                )

    def _problems_of_times(self, states: list[State]) -> Iterator[str]:
        times = [state.time for state in states]
        if (np.diff(times) < 0).any():
            yield "the time of a state is before that of an earlier state"
        if times[-1] == times[0]:
            yield f"no new state came within {PERIODS * PERIOD_S:g} s"
        for earlier, later in pairwise(states):
            same_time = earlier.time == later.time
            same_values = all(
                np.array_equal(getattr(earlier, name), getattr(later, name), equal_nan=True)
                for name in STATE_ARRAYS
            )
            if same_time and not same_values:
                yield "two states have the same time and other values"
            if self._driver.noisy and same_values and not same_time:
                yield "noisy is True, and two states have the same values"

    def holding(self) -> Iterator[str]:
        """The robot stays where it is told to stay, and `write` uses the commanded joints only."""
        driver = self._driver
        self.doing = "read"
        found = np.array(driver.read().qpos, float)
        ctrl = self._command(found)
        sent = ctrl.copy()
        for _ in range(PERIODS):
            state = self._write_and_read(ctrl)
        if not np.array_equal(ctrl, sent, equal_nan=True):
            yield "write changes the array that it is given"
        if state.fault is not None:
            yield f"a robot that is held has the fault {state.fault.kind}: {state.fault.text}"
        joint, moved = self._largest(np.abs(state.qpos - found))
        if moved > MAX_MOTION_RAD:
            yield (
                f"{joint} moved by {moved:.2f} rad while all were told to stay; {HINT} "
                "write ignores the entries of joints that are not commanded"
            )
        if np.median(self._write_s) > MAX_CALL_S:
            yield f"write takes {1e3 * np.median(self._write_s):.1f} ms; it must not wait"
        answers: list[Fault | None] = []
        yield from self._silent("verify", lambda: answers.append(driver.verify()), wait_first=True)
        (fault,) = answers
        if fault is not None and not isinstance(fault, Fault):
            yield f"verify returns {fault!r}, neither a Fault nor None"
        elif fault is not None:
            yield f"verify reports {fault.text}"

    def moving(self) -> Iterator[str]:
        """Each commanded joint moves where it is told to, and no other joint moves."""
        driver = self._driver
        self.doing = "read"
        ctrl = np.array(driver.read().qpos, float)
        low, high = self._robot.qpos_range.T
        for joint in driver.commanded:
            i = self._robot.joint_names.index(joint)
            before = np.array(driver.read().qpos, float)
            begin = ctrl[i]
            move = -MOVE_RAD if begin - low[i] > high[i] - begin else MOVE_RAD
            for share in np.minimum(np.arange(1, 2 * PERIODS + 1) / PERIODS, 1.0):
                ctrl[i] = begin + share * move
                state = self._write_and_read(self._command(ctrl))
            moved = state.qpos - before
            if not moved[i] * np.sign(move) >= MIN_MOVE_RAD:  # NaN is not enough either
                yield f"{joint} was told to move by {move:+.2f} rad and moved by {moved[i]:+.2f}"
            of_others = np.abs(moved)
            of_others[i] = 0.0
            other, size = self._largest(of_others)
            if size > MAX_OTHER_MOVE_RAD:
                yield f"{other} moved by {size:.2f} rad when {joint} was told to; {HINT}"

    def damping(self) -> Iterator[str]:
        """Damping down to weight 0, and what the robot says of it."""
        driver = self._driver
        for left in np.linspace(1.0, 0.0, PERIODS):
            self.doing = "damp"
            driver.damp(float(left), float(left))
            self._wait()
            self.doing = "read while damping"
            driver.read()
        self.doing = "confirm"
        if not driver.confirm():
            yield "confirm returns no words"

    def watchdog(self) -> Iterator[str]:
        """The same robot can be opened in another process."""
        driver = self._driver
        self.doing = "watchdog"
        options = driver.watchdog()
        if options is None:
            return
        try:
            again = open_driver(**json.loads(json.dumps(options)))
        except (TypeError, GAPONetError) as error:
            yield f"open_driver does not accept the options that watchdog returns: {error}"
            return
        for name in ("address", "joint_names", "commanded"):
            if getattr(again, name) != getattr(driver, name):
                yield f"the driver that watchdog describes has another {name}"

    def leaving(self) -> Iterator[str]:
        """`close` with hold sends nothing, and may be called again."""
        yield from self._silent("close(hold=True)", lambda: self._driver.close(hold=True))
        self.doing = "a second close"
        self._driver.close(hold=True)

    def _command(self, ctrl: Array) -> Array:
        """Return targets with NaN for the joints that are not commanded."""
        command = np.full_like(ctrl, np.nan)
        commanded = self._robot.index(self._driver.commanded)
        command[commanded] = ctrl[commanded]
        return command

    def _write_and_read(self, ctrl: Array) -> State:
        """Write targets, (n) rad; return the state one period later."""
        self.doing = "write"
        began = time.monotonic()
        self._driver.write(ctrl, 1.0)
        self._write_s.append(time.monotonic() - began)
        self._wait()
        self.doing = "read"
        return self._driver.read()

    def _silent(
        self, words: str, call: Callable[[], object], wait_first: bool = False
    ) -> Iterator[str]:
        """Call what must send nothing.

        Args:
            wait_first: Wait until the last commands have arrived.
        """
        self.doing = words
        if self._commands is None:
            call()
            return
        if wait_first:
            self._wait()
        before = self._commands()
        call()
        self._wait()  # until it would have arrived
        if self._commands() != before:
            yield f"{words} sends a command"

    def _largest(self, sizes: Array) -> tuple[str, float]:
        """Return the joint with the largest of n sizes, and that size; NaN counts as infinite."""
        sizes = np.nan_to_num(sizes, nan=np.inf)
        i = int(np.argmax(sizes))
        return self._robot.joint_names[i], float(sizes[i])

    def _wait(self) -> None:
        self._clock.wait_until(self._clock.now() + PERIOD_S)

    def _problems_of(self, state: State) -> Iterator[str]:
        n = len(self._robot.joint_names)
        for name in STATE_ARRAYS:
            values = getattr(state, name)
            if not isinstance(values, np.ndarray) or values.shape != (n,):
                raise _UntestableError(f"{name} of a state is no array of shape ({n},)")
            if name != "temperature" and not np.isfinite(values).all():
                yield f"{name} of a state is not finite"
        if not isinstance(state.refused, int):
            yield f"refused of a state is {state.refused!r}, no whole number"
        low, high = self._robot.qpos_range.T
        joint, outside = self._largest(np.maximum(low - state.qpos, state.qpos - high))
        if outside > MAX_OUTSIDE_RAD:
            yield f"{joint} is read {outside:.2f} rad outside its range; {HINT}"
        age = self._clock.now() - state.time
        if age < -ROUNDING_S:
            yield "a state is from the future: its time is not that of the clock"
        elif age > MAX_AGE_S:
            yield f"a state is {age:.1f} s old"
        if state.fault is not None:
            yield f"a state has the fault {state.fault.kind}: {state.fault.text}"
