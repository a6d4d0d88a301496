"""Whether the servos of an SO-101 do what they are told, and are told by this program alone."""

from __future__ import annotations

from collections import Counter, deque

from gaponet.hw.control.driver import Fault
from gaponet.hw.drivers import feetech as reg

SETTINGS_INTERVAL_S = 1.0  # in which the settings of all servos are read again, one after the other
MAX_MISMATCHES = 3  # readings in a row that differ from what was sent: packets get lost
# sent last; a servo that misses packets holds one of them, or that before the run
REMEMBERED_GOALS = 64
FOREIGN_WINDOW_S = 1.0  # in which signs of another program are counted
MAX_FOREIGN_SIGNS = 2  # one may be noise on the cable
GAINS = {
    "p": reg.P,
    "i": reg.I,
    "d": reg.D,
    "max_torque": reg.MAX_TORQUE,
    "protection_current": reg.PROTECTION_CURRENT,
    "mode": reg.MODE,
}
CALIBRATION = {
    "homing_offset": reg.HOMING_OFFSET,
    "range_min": reg.MIN_POSITION,
    "range_max": reg.MAX_POSITION,
}
LIMITS = {
    "acceleration": reg.ACCELERATION,
    "goal_velocity": reg.GOAL_VELOCITY,
    "torque_limit": reg.TORQUE_LIMIT,
}


class Goals:
    """Goals that were sent to the servos.

    Attributes:
        in_force: Servo → goal, steps; None: nothing was commanded, or the arm was let go.
        torque_on: Servos that have reported that their torque is on.
    """

    def __init__(self, found: set[int]) -> None:
        """
        Args:
            found: Goals that the servos held when they were found, steps.
        """
        self.in_force: dict[int, int] | None = None
        self.torque_on: set[int] = set()
        self._found = found
        self._sent: deque[set[int]] = deque(maxlen=REMEMBERED_GOALS)

    def send(self, goals: dict[int, int]) -> None:
        """Note goals that were sent."""
        self.in_force = goals
        self._sent.append(set(goals.values()))

    def let_go(self) -> None:
        """Note that the arm is lowered: no goal is in force, and torques go off."""
        self.in_force = None
        self.torque_on = set()

    def are_ours(self, goal: int) -> bool:
        """Return True if a goal was in a servo before the run, or was sent to any servo lately."""
        return goal in self._found or any(goal in goals for goals in self._sent)


class Settings:
    """Settings of the servos at the start of a run.

    Attributes:
        stored: Servo → gains and calibration, by name.
    """

    def __init__(self, stored: dict[int, dict[str, int]]) -> None:
        self.stored = stored
        self._servos = list(stored)
        self._index = 0  # servo that was read last
        self._time = 0.0  # when it was read, s

    def changes(
        self, bus: reg.ServoBus, servos: list[int], retries: int = reg.RETRIES
    ) -> list[tuple[int, str]]:
        """Read servos again, and return what has changed in which.

        A servo that does not answer has changed nothing.
        """
        wrong = []
        for servo, data in bus.sync_read(servos, reg.SETTINGS, retries).items():
            for name, value in settings_in(data).items():
                before = self.stored[servo][name]
                if value != before:
                    what = f"its {name.replace('_', ' ')} went from {before} to {value}"
                    wrong.append((servo, what))
        return wrong

    def next_changes(self, bus: reg.ServoBus, now: float) -> list[tuple[int, str]]:
        """Read the next servo again, if it is time for one at `now` (s)."""
        if not self._servos or now - self._time < SETTINGS_INTERVAL_S / len(self._servos):
            return []
        self._index = (self._index + 1) % len(self._servos)
        self._time = now
        return self.changes(bus, [self._servos[self._index]], retries=0)


class OtherPrograms:
    """Signs of another program that commands the servos, or speaks on the bus.

    Its goals are seen if they are in force when the servos are read: they were never sent here. Its
    requests, and the replies to them, are seen if they reach this port.
    """

    def __init__(self, port: str) -> None:
        """
        Args:
            port: Name, for the fault.
        """
        self.port = port
        self._times: list[float] = []  # of recent signs, s
        self._packets = 0  # of the bus, when they were looked at last

    def fault(
        self, bus: reg.ServoBus, blocks: dict[int, bytes], goals: Goals, now: float
    ) -> Fault | None:
        """Return a fault after several signs in a short time.

        Args:
            bus: Counts packets that nobody here has asked for.
            blocks: Registers of each servo.
            goals: That were sent.
            now: s.
        """
        signs = bus.foreign - self._packets
        self._packets = bus.foreign
        what = "packets came that nobody here has asked for"
        for servo, block in blocks.items():
            goal = reg.GOAL_POSITION.value_in(reg.RUNNING, block)
            is_on = reg.TORQUE_ENABLE.value_in(reg.RUNNING, block)
            if goals.in_force is not None and is_on and not goals.are_ours(goal):
                signs += 1
                what = f"servo {servo} holds the goal {goal}, which was never sent here"
        recent = [time_s for time_s in self._times if now - time_s <= FOREIGN_WINDOW_S]
        self._times = recent + [now] * signs
        if not signs or len(self._times) < MAX_FOREIGN_SIGNS:
            return None
        return Fault("source", f"another program is on {self.port}: {what}; end it")


class Obedience:
    """Compares what the servos say with what they were told.

    Attributes:
        goals: That were sent.
        settings: Of the start.
        fault: What was wrong first; it stays.
    """

    def __init__(
        self,
        names: dict[int, str],
        settings: Settings,
        limits: dict[str, list[int]],
        goals: Goals,
        others: OtherPrograms,
    ) -> None:
        """
        Args:
            names: Servo → joint.
            settings: Of the start.
            limits: LIMITS at the start, by name; one of each servo.
            goals: Goals that the servos held when they were found.
            others: Looks for other programs.
        """
        self.goals = goals
        self.settings = settings
        self.fault: Fault | None = None
        self._names = names
        self._limits = limits
        self._others = others
        self._mismatches: Counter[tuple[str, int]] = Counter()

    def check(self, bus: reg.ServoBus, blocks: dict[int, bytes], now: float) -> None:
        """Look at the registers of all servos, and read the settings of one at times.

        Args:
            bus: For the settings.
            blocks: Registers of each servo.
            now: s.
        """
        if self.fault is None:
            self.fault = (
                self._others.fault(bus, blocks, self.goals, now)
                or self._said("goal", self._wrong_goals(blocks))
                or self._said("obedience", self._wrong_in(blocks))
                or self._said("obedience", self.settings.next_changes(bus, now))
            )

    def check_settings(self, bus: reg.ServoBus) -> None:
        """Read the settings of all servos again."""
        if self.fault is None:
            changes = self.settings.changes(bus, list(self._names))
            self.fault = self._said("obedience", changes)

    def _wrong_goals(self, blocks: dict[int, bytes]) -> list[tuple[int, str]]:
        """Return servos with torque that hold another goal than the one that they were told.

        Nothing is known of the way to that goal: it may be another servo's, or of an earlier run.
        """
        wrong: list[tuple[int, str]] = []
        for servo, sent in (self.goals.in_force or {}).items():
            goal = reg.GOAL_POSITION.value_in(reg.RUNNING, blocks[servo])
            is_on = reg.TORQUE_ENABLE.value_in(reg.RUNNING, blocks[servo])
            if goal == sent:
                self._mismatches["goal", servo] = 0
            elif is_on and self._mismatch("goal", servo):
                wrong.append((servo, f"it holds the goal {goal}, not {sent} as it was told"))
        return wrong

    def _wrong_in(self, blocks: dict[int, bytes]) -> list[tuple[int, str]]:
        """Return servos whose torque is off, or whose limits are not those that were found."""
        wrong: list[tuple[int, str]] = []
        for i, servo in enumerate(self._names):
            block = blocks[servo]  # replies that were asked for again come last
            if self.goals.in_force is not None and self._lost_torque(servo, block):
                what = "its torque is off, though it was switched on: it has reset itself"
                wrong.append((servo, what))
            for name, register in LIMITS.items():
                if name == "torque_limit" and self.goals.in_force is None:
                    continue  # it may change until the first goal is sent
                before = self._limits[name][i]
                now = register.value_in(reg.RUNNING, block)
                if now != before:
                    what = f"its {name.replace('_', ' ')} went from {before} to {now}"
                    wrong.append((servo, what))
        return wrong

    def _lost_torque(self, servo: int, block: bytes) -> bool:
        """Return True if the torque of a servo is off, but was on, or does not come on."""
        if reg.TORQUE_ENABLE.value_in(reg.RUNNING, block):
            self.goals.torque_on.add(servo)
            return False
        return servo in self.goals.torque_on or self._mismatch("torque", servo)

    def _mismatch(self, what: str, servo: int) -> bool:
        """Count a reading that differs from what was sent.

        Return True after more than lost packets can explain.
        """
        self._mismatches[what, servo] += 1
        return self._mismatches[what, servo] >= MAX_MISMATCHES

    def _said(self, kind: str, wrong: list[tuple[int, str]]) -> Fault | None:
        """Return the fault of servos and what is wrong with each, by joint; None if nothing is."""
        if not wrong:
            return None
        reports = "; ".join(
            f"servo {servo} ({self._names[servo]}): {what}" for servo, what in wrong
        )
        return Fault(kind, f"{reports}; look at supply and cables")


def settings_in(block: bytes) -> dict[str, int]:
    """Return gains and calibration in the registers of a servo."""
    registers = GAINS | CALIBRATION
    return {name: register.value_in(reg.SETTINGS, block) for name, register in registers.items()}
