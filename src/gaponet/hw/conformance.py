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
from gaponet.hw.control.driver import Driver, EndAction, State
from gaponet.hw.drivers.open import missing_members, open_driver
from gaponet.robot.spec import RobotSpec

PERIOD_S = 0.02  # of control
PERIODS = 10  # of holding, and of damping
MAX_READ_S = 0.5 * PERIOD_S  # median
MAX_AGE_S = 0.5  # of a state
ROUNDING_S = 1e-3  # of the time of a state
MAX_MOTION_RAD = 0.1  # of a joint that is held where it is
STATE_ARRAYS = ("qpos", "qvel", "tau", "temperature")


def broken_promises(
    driver: Driver,
    robot: RobotSpec,
    *,
    commands: Callable[[], int] | None = None,
    clock: Clock | None = None,
) -> list[str]:
    """Use a driver as a run does: connect, read, hold, damp, leave.

    The joints are held where they are for 0.2 s and then damped. Let a simulated robot be at the
    other end of the bus.

    Args:
        driver: Not yet connected.
        robot: The robot that it was made for.
        commands: Number of commands that the simulated robot has received so far. With it the
            promises to send nothing are tested too.
        clock: That of the states; default: the machine's.

    Returns:
        What the driver does not keep, a sentence each; empty if it keeps all. What comes after an
        exception is not tested.
    """
    trial = _Trial(driver, robot, commands, clock or MonotonicClock())
    broken: list[str] = []
    for stage in (
        trial.before_connecting,
        trial.connecting,
        trial.reading,
        trial.holding,
        trial.damping,
        trial.watchdog,
        trial.leaving,
    ):
        try:
            broken += stage()
        except Exception as error:
            broken.append(f"{stage.__name__}: {trial.doing} raised {error!r}")
            break
    try:
        driver.close()
    except Exception as error:
        broken.append(f"close raised {error!r}; it must never raise")
    return list(dict.fromkeys(broken))


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
        clock: Clock,
    ) -> None:
        """Arguments as of broken_promises."""
        self.doing = ""
        self._driver = driver
        self._robot = robot
        self._commands = commands
        self._clock = clock

    def before_connecting(self) -> Iterator[str]:
        """Members, joints, and leaving without having been there."""
        driver = self._driver
        self.doing = "an attribute"
        if missing := missing_members(driver):
            raise AttributeError(f"it lacks {', '.join(missing)}")
        if not driver.address:
            yield "address is empty; it names the robot that one controller at a time may have"
        if driver.joint_names != self._robot.joint_names:
            yield "joint_names are not robot.joint_names, in the same order"
        if not driver.commanded:
            yield "commanded is empty"
        if unknown := set(driver.commanded) - set(driver.joint_names):
            yield f"commanded has {', '.join(sorted(unknown))}, not in joint_names"
        if driver.at_end not in get_args(EndAction):
            yield f"at_end is {driver.at_end!r}, none of {', '.join(get_args(EndAction))}"
        if driver.at_stop not in ("damps", "lowers"):
            yield f"at_stop is {driver.at_stop!r}, neither 'damps' nor 'lowers'"
        self.doing = "close before connect"
        driver.close(hold=True)

    def connecting(self) -> Iterator[str]:
        """What a connected driver says of its robot."""
        driver = self._driver
        n = len(self._robot.joint_names)
        yield from self._silent("connect", driver.connect)
        self.doing = "an attribute after connect"
        for name in ("kp", "kd"):
            gains = np.asarray(getattr(driver, name), float)
            if gains.shape != (n,) or not np.isfinite(gains).all() or (gains < 0).any():
                yield f"{name} is not {n} finite numbers that are 0 or more"
        if driver.qpos_range is not None and np.shape(driver.qpos_range) != (n, 2):
            yield f"qpos_range has shape {np.shape(driver.qpos_range)} instead of ({n}, 2)"
        try:
            json.dumps(driver.facts)
        except TypeError as error:
            yield f"facts cannot be stored as JSON: {error}"

    def reading(self) -> Iterator[str]:
        """States: shapes, units as far as they can be told, and times."""
        durations = []
        states: list[State] = []
        for _ in range(PERIODS):
            began = time.monotonic()
            yield from self._silent("read", lambda: states.append(self._driver.read()))
            durations.append(time.monotonic() - began)
            yield from self._problems_of(states[-1])
            self._wait()
        if np.median(durations) > MAX_READ_S:
            yield (
                f"read takes {1e3 * np.median(durations):.0f} ms; it must not wait for the robot"
            )
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
        ctrl = found.copy()
        commanded = self._robot.index(driver.commanded)
        others = np.setdiff1d(np.arange(len(ctrl)), commanded)
        ctrl[others] = np.nan  # these entries are ignored
        sent = ctrl.copy()
        for _ in range(PERIODS):
            self.doing = "write"
            driver.write(ctrl)
            self._wait()
            self.doing = "read"
            state = driver.read()
        if not np.array_equal(ctrl, sent, equal_nan=True):
            yield "write changes the array that it is given"
        if state.fault is not None:
            yield f"a robot that is held has the fault {state.fault.kind}: {state.fault.text}"
        moved = np.abs(state.qpos - found)[commanded]
        if not moved.max() <= MAX_MOTION_RAD:
            joint = driver.commanded[int(np.argmax(moved))]
            yield f"{joint} moved by {moved.max():.2f} rad while it was told to stay"
        self.doing = "verify"
        if fault := driver.verify():
            yield f"verify reports {fault.text}"

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

    def _silent(self, words: str, call: Callable[[], object]) -> Iterator[str]:
        """Call what must send nothing."""
        self.doing = words
        before = self._commands() if self._commands else 0
        call()
        if self._commands and self._commands() != before:
            yield f"{words} sends a command"

    def _wait(self) -> None:
        self._clock.wait_until(self._clock.now() + PERIOD_S)

    def _problems_of(self, state: State) -> Iterator[str]:
        n = len(self._robot.joint_names)
        for name in STATE_ARRAYS:
            values: Array = np.asarray(getattr(state, name), float)
            if values.shape != (n,):
                yield f"{name} of a state has shape {values.shape} instead of ({n},)"
            elif name in ("qpos", "qvel") and not np.isfinite(values).all():
                yield f"{name} of a state is not finite"
        age = self._clock.now() - state.time
        if age < -ROUNDING_S:
            yield "a state is from the future: its time is not that of the clock"
        elif age > MAX_AGE_S:
            yield f"a state is {age:.1f} s old"
        if state.fault is not None:
            yield f"a state has the fault {state.fault.kind}: {state.fault.text}"
