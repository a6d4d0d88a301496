"""State machine of a run on a robot, as one table, and the durations of its phases."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum

from gaponet.base.errors import UsageError


class Phase(StrEnum):
    """State of a controller."""

    CONNECT = "connect"
    IDLE = "idle"
    BLEND_IN = "blend_in"
    RUN = "run"
    BLEND_OUT = "blend_out"
    RELEASE = "release"
    DAMP = "damp"
    STOPPED = "stopped"


class Trigger(Enum):
    """Event of the state machine, with its meaning."""

    CONSENT = (
        "the robot has answered, and `on_connect` (which shows the plan and asks) did not refuse"
    )
    READY = "five good states in a row, a first target, a clear way to it"
    ARRIVED = "at the first target and settled; weight 1"
    RETURN = "the motion is over, and the robot is to go back"
    HAND_OVER = "the run is over without fault, on rt/arm_sdk"
    HOLD = "the run is over without fault, on an SO-101"
    DAMP = "the run is over without fault, on rt/lowcmd"
    RELEASED = "weight 0 was sent"
    DAMPED = "the time for damping (`--damp`) is over"
    FAULT = "any fault, key, signal or call, after the first command"
    FAULT_BEFORE_COMMAND = "any fault, key, signal or call, before the first command"
    FAULT_AFTER_WATCHDOG = (
        "any fault, key, signal or call, after the watchdog began to damp the robot"
    )


class Action(Enum):
    """Action of a controller in a transition and until the next one."""

    READ = "read states; send nothing"
    BLEND_IN = (
        "send positions, from the measured one to the first target; weight 0 → 1 on rt/arm_sdk"
    )
    PLAY = "send the positions of the motion, corrected where a model is given"
    GO_BACK = "send positions, back to where the robot was at the start"
    RELEASE = "send the last position; weight 1 → 0"
    DAMP = (
        "send no position: stiffness 0, damping gains (H1-2); torque limits to 0, then torque off "
        "(SO-101)"
    )
    HOLD = "send nothing; servos hold the last position"
    SEND_NOTHING = "send nothing"
    CONFIRM = "send nothing; report what the robot itself says"
    IGNORE = "none"
    RAISE = "raise an error of this program, which then is a fault"


MOVING = (Phase.BLEND_IN, Phase.RUN, Phase.BLEND_OUT)
COMMANDING = (*MOVING, Phase.RELEASE)
ENDED = (Phase.DAMP, Phase.STOPPED)
_WAITING = (Phase.CONNECT, Phase.IDLE)
_FAULTS = (
    Trigger.FAULT,
    Trigger.FAULT_BEFORE_COMMAND,
    Trigger.FAULT_AFTER_WATCHDOG,
)

# Phases, triggers, next phase (None: the same one), action. Earlier rows take precedence.
TRANSITIONS: tuple[tuple[tuple[Phase, ...], tuple[Trigger, ...], Phase | None, Action], ...] = (
    ((Phase.CONNECT,), (Trigger.CONSENT,), Phase.IDLE, Action.READ),
    ((Phase.IDLE,), (Trigger.READY,), Phase.BLEND_IN, Action.BLEND_IN),
    ((Phase.BLEND_IN,), (Trigger.ARRIVED,), Phase.RUN, Action.PLAY),
    ((Phase.RUN,), (Trigger.RETURN,), Phase.BLEND_OUT, Action.GO_BACK),
    ((Phase.RUN, Phase.BLEND_OUT), (Trigger.HAND_OVER,), Phase.RELEASE, Action.RELEASE),
    ((Phase.RUN, Phase.BLEND_OUT), (Trigger.HOLD,), Phase.STOPPED, Action.HOLD),
    ((Phase.RUN, Phase.BLEND_OUT), (Trigger.DAMP,), Phase.DAMP, Action.DAMP),
    ((Phase.RELEASE,), (Trigger.RELEASED,), Phase.STOPPED, Action.SEND_NOTHING),
    (COMMANDING, (Trigger.FAULT,), Phase.DAMP, Action.DAMP),
    (
        COMMANDING,
        (Trigger.FAULT_BEFORE_COMMAND, Trigger.FAULT_AFTER_WATCHDOG),
        Phase.STOPPED,
        Action.SEND_NOTHING,
    ),
    (_WAITING, _FAULTS, Phase.STOPPED, Action.SEND_NOTHING),
    ((Phase.DAMP,), (Trigger.DAMPED,), Phase.STOPPED, Action.CONFIRM),
    (ENDED, tuple(Trigger), None, Action.IGNORE),
    ((*_WAITING, *COMMANDING), tuple(Trigger), None, Action.RAISE),
)


def _transition_table() -> dict[tuple[Phase, Trigger], tuple[Phase, Action]]:
    """Return phase, trigger → next phase, action; the first row of TRANSITIONS that fits counts."""
    table: dict[tuple[Phase, Trigger], tuple[Phase, Action]] = {}
    for phases, triggers, next_phase, action in TRANSITIONS:
        for phase in phases:
            for trigger in triggers:
                table.setdefault((phase, trigger), (next_phase or phase, action))
    return table


TRANSITION_TABLE = _transition_table()


class PhaseMachine:
    """The state machine of one run.

    Attributes:
        phase: The present phase.
        begun: Its first period.
    """

    def __init__(self) -> None:
        self.phase = Phase.CONNECT
        self.begun = 0

    def fire(self, trigger: Trigger, period: int) -> Action:
        """Make the transition of an event, and return its action.

        Raises:
            AssertionError: The event cannot happen in this phase.
        """
        phase, action = TRANSITION_TABLE[self.phase, trigger]
        if action is Action.RAISE:
            raise AssertionError(f"{trigger.name} in phase {self.phase}")
        if action is not Action.IGNORE:
            self.phase = phase
            self.begun = period
        return action


@dataclass(frozen=True)
class ControlConfig:
    """Timing of a controller."""

    rate: float = 50.0
    """Control periods per second."""
    blend: float = 2.0
    """Shortest duration of the moves to the first target and back, s."""
    blend_speed: float = 0.5
    """Speed of the fastest joint in those moves, rad/s."""
    settle: float = 0.5
    """How long the robot stands still at the first target before the run, s."""
    blend_out: bool = True
    """After the run the robot goes back to where it was at the start. With --no-blend-out it stays
    where the run ends. A fault never waits for the way back."""
    damp: float = 2.0
    """How long the robot is damped after a fault, or hands its arms back after a run, before it is
    let go, s."""

    def __post_init__(self) -> None:
        if not 1 <= self.rate <= 1000:
            raise UsageError(f"rate is {self.rate} Hz; give 1 to 1000")
        for name in ("blend", "blend_speed", "damp", "settle"):
            if not (0 < getattr(self, name) < 1e6 or (name == "settle" and not self.settle)):
                raise UsageError(f"{name} is {getattr(self, name)}; give a positive number")
